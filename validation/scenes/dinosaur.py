"""The dinosaur on its turntable (Oxford Visual Geometry Group): tracks, published cameras, pairs of views."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.verification import PairVerification, homography_inlier_ratio
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline.run import stream
from thesisrecon.records import Tracks, TwoView
from validation.scenes.real import data_root

SIZE = (720, 576)
MIN_COMMON = 16


class Dinosaur(NamedTuple):
    """The tracks, published cameras ``P`` (36, 3, 4) up to a projective transform, ``sizes`` (36, 2)."""

    tracks: Tracks
    P: F64
    sizes: I64


def load_dinosaur() -> Dinosaur | None:
    """The set, or None if it is not on this machine."""
    root = data_root()
    if root is None or not (root / "dinosaur").is_dir():
        return None
    xy = np.loadtxt(root / "dinosaur" / "tracks.txt")
    P = np.loadtxt(root / "dinosaur" / "projections.txt").reshape(-1, 3, 4)
    xy = xy.reshape(len(xy), len(P), 2)
    point, view = np.nonzero((xy >= 0).all(axis=2))
    tracks = Tracks(view.astype(np.int64), point.astype(np.int64), xy[point, view], len(P), len(xy))
    return Dinosaur(tracks, P, np.tile(np.array(SIZE, dtype=np.int64), (len(P), 1)))


def pairs_from_tracks(tracks: Tracks, *, seed: int = 0) -> list[TwoView]:
    """The pairs of views with ``MIN_COMMON`` points in common, their F estimated and verified as matches are.
    Degeneracy of F is not tested.
    """
    table = np.full((tracks.n_views, tracks.n_points), -1)
    table[tracks.view_index, tracks.point_index] = np.arange(len(tracks.xy))
    pairs = []
    for i in range(tracks.n_views):
        for j in range(i + 1, tracks.n_views):
            both = np.flatnonzero((table[i] >= 0) & (table[j] >= 0))
            if len(both) >= MIN_COMMON:
                xy1, xy2 = tracks.xy[table[i, both]], tracks.xy[table[j, both]]
                pair = _verified(i, j, both, (xy1, xy2), stream(seed, "matches", i, j))
                pairs += [pair] if pair is not None else []
    return pairs


def _verified(i: int, j: int, points: I64, xy: tuple[F64, F64], rng: np.random.Generator) -> TwoView | None:
    try:
        fit = LocallyOptimisedRansac().estimate(*xy, rng)
    except StageFailure:
        return None
    kept, needed = fit.inliers, PairVerification().min_inliers
    xy1, xy2 = xy[0][kept], xy[1][kept]
    share = homography_inlier_ratio(fit.F, xy1, xy2, tolerance_px=max(2.0, 4.3 * fit.sigma_px), rng=rng)
    enough = len(xy1) >= needed
    return TwoView(
        i, j, fit.F, fit.sigma_px, points[kept], points[kept], xy1, xy2,
        np.tile(np.eye(2), (len(xy1), 1, 1)), len(kept), share, enough,
        "" if enough else f"only {len(xy1)} of {len(kept)} matches agree; {needed} are needed",
    )  # fmt: skip

"""Selection of tracks and of the initial image pair (6.2): parallax, length, spread over every image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse

from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.conditioning import pixel_from_unit
from thesisrecon.geometry.two_view import canonical_cameras, quasi_euclidean_planes
from thesisrecon.optimize.triangulation import triangulate_points
from thesisrecon.records import Reconstruction, Tracks, TwoView

# Homography inlier ratio beyond which a pair shows no parallax: the rest may be undetected wrong matches.
NO_PARALLAX = 0.95
_NO_PARALLAX_REASONS = {
    "pure rotation": "the camera only rotated about its centre (pure rotation)",
    "plane": (
        "all matches lie on one plane (planar scene), the camera hardly moved, or it rotated about its "
        "centre while zooming (pure rotation)"
    ),
}


def rank_initial_pairs(tracks: Tracks, pairs: Sequence[TwoView]) -> list[TwoView]:
    """Rank the accepted pairs as initial pairs, best first (6.2).

    The score is the number of shared points (those seen in a third view count twice) times the share that no
    homography explains; pairs whose matches leave F undetermined count a tenth. If one initial pair fails,
    another one with the same view would probably fail too: each use of a view halves the score of its pairs.
    """
    table = np.zeros((tracks.n_views, tracks.n_points), dtype=bool)
    table[tracks.view_index, tracks.point_index] = True
    long = table.sum(axis=0) >= 3

    def score(pair: TwoView) -> float:
        both = table[pair.i] & table[pair.j]
        shared = float(both.sum() + (both & long).sum())
        return shared * (1.0 - pair.homography_inlier_ratio) * (0.1 if pair.undetermined else 1.0)

    left = sorted((pair for pair in pairs if pair.accepted), key=lambda pair: (pair.i, pair.j))
    scores = np.array([score(pair) for pair in left])
    views = np.array([(pair.i, pair.j) for pair in left]).reshape(-1, 2)
    uses, ranked = np.zeros(tracks.n_views), []
    for _ in range(len(left)):
        discounted = np.where(scores >= 0.0, scores * 0.5 ** uses[views].sum(axis=1), -1.0)
        best = int(np.argmax(discounted))
        ranked.append(left[best])
        uses[views[best]] += 1
        scores[best] = -1.0
    return ranked


def select_core(pairs: Sequence[TwoView], n_views: int, size: int) -> B8:
    """Select ``size`` well-connected views (V,): a view of the best pair, then always the best connected.

    The connection of two views is the number of their matches that no homography explains, which is large
    only with many matches and a baseline.
    """
    tie = np.zeros((n_views, n_views))
    for pair in pairs:
        if pair.accepted:
            tie[pair.i, pair.j] = tie[pair.j, pair.i] = pair.inliers * (1.0 - pair.homography_inlier_ratio)
    core = np.zeros(n_views, dtype=bool)
    core[int(tie.max(axis=1).argmax())] = True
    for _ in range(size - 1):
        gain = np.where(core, -1.0, tie[core].sum(axis=0))
        core[int(np.argmax(gain))] |= gain.max() > 0.0
    return core


def require_pair_with_parallax(pairs: Sequence[TwoView]) -> None:
    """Raise ``StageFailure`` if every accepted pair is planar, a pure rotation or nearly a homography."""
    accepted = [pair for pair in pairs if pair.accepted]
    if not accepted:
        return
    shares = [pair.homography_inlier_ratio for pair in accepted]
    kinds = Counter(pair.configuration for pair in accepted)
    if min(shares) >= NO_PARALLAX or all(kind in _NO_PARALLAX_REASONS for kind in kinds):
        meaning = _NO_PARALLAX_REASONS.get(
            kinds.most_common(1)[0][0], "the camera only rotates, hardly moves, or sees one plane"
        )
        raise StageFailure(
            f"the images show no parallax: {meaning}",
            f"in the least planar of {counted(len(shares), 'pair')} a homography explains "
            f"{min(shares):.0%} of the matches",
            "walk around the scene between images, and include objects at different depths",
        )


def initial_cameras(pair: TwoView, sizes: I64) -> tuple[F64, F64]:
    """Compute initial cameras (3.42): P1 = [I | 0], P2 = [[e]x F + e pi' | e], in pixels (HZ 9.5).

    The plane pi is chosen in unit-free pixels so that the left part of P2 is nearest to a rotation: the frame
    is then nearly metric with a focal length of one long side. Of the two such planes the one with fewer
    points beyond it is taken, and the sign of P2 that places most points in front of both cameras.
    """
    T1, T2 = pixel_from_unit(sizes)
    F = T2.T @ pair.F @ T1
    best, most = None, -1.0
    for plane in quasi_euclidean_planes(F):
        P1, P2 = canonical_cameras(F, plane=plane)
        P = np.stack([T1 @ P1, T2 @ P2])
        X = triangulate_points(P, np.stack([pair.xy1, pair.xy2]), method="linear")
        first, second = np.sign(X @ P[0, 2]), np.sign(X @ P[1, 2])
        side = 1.0 if np.sum(first * second) >= 0 else -1.0
        here = abs(float(np.sum(first * np.sign(X[:, 3]))))
        if here > most:
            best, most = (P[0], side * P[1]), here
    assert best is not None
    return best


# Cells of the grid over an image, along each side.
_CELLS = 8


def select_tracks_with_parallax(tracks: Tracks, pairs: Sequence[TwoView]) -> B8:
    """Select tracks (N,) seen from several positions; undetermined depths of others distort the frame."""
    n, K = tracks.n_views, len(tracks.xy)
    i, j = np.array(
        [(p.i, p.j) for p in pairs if p.accepted and p.homography_inlier_ratio >= NO_PARALLAX], dtype=np.int64
    ).reshape(-1, 2).T  # fmt: skip
    rows, columns = np.concatenate([i, j, np.arange(n)]), np.concatenate([j, i, np.arange(n)])
    near = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), (n, n))
    seen = scipy.sparse.csr_array((np.ones(K), (tracks.view_index, tracks.point_index)), (n, tracks.n_points))
    # Ordered pairs of the views of a track, less those without parallax.
    return np.asarray(seen.sum(axis=0) ** 2 > (near @ seen).multiply(seen).sum(axis=0))


def select_tracks(tracks: Tracks, usable: B8, *, points_per_view: int) -> B8:
    """Select the longest ``usable`` tracks (N,), cell by cell of a grid over the points of each image."""
    length = np.bincount(tracks.point_index, minlength=tracks.n_points)
    keep = np.zeros(tracks.n_points, dtype=bool)
    for rows in rows_of_views(tracks.view_index, tracks.n_views):
        k = rows[usable[tracks.point_index[rows]]]
        keep[tracks.point_index[k][_by_cell_and_length(tracks, k, length)[:points_per_view]]] = True
    return keep


def _by_cell_and_length(tracks: Tracks, k: I64, length: I64) -> I64:
    """Return the order of the observations k: one of each cell in turn, longest tracks first."""
    if len(k) == 0:
        return k
    xy = tracks.xy[k]
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell = np.minimum((xy - low) / np.maximum(high - low, 1e-9) * _CELLS, _CELLS - 1).astype(np.int64)
    cell_number = cell[:, 0] * _CELLS + cell[:, 1]
    by_length = np.lexsort((k, -length[tracks.point_index[k]], cell_number))
    sorted_cells = cell_number[by_length]
    start = np.searchsorted(sorted_cells, sorted_cells)
    rank = np.arange(len(k)) - start
    return by_length[np.lexsort((by_length, -length[tracks.point_index[k]][by_length], rank))]


def observation_cells(tracks: Tracks) -> I64:
    """Return the grid cell (K,) of each observation in the extent of its view, consecutive over all views."""
    low, high = np.full((2, tracks.n_views, 2), np.inf)
    np.minimum.at(low, tracks.view_index, tracks.xy)
    np.minimum.at(high, tracks.view_index, -tracks.xy)
    view, extent = tracks.view_index, np.maximum(-high - low, 1e-9)
    cell = np.minimum((tracks.xy - low[view]) / extent[view] * _CELLS, _CELLS - 1).astype(np.int64)
    return np.asarray((view * _CELLS + cell[:, 0]) * _CELLS + cell[:, 1], dtype=np.int64)


def coverage_of_views(cell: I64, chosen: B8, n_views: int) -> F64:
    """Return the coverage (V,) of each view: the sum over its cells of the root of chosen observations."""
    counts = np.bincount(cell[chosen], minlength=n_views * _CELLS**2).reshape(n_views, -1)
    return np.asarray(np.sqrt(counts).sum(axis=1))


def working_tracks(tracks: Tracks, pairs: Sequence[TwoView], *, points_per_view: int) -> tuple[Tracks, B8]:
    """Return the selected tracks with parallax, renumbered in the same order, and which (N,) they are."""
    usable = select_tracks_with_parallax(tracks, pairs)
    keep = select_tracks(tracks, usable, points_per_view=points_per_view)
    chosen = keep[tracks.point_index]
    point = (np.cumsum(keep) - 1)[tracks.point_index[chosen]]
    return Tracks(tracks.view_index[chosen], point, tracks.xy[chosen], tracks.n_views, int(keep.sum())), keep


def tracks_of_views(tracks: Tracks, views: B8) -> Tracks:
    """Return the observations of some views (V,); views and points keep their numbers."""
    k = np.flatnonzero(views[tracks.view_index])
    return replace(
        tracks, view_index=tracks.view_index[k], point_index=tracks.point_index[k], xy=tracks.xy[k]
    )


def expand_to_all_tracks(
    reconstruction: Reconstruction, tracks: Tracks, keep: B8, views: B8 | None = None
) -> Reconstruction:
    """Express the reconstruction of :func:`working_tracks`, all or of ``views``, in the numbers of all."""
    X = np.zeros((tracks.n_points, 4))
    X[keep] = reconstruction.X
    valid = np.zeros(tracks.n_points, dtype=bool)
    valid[keep] = reconstruction.valid
    inlier = np.zeros(len(tracks.xy), dtype=bool)
    chosen = keep[tracks.point_index]
    inlier[chosen if views is None else chosen & views[tracks.view_index]] = reconstruction.inlier
    return replace(reconstruction, X=X, valid=valid, inlier=inlier, tracks=tracks)

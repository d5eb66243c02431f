"""Factorisation beside the incremental way: ``python -m validation.studies.factorization [-o OUT]``.

Synthetic: how far a core of views is from the truth after each beginning of chapter 6, before and after
bundle adjustment, by noise. Real photographs (matched once, kept in OUT): cameras, residuals and time of both
whole ways. The exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.config import ProjectiveReconstructor
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.strata import random_transform
from thesisrecon.numerics.projective_bundle import refine_projective_bundle
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.projective.factorization import Factorization, depths_from_fundamentals, factorize
from thesisrecon.projective.incremental import GatedIncremental
from thesisrecon.records import Reconstruction, Tracks, TwoView
from validation.metrics.record import Metric, markdown_table
from validation.scenes.cloud import make_cloud
from validation.scenes.dinosaur import pairs_from_tracks
from validation.scenes.real import Scene, load_fixture_scene, load_real_scene
from validation.scenes.rigs import Rig, noisy_tracks

PLAIN, ITERATED, AFFINE, GROWN = (
    "Sturm-Triggs",
    "iterated",
    "iterated from equal depths",
    "pair and resection",
)
NOISES_PX = (0.0, 0.5, 1.0, 2.0)
VIEWS, POINTS = 6, 150
BUNDLE_STEPS = 100
OUTLIER_PX = 50.0
"""Distances count no more than this."""
RMS_TOLERANCE = 1.01
SCENES = ("fountain-P11", "Herz-Jesus-P8", "courtyard")
WAYS: dict[str, ProjectiveReconstructor] = {
    "incremental": GatedIncremental(),
    "factorization": Factorization(),
}


@dataclass(frozen=True)
class Start:
    """Cameras (V, 3, 4) and points (N, 4) that a bundle adjustment of xy (V, N, 2) begins with."""

    P: F64
    X: F64

    def rms_px(self, xy: F64) -> float:
        """Root of the mean squared distance of the projections."""
        xh = np.einsum("vab,nb->vna", self.P, self.X)
        distance = np.linalg.norm(xh[..., :2] / xh[..., 2:] - xy, axis=2)
        return float(np.sqrt(np.mean(np.minimum(np.nan_to_num(distance, nan=np.inf), OUTLIER_PX) ** 2)))


def complete_rig(rng: np.random.Generator) -> Rig:
    """Six views of a cloud that all see every point."""
    rig = make_cloud(VIEWS, rng, points=POINTS)
    return replace(rig, seen=np.ones_like(rig.seen))


def starts(tracks: Tracks, xy: F64, sizes: NDArray[np.int64], seed: int) -> dict[str, Start]:
    """What each way begins a bundle adjustment with; fundamental matrices are estimated from the matches."""
    pairs = pairs_from_tracks(tracks, seed=seed)
    depths = depths_from_fundamentals(xy, {(p.i, p.j): p.F for p in pairs}, [(0, k) for k in range(1, VIEWS)])
    tables = {
        PLAIN: factorize(xy, depths),
        ITERATED: factorize(xy, depths, iterations=50),
        AFFINE: factorize(xy, iterations=200),
    }
    found = {name: Start(factors.P, factors.X) for name, factors in tables.items()}
    return found | {GROWN: grown(tracks, pairs, sizes, seed)}


def grown(tracks: Tracks, pairs: Sequence[TwoView], sizes: NDArray[np.int64], seed: int) -> Start:
    """The incremental way without any bundle adjustment, gate or discarding."""
    growth = GatedIncremental(
        bundle_iterations=0, final_rounds=0, max_spread=None, restarts=1, outlier_sigmas=(1e3, 1e3)
    )
    found = growth.reconstruct(tracks, pairs, sizes, rng=np.random.default_rng(seed))
    return Start(found.P, found.X)


def projective_error_pct(X: F64, truth: F64) -> float:
    """Median distance of points X (N, 4) from ``truth`` (N, 3), in percent of the scene's size, after the
    transform that fits best (linear least squares)."""
    rows = []
    Y = np.column_stack([truth, np.ones(len(truth))])
    for a in range(3):
        row = np.zeros((len(X), 4, 4))
        row[:, a], row[:, 3] = X, -Y[:, a : a + 1] * X
        rows.append(row.reshape(len(X), 16))
    H = np.linalg.svd(np.concatenate(rows), full_matrices=False)[2][-1].reshape(4, 4)
    apart = np.linalg.norm(dehomogenize(X @ H.T) - truth, axis=1)
    size = float(np.linalg.norm(truth - truth.mean(axis=0), axis=1).mean())
    return 100.0 * float(np.median(apart)) / size


def check_noise(sigma_px: float, trials: int) -> list[Metric]:
    """Medians over ``trials`` rigs: residual and error in space of each start, and of what the bundle makes
    of it; the share of starts from which it reaches the best minimum."""
    before, apart, after = (
        {name: list[float]() for name in (PLAIN, ITERATED, AFFINE, GROWN)} for _ in range(3)
    )
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        rig = complete_rig(rng)
        tracks = noisy_tracks(rig, sigma_px, rng)
        xy, seen = complete_table(tracks)
        sizes = np.tile(np.array(rig.size, dtype=np.int64), (VIEWS, 1))
        for name, start in starts(tracks_of(xy), xy, sizes, seed).items():
            before[name].append(start.rms_px(xy))
            apart[name].append(projective_error_pct(start.X, rig.X[seen]))
            after[name].append(adjusted_rms_px(start, xy, rng))
    best = np.min([after[name] for name in after], axis=0)
    reached = {
        name: 100.0 * float(np.mean(np.array(values) <= RMS_TOLERANCE * best + 1e-6))
        for name, values in after.items()
    }
    title = f"noise {sigma_px:g} px"
    return [
        Metric(title, "residual before the bundle, RMS", "px", _medians(before), ITERATED),
        Metric(title, "error in space before the bundle", "%", _medians(apart), ITERATED),
        Metric(title, "residual after the bundle, RMS", "px", _medians(after), ITERATED),
        Metric(title, "starts that lead to the best minimum", "%", reached, ITERATED, 99.0, at_most=False),
    ]


def complete_table(tracks: Tracks) -> tuple[F64, NDArray[np.bool_]]:
    """Images (V, N, 2) of the points that every view sees, and which they are."""
    xy = np.full((tracks.n_views, tracks.n_points, 2), np.nan)
    xy[tracks.view_index, tracks.point_index] = tracks.xy
    seen = np.isfinite(xy).all(axis=(0, 2))
    return xy[:, seen], seen


def tracks_of(xy: F64) -> Tracks:
    """The table (V, N, 2) as tracks."""
    views, points = xy.shape[:2]
    view, point = np.tile(np.arange(views), points), np.repeat(np.arange(points), views)
    return Tracks(view, point, xy[view, point], views, points)


def adjusted_rms_px(start: Start, xy: F64, rng: np.random.Generator) -> float:
    """The residual that bundle adjustment reaches, in a random frame, all points at their signs."""
    t = tracks_of(xy)
    G = random_transform("projective", rng)
    signs = np.sign(np.einsum("vb,nb->vn", start.P[:, 2], start.X))
    X = start.X * np.where(signs.sum(axis=0) < 0.0, -1.0, 1.0)[:, None]
    result = refine_projective_bundle(
        start.P @ np.linalg.inv(G), X @ G.T, t.view_index, t.point_index, t.xy,
        loss_px=10.0, max_iterations=BUNDLE_STEPS,
    )  # fmt: skip
    return float(np.sqrt(np.mean(np.sum(result.residual_px**2, axis=1))))


def _medians(values: Mapping[str, list[float]]) -> dict[str, float]:
    return {name: float(np.median(numbers)) for name, numbers in values.items()}


def load(name: str) -> Scene | None:
    """A scene of the fixtures or of the real photographs; None where it is not on this machine."""
    return load_fixture_scene(name) if name == "courtyard" else load_real_scene(name)


def check_photographs(scene: Scene, out: Path) -> list[Metric]:
    """Both whole ways on the tracks of the photographs, which are matched in ``out``."""
    run = reconstruct(list(scene.image_paths), out, until="projective", overwrite=True)
    assert run.tracks is not None
    sizes = np.array([image.size for image in run.images], dtype=np.int64)
    models: dict[str, Reconstruction] = {}
    seconds: dict[str, float] = {}
    for _ in range(2):
        # The first round compiles.
        for name, way in WAYS.items():
            begun = time.perf_counter()
            models[name] = way.reconstruct(run.tracks, run.pairs, sizes, rng=np.random.default_rng(0))
            seconds[name] = time.perf_counter() - begun
    rms = {name: residual_rms_px(model) for name, model in models.items()}
    registered = {name: float(model.registered.sum()) for name, model in models.items()}
    ours, other = "factorization", "incremental"
    inliers = {name: float(model.inlier.sum()) for name, model in models.items()}
    return [
        Metric(scene.name, "cameras", "", registered, ours, registered[other], at_most=False),
        Metric(scene.name, "residual, RMS", "px", rms, ours, RMS_TOLERANCE * rms[other]),
        Metric(scene.name, "explained observations", "", inliers, ours, 0.99 * inliers[other], at_most=False),
        Metric(scene.name, "time", "s", seconds, ours),
    ]


def residual_rms_px(model: Reconstruction) -> float:
    """Root of the mean squared distance of the explained observations."""
    t, k = model.tracks, model.inlier
    xh = np.einsum("kab,kb->ka", model.P[t.view_index[k]], model.X[t.point_index[k]])
    return float(np.sqrt(np.mean(np.sum((xh[:, :2] / xh[:, 2:] - t.xy[k]) ** 2, axis=1))))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, help="where matches are kept")
    parser.add_argument("--trials", type=int, default=30, help="rigs per noise")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=SCENES)
    options = parser.parse_args(arguments)
    tables = [check_noise(sigma_px, options.trials) for sigma_px in NOISES_PX]
    with tempfile.TemporaryDirectory() as folder:
        for name in options.scenes:
            scene = load(name)
            if scene is not None:
                tables.append(check_photographs(scene, (options.out or Path(folder)) / name))
    for table in tables:
        print(f"## {table[0].scene}", markdown_table(table), sep="\n\n", end="\n\n", flush=True)
    return int(any(row.verdict == "missed" for table in tables for row in table))


if __name__ == "__main__":
    raise SystemExit(main())

"""Chapter 6: factorisation beside incremental reconstruction.

Distance of a core of views from the truth after each start of chapter 6, before and after bundle adjustment,
by noise; cameras, residuals and time of both methods on real images (matched once in OUT).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.arrays import F64
from thesisrecon.config import ProjectiveReconstructor
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.numerics._observations import Observations
from thesisrecon.numerics._projective_bundle import refine_projective_bundle
from thesisrecon.projective.factorization import Factorization, depths_from_fundamentals, factorize
from thesisrecon.projective.incremental import IncrementalProjective
from thesisrecon.records import Reconstruction, Tracks, TwoView
from validation.runs.study import Part
from validation.runs.tables import Metric, Rows
from validation.scenes.dinosaur import pairs_from_tracks
from validation.scenes.real import Scene, scenes_here
from validation.scenes.rigs import noisy_tracks
from validation.scenes.transforms import random_transform
from validation.scenes.triangulation import beside

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
"""Distances are capped here."""
RMS_TOLERANCE = 1.01
SCENES = ("fountain-P11", "Herz-Jesus-P8", "courtyard")
WAYS: dict[str, ProjectiveReconstructor] = {
    "incremental": IncrementalProjective(),
    "factorization": Factorization(),
}


@dataclass(frozen=True)
class Start:
    """Cameras P (V, 3, 4) and points X (N, 4) that start a bundle adjustment of xy (V, N, 2)."""

    P: F64
    X: F64

    def rms_px(self, xy: F64) -> float:
        xh = np.einsum("vab,nb->vna", self.P, self.X)
        distance = np.linalg.norm(xh[..., :2] / xh[..., 2:] - xy, axis=2)
        return float(np.sqrt(np.mean(np.minimum(np.nan_to_num(distance, nan=np.inf), OUTLIER_PX) ** 2)))


def starts(tracks: Tracks, xy: F64, sizes: NDArray[np.int64], seed: int) -> dict[str, Start]:
    """Return the start of each method; fundamental matrices are estimated from the matches."""
    pairs = pairs_from_tracks(tracks, seed=seed)
    depths = depths_from_fundamentals(xy, {(p.i, p.j): p.F for p in pairs}, [(0, k) for k in range(1, VIEWS)])
    tables = {
        PLAIN: factorize(xy, depths),
        ITERATED: factorize(xy, depths, iterations=50),
        AFFINE: factorize(xy, iterations=200),
    }
    found = {name: Start(P, X) for name, (P, X, _) in tables.items()}
    return found | {GROWN: grown(tracks, pairs, sizes, seed)}


def grown(tracks: Tracks, pairs: Sequence[TwoView], sizes: NDArray[np.int64], seed: int) -> Start:
    """Run the incremental method without bundle adjustment, gates or rejection."""
    growth = IncrementalProjective(
        bundle_iterations=0,
        final_rounds=0,
        max_projection_std_rel=None,
        max_initial_pairs=1,
        outlier_sigmas=(1e3, 1e3),
    )
    found = growth.reconstruct(tracks, pairs, sizes, rng=np.random.default_rng(seed))
    return Start(found.P, found.X)


def projective_error_pct(X: F64, truth: F64) -> float:
    """Measure points X (N, 4) against ``truth`` (N, 3) after the best projective transform.

    Return the median distance in percent of the scene's size; the transform is a linear least-squares fit.
    """
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
    """Measure residual and space error of each start, and the share that reaches the best minimum."""
    before, apart, after = (
        {name: list[float]() for name in (PLAIN, ITERATED, AFFINE, GROWN)} for _ in range(3)
    )
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        rig = beside(rng, VIEWS, POINTS)
        tracks = noisy_tracks(rig, sigma_px, rng)
        xy, seen = complete_tracks(tracks)
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
    rows = Rows(f"noise {sigma_px:g} px", ITERATED)
    rows.add("residual before the bundle, RMS", _medians(before), "px")
    rows.add("error in space before the bundle", _medians(apart), "%")
    rows.add("residual after the bundle, RMS", _medians(after), "px")
    rows.add("starts that lead to the best minimum", reached, "%", at_least=99.0)
    return rows


def complete_tracks(tracks: Tracks) -> tuple[F64, NDArray[np.bool_]]:
    """Images (V, N, 2) of the points that every view sees, and which they are."""
    xy = np.full((tracks.n_views, tracks.n_points, 2), np.nan)
    xy[tracks.view_index, tracks.point_index] = tracks.xy
    seen = np.isfinite(xy).all(axis=(0, 2))
    return xy[:, seen], seen


def tracks_of(xy: F64) -> Tracks:
    views, points = xy.shape[:2]
    view, point = np.tile(np.arange(views), points), np.repeat(np.arange(points), views)
    return Tracks(view, point, xy[view, point], views, points)


def adjusted_rms_px(start: Start, xy: F64, rng: np.random.Generator) -> float:
    """Return the residual after bundle adjustment in a random frame."""
    t = tracks_of(xy)
    G = random_transform("projective", rng)
    signs = np.sign(np.einsum("vb,nb->vn", start.P[:, 2], start.X))
    X = start.X * np.where(signs.sum(axis=0) < 0.0, -1.0, 1.0)[:, None]
    result = refine_projective_bundle(
        start.P @ np.linalg.inv(G), X @ G.T, Observations(t.view_index, t.point_index, t.xy),
        loss_px=10.0, max_iterations=BUNDLE_STEPS,
    )  # fmt: skip
    return float(np.sqrt(np.mean(np.sum(result.residual_px**2, axis=1))))


def _medians(values: Mapping[str, list[float]]) -> dict[str, float]:
    return {name: float(np.median(numbers)) for name, numbers in values.items()}


def check_images(scene: Scene, out: Path) -> list[Metric]:
    """Run both methods on the tracks of real images, which are matched in ``out``."""
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
    inliers = {name: float(model.inlier.sum()) for name, model in models.items()}
    rows, other = Rows(scene.name, "factorization"), "incremental"
    rows.add("cameras", registered, at_least=registered[other])
    rows.add("residual, RMS", rms, "px", at_most=RMS_TOLERANCE * rms[other])
    rows.add("explained observations", inliers, at_least=0.99 * inliers[other])
    rows.add("time", seconds, "s")
    return rows


def residual_rms_px(model: Reconstruction) -> float:
    t, k = model.tracks, model.inlier
    xh = np.einsum("kab,kb->ka", model.P[t.view_index[k]], model.X[t.point_index[k]])
    return float(np.sqrt(np.mean(np.sum((xh[:, :2] / xh[:, 2:] - t.xy[k]) ** 2, axis=1))))


def factorization_study(out: Path, trials: int = 30, scenes: Sequence[str] = SCENES) -> Iterator[Part]:
    """Compare factorisation with incremental reconstruction, on synthetic rigs and on real images."""
    for sigma_px in NOISES_PX:
        yield check_noise(sigma_px, trials)
    for scene in scenes_here(scenes):
        yield check_images(scene, out / scene.name)

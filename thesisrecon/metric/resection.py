"""Calibrated resection of the cameras that the projective stage had to postpone (P3P in RANSAC, then
refinement).

From the certain core to all photographs: postponed cameras join, all tracks are triangulated, and a camera
that the rest contradicts is found again or refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import counted
from thesisrecon.geometry.resection import pose_from_three_points
from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import (
    K1,
    WIDTH,
    MetricModel,
    explained_shares,
    normalized_observations,
    retriangulate,
)
from thesisrecon.numerics.separate_refinement import refine_pose

# What the focal of a camera that shares none is multiplied with in turn.
ZOOMS = (1.0, 0.8, 1.25, 0.64, 1.56)


def resect_calibrated(
    X: F64, normalized: F64, *, threshold: float, rng: np.random.Generator, samples: int = 300
) -> tuple[F64, F64, B8] | None:
    """Pose R, t and inliers of a calibrated camera; X (M, 3), normalised image points (M, 2), threshold in
    their unit.

    Truncated-quadratic score over all candidates of ``samples`` three-point samples; None below four points
    or where no sample has a pose.
    """
    if len(X) < 4:
        return None
    chosen = rng.random((samples, len(X))).argpartition(2, axis=1)[:, :3]
    rays = np.column_stack([normalized, np.ones(len(X))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R, t, _ = pose_from_three_points(X[chosen], rays[chosen])
    if len(R) == 0:
        return None
    scored = rng.choice(len(X), 500, replace=False) if len(X) > 500 else np.arange(len(X))
    cost = np.minimum(_squared(R, t, X[scored], normalized[scored]) / threshold**2, 1.0).sum(axis=1)
    best = int(cost.argmin())
    return R[best], t[best], _squared(R[best : best + 1], t[best : best + 1], X, normalized)[0] < threshold**2


def _squared(R: F64, t: F64, X: F64, xy: F64) -> F64:
    Y = np.einsum("cij,mj->cmi", R, X) + t[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        squared = np.sum((Y[..., :2] / Y[..., 2:] - xy) ** 2, axis=-1)
    return np.where((Y[..., 2] > 0) & np.isfinite(squared), squared, np.inf)


def add_missing_cameras(
    model: MetricModel,
    *,
    sigmas: float,
    min_points: int,
    rng: np.random.Generator,
    allowed: B8 | None = None,
) -> tuple[MetricModel, dict[int, str]]:
    """Register by calibrated resection every view that sees enough of the model; the reasons of the others.

    A camera is taken with the intrinsics that it shares; a focal that no registered view shares is refined
    with the pose. Views are tried with most points first; ``allowed`` (V,) says which may join (all).
    """
    t = model.tracks
    counts = np.bincount(t.view_index[model.valid[t.point_index]], minlength=t.n_views)
    refused: dict[int, str] = {}
    for view in np.argsort(-counts, kind="stable"):
        if model.registered[view] or not (allowed is None or allowed[view]):
            continue
        if counts[view] < min_points:
            refused[int(view)] = (
                f"sees only {counted(counts[view], 'point')} of the model (needs {min_points}): "
                "too little overlap"
            )
            continue
        added = _add(model, int(view), sigmas, rng, min_points)
        if isinstance(added, str):
            refused[int(view)] = added
        else:
            model = added
    return model, refused


def _add(
    model: MetricModel, view: int, sigmas: float, rng: np.random.Generator, min_points: int
) -> MetricModel | str:
    t, cameras = model.tracks, model.cameras
    k = np.flatnonzero((t.view_index == view) & model.valid[t.point_index])
    row = int(cameras.group[view])
    focals = np.arange(len(cameras.intrinsics)) if cameras.shared is None else cameras.shared[:, 0]
    alone = not model.registered[focals[cameras.group] == focals[row]].any()
    found = _pose_and_focal(model, k, row, 2.0 * sigmas * model.gate_px, (ZOOMS if alone else (1.0,), rng))
    support = 0 if found is None else int(found[3].sum())
    if found is None or support < min_points or support < 0.3 * len(k):
        return f"only {support} of its {counted(len(k), 'point')} agree with one camera"
    R, translation, start, inlier = found
    pose = refine_pose(
        R, translation, start, model.X[t.point_index[k]][inlier], t.xy[k][inlier],
        free=(np.arange(len(start)) == 0) & alone, loss_px=2.0 * model.sigma_px, iterations=20,
    )  # fmt: skip
    Rs, ts, intrinsics = cameras.R.copy(), cameras.t.copy(), cameras.intrinsics.copy()
    Rs[view], ts[view], intrinsics[row] = pose.R, pose.t, pose.intrinsics
    registered = model.registered.copy()
    registered[view] = True
    return model.with_cameras(replace(cameras, R=Rs, t=ts, intrinsics=intrinsics), registered)


def _pose_and_focal(
    model: MetricModel,
    k: I64,
    row: int,
    threshold_px: float,
    tried: tuple[tuple[float, ...], np.random.Generator],
) -> tuple[F64, F64, F64, B8] | None:
    """The best supported R, t, intrinsics and inliers of observations ``k`` over zooms of the row's focal."""
    t, best = model.tracks, None
    zooms, rng = tried
    for zoom in zooms:
        table = model.cameras.intrinsics.copy()
        table[row, 0] *= zoom
        cameras = replace(model.cameras, intrinsics=table)
        normalized = normalized_observations(cameras, t.view_index[k], t.xy[k])
        threshold = threshold_px / table[row, 0]
        # A focal that is off by some per cent needs a wider gate to show that it is the nearest.
        threshold = max(threshold, 0.01) if len(zooms) > 1 else threshold
        pose = resect_calibrated(model.X[t.point_index[k]], normalized, threshold=threshold, rng=rng)
        if pose is not None and (best is None or pose[2].sum() > best[3].sum()):
            best = pose[0], pose[1], table[row], pose[2]
    return best


# Lenses are freed early: a camera taken for a pinhole is fitted to its distortion, and its gate then lets
# wrong points in.
BEFORE_LENS = np.arange(WIDTH) <= K1
MOST_ROUNDS = 6
SETTLED = 0.003
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Completion:
    """Parameters of the rounds: gates in sigmas, early and late; ``min_angle`` rad; ``min_points`` that a
    joining camera sees."""

    gates: tuple[float, float]
    min_angle: float
    min_points: int

    def run(
        self, model: MetricModel, adjustment: Adjustment, rng: np.random.Generator
    ) -> tuple[MetricModel, dict[int, str]]:
        """The completed model and the reason of every view that did not join."""
        model, refused = self._grow(model, adjustment, rng, np.ones(len(model.registered), dtype=bool))
        suspects = model.registered & (explained_shares(model) < LEAST_SHARE)
        if suspects.any() and (model.registered & ~suspects).sum() >= 3:
            model, refused = self._seek_again(model, adjustment, rng, suspects)
        return model, refused

    def _grow(
        self, model: MetricModel, adjustment: Adjustment, rng: np.random.Generator, allowed: B8
    ) -> tuple[MetricModel, dict[int, str]]:
        """Rounds of triangulation, resection of ``allowed`` views and adjustment until what is explained
        stops growing."""
        early, late = self.gates
        model = retriangulate(model, sigmas=early, min_angle=self.min_angle)
        refused: dict[int, str] = {}
        share = 0.0
        for n in range(MOST_ROUNDS):
            before = int(model.registered.sum())
            model, refused = add_missing_cameras(
                model, sigmas=early, min_points=self.min_points, rng=rng, allowed=allowed
            )
            joined = int(model.registered.sum()) > before
            if joined:
                model = retriangulate(model, sigmas=early, min_angle=self.min_angle)
            model = adjustment.run(model, free=BEFORE_LENS, iterations=6)[0]
            # What fitted a wrong model comes back under the right one only if the gate is wide meanwhile.
            model = retriangulate(model, sigmas=early if n == 0 else late, min_angle=self.min_angle)
            now = float(model.ok.mean())
            if not joined and n > 0 and now - share < SETTLED:
                break
            share = now
        return model, refused

    def _seek_again(
        self, model: MetricModel, adjustment: Adjustment, rng: np.random.Generator, suspects: B8
    ) -> tuple[MetricModel, dict[int, str]]:
        """Views that explain less than half of their observations are taken out, the rest settles without
        them, and they may join where they then fit."""
        none = np.zeros(len(suspects), dtype=bool)
        model = replace(
            model, registered=model.registered & ~suspects, ok=model.ok & ~suspects[model.tracks.view_index]
        )
        model, _ = self._grow(model, adjustment, rng, none)
        model, refused = self._grow(model, adjustment, rng, ~none)
        share = explained_shares(model)
        wrong = model.registered & (share < LEAST_SHARE)
        if wrong.any():
            for view in np.flatnonzero(wrong):
                refused[int(view)] = f"only {share[view]:.0%} of its matches agree with the other photographs"
            model = replace(model, registered=model.registered & ~wrong)
            model = retriangulate(model, sigmas=self.gates[1], min_angle=self.min_angle)
        return model, refused

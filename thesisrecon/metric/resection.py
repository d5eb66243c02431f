"""Calibrated resection of the cameras that the projective stage had to postpone (P3P in RANSAC, then
refinement)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import counted
from thesisrecon.geometry.resection import pose_from_three_points
from thesisrecon.metric.model import MetricModel, normalized_observations
from thesisrecon.optimize.triangulation_refine import refine_pose
from thesisrecon.types import B8, I64

F64 = NDArray[np.float64]
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

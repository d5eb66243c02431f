"""Coverage of stated intervals: errors in units of the stated standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.geometry.conditioning import scene_frame
from thesisrecon.optimize.bundle.covariance import gauge_directions
from thesisrecon.records import MetricResult

NAMES = ("focal_px", "principal_x_px", "principal_y_px")
LEVEL = 1.96
"""Half width of a 95 % interval in standard deviations."""


@dataclass(frozen=True)
class IntervalScores:
    """Errors ``z`` (V, 3) of :data:`NAMES` in their stds, or NaN; ``std_rel`` (V,) of the focal."""

    z: F64
    std_rel: F64

    def holding(self, columns: Sequence[int] = (0, 1, 2)) -> float:
        """Share of the 95 % intervals of these columns that hold the truth; NaN without any."""
        z = self.z[:, list(columns)]
        z = z[np.isfinite(z)]
        return float(np.mean(np.abs(z) <= LEVEL)) if len(z) else float("nan")


def interval_scores(metric: MetricResult, K: F64) -> IntervalScores:
    """Stated intervals against the true K (V, 3, 3); the focal's truth is the geometric mean of fx and fy."""
    truth = np.column_stack([np.sqrt(K[:, 0, 0] * K[:, 1, 1]), K[:, 0, 2], K[:, 1, 2]])
    z, std_rel = np.full((len(K), 3), np.nan), np.full(len(K), np.nan)
    for view, intervals in enumerate(metric.intrinsics):
        for column, name in enumerate(NAMES):
            interval = intervals.get(name)
            if interval is not None and interval.std > 0.0:
                z[view, column] = (interval.value - truth[view, column]) / interval.std
        if "focal_px" in intervals:
            std_rel[view] = intervals["focal_px"].std / intervals["focal_px"].value
    return IntervalScores(z, std_rel)


def pose_scores(metric: MetricResult, R: F64, C: F64) -> F64:
    """Errors (V, 6) of rotations and centres in stated standard deviations; NaN where not registered.

    The true poses, ``R`` (V, 3, 3) and ``C`` (V, 3), are first moved by the similarity that aligns them best,
    rotations in rad and translations in sizes of the scene: only the differences that remain are errors.
    """
    model = metric.reconstruction
    assert model.K is not None
    assert metric.pose_std is not None
    views = np.flatnonzero(model.registered)
    Rt = np.linalg.solve(model.K[views], model.P[views])
    X = model.X[model.valid]
    origin, scale = scene_frame(X[:, :3] / X[:, 3:])
    found, t = Rt[:, :, :3], scale * (Rt[:, :, 3] + Rt[:, :, :3] @ origin)
    centres = -np.einsum("vba,vb->va", found, t)
    U, _, Vt = np.linalg.svd(np.einsum("vab,vac->bc", R[views], found))
    Q = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    true = C[views] @ Q
    true = true - true.mean(axis=0)
    middle = centres.mean(axis=0)
    true = middle + true * (np.sum(true * (centres - middle)) / np.sum(true**2))
    turned = Rotation.from_matrix(R[views] @ Q @ np.swapaxes(found, 1, 2)).as_rotvec()
    shift = -np.einsum("vab,vb->va", found, true - centres)
    error = np.concatenate([turned, shift], axis=1)
    N = gauge_directions(np.asarray(found, dtype=np.float64), t)
    error -= (N @ (N.T @ error.ravel())).reshape(error.shape)
    error[:, 3:] = -np.einsum("vba,vb->va", found, error[:, 3:]) / scale
    z = np.full((len(model.registered), 6), np.nan)
    z[views] = error / metric.pose_std[views]
    return z


def join_scores(scores: Sequence[IntervalScores]) -> IntervalScores:
    """The views of several results together."""
    return IntervalScores(np.concatenate([s.z for s in scores]), np.concatenate([s.std_rel for s in scores]))


def holding_std(scores: Sequence[IntervalScores], columns: Sequence[int]) -> float:
    """Standard deviation of the share of intervals that hold the truth, of several scenes: the cameras of one
    scene err together, so that it is scenes that count (Cochran 1977, the ratio estimate of clusters).
    """
    held = [np.abs(s.z[:, list(columns)]) for s in scores]
    held = [z[np.isfinite(z)] <= LEVEL for z in held]
    total, share = sum(map(len, held)), float(np.mean(np.concatenate(held)))
    deviations = np.array([h.sum() - share * len(h) for h in held])
    n = len(scores)
    return float(np.sqrt(np.sum(deviations**2) * n / max(n - 1, 1))) / max(total, 1)


def focal_errors_pct(K: F64, K_true: F64) -> F64:
    """|f / f_true - 1| (V,) in percent, f the geometric mean of fx and fy; NaN where K is zero."""
    f = np.sqrt(K[:, 0, 0] * K[:, 1, 1])
    truth = np.sqrt(K_true[:, 0, 0] * K_true[:, 1, 1])
    return np.where(f > 0, 100.0 * np.abs(f / truth - 1.0), np.nan)

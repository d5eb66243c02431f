"""Errors of cameras against the truth, of points against observations, and in stated standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64, I64
from thesisrecon.camera import project_camera
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.strata import estimate_similarity, rotation_errors_deg
from thesisrecon.records import MetricResult, Reconstruction
from thesisrecon.testing import pose_errors

TrueCameras = tuple[F64, F64, F64]
"""K, R (V, 3, 3), R world-to-camera, and centres C (V, 3) in some unit of length."""


@dataclass(frozen=True)
class CameraErrors:
    """Errors of the registered cameras: the median over views of |f / f_true - 1|, f the geometric mean of fx
    and fy; median distance of principal points; mean distance of centres after the least-squares similarity,
    in the truth's unit, None if they are too few; median angle after the common rotation is off.
    """

    focal_error_pct: float
    principal_point_error_px: float
    centre_error: float | None
    rotation_error_deg: float

    @property
    def centre_error_mm(self) -> float | None:
        """``centre_error`` where the truth is in metres."""
        return None if self.centre_error is None else 1000.0 * self.centre_error


class Reprojection(NamedTuple):
    """Distances of inlier observations from their projected points, recomputed from cameras and points."""

    median_px: float
    mean_px: float
    rms_px: float
    observations: int


def measure_cameras(reconstruction: Reconstruction, truth: TrueCameras) -> CameraErrors:
    """Compare the registered cameras with the truth of the same views; views without truth do not count."""
    registered = np.flatnonzero(reconstruction.registered)
    if reconstruction.stratum != "metric" or reconstruction.K is None or len(registered) == 0:
        raise ValueError("measure_cameras needs a metric reconstruction with at least one registered camera")
    if len(truth[0]) != len(reconstruction.P):
        counts = f"{len(truth[0])} for {len(reconstruction.P)}"
        raise ValueError(f"measure_cameras needs one truth per view; got {counts}")
    known = np.isfinite(truth[2][registered]).all(axis=1)
    views = registered[known]
    intrinsics = measure_intrinsics(reconstruction, truth[0])
    if not len(views):
        return CameraErrors(*intrinsics, None, np.nan)
    R = _rotations_translations(reconstruction)[0][known]
    off = centre_errors(reconstruction, truth)
    turn = float(np.median(rotation_errors_deg(R, truth[1][views])))
    return CameraErrors(*intrinsics, None if off is None else float(np.mean(off)), turn)


def centre_errors(reconstruction: Reconstruction, truth: TrueCameras) -> F64 | None:
    """Distances of the registered centres that are known, after the similarity; None if they are too few."""
    views = np.flatnonzero(reconstruction.registered & np.isfinite(truth[2]).all(axis=1))
    centres = dehomogenize(camera_centre(reconstruction.P[views]))
    try:
        moved = estimate_similarity(centres, truth[2][views]).apply(centres)
    except ValueError:
        return None
    return np.asarray(np.linalg.norm(moved - truth[2][views], axis=1))


def measure_intrinsics(reconstruction: Reconstruction, K_true: F64) -> tuple[float, float]:
    """Median errors of focal lengths (%) and principal points (px) of registered views whose K is known."""
    assert reconstruction.K is not None
    known = reconstruction.registered & np.isfinite(K_true).all(axis=(1, 2))
    if not known.any():
        return np.nan, np.nan
    K, K_true = reconstruction.K[known], K_true[known]
    principal_point = np.linalg.norm(K[:, :2, 2] - K_true[:, :2, 2], axis=1)
    return float(np.median(focal_errors_pct(K, K_true))), float(np.median(principal_point))


def pose_pair_errors(reconstruction: Reconstruction | None, truth: TrueCameras) -> F64:
    """Errors (degrees) of the relative poses of pairs with truth; of missing cameras they are infinite."""
    return relative_pose_errors(*camera_poses(reconstruction, len(truth[1])), truth[1], truth[2])


def camera_poses(reconstruction: Reconstruction | None, views: int) -> tuple[F64, F64]:
    """Rotations (V, 3, 3) and centres (V, 3) of metric cameras; NaN where none is registered."""
    R, C = np.full((views, 3, 3), np.nan), np.full((views, 3), np.nan)
    if reconstruction is not None:
        there = reconstruction.registered
        R[there], t = _rotations_translations(reconstruction)
        C[there] = -np.einsum("vba,vb->va", R[there], t)
    return R, C


def relative_centre_error(errors: CameraErrors, C: F64) -> float:
    """Return ``centre_error`` over the extent of the true centres C (V, 3); NaN where it is unknown."""
    extent = 2.0 * float(np.linalg.norm(C - C.mean(axis=0), axis=1).max())
    return float("nan") if errors.centre_error is None else errors.centre_error / extent


def measure_reprojection(reconstruction: Reconstruction) -> Reprojection:
    """Project every point into every registered view that sees it as an inlier, and measure the distances."""
    assert reconstruction.K is not None
    tracks = reconstruction.tracks
    kept = reconstruction.inlier & reconstruction.valid[tracks.point_index]
    distances = []
    rotations, translations = _rotations_translations(reconstruction)
    views = np.flatnonzero(reconstruction.registered)
    for i, R, t in zip(views, rotations, translations, strict=True):
        here = kept & (tracks.view_index == i)
        X = reconstruction.X[tracks.point_index[here]]
        distortion = 0.0 if reconstruction.distortion is None else reconstruction.distortion[i]
        seen = project_camera(reconstruction.K[i], R, t, X[:, :3] / X[:, 3:], distortion=distortion)
        distances.append(np.linalg.norm(seen - tracks.xy[here], axis=1))
    d = np.concatenate([*distances, np.zeros(0)])
    if len(d) == 0:
        raise ValueError("measure_reprojection needs at least one inlier observation in a registered view")
    return Reprojection(float(np.median(d)), float(np.mean(d)), float(np.sqrt(np.mean(d**2))), len(d))


def _rotations_translations(reconstruction: Reconstruction) -> tuple[F64, F64]:
    views = np.flatnonzero(reconstruction.registered)
    assert reconstruction.K is not None
    pose = np.linalg.solve(reconstruction.K[views], reconstruction.P[views]).astype(np.float64)
    pose /= np.cbrt(np.linalg.det(pose[:, :, :3]))[:, None, None]
    return pose[:, :, :3], pose[:, :, 3]


NAMES = ("focal_px", "principal_x_px", "principal_y_px")
LEVEL = 1.96  # Half width of a 95 % interval in standard deviations


def interval_scores(metric: MetricResult, K: F64) -> F64:
    """Stated intervals against the true K (V, 3, 3), whose focal length is the geometric mean of fx and fy:
    (V, 4) errors of :data:`NAMES` in their standard deviations, or NaN, and the relative one of the focal
    length.
    """
    truth = np.column_stack([np.sqrt(K[:, 0, 0] * K[:, 1, 1]), K[:, 0, 2], K[:, 1, 2]])
    found = np.full((len(K), 4), np.nan)
    for view, intervals in enumerate(metric.intrinsics):
        for column, name in enumerate(NAMES):
            interval = intervals.get(name)
            if interval is not None and interval.std > 0.0:
                found[view, column] = (interval.value - truth[view, column]) / interval.std
        if "focal_px" in intervals:
            found[view, 3] = intervals["focal_px"].std / intervals["focal_px"].value
    return found


def pose_scores(metric: MetricResult, R: F64, C: F64) -> F64:
    """Errors (V, 6) of rotations and centres in stated standard deviations; NaN where not registered. The
    true poses R (V, 3, 3), C (V, 3) are first moved by the similarity that aligns them best.
    """
    model = metric.reconstruction
    assert metric.pose_std is not None
    views, X = np.flatnonzero(model.registered), model.X[model.valid]
    found, centres = camera_poses(model, len(R))
    error = pose_errors(found[views], centres[views], R[views], C[views], X[:, :3] / X[:, 3:])
    z = np.full((len(model.registered), 6), np.nan)
    z[views] = error / metric.pose_std[views]
    return z


def holding_std(scores: Sequence[F64]) -> float:
    """Standard deviation of the share of intervals that hold the truth, from the errors of each scene: the
    cameras of one scene err together, so that it is scenes that count (Cochran 1977, ratio of clusters).
    """
    held = [np.abs(z[np.isfinite(z)]) <= LEVEL for z in scores]
    total, share, n = sum(map(len, held)), float(np.mean(np.concatenate(held))), len(scores)
    deviations = np.array([h.sum() - share * len(h) for h in held])
    return float(np.sqrt(np.sum(deviations**2) * n / max(n - 1, 1))) / max(total, 1)


def focal_errors_pct(K: F64, K_true: F64) -> F64:
    """|f / f_true - 1| (V,) in percent, f the geometric mean of fx and fy; NaN where K is zero."""
    f = np.sqrt(K[:, 0, 0] * K[:, 1, 1])
    truth = np.sqrt(K_true[:, 0, 0] * K_true[:, 1, 1])
    return np.where(f > 0, 100.0 * np.abs(f / truth - 1.0), np.nan)


AUC_DEG = (0.1, 0.5, 1.0, 3.0, 5.0, 10.0, 20.0)
STEPS = 100
"""Thresholds of a recall curve, from zero to the largest of :data:`AUC_DEG`."""


def relative_pose_errors(R: F64, C: F64, R_true: F64, C_true: F64) -> F64:
    """Errors (V (V - 1) / 2,) in degrees of all pairs i < j of cameras: the larger one of the angles of
    relative rotation and direction of translation (Jin et al. 2021, IMW), as in the benchmarks of SuperGlue.

    R (V, 3, 3) are world-to-camera, C (V, 3) centres. A pair of which a camera is missing (NaN) in the first
    model has an infinite error; one that is missing in the truth is left out, and a pair with one true centre
    is judged by its rotation.
    """
    known = np.isfinite(C_true).all(axis=1) & np.isfinite(R_true).all(axis=(1, 2))
    pairs = np.array(list(combinations(np.flatnonzero(known), 2)), dtype=np.int64).reshape(-1, 2)
    i, j = pairs.T
    (turn, step), (turn_true, step_true) = (_relative(*given, i, j) for given in ((R, C), (R_true, C_true)))
    errors = np.full(len(pairs), np.inf)
    there = np.isfinite(step).all(axis=1) & np.isfinite(turn).all(axis=(1, 2))
    between = np.swapaxes(turn_true[there], 1, 2) @ turn[there]
    rotation = Rotation.from_matrix(between).magnitude() if there.any() else np.zeros(0)
    lengths = np.linalg.norm(step[there], axis=1), np.linalg.norm(step_true[there], axis=1)
    sine = np.linalg.norm(np.cross(step[there], step_true[there]), axis=1)
    direction = np.arctan2(sine, np.sum(step[there] * step_true[there], axis=1))
    extent = max(float(np.linalg.norm(step_true, axis=1).max(initial=0.0)), 1e-300)
    direction = np.where(lengths[1] > 1e-9 * extent, direction, 0.0)
    errors[there] = np.degrees(np.maximum(rotation, direction))
    return errors


def _relative(R: F64, C: F64, i: I64, j: I64) -> tuple[F64, F64]:
    """Rotations from camera i to camera j and the centres of j in the frames of i."""
    return R[j] @ np.swapaxes(R[i], 1, 2), np.einsum("kab,kb->ka", R[i], C[j] - C[i])


def recall(errors: F64, thresholds: F64) -> F64:
    """Share of the errors of at most each threshold."""
    if not len(errors):
        return np.asarray(thresholds) * np.nan
    return np.asarray((errors[:, None] <= np.asarray(thresholds)).mean(axis=0))


def area_under_recall(errors: F64, threshold: float) -> float:
    """Area under the recall curve up to a threshold, over it: the mean of max(0, 1 - e / threshold)."""
    return float(np.maximum(1.0 - errors / threshold, 0.0).mean()) if len(errors) else float("nan")


def pose_scores_pct(errors: F64) -> dict[str, float]:
    """AUC at every threshold and mAA(10 degrees), in percent, by the names of the ablations."""
    areas = {f"auc{at:g}_pct": 100.0 * area_under_recall(errors, at) for at in AUC_DEG}
    return {**areas, "maa_pct": 100.0 * mean_accuracy(errors)}


def mean_accuracy(errors: F64, up_to: int = 10) -> float:
    """Mean of the recalls at 1, 2, ... ``up_to`` degrees (mAA)."""
    return float(recall(errors, np.arange(1.0, up_to + 1.0)).mean())

"""Errors of cameras against the truth, and of points against their observations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.camera import project_camera
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.strata import estimate_similarity, rotation_errors_deg
from thesisrecon.records import Reconstruction


@dataclass(frozen=True)
class TrueCameras:
    """The truth: ``K, R`` (V, 3, 3), R world-to-camera, and centres ``C`` (V, 3) in some unit of length."""

    K: F64
    R: F64
    C: F64


@dataclass(frozen=True)
class CameraErrors:
    """Errors of the registered cameras; None if they are too few to be aligned.

    ``focal_error_pct``: median over views of |f / f_true - 1|, f the geometric mean of fx and fy.
    ``principal_point_error_px``: median distance. ``centre_error``: mean distance after the least-squares
    similarity, in the truth's unit. ``rotation_error_deg``: median angle after the common rotation is off.
    """

    focal_error_pct: float
    principal_point_error_px: float
    centre_error: float | None
    rotation_error_deg: float

    @property
    def centre_error_mm(self) -> float | None:
        """``centre_error`` where the truth is in metres."""
        return None if self.centre_error is None else 1000.0 * self.centre_error


@dataclass(frozen=True)
class Reprojection:
    """Distances of inlier observations from their projected points, recomputed from cameras and points."""

    median_px: float
    mean_px: float
    rms_px: float
    observations: int


def measure_cameras(reconstruction: Reconstruction, truth: TrueCameras) -> CameraErrors:
    """Compare the registered cameras with the truth of the same views."""
    views = np.flatnonzero(reconstruction.registered)
    if reconstruction.stratum != "metric" or reconstruction.K is None or len(views) == 0:
        raise ValueError("measure_cameras needs a metric reconstruction with at least one registered camera")
    if len(truth.K) != len(reconstruction.P):
        counts = f"{len(truth.K)} for {len(reconstruction.P)}"
        raise ValueError(f"measure_cameras needs one truth per view; got {counts}")
    K, K_true = reconstruction.K[views], truth.K[views]
    focal = np.sqrt(K[:, 0, 0] * K[:, 1, 1] / (K_true[:, 0, 0] * K_true[:, 1, 1]))
    principal_point = np.linalg.norm(K[:, :2, 2] - K_true[:, :2, 2], axis=1)
    R, centres = _poses(reconstruction)
    return CameraErrors(
        focal_error_pct=100.0 * float(np.median(np.abs(focal - 1.0))),
        principal_point_error_px=float(np.median(principal_point)),
        centre_error=_centre_error(centres, truth.C[views]),
        rotation_error_deg=float(np.median(rotation_errors_deg(R, truth.R[views]))),
    )


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


def _poses(reconstruction: Reconstruction) -> tuple[F64, F64]:
    R, _ = _rotations_translations(reconstruction)
    centres = camera_centre(reconstruction.P[reconstruction.registered])
    return R, centres[:, :3] / centres[:, 3:]


def _centre_error(centres: F64, true_centres: F64) -> float | None:
    try:
        similarity = estimate_similarity(centres, true_centres)
    except ValueError:
        return None
    return float(np.mean(np.linalg.norm(similarity.apply(centres) - true_centres, axis=1)))

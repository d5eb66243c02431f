"""The metric model while it is refined: cameras with shared intrinsics, points, and which observations
agree."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.camera import distort, undistort
from thesisrecon.geometry.triangulation import triangulate_observations, triangulation_angles
from thesisrecon.optimize.metric_bundle import MetricCameras
from thesisrecon.optimize.triangulation_refine import refine_points
from thesisrecon.types import B8, I64, Tracks

F64 = NDArray[np.float64]
# Columns of a table of intrinsics: f, aspect, skew, cx, cy, k1 and the two radial coefficients that nothing
# is assumed of in words.
FOCAL, ASPECT, SKEW, CENTRE, K1, WIDTH = 0, 1, 2, (3, 4), 5, 8


@dataclass(frozen=True)
class MetricModel:
    """All views have a camera entry; only those ``registered`` count. ``X`` (N, 3), zero where not ``valid``;
    ``ok`` (K,) observations of registered views that the model explains; ``sigma_px`` their noise,
    ``loss_sigmas`` where a robust loss should turn, and ``tail`` how many times wider than that of normal
    noise its tail is, which gates allow for."""

    tracks: Tracks
    sizes: I64
    cameras: MetricCameras
    registered: B8
    X: F64
    valid: B8
    ok: B8
    sigma_px: float
    loss_sigmas: float = 2.0
    tail: float = 1.0

    @property
    def gate_px(self) -> float:
        """The unit of gates in sigmas."""
        return self.sigma_px * self.tail

    def with_cameras(self, cameras: MetricCameras, registered: B8 | None = None) -> MetricModel:
        """The same with other cameras."""
        return replace(
            self, cameras=cameras, registered=self.registered if registered is None else registered
        )


def project_observations(cameras: MetricCameras, X: F64, view: I64, point: I64) -> tuple[F64, F64]:
    """Pixels (K, 2) and depths (K,) of the observations' points, with distortion."""
    Y = np.einsum("kab,kb->ka", cameras.R[view], X[point]) + cameras.t[view]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        xy = Y[:, :2] / Y[:, 2:]
        radial = cameras.intrinsics[cameras.group[view], K1:]
        return apply_calibration(cameras, view, distort(xy, radial)), Y[:, 2]


def apply_calibration(cameras: MetricCameras, view: I64, xy: F64) -> F64:
    """Normalised image points to pixels."""
    f, aspect, skew, cx, cy = cameras.intrinsics[cameras.group[view], :K1].T
    return np.column_stack([f * xy[:, 0] + skew * xy[:, 1] + cx, aspect * f * xy[:, 1] + cy])


def normalized_observations(cameras: MetricCameras, view: I64, xy: F64) -> F64:
    """Pixels to normalised image points without distortion (K, 2)."""
    rows = cameras.intrinsics[cameras.group[view]]
    f, aspect, skew, cx, cy = rows[:, :K1].T
    y = (xy[:, 1] - cy) / (aspect * f)
    distorted = np.column_stack([(xy[:, 0] - cx - skew * y) / f, y])
    radial = rows[:, K1:]
    return undistort(distorted, radial) if radial.any() else distorted


def retriangulate(model: MetricModel, *, sigmas: float, min_angle: float) -> MetricModel:
    """All points afresh from all observations in registered views, then the gate of ``sigmas`` noise sigmas.

    Distortion is taken off the observations first, so that triangulation sees pinhole cameras. A point with
    a wrong observation is triangulated once more from those that agreed; points seen under less than
    ``min_angle`` (rad) have no reliable depth and are left out.
    """
    t = model.tracks
    near = np.flatnonzero(model.registered[t.view_index])
    view, point = t.view_index[near], t.point_index[near]
    normalized = normalized_observations(model.cameras, view, t.xy[near])
    poses = np.concatenate([model.cameras.R, model.cameras.t[:, :, None]], axis=2)
    scale = np.median(model.cameras.intrinsics[model.cameras.group[model.registered], 0])
    loss = model.sigma_px / scale
    X = _triangulate(poses, normalized, view, point, t.n_points, loss)
    model = mark(replace(model, X=X), sigmas=sigmas, min_angle=min_angle)
    spoiled = np.bincount(point[~model.ok[near]], minlength=t.n_points) > 0
    again = model.ok[near] & spoiled[point]
    if again.any():
        Y = _triangulate(poses, normalized[again], view[again], point[again], t.n_points, loss)
        better = np.bincount(point[again], minlength=t.n_points) >= 2
        model = mark(replace(model, X=np.where(better[:, None], Y, X)), sigmas=sigmas, min_angle=min_angle)
    return model


def _triangulate(poses: F64, xy: F64, view: I64, point: I64, n_points: int, loss: float) -> F64:
    Xh = triangulate_observations(poses, view, point, xy, n_points)
    Xh = refine_points(poses, Xh, view, point, xy, loss_px=loss, iterations=4)
    with np.errstate(divide="ignore", invalid="ignore"):
        X = Xh[:, :3] / Xh[:, 3:]
    return np.where(np.isfinite(X).all(axis=1, keepdims=True), X, 0.0)


def agreeing_observations(model: MetricModel, *, sigmas: float) -> B8:
    """(K,) observations of registered views in front of their camera and within the gate, at any angle."""
    t = model.tracks
    k = np.flatnonzero(model.registered[t.view_index])
    view, point = t.view_index[k], t.point_index[k]
    xy, depth = project_observations(model.cameras, model.X, view, point)
    residual = np.nan_to_num(np.linalg.norm(xy - t.xy[k], axis=1), nan=np.inf)
    known = np.abs(model.X[point]).sum(axis=1) > 0
    ok = np.zeros(len(t.xy), dtype=bool)
    ok[k] = (residual < sigmas * model.gate_px) & (depth > 0) & known
    return ok


def mark(model: MetricModel, *, sigmas: float, min_angle: float) -> MetricModel:
    """Mark the observations that agree, and the points with two of them at ``min_angle`` (rad) or more."""
    t = model.tracks
    ok = agreeing_observations(model, sigmas=sigmas)
    angle = _largest_angle(model, ok)
    valid = (np.bincount(t.point_index[ok], minlength=t.n_points) >= 2) & (angle > min_angle)
    return replace(model, ok=ok & valid[t.point_index], valid=valid)


def _largest_angle(model: MetricModel, ok: B8) -> F64:
    t = model.tracks
    centres = -np.einsum("vba,vb->va", model.cameras.R, model.cameras.t)
    return triangulation_angles(centres, t.view_index[ok], t.point_index[ok], model.X, t.n_points)


def residual_norms(model: MetricModel) -> F64:
    """Reprojection residual (px) of every explained observation."""
    t = model.tracks
    view, point = t.view_index[model.ok], t.point_index[model.ok]
    xy, _ = project_observations(model.cameras, model.X, view, point)
    return np.asarray(np.linalg.norm(xy - t.xy[model.ok], axis=1))


def truncated_cost(model: MetricModel, gate_px: float) -> float:
    """Mean of min(r^2, gate^2) / gate^2 over ALL observations; those without a camera or a point count fully.

    What cannot be explained costs as much as what is explained badly: a wrong answer cannot win by refusing.
    """
    squared = np.ones(len(model.tracks.xy))
    squared[model.ok] = np.minimum(residual_norms(model) ** 2 / gate_px**2, 1.0)
    return float(squared.mean())


def explained_shares(model: MetricModel) -> F64:
    """(V,) share of each view's observations of valid points that are explained; 1 where it has none."""
    t = model.tracks
    seen = np.bincount(t.view_index[model.valid[t.point_index]], minlength=t.n_views)
    good = np.bincount(t.view_index[model.ok], minlength=t.n_views)
    return np.asarray(np.where(seen > 0, good / np.maximum(seen, 1), 1.0))

"""The metric model while it is refined: cameras with shared intrinsics, points, and which observations
agree.

The upgrade of chapter 7 as a metric model: rotations, translations, and intrinsics that views share as is
assumed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.camera_matrix import distort, undistort
from thesisrecon.geometry.triangulation import triangulate_observations, triangulation_angles
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.partial_bundle import refine_points
from thesisrecon.records import Reconstruction, Tracks, Upgrade

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
        distortion = cameras.intrinsics[cameras.group[view], K1:]
        return apply_calibration(cameras, view, distort(xy, distortion)), Y[:, 2]


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
    distortion = rows[:, K1:]
    return undistort(distorted, distortion) if distortion.any() else distorted


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


def camera_rows(prior: IntrinsicsPrior) -> tuple[I64, I64]:
    """Row of each view (V,) in a table of intrinsics, and which rows share their values (G, 8).

    Views have a row in common where they share all that is not known beforehand and have the same knowledge.
    k2 and k3 are shared as k1 is.
    """
    moves = (prior.std > 0.0).any(axis=0)
    knowledge = np.nan_to_num(np.concatenate([prior.mean, prior.std], axis=1), nan=-1.0, posinf=-1.0)
    same = np.unique(knowledge, axis=0, return_inverse=True)[1].reshape(-1, 1)
    key = np.concatenate([prior.shared[:, moves], same], axis=1)
    first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)[1:]
    shared = prior.shared[first]
    return group.reshape(-1).astype(np.int64), np.column_stack([shared, shared[:, K1], shared[:, K1]])


def upgraded_model(
    reconstruction: Reconstruction, upgrade: Upgrade, prior: IntrinsicsPrior, max_rotation_residual: float
) -> MetricModel | None:
    """The model of an upgraded projective reconstruction; None where fewer than three cameras are sound.

    A camera K^-1 P H that is further from a scaled rotation than ``max_rotation_residual`` (Frobenius norm of
    3 C C' / tr - I) is left out.
    """
    views = np.flatnonzero(reconstruction.registered)
    P = reconstruction.P[views] @ np.linalg.inv(upgrade.metric_from_projective)
    Q = np.linalg.inv(upgrade.K[views]) @ P
    Q *= np.where(np.linalg.det(Q[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    U, S, Vt = np.linalg.svd(Q[:, :, :3])
    scale = S.mean(axis=1)
    off = np.sqrt(np.sum((3.0 * S**2 / np.sum(S**2, axis=1, keepdims=True) - 1.0) ** 2, axis=1))
    good = off < max_rotation_residual
    if good.sum() < 3:
        return None
    n = len(reconstruction.P)
    R, t = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    R[views], t[views] = U @ Vt, Q[:, :, 3] / scale[:, None]
    registered = np.zeros(n, dtype=bool)
    registered[views[good]] = True
    Xm = reconstruction.X @ upgrade.metric_from_projective.T
    with np.errstate(divide="ignore", invalid="ignore"):
        X = Xm[:, :3] / Xm[:, 3:]
    finite = reconstruction.valid & np.isfinite(X).all(axis=1)
    X = np.where(finite[:, None], X, 0.0)
    # The upgrade fixes the frame up to scale: bring the scene's spread to 1.
    spread = float(np.median(np.linalg.norm(X[finite] - np.median(X[finite], axis=0), axis=1)))
    group, shared = camera_rows(prior)
    rows = _intrinsics(upgrade.K, reconstruction.registered, reconstruction.sizes, prior)
    cameras = MetricCameras(R, t / spread, rows[np.unique(group, return_index=True)[1]], group, shared)
    ok = reconstruction.inlier & registered[reconstruction.tracks.view_index]
    return MetricModel(
        reconstruction.tracks,
        reconstruction.sizes,
        cameras,
        registered,
        X / spread,
        finite,
        ok,
        reconstruction.sigma_px,
    )


def _intrinsics(K: F64, registered: B8, sizes: I64, prior: IntrinsicsPrior) -> F64:
    """(V, 8) from the focals of the registered views that share them; a camera without any starts from the
    others' field of view. The rest is as assumed."""
    group, longest = prior.group, sizes.max(axis=1)
    typical = float(np.median(K[registered, 0, 0] / longest[registered]))
    rows = np.zeros((len(K), WIDTH))
    rows[:, 1 : K1 + 1] = prior.mean[:, 1:]
    for g in range(int(group.max()) + 1):
        views = np.flatnonzero(group == g)
        known = views[registered[views]]
        focal = float(np.median(K[known, 0, 0])) if len(known) else typical * longest[views[0]]
        rows[views, FOCAL] = focal
    return rows

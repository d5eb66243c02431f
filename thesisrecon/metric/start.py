"""The upgrade of chapter 7 as a metric model: rotations, translations, and intrinsics that views share as is
assumed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.metric.model import FOCAL, K1, WIDTH, MetricModel
from thesisrecon.optimize.metric_bundle import MetricCameras
from thesisrecon.types import B8, I64, Assumptions, Reconstruction, Upgrade

F64 = NDArray[np.float64]


def camera_rows(assumed: Assumptions) -> tuple[I64, I64]:
    """Row of each view (V,) in a table of intrinsics, and which rows share their values (G, 8).

    Views have a row in common where they share all that is not known beforehand and have the same knowledge.
    k2 and k3 are shared as k1 is.
    """
    moves = (assumed.std > 0.0).any(axis=0)
    knowledge = np.nan_to_num(np.concatenate([assumed.mean, assumed.std], axis=1), nan=-1.0, posinf=-1.0)
    same = np.unique(knowledge, axis=0, return_inverse=True)[1].reshape(-1, 1)
    key = np.concatenate([assumed.shared[:, moves], same], axis=1)
    first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)[1:]
    shared = assumed.shared[first]
    return group.reshape(-1).astype(np.int64), np.column_stack([shared, shared[:, K1], shared[:, K1]])


def upgraded_model(
    reconstruction: Reconstruction, upgrade: Upgrade, assumed: Assumptions, max_rotation_residual: float
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
    group, shared = camera_rows(assumed)
    rows = _intrinsics(upgrade.K, reconstruction.registered, reconstruction.sizes, assumed)
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


def _intrinsics(K: F64, registered: B8, sizes: I64, assumed: Assumptions) -> F64:
    """(V, 8) from the focals of the registered views that share them; a camera without any starts from the
    others' field of view. The rest is as assumed."""
    group, longest = assumed.group, sizes.max(axis=1)
    typical = float(np.median(K[registered, 0, 0] / longest[registered]))
    rows = np.zeros((len(K), WIDTH))
    rows[:, 1 : K1 + 1] = assumed.mean[:, 1:]
    for g in range(int(group.max()) + 1):
        views = np.flatnonzero(group == g)
        known = views[registered[views]]
        focal = float(np.median(K[known, 0, 0])) if len(known) else typical * longest[views[0]]
        rows[views, FOCAL] = focal
    return rows

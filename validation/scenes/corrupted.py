"""Correct metric models with typical reconstruction errors, for tests of the self-check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64, I64
from thesisrecon.metric._model import MetricEstimate, camera_rows
from thesisrecon.optimize.bundle.metric_kernels import MetricCameras
from thesisrecon.records import IntrinsicsPrior, Reconstruction


def model_from_reconstruction(found: Reconstruction, prior: IntrinsicsPrior) -> MetricEstimate:
    """The working model of a metric reconstruction."""
    assert found.K is not None
    assert found.distortion is not None
    views = found.registered
    K = np.where(views[:, None, None], found.K, np.eye(3))
    Q = np.linalg.inv(K) @ found.P
    group, shared = camera_rows(prior)
    rows = np.zeros((len(shared), 8))
    for g in range(len(rows)):
        mine = np.flatnonzero((group == g) & views)
        v = int(mine[0]) if len(mine) else int(np.flatnonzero(views)[0])
        rows[g] = [K[v, 0, 0], K[v, 1, 1] / K[v, 0, 0], K[v, 0, 1], *K[v, :2, 2], *found.distortion[v]]
    cameras = MetricCameras(
        np.where(views[:, None, None], Q[:, :, :3], np.eye(3)), Q[:, :, 3], rows, group, shared
    )
    return MetricEstimate(
        found.tracks, found.sizes, cameras, views.copy(), found.X[:, :3].copy(), found.valid.copy(),
        found.inlier.copy(), max(found.sigma_px, 0.02),
    )  # fmt: skip


def _spread(model: MetricEstimate) -> float:
    C = model.cameras.centres[model.registered]
    return float(np.sqrt(np.mean(np.sum((C - C.mean(axis=0)) ** 2, axis=1))))


def _direction(rng: np.random.Generator) -> F64:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def _placed(model: MetricEstimate, R: F64, C: F64) -> MetricEstimate:
    t = -np.einsum("vab,vb->va", R, C)
    return replace(model, cameras=replace(model.cameras, R=R, t=t))


def move_cameras(
    model: MetricEstimate, rng: np.random.Generator, views: I64, degrees: float
) -> MetricEstimate:
    """Views turned by up to ``degrees`` (at least a quarter) and moved by a fifth to a half of the path."""
    R, C = model.cameras.R.copy(), model.cameras.centres
    for v in views:
        turn = np.radians(rng.uniform(degrees / 4.0, degrees)) * _direction(rng)
        R[v] = Rotation.from_rotvec(turn).as_matrix() @ R[v]
        C[v] += _spread(model) * rng.uniform(0.2, 0.5) * _direction(rng)
    return _placed(model, R, C)


def one_moved(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """Move and rotate one camera."""
    return move_cameras(model, rng, rng.choice(np.flatnonzero(model.registered), 1), 20.0)


def all_moved(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """Move and rotate all cameras, so that adjustment ends in a local minimum."""
    return move_cameras(model, rng, np.flatnonzero(model.registered), 8.0)


def two_swapped(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """Swap two cameras."""
    i, j = rng.choice(np.flatnonzero(model.registered), 2, replace=False)
    R, C = model.cameras.R.copy(), model.cameras.centres
    R[[i, j]], C[[i, j]] = R[[j, i]], C[[j, i]]
    return _placed(model, R, C)


def mirrored(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """The depth reversal of weak perspective: the scene mirrored at a plane across one optical axis, cameras
    turned the other way."""
    z = model.cameras.R[rng.choice(np.flatnonzero(model.registered)), 2]
    o = np.median(model.X[model.valid], axis=0)
    M = np.eye(3) - 2.0 * np.outer(z, z)
    R = np.diag([1.0, 1.0, -1.0]) @ model.cameras.R @ M
    # Mirrored cameras look away from the scene; move them back to their side.
    C = o + (model.cameras.centres - o) @ M
    return _placed(model, R, C - 2.0 * ((C - o) @ z)[:, None] * z)


def _transformed(model: MetricEstimate, H: F64, focal_factor: float) -> MetricEstimate:
    """Cameras nearest to those of the model in the frame H X, all focals multiplied."""
    intrinsics = model.cameras.intrinsics.copy()
    intrinsics[:, 0] *= focal_factor
    cameras = replace(model.cameras, intrinsics=intrinsics)
    P = np.linalg.inv(cameras.K) @ model.cameras.P @ np.linalg.inv(H)
    P *= np.where(np.linalg.det(P[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    U, _, Vt = np.linalg.svd(P[:, :, :3])
    C = -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[:, :, 0]
    return _placed(replace(model, cameras=cameras), U @ Vt, C)


def wrong_infinity(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """The upgrade with a plane at infinity 2.5 to 10 path lengths away."""
    H = np.eye(4)
    H[3, :3] = _direction(rng) * rng.uniform(0.1, 0.4) / _spread(model)
    H[3, 3] = 1.0 - H[3, :3] @ np.median(model.X[model.valid], axis=0)
    return _transformed(model, H, 1.0)


def wrong_focal(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """The bas-relief: half or double the focal, and the scene as deep as suits it."""
    factor = float(rng.choice([0.5, 2.0]))
    z = model.cameras.R[rng.choice(np.flatnonzero(model.registered)), 2]
    H = np.eye(4)
    H[:3, :3] += (factor - 1.0) * np.outer(z, z)
    return _transformed(model, H, factor)


CORRUPTIONS: dict[str, Callable[[MetricEstimate, np.random.Generator], MetricEstimate]] = {
    "one camera moved": one_moved,
    "two cameras swapped": two_swapped,
    "all cameras moved": all_moved,
    "mirrored": mirrored,
    "wrong plane at infinity": wrong_infinity,
    "focal halved or doubled": wrong_focal,
}
"""Reconstruction errors by name."""

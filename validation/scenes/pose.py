"""True poses of synthetic cameras, and perturbed cameras.

``look_at`` uses + - * / sqrt only, which IEEE 754 rounds exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.optimize.bundle.projection import MetricCameras

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Pose:
    """A true camera: ``K``, ``R`` (world-to-camera), ``C`` (m), exposure, and row of a lens."""

    K: F64
    R: F64
    C: F64
    exposure: float = 1.0
    lens: F64 | None = None


def true_cameras(poses: Sequence[Pose]) -> tuple[F64, F64, F64]:
    """K, R (V, 3, 3) and C (V, 3) of poses."""
    K, R, C = (np.array([getattr(pose, name) for pose in poses]) for name in "KRC")
    return K, R, C


def look_at(C: F64, target: F64, tan_half_roll: float) -> F64:
    """R (3, 3) world-to-camera of a camera at C towards a target, z up in the world, turned about its own
    axis. The roll is given as the tangent of its half, so that no library's sine decides the last bit.
    """
    forward = _unit(target - C)
    right = _unit(np.array([forward[1], -forward[0], 0.0]))
    down = np.cross(forward, right)
    t = tan_half_roll
    c, s = (1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t)
    return np.stack([c * right + s * down, c * down - s * right, forward])


def turntable(
    rng: np.random.Generator, views: int, distance: float, *, highest_deg: float, widest_deg: float
) -> tuple[F64, F64]:
    """R (V, 3, 3), C (V, 3) of a camera of any height and roll that circles about z by 40 degrees or more."""
    height = np.radians(rng.uniform(-10.0, highest_deg))
    start = distance * np.array([np.cos(height), 0.0, np.sin(height)])
    R = look_at(start, 0.2 * rng.normal(size=3), rng.uniform(-0.3, 0.3))
    angle = np.sort(rng.uniform(0.0, np.radians(rng.uniform(40.0, widest_deg)), views))
    turn = Rotation.from_rotvec(angle[:, None] * UP).as_matrix()
    return R @ turn.swapaxes(1, 2), turn @ start


def perturb(
    cameras: MetricCameras, X: F64, rng: np.random.Generator, *, turned: float, moved: float, zoomed: float
) -> tuple[MetricCameras, F64]:
    """Cameras turned about their centres (rad), moved and zoomed (a factor), and points (N, 3) moved."""
    turn = Rotation.from_rotvec(turned * rng.normal(size=cameras.t.shape)).as_matrix()
    t = np.einsum("vab,vb->va", turn, cameras.t) + moved * rng.normal(size=cameras.t.shape)
    rows = cameras.intrinsics * [zoomed, 1.0, 1.0, 1.0, 1.0, 1.0]
    X = X + moved * rng.normal(size=X.shape)
    return MetricCameras(turn @ cameras.R, t, rows, cameras.group, cameras.shared), X


def _unit(a: F64) -> F64:
    return np.asarray(a / np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]), dtype=np.float64)

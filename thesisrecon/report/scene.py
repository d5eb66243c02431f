"""The reconstruction turned and trimmed for the eye: upright, without strays, cameras as small pyramids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.camera import camera_centre, decompose_camera
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.types import F64, I64, Reconstruction

MAX_POINTS = 25_000


@dataclass(frozen=True)
class Scene:
    """What the 3D view draws, z up.

    ``points`` (M, 3) and their number ``index`` (M,) in X; ``views`` (C,) the
    registered ones, ``centres`` (C, 3) and ``corners`` (C, 4, 3) of their pyramids, first two along the upper
    edge of the photograph; ``low, high`` (3,) the box to show.
    """

    points: F64
    index: I64
    views: I64
    centres: F64
    corners: F64
    low: F64
    high: F64


def build_scene(reconstruction: Reconstruction, *, max_points: int = MAX_POINTS) -> Scene | None:
    """The drawable scene of a metric or affine reconstruction; None without a registered camera.

    At most ``max_points`` points, evenly thinned in the order of X, those beyond four times the 80 % distance
    from the median left out. Lengths stay in the reconstruction's own (arbitrary) unit.
    """
    views = np.flatnonzero(reconstruction.registered).astype(np.int64)
    if len(views) == 0:
        return None
    parts = [decompose_camera(reconstruction.P[i]) for i in views]
    rotations = np.stack([R for _, R, _ in parts])
    centres = np.stack([dehomogenize(camera_centre(reconstruction.P[i])) for i in views])
    upright = upright_rotation(rotations)
    index = _kept_points(reconstruction, max_points)
    points = reconstruction.X[index, :3] @ upright.T
    centres_up = centres @ upright.T
    depth = _pyramid_depth(centres_up, points)
    corners = np.stack(
        [
            centre + depth * _corner_rays(K, reconstruction.sizes[i]) @ R @ upright.T
            for i, (K, R, _), centre in zip(views, parts, centres_up, strict=True)
        ]
    )
    low, high = _box(np.concatenate([points, centres_up, corners.reshape(-1, 3)]))
    return Scene(points, index, views, centres_up, corners, low, high)


def upright_rotation(rotations: F64) -> F64:
    """Turn of the world (3, 3) that puts z up and the cameras' mean gaze along +y.

    ``rotations`` (C, 3, 3) world-to-camera. Photographers hold the camera level, so up is orthogonal to the x
    axes of the cameras; a little weight on the optical axes decides where all x axes are parallel. The sign
    is that of the mean upper side of the photographs.
    """
    x_axes, y_axes, z_axes = rotations[:, 0], rotations[:, 1], rotations[:, 2]
    _, vectors = np.linalg.eigh(x_axes.T @ x_axes + 0.1 * z_axes.T @ z_axes)
    up = vectors[:, 0] if vectors[:, 0] @ y_axes.sum(axis=0) <= 0 else -vectors[:, 0]
    gaze = z_axes.sum(axis=0)
    gaze = gaze - (gaze @ up) * up
    if np.linalg.norm(gaze) < 0.1 * len(z_axes):  # cameras all round the object: look as the first one does
        gaze = z_axes[0] - (z_axes[0] @ up) * up
    if np.linalg.norm(gaze) < 1e-6:  # it looks straight down: its upper side is as good as any direction
        gaze = -y_axes[0] + (y_axes[0] @ up) * up
    ahead = gaze / np.linalg.norm(gaze)
    return np.stack([np.cross(ahead, up), ahead, up])


def _kept_points(reconstruction: Reconstruction, max_points: int) -> I64:
    valid = np.flatnonzero(reconstruction.valid & np.isfinite(reconstruction.X).all(axis=1))
    if len(valid) == 0:
        return valid.astype(np.int64)
    X = reconstruction.X[valid, :3]
    distance = np.linalg.norm(X - np.median(X, axis=0), axis=1)
    near: I64 = valid[distance <= 4.0 * np.quantile(distance, 0.8)].astype(np.int64)
    step = max(1, int(np.ceil(len(near) / max_points)))
    return near[::step]


def _corner_rays(K: F64, size: NDArray[np.int64]) -> F64:
    """Rays (4, 3) of unit depth through the photograph's corners, clockwise from the top left."""
    width, height = float(size[0]), float(size[1])
    xy = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    return homogenize(xy) @ np.linalg.inv(K).T


def _pyramid_depth(centres: F64, points: F64) -> float:
    """A depth that keeps neighbouring pyramids apart, within 4 and 15 % of the reach of the scene."""
    everything = np.concatenate([centres, points])
    reach = float(np.linalg.norm(np.ptp(everything, axis=0))) / 2 or 1.0
    if len(centres) < 2:
        return 0.15 * reach
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    return float(np.clip(0.4 * np.median(gaps.min(axis=1)), 0.04 * reach, 0.15 * reach))


def _box(corners: F64) -> tuple[F64, F64]:
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.03 * float((high - low).max()) or 1.0
    return low - margin, high + margin

"""Depth maps and photographs of the unit sphere."""

from functools import cache

import numpy as np

from tests.synthetic import looking_along
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.records import DepthMap, PinholeView
from thesisrecon.surface.fusion import VolumetricFusion

K = np.array([[150.0, 0.0, 79.5], [0.0, 150.0, 59.5], [0.0, 0.0, 1.0]])
SHAPE = (120, 160)


def looking_at_origin(angle, height, distance):
    """P of a camera that looks at the origin from ``angle`` (rad) about the vertical."""
    centre = np.array([np.sin(angle) * distance, height, -np.cos(angle) * distance])
    return camera_from_centre(K, looking_along(-centre), centre)


def paint(X):
    """Colours (..., 3) of points (..., 3) of the sphere."""
    waves = np.stack([np.sin(9 * X[..., 0] + 4 * X[..., 1]), np.sin(8 * X[..., 1] - 5 * X[..., 2])], axis=-1)
    third = np.cos(10 * X[..., 2] + 3 * X[..., 0])
    return 128.0 + 60.0 * np.concatenate([waves, third[..., None]], axis=-1)


def points_of(depth_map):
    """Points (H, W, 3) of the pixels, NaN where there is no depth."""
    y, x = np.indices(depth_map.depth.shape)
    M = depth_map.P[:, :3]
    rays = np.stack([x, y, np.ones(x.shape)], axis=-1) @ np.linalg.inv(M).T
    return rays * depth_map.depth[..., None].astype(float) - np.linalg.solve(M, depth_map.P[:, 3])


def photograph(depth_map, gain=1.0):
    """The painted sphere before black, seen where the depth map is, exposed by ``gain``."""
    color = np.nan_to_num(paint(points_of(depth_map))) * gain
    color[np.isnan(depth_map.depth)] = 0.0
    rgb = np.clip(np.rint(color), 0, 255).astype(np.uint8)
    return PinholeView(depth_map.view, depth_map.P, rgb, np.ones(rgb.shape[:2], dtype=bool))


def ring_of(count=8):
    """Views from all round, above and below in turn."""
    turns = [looking_at_origin(2 * np.pi * k / count, 1.5 * (-1) ** k, 3.5) for k in range(count)]
    return [sphere_map(k, P) for k, P in enumerate(turns)]


@cache
def fused_sphere():
    """The sphere of the ring as a fine mesh."""
    return VolumetricFusion(tolerance=0.0).fuse(ring_of())


def sphere_map(view, P, *, noise=0.0, seed=0):
    """Depth of the unit sphere; std as the noise, at least 1e-4."""
    y, x = np.indices(SHAPE)
    M = P[:, :3]
    centre = -np.linalg.solve(M, P[:, 3])
    rays = np.stack([x, y, np.ones(SHAPE)], axis=-1) @ np.linalg.inv(M).T
    a, b, c = (rays**2).sum(-1), rays @ centre, centre @ centre - 1.0
    under = b**2 - a * c
    with np.errstate(invalid="ignore"):
        depth = np.where(under > 0.0, (-b - np.sqrt(under)) / a, np.nan)
    depth += noise * np.random.default_rng(seed + view).normal(size=SHAPE)
    std = np.full(SHAPE, max(noise, 1e-4), dtype=np.float32)
    return DepthMap(view, P, depth.astype(np.float32), std, np.ones(SHAPE, dtype=np.uint8))

"""Scenes of rectangles that are hard to match, with exact depth: fences, tunnels, blank walls."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.ndimage import map_coordinates

from tests.stereo.depth_scenes import Walled, observed_points
from tests.synthetic import texture
from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.records import Image

PER_UNIT = 60.0
"""Texels a unit of length."""


@dataclass(frozen=True)
class Rectangle:
    """A corner and two edges; its grey levels, or one for all of it."""

    corner: tuple[float, float, float]
    along: tuple[float, float, float]
    up: tuple[float, float, float]
    levels: F64 | float


@cache
def textured(seed):
    """Grey levels that go on by reflection."""
    return texture(300, 300, seed)


def fence(seed=0):
    """Slats of 0.25, as far apart as they are wide, at depth 4 before a wall at 6: occlusions everywhere."""
    places = [0.5 * k - 4.0 for k in range(16)]
    slats = [
        Rectangle((x, -3.0, 4.0), (0.25, 0, 0), (0, 6.0, 0), textured(seed + k))
        for k, x in enumerate(places, 1)
    ]
    return [Rectangle((-6.0, -5.0, 6.0), (12.0, 0, 0), (0, 10.0, 0), textured(seed)), *slats]


def tunnel(seed=0):
    """Four walls along the way and one at its end."""
    z = (0.0, 0.0, 14.0)
    sides = [((-1.5, -1.2, -1.0), (0, 2.4, 0)), ((1.5, -1.2, -1.0), (0, 2.4, 0))]
    sides += [((-1.5, -1.2, -1.0), (3.0, 0, 0)), ((-1.5, 1.2, -1.0), (3.0, 0, 0))]
    walls = [Rectangle(corner, z, up, textured(seed + k)) for k, (corner, up) in enumerate(sides)]
    return [*walls, Rectangle((-1.5, -1.2, 13.0), (3.0, 0, 0), (0, 2.4, 0), textured(seed + 9))]


def blank_wall(rim=1.2, seed=0):
    """A blank square with a textured rim of that width, leaning away, at depth 5 in its middle."""
    wall = leaning(4.0, 5.0, textured(seed))
    return [wall, leaning(4.0 - rim, 5.0 - 1e-6, 140.0)]


def leaning(half, depth, levels):
    """A square about the optical axis that leans away to the right."""
    slope = 0.3
    corner = (-half, -half, depth - slope * half)
    return Rectangle(corner, (2 * half, 0, 2 * slope * half), (0, 2 * half, 0), levels)


def looking_ahead(places, *, focal=200.0, size=(200, 150)):
    """Cameras (V, 3, 4) at places, all looking along z."""
    K = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    return np.array([camera_from_centre(K, np.eye(3), np.array(place, dtype=float)) for place in places])


def photograph_scene(P, rectangles, *, sizes=None, noise=1.0, points=400, seed=0):
    """What cameras P (V, 3, 4) see, with noise of so many grey levels, and so many exact sparse points."""
    rng = np.random.default_rng(seed)
    wanted = [(200, 150)] * len(P) if sizes is None else list(sizes)
    images, depths = [], []
    for view, (camera, size) in enumerate(zip(P, wanted, strict=True)):
        depth, gray = trace(camera, rectangles, size)
        gray = gray + noise * rng.normal(size=gray.shape)
        rgb = np.repeat(np.clip(np.rint(gray), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        images.append(Image(f"{view}.png", rgb, size))
        depths.append(depth)
    reconstruction = sparse(P, depths, rectangles, points, rng)
    return Walled(tuple(images), reconstruction, tuple(depths))


def trace(P, rectangles, size):
    """Depth (inf where nothing is) and grey level (H, W)."""
    x, y = np.meshgrid(np.arange(float(size[0])), np.arange(float(size[1])))
    M = np.linalg.inv(P[:, :3])
    centre, rays = -M @ P[:, 3], homogenize(np.stack([x, y], axis=-1).reshape(-1, 2)) @ M.T
    best, level = np.full(len(rays), np.inf), np.full(len(rays), 90.0)
    for r in rectangles:
        along, up = np.array(r.along, dtype=float), np.array(r.up, dtype=float)
        A = np.linalg.inv(np.stack([along, up, np.cross(along, up)], axis=1))
        start, step = A @ (centre - np.array(r.corner)), rays @ A.T
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -start[2] / step[:, 2]
            u, v = start[:2, None] + t * step[:, :2].T
        hit = (t > 1e-6) & (t < best) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        best[hit] = t[hit]
        if isinstance(r.levels, float):
            level[hit] = r.levels
        else:
            places = PER_UNIT * np.stack([v[hit] * np.linalg.norm(up), u[hit] * np.linalg.norm(along)])
            level[hit] = map_coordinates(r.levels, places, order=1, mode="reflect")
    return best.reshape(x.shape), level.reshape(x.shape)


def sparse(P, depths, rectangles, points, rng):
    """Exact points on textured surfaces, from every view in turn, observed by all that see them."""
    blank = [r for r in rectangles if isinstance(r.levels, float)]
    found = []
    for camera, depth in zip(P, depths, strict=True):
        height, width = depth.shape
        at = np.stack([rng.integers(2, width - 2, points), rng.integers(2, height - 2, points)], axis=1)
        z = depth[at[:, 1], at[:, 0]]
        M = np.linalg.inv(camera[:, :3])
        at, z = at[np.isfinite(z)], z[np.isfinite(z)]
        X = (M @ (homogenize(at.astype(float)).T * z - camera[:, 3:])).T
        for r in blank:
            away = X - np.array(r.corner)
            u, v = (away @ np.array(edge) / np.dot(edge, edge) for edge in (r.along, r.up))
            away_from_it = (u < 0) | (u > 1) | (v < 0) | (v > 1)
            X = X[away_from_it]
        found.append(X)
    return observed_points(P, depths, np.concatenate(found), np.zeros(3))

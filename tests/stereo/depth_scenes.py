"""Photographs of textured rectangles with exact depth; a wall with a board before it."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from tests.synthetic import looking_along, photograph, reconstruction_of, texture
from thesisrecon.arrays import F64
from thesisrecon.camera import decompose_camera
from thesisrecon.geometry import camera_matrix as matrix
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.lens import distort, undistort
from thesisrecon.records import Image, Reconstruction, Tracks

SIZE = (240, 180)
RADIAL = np.array([-0.08, 0.02, 0.0])
PER_UNIT = 60.0
"""Texels a unit of length."""


@dataclass(frozen=True)
class Rectangle:
    """A corner and two edges; its grey levels, or one for all of it."""

    corner: tuple[float, float, float]
    along: tuple[float, float, float]
    up: tuple[float, float, float]
    levels: F64 | float


@dataclass(frozen=True)
class Scene:
    """Photographs, their reconstruction, and true depth (H, W) of every view without distortion."""

    images: tuple[Image, ...]
    reconstruction: Reconstruction
    depth: tuple[F64, ...]


def on_arc(angles_deg, *, distance=6.0):
    """Cameras (V, 3, 4) about a point on the wall."""
    K = np.array([[260.0, 0.0, 121.0], [0.0, 260.0, 88.0], [0.0, 0.0, 1.0]])
    cameras = []
    for k, angle in enumerate(np.radians(angles_deg)):
        centre = distance * np.array([np.sin(angle), 0.06 * (-1) ** k, -np.cos(angle)])
        cameras.append(matrix.camera_from_centre(K, looking_along(-centre), centre))
    return np.array(cameras)


def make_walled(P, *, lens=(0.0, 0.0, 0.0)):
    """A board at Z = -0.8 before a wall that leans away."""
    wall = Rectangle((-10.0, -7.5, -2.0), (20.0, 0, 4.0), (0, 15.0, 0), texture(900, 900, 0))
    board = Rectangle((-0.7, -0.7, -0.8), (1.4, 0, 0), (0, 1.4, 0), texture(900, 900, 1))
    return photograph_scene(P, [wall, board], sizes=[SIZE] * len(P), noise=0.0, lens=lens)


def photograph_scene(P, rectangles, *, sizes=None, noise=1.0, points=400, seed=0, lens=(0.0, 0.0, 0.0)):
    """What cameras P (V, 3, 4) see, with noise in grey levels, and exact sparse points of every view."""
    rng = np.random.default_rng(seed)
    images, depths, X = [], [], []
    for view, (camera, size) in enumerate(zip(P, sizes or [(200, 150)] * len(P), strict=True)):
        shape = size[::-1]
        xy = np.indices(shape)[::-1].reshape(2, -1).T.astype(float)
        K = decompose_camera(camera)[0]
        straight = undistort((xy - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T, lens) @ K[:2, :2].T + K[:2, 2]
        gray = trace(camera, rectangles, straight)[1].reshape(shape)
        images.append(photograph(gray + noise * rng.normal(size=shape), f"{view}.png"))
        depth, _, textured = trace(camera, rectangles, xy)
        chosen = rng.choice(np.flatnonzero(textured), min(points, int(textured.sum())), replace=False)
        rays = homogenize(xy[chosen]) * depth[chosen, None] - camera[:, 3]
        X.append(rays @ np.linalg.inv(camera[:, :3]).T)
        depths.append(depth.reshape(shape))
    return Scene(tuple(images), observed_points(P, depths, np.concatenate(X), lens), tuple(depths))


def trace(P, rectangles, xy):
    """Depth (inf where nothing is), grey level, and whether it has texture, of pixels (N, 2)."""
    M = np.linalg.inv(P[:, :3])
    centre, rays = -M @ P[:, 3], homogenize(xy) @ M.T
    best, level, textured = np.full(len(rays), np.inf), np.full(len(rays), 90.0), np.zeros(len(rays), bool)
    for r in rectangles:
        along, up = np.array(r.along, dtype=float), np.array(r.up, dtype=float)
        A = np.linalg.inv(np.stack([along, up, np.cross(along, up)], axis=1))
        start, step = A @ (centre - np.array(r.corner)), rays @ A.T
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -start[2] / step[:, 2]
            u, v = start[:2, None] + t * step[:, :2].T
        hit = (t > 1e-6) & (t < best) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        best[hit], textured[hit] = t[hit], not isinstance(r.levels, float)
        if isinstance(r.levels, float):
            level[hit] = r.levels
        else:
            places = PER_UNIT * np.stack([v[hit] * np.linalg.norm(up), u[hit] * np.linalg.norm(along)])
            level[hit] = map_coordinates(r.levels, places, order=1, mode="reflect")
    return best, level, textured


def observed_points(P, depths, X, lens):
    """A metric reconstruction of points X (N, 3), observed by every view whose depth map shows them."""
    K = np.stack([decompose_camera(camera)[0] for camera in P])
    views, points, seen_at = [], [], []
    for k, (camera, depth) in enumerate(zip(P, depths, strict=True)):
        z = X @ camera[2, :3] + camera[2, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = matrix.project(camera, X)
        limit = np.array(depth.shape[::-1]) - 1.0
        inside = (z > 0) & np.all((xy >= 0) & (xy <= limit), axis=1)
        at = np.where(inside[:, None], np.rint(xy), 0).astype(np.int64)
        n = np.flatnonzero(inside & (np.abs(depth[at[:, 1], at[:, 0]] / np.where(z > 0, z, 1) - 1) < 0.02))
        views.append(np.full(len(n), k))
        points.append(n)
        normalized = (xy[n] - K[k, :2, 2]) @ np.linalg.inv(K[k, :2, :2]).T
        seen_at.append(distort(normalized, lens) @ K[k, :2, :2].T + K[k, :2, 2])
    view, point = np.concatenate(views), np.concatenate(points)
    order = np.lexsort((view, point))
    tracks = Tracks(view[order], point[order], np.concatenate(seen_at)[order], len(P), len(X))
    sizes = np.array([depth.shape[::-1] for depth in depths])
    distortion = np.tile(lens, (len(P), 1))
    return reconstruction_of(P, sizes, X=homogenize(X), tracks=tracks, K=K, distortion=distortion)

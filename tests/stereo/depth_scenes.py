"""A wall with a board in front of it, photographed from an arc: everything about it is known exactly."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from tests.synthetic import reconstruction_of, texture
from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import (
    camera_from_centre,
    decompose_camera,
    distort,
    project,
    undistort,
)
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.records import Image, Reconstruction, Tracks

SIZE = (240, 180)
FOCAL = 260.0
RADIAL = np.array([-0.08, 0.02, 0.0])


@dataclass(frozen=True)
class Walled:
    """Photographs, their reconstruction, and true depth (H, W) of every view without distortion."""

    images: tuple[Image, ...]
    reconstruction: Reconstruction
    depth: tuple[F64, ...]


def calibration():
    return np.array([[FOCAL, 0.0, 121.0], [0.0, FOCAL, 88.0], [0.0, 0.0, 1.0]])


def on_arc(angles_deg, *, distance=6.0):
    """Cameras (V, 3, 4) about a point on the wall."""
    cameras = []
    for k, angle in enumerate(np.radians(angles_deg)):
        centre = distance * np.array([np.sin(angle), 0.06 * (-1) ** k, -np.cos(angle)])
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        cameras.append(camera_from_centre(calibration(), np.array([x, np.cross(z, x), z]), centre))
    return np.array(cameras)


def make_walled(P, *, distortion=None, plain=False, seed=0):
    """Photographs by cameras P (V, 3, 4) through a lens; a ``plain`` wall and board have no texture."""
    textures = [
        np.full((900, 900), 90.0 + 60.0 * k) if plain else texture(900, 900, seed + k) for k in (0, 1)
    ]
    lens = np.zeros(3) if distortion is None else distortion
    x, y = np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1])))
    xy = np.stack([x, y], axis=-1).reshape(-1, 2)
    images, depths = [], []
    for view, camera in enumerate(P):
        depths.append(_trace(camera, xy, textures)[0].reshape(x.shape))
        K = decompose_camera(camera)[0]
        straight = undistort((xy - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T, lens) @ K[:2, :2].T + K[:2, 2]
        gray = _trace(camera, straight, textures)[1].reshape(x.shape)
        rgb = np.repeat(np.clip(np.rint(gray), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        images.append(Image(f"{view}.png", rgb, SIZE))
    return Walled(tuple(images), _reconstruction(P, lens, depths, seed), tuple(depths))


def _trace(P, xy, textures):
    """Depth and grey level (N,): a board |X|, |Y| < 0.7 at Z = -0.8 before a leaning wall Z = 0.2 X."""
    M = np.linalg.inv(P[:, :3])
    centre, rays = -M @ P[:, 3], homogenize(xy) @ M.T
    board = (-0.8 - centre[2]) / rays[:, 2]
    wall = (0.2 * centre[0] - centre[2]) / (rays[:, 2] - 0.2 * rays[:, 0])
    hit = centre + board[:, None] * rays
    near = (np.abs(hit[:, :2]) < 0.7).all(axis=1)
    depth = np.where(near, board, wall)
    X = centre + depth[:, None] * rays
    places = 450.0 + 70.0 * X[:, :2].T[::-1]
    levels = [map_coordinates(t, places, order=3, mode="reflect") for t in textures]
    return depth, np.where(near, levels[1], levels[0])


def _reconstruction(P, lens, depths, seed):
    """Points on the surface seen in view 0, observed by every view that sees them."""
    rng = np.random.default_rng(seed)
    pixel = np.stack([rng.integers(4, SIZE[0] - 4, 400), rng.integers(4, SIZE[1] - 4, 400)], axis=1)
    M = np.linalg.inv(P[0, :, :3])
    X = M @ (homogenize(pixel.astype(np.float64)).T * depths[0][pixel[:, 1], pixel[:, 0]] - P[0, :, 3:])
    return observed_points(P, depths, X.T, lens)


def observed_points(P, depths, X, lens):
    """A metric reconstruction of points X (N, 3), observed by every view whose depth map shows them."""
    K = np.stack([decompose_camera(camera)[0] for camera in P])
    views, points, seen_at = [], [], []
    for k, (camera, depth) in enumerate(zip(P, depths, strict=True)):
        z = X @ camera[2, :3] + camera[2, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = project(camera, X)
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

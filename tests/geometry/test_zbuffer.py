"""The z-buffer against rays."""

import numpy as np
import pytest

from thesisrecon.camera import Camera
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.zbuffer import Raster, rasterize

K = np.array([[60.0, 0.0, 31.3], [0.0, 62.0, 22.7], [0.0, 0.0, 1.0]])
SIZE = (64, 48)


def soup(rng, count=60):
    """Triangles about (0, 0, 5), some of them large."""
    middle = rng.uniform([-3, -2, 3], [3, 2, 8], (count, 1, 3))
    vertices = (middle + rng.normal(0.0, 0.8, (count, 3, 3))).reshape(-1, 3)
    return vertices, np.arange(3 * count).reshape(-1, 3)


def cast_rays(vertices, faces, camera):
    """Depth (H, W) and face by intersecting every ray with every triangle: the plain twin."""
    width, height = camera.size
    y, x = np.mgrid[:height, :width]
    rays = homogenize(np.column_stack([x.ravel(), y.ravel()]).astype(float)) @ np.linalg.inv(camera.K).T
    seen = vertices @ camera.R.T + camera.t
    depth, face = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for m, corners in enumerate(seen[faces]):
        if abs(np.linalg.det(corners)) < 1e-12:
            continue
        weights = rays @ np.linalg.inv(corners)
        total = weights.sum(axis=1)
        hit = (weights >= 0.0).all(axis=1) & (total > 0.0)
        z = np.where(hit, 1.0 / np.where(hit, total, 1.0), np.inf)
        nearer = hit & (z < depth) & (z > 1e-5)
        depth[nearer], face[nearer] = z[nearer], m
    return depth.reshape(height, width), face.reshape(height, width)


def camera_at(rng, distance=0.0):
    angle = rng.normal(0.0, 0.2, 3)
    turn = np.array([[0, -angle[2], angle[1]], [angle[2], 0, -angle[0]], [-angle[1], angle[0], 0]])
    R = np.linalg.qr(np.eye(3) + turn)[0]
    R *= np.sign(np.diag(R))[None, :]
    return Camera(K, R * np.sign(np.linalg.det(R)), np.array([0.1, -0.2, distance]), SIZE)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("distance", [0.0, -4.5], ids=["before", "within"])
def test_what_is_seen_is_what_rays_meet(seed, distance):
    rng = np.random.default_rng(seed)
    vertices, faces = soup(rng)
    camera = camera_at(rng, distance)
    raster = rasterize(vertices, faces, camera)
    depth, face = cast_rays(vertices, faces, camera)
    agree = raster.face == face
    assert agree.mean() > 0.998  # at edges rounding decides
    seen = agree & (face >= 0)
    assert seen.mean() > 0.1
    np.testing.assert_allclose(raster.depth[seen], depth[seen], rtol=1e-5)


@pytest.mark.parametrize("unit", [2.0**-30, 2.0**30])
def test_the_unit_of_length_changes_nothing(unit):
    vertices, faces = soup(np.random.default_rng(6))
    camera = camera_at(np.random.default_rng(7), -4.5)
    other = Camera(camera.K, camera.R, unit * camera.t, SIZE)
    one, scaled = rasterize(vertices, faces, camera), rasterize(unit * vertices, faces, other)
    assert (one.face >= 0).mean() > 0.1
    np.testing.assert_array_equal(scaled.face, one.face)
    np.testing.assert_array_equal(scaled.depth, np.float32(unit) * one.depth)


def test_points_are_where_the_corners_say():
    rng = np.random.default_rng(5)
    vertices, faces = soup(rng)
    camera = camera_at(rng)
    raster = rasterize(vertices, faces, camera)
    points = raster.interpolate(vertices[faces])
    seen = raster.face >= 0
    xyz = homogenize(points[seen].astype(float)) @ camera.P.T
    y, x = np.nonzero(seen)
    np.testing.assert_allclose(xyz[:, :2] / xyz[:, 2:], np.column_stack([x, y]), atol=2e-3)
    np.testing.assert_allclose(xyz[:, 2], raster.depth[seen], rtol=1e-4)


def test_no_crack_opens_between_faces():
    rng = np.random.default_rng(2)
    n = 25
    v, u = np.mgrid[:n, :n] / (n - 1.0)
    vertices = np.stack([8 * u - 4, 8 * v - 4, 4 + rng.normal(0, 0.05, u.shape)], axis=-1).reshape(-1, 3)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    assert (rasterize(vertices, faces, Camera(K, np.eye(3), np.zeros(3), SIZE)).face >= 0).all()


def test_threads_change_nothing():
    rng = np.random.default_rng(3)
    vertices, faces = soup(rng)
    one, three = (rasterize(vertices, faces, camera_at(np.random.default_rng(1)), threads=n) for n in (1, 3))
    for name in Raster.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))


def test_a_camera_is_that_of_its_matrix():
    camera = camera_at(np.random.default_rng(4), 1.0)
    again = Camera.from_matrix(-3.0 * camera.P, SIZE)
    np.testing.assert_allclose(again.P, camera.P, atol=1e-9)
    np.testing.assert_allclose(camera.P @ np.append(camera.centre, 1.0), 0.0, atol=1e-9)
    xy = homogenize(np.array([[0.3, -0.1, 4.0]])) @ camera.P.T
    finer = homogenize(np.array([[0.3, -0.1, 4.0]])) @ camera.resized(3.0).P.T
    x, x3 = xy[:, :2] / xy[:, 2:], finer[:, :2] / finer[:, 2:]
    np.testing.assert_allclose(x3, 3.0 * (x + 0.5) - 0.5, atol=1e-9)

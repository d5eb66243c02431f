"""Resampling of images and the z-buffer."""

import numpy as np
import pytest
from scipy.ndimage import convolve1d
from scipy.spatial.transform import Rotation

from tests.synthetic import texture
from thesisrecon.camera import Camera
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.imaging.raster import Raster, image_corners, rasterize, rasterize_rows
from thesisrecon.imaging.resampling import cubic_weights, gaussian_taps, halve, resample, smooth


def test_smoothing_equals_its_numpy_twin():
    image = texture(37, 52).astype(np.float32)
    taps = gaussian_taps(1.5)
    twin = convolve1d(convolve1d(image, taps, axis=0, mode="nearest"), taps, axis=1, mode="nearest")
    assert np.abs(smooth(image, 1.5) - twin).max() < 1e-3


@pytest.mark.parametrize(("height", "width"), [(31, 44), (30, 45)])
def test_halving_equals_its_numpy_twin(height, width):
    image = texture(height, width).astype(np.float32)
    twin = np.pad(image, 1, mode="edge")
    for size in (height, width):
        twin = ((twin[0:-3:2] + 3 * twin[1:-2:2] + 3 * twin[2:-1:2] + twin[3::2])[: size // 2] / 8).T
    assert halve(image).shape == (15, 22)
    assert np.abs(halve(image) - twin).max() < 1e-3


@pytest.mark.parametrize(("width", "height"), [(61, 45), (20, 15), (80, 60)])
def test_resampling_keeps_the_image_area_in_place(width, height):
    y, x = np.mgrid[0:30, 0:40].astype(np.float32)
    small = resample(3.0 * x + 2.0 * y, width, height)
    u = (np.arange(width) + 0.5) * 40 / width - 0.5
    v = (np.arange(height) + 0.5) * 30 / height - 0.5
    expected = 3.0 * np.clip(u, 0, 39)[None] + 2.0 * np.clip(v, 0, 29)[:, None]
    assert np.abs(small - expected).max() < 1e-3


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
    depth, face = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for m, corners in enumerate((vertices @ camera.R.T + camera.t)[faces]):
        weights = rays @ np.linalg.inv(corners)
        total = weights.sum(axis=1)
        z = np.where((weights >= 0.0).all(axis=1) & (total > 0.0), 1.0 / total, np.inf)
        nearer = (z < depth) & (z > 1e-5)
        depth[nearer], face[nearer] = z[nearer], m
    return depth.reshape(height, width), face.reshape(height, width)


def camera_at(rng, distance=0.0):
    R = Rotation.from_rotvec(rng.normal(0.0, 0.2, 3)).as_matrix()
    return Camera(K, R, np.array([0.1, -0.2, distance]), SIZE)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("distance", [0.0, -4.5], ids=["before", "within"])
def test_visible_points_are_those_that_rays_meet(seed, distance):
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


def test_points_are_where_the_corners_say_and_rows_are_those_of_the_whole():
    rng = np.random.default_rng(5)
    vertices, faces = soup(rng)
    camera = camera_at(rng)
    raster = rasterize(vertices, faces, camera)
    seen = raster.face >= 0
    xyz = homogenize(raster.interpolate(vertices[faces])[seen].astype(float)) @ camera.P.T
    np.testing.assert_allclose(dehomogenize(xyz), np.argwhere(seen)[:, ::-1], atol=2e-3)
    np.testing.assert_allclose(xyz[:, 2], raster.depth[seen], rtol=1e-4)
    rng = np.random.default_rng(3)
    vertices, faces = soup(rng)
    camera = camera_at(np.random.default_rng(1))
    whole = rasterize(vertices, faces, camera)
    rows = rasterize_rows(*image_corners(vertices, faces, camera), (7, 30), camera.size[0])
    for name in Raster.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(whole[7:30], name), getattr(rows, name))


def test_no_crack_opens_between_faces():
    rng = np.random.default_rng(2)
    n = 25
    v, u = np.mgrid[:n, :n] / (n - 1.0)
    vertices = np.stack([8 * u - 4, 8 * v - 4, 4 + rng.normal(0, 0.05, u.shape)], axis=-1).reshape(-1, 3)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    assert (rasterize(vertices, faces, Camera(K, np.eye(3), np.zeros(3), SIZE)).face >= 0).all()


def keys_kernel(x):
    """Keys' kernel with a = -1/2 at distances x from a pixel, written as in the paper."""
    s = np.abs(x)
    near = 1.5 * s**3 - 2.5 * s**2 + 1.0
    far = -0.5 * s**3 + 2.5 * s**2 - 4.0 * s + 2.0
    return np.where(s <= 1.0, near, np.where(s < 2.0, far, 0.0))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.73, 1.0])
def test_cubic_weights_are_those_of_keys(share):
    weights = np.empty(4)
    cubic_weights(share, weights)
    np.testing.assert_allclose(weights, keys_kernel(share - np.arange(-1.0, 3.0)), atol=1e-15)
    assert weights.sum() == pytest.approx(1.0, abs=1e-15)

"""Conventions between our records and COLMAP's, at their border: half pixels, quaternions, poses, indices."""

import numpy as np
import PIL.Image
import pytest

from tests.validation.references.conftest import skip_without
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from validation.references.ceres import colmap_model
from validation.references.colmap import match_with_pycolmap, read_colmap_model
from validation.references.fundamental import colmap_points
from validation.references.libraries import pycolmap

skip_without("pycolmap")

SIZE = (640, 480)
K1 = (-0.12, 0.07)


def problem(looked):
    """Both cameras with radial distortion; each point seen by both, in an order of nobody's."""
    rows = [[K[0, 0], 1.0, 0.0, K[0, 2], K[1, 2], k1] for K, k1 in zip(looked.K, K1, strict=True)]
    cameras = MetricCameras(looked.R, looked.t, np.array(rows), np.arange(2))
    order = np.random.default_rng(0).permutation(2 * len(looked.X))
    view, point = np.divmod(order, len(looked.X))
    return cameras, Observations(view, point, distorted(looked)[view, point])


def distorted(looked):
    """Pixels (2, N, 2) by the formula: x (1 + k1 r^2) with r in the plane at distance 1."""
    x = np.einsum("vab,nb->vna", looked.R, looked.X) + looked.t[:, None]
    u = x[..., :2] / x[..., 2:]
    u = u * (1.0 + np.array(K1)[:, None, None] * (u**2).sum(axis=-1, keepdims=True))
    return np.asarray(u * looked.K[:, None, 0, :1] + looked.K[:, None, :2, 2])


def test_colmap_sees_our_points_half_a_pixel_farther(looked):
    cameras, seen = problem(looked)
    model = colmap_model(cameras, looked.X, seen, SIZE)
    for v, xy in enumerate(distorted(looked)):
        image = model.images[v + 1]
        camera, pose = model.cameras[image.camera_id], image.cam_from_world()
        theirs = camera.img_from_cam(np.array([pose * X for X in looked.X]))
        np.testing.assert_allclose(theirs, xy + 0.5, atol=1e-9)
        for point in image.points2D:
            expected = theirs[point.point3D_id - 1]
            np.testing.assert_allclose(point.xy, expected, atol=1e-9)
    for j in (0, 17, len(looked.X) - 1):
        np.testing.assert_array_equal(model.points3D[j + 1].xyz, looked.X[j])


@pytest.mark.parametrize("text", [True, False])
def test_files_that_colmap_writes_mean_the_same_to_us(looked, tmp_path, text):
    cameras, seen = problem(looked)
    model = colmap_model(cameras, looked.X, seen, SIZE)
    (model.write_text if text else model.write_binary)(tmp_path)
    read = read_colmap_model(tmp_path, ["0.png", "1.png"])
    assert read.K is not None
    assert read.distortion is not None
    np.testing.assert_allclose(read.K, looked.K, atol=1e-9)
    np.testing.assert_allclose(read.distortion[:, 0], K1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(read.K) @ read.P, looked.P_normalised, atol=1e-9)
    xy = distorted(looked)
    for v in range(2):
        here = read.tracks.view_index == v
        np.testing.assert_allclose(
            read.tracks.xy[here], xy[v, read.tracks.point_index[here]], atol=1e-9 if not text else 1e-3
        )
    np.testing.assert_allclose(dehomogenize(read.X), looked.X, atol=1e-9)


def test_sift_keypoints_are_shifted_by_half_a_pixel(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    y, x = np.indices((96, 128))
    grey = 255.0 * np.exp(-((x - 70.0) ** 2 + (y - 40.0) ** 2) / 32.0)
    for name in ("a.png", "b.png"):
        PIL.Image.fromarray(grey.astype(np.uint8)).save(images / name)
    match_with_pycolmap(images, tmp_path / "out", threads=1)
    store = pycolmap.Database.open(tmp_path / "out" / "database.db")
    image = store.read_all_images()[0]
    np.testing.assert_allclose(store.read_keypoints(image.image_id)[0, :2], [70.5, 40.5], atol=0.02)
    camera = store.read_camera(image.camera_id)
    assert camera.params[0] == pytest.approx(1.2 * 128)
    assert not camera.has_prior_focal_length
    store.close()


@pytest.mark.parametrize("views", [2, 3])
def test_points_of_world_to_camera_matrices_are_where_they_were(views, looked):
    P, xy = looked.P, looked.xy
    if views == 3:
        third = looked.P[1].copy()
        third[:, 3] += looked.K[1] @ [0.5, -0.8, 0.1]
        x = np.column_stack([looked.X, np.ones(len(looked.X))]) @ third.T
        P, xy = np.concatenate([P, third[None]]), np.concatenate([xy, (x[:, :2] / x[:, 2:])[None]])
    np.testing.assert_allclose(dehomogenize(colmap_points(P, xy)), looked.X, atol=1e-6)

"""The camera record: projection with distortion and its inverse."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon.camera import Camera
from thesisrecon.geometry.zbuffer import rasterize

K = np.array([[800.0, 2.0, 310.0], [0.0, 790.0, 245.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def camera():
    return Camera(
        K,
        Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(),
        np.array([0.2, -0.1, 0.5]),
        (640, 480),
        np.array([-0.1, 0.02]),
    )


def test_unprojection_inverts_projection(camera):
    X = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (50, 3)) @ camera.R + camera.centre
    depth = (X @ camera.R.T + camera.t)[:, 2]
    np.testing.assert_allclose(camera.unproject(camera.project(X), depth), X, atol=1e-9)
    rays = camera.unproject(camera.project(X))
    apart = X - camera.centre
    np.testing.assert_allclose(rays, apart / np.linalg.norm(apart, axis=1, keepdims=True), atol=1e-9)


def test_projection_without_distortion_is_the_camera_matrix(camera):
    pinhole = replace(camera, distortion=None)
    X = np.array([[0.1, 0.2, 3.0], [-1.0, 0.5, 4.0]])
    xh = np.column_stack([X, np.ones(2)]) @ pinhole.P.T
    np.testing.assert_allclose(pinhole.project(X), xh[:, :2] / xh[:, 2:], atol=1e-9)
    assert np.abs(camera.project(X) - pinhole.project(X)).max() > 0.1


def test_scaling_moves_pixels_as_resizing_does(camera):
    X = np.array([[0.1, 0.2, 3.0], [-1.0, 0.5, 4.0]])
    np.testing.assert_allclose(
        camera.scaled(0.5).project(X), (camera.project(X) + 0.5) * 0.5 - 0.5, atol=1e-9
    )


def test_rendering_refuses_distortion(camera):
    assert replace(camera, distortion=np.zeros(3)).is_pinhole
    with pytest.raises(ValueError, match="without distortion"):
        rasterize(np.eye(3), np.array([[0, 1, 2]]), camera)


def test_distortion_of_a_wrong_shape_is_refused(camera):
    with pytest.raises(ValueError, match="distortion"):
        replace(camera, distortion=np.zeros((2, 2)))

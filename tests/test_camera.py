"""The camera record: projection with distortion and its inverse."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon.camera import Camera
from thesisrecon.imaging.raster import rasterize

K = np.array([[800.0, 2.0, 310.0], [0.0, 790.0, 245.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def camera():
    return Camera(
        K, Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.2, -0.1, 0.5]), (640, 480),
        np.array([-0.1, 0.02]),
    )  # fmt: skip


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


def test_rendering_refuses_distortion_and_rotations_of_four_digits_are_accepted(camera):
    replace(camera, R=camera.R.round(4))
    assert replace(camera, distortion=np.zeros(3)).is_pinhole
    refuses(ValueError, "without distortion", rasterize, np.eye(3), np.array([[0, 1, 2]]), camera)


def test_lists_are_converted():
    camera = Camera(K.tolist(), np.eye(3).tolist(), [0, 0, 5], [640, np.int64(480)], [0.1])
    assert camera.size == (640, 480)
    assert all(isinstance(a, np.ndarray) and a.dtype == float for a in (camera.K, camera.R, camera.t))
    X = [[0.1, 0.2, 3.0]]
    np.testing.assert_allclose(camera.unproject(camera.project(X), [8.0]), X, atol=1e-9)
    back = Camera.from_matrix((-2.0 * camera.P).tolist(), (640, 480))
    np.testing.assert_allclose(back.K, K, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"K": K[:2]}, r"needs K \(3, 3\)"), ({"t": np.zeros((3, 1))}, r"got .*\(3, 1\)"),
        ({"R": np.full((3, 3), np.nan)}, "finite"), ({"distortion": np.zeros((2, 2))}, "distortion"),
        ({"distortion": np.array([np.inf])}, "finite"),
        ({"K": K.T}, "upper triangular"), ({"K": -K}, "positive focal lengths"),
        ({"K": 2.0 * K}, "K33 = 1"), ({"R": 1.001 * np.eye(3)}, r"needs a rotation R; .* 0\.002"),
        ({"R": np.zeros((3, 3))}, "needs a rotation R"), ({"R": np.diag([1.0, 1, -1])}, "got a reflection"),
        ({"size": (640.0, 480.0)}, "whole numbers"),
        ({"size": (640,)}, "whole numbers"), ({"size": (640, 0)}, "at least 1 x 1"),
    ],
)  # fmt: skip
def test_impossible_cameras_are_refused(camera, change, words):
    refuses(ValueError, words, replace, camera, **change)


def test_wrong_arguments_are_refused(camera):
    for factor in (0.0, -1.0, np.nan, np.inf):
        refuses(ValueError, "factor above 0", camera.scaled, factor)
    refuses(ValueError, r"needs P \(3, 4\); got \(3, 3\)", Camera.from_matrix, np.eye(3), (640, 480))
    refuses(ValueError, r"needs X \(N, 3\); got \(3,\)", camera.project, np.zeros(3))
    refuses(ValueError, r"needs xy \(N, 2\); got \(4, 3\)", camera.unproject, np.zeros((4, 3)))
    refuses(ValueError, r"depth \(N\); got \(4, 2\), \(3,\)", camera.unproject, np.zeros((4, 2)), np.ones(3))

"""Records: projection of the camera with distortion and its inverse, holes of disparities; counted words."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon.camera import Camera
from thesisrecon.errors import counted
from thesisrecon.imaging.raster import rasterize
from thesisrecon.records import DisparityMap, Tracks

K = np.array([[800.0, 2.0, 310.0], [0.0, 790.0, 245.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def camera():
    return Camera(
        K, Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.2, -0.1, 0.5]), (640, 480),
        np.array([-0.1, 0.02]),
    )  # fmt: skip


def test_unprojection_inverts_projection_which_follows_the_camera_matrix_and_resizing(camera):
    X = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (50, 3)) @ camera.R + camera.centre
    depth, xy = (X @ camera.R.T + camera.t)[:, 2], camera.project(X)
    np.testing.assert_allclose(camera.unproject(xy, depth), X, atol=1e-9)
    apart = X - camera.centre
    rays = apart / np.linalg.norm(apart, axis=1, keepdims=True)
    np.testing.assert_allclose(camera.unproject(xy), rays, atol=1e-9)
    np.testing.assert_allclose(camera.scaled(0.5).project(X), (xy + 0.5) * 0.5 - 0.5, atol=1e-9)
    pinhole = replace(camera, distortion=None)
    xh = np.column_stack([X, np.ones(50)]) @ pinhole.P.T
    np.testing.assert_allclose(pinhole.project(X), xh[:, :2] / xh[:, 2:], atol=1e-9)
    assert np.abs(xy - pinhole.project(X)).max() > 0.1
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


def test_cameras_keep_copies_and_compare_by_value(camera):
    mine = K.copy()
    one, other = (Camera(mine, np.eye(3), np.zeros(3), (640, 480), std={"k1": np.nan}) for _ in range(2))
    mine[0, 0] = 1.0
    np.testing.assert_array_equal(one.K, K)
    refuses(ValueError, "read-only", one.K.fill, 0.0)
    assert one == other
    assert one in [other]
    assert one not in (camera, None, replace(one, t=np.ones(3)), replace(one, distortion=np.zeros(1)))
    refuses(TypeError, "unhashable", hash, one)
    for five in ([-0.2, 0.1, 0.001, 0.0, 0.0], [0.1, 0, 0, 0, 0.01], [0.1, 0.1, 0.1, 0.0]):
        refuses(
            ValueError, "k1, k2, p1, p2, k3 in OpenCV, and k1, k2, k3, k4, k5", replace, one, distortion=five
        )
    assert replace(one, distortion=[0.1, 0.2, 0, 0, 0]).distortion.shape == (5,)
    refuses(ValueError, "hidden by its mask", replace, one, t=np.ma.masked_all(3))


def test_pixels_outside_the_range_of_a_lens_have_no_ray(camera):
    lens = replace(camera, R=np.eye(3), t=np.zeros(3), distortion=np.array([-0.3]))
    # r (1 - 0.3 r^2) grows up to r = 1.054, to 0.703.
    r = np.array([0.0, 0.5, 0.7, 0.71, 3.0])
    rays = lens.unproject(np.column_stack([K[0, 2] + K[0, 0] * r, np.full(5, K[1, 2])]), np.ones(5))
    np.testing.assert_array_equal(np.isfinite(rays).all(axis=1), r < 0.703)
    back = lens.project(rays[:3])
    np.testing.assert_allclose(back[:, 0], K[0, 2] + K[0, 0] * r[:3], atol=1e-6)


def test_holes_are_filled_with_the_farther_side():
    nan = np.nan
    disparity = np.array([[nan, 5, nan, nan, 3, nan], [nan] * 6, [1, nan, 4, nan, 2, 2]], dtype=np.float32)
    filled = DisparityMap(disparity, np.isfinite(disparity).astype(np.float32), 0.5).filled()
    assert filled.dtype == np.float32
    np.testing.assert_array_equal(filled, [[5, 5, 3, 3, 3, 3], [nan] * 6, [1, 1, 4, 2, 2, 2]])


def test_counted_nouns_have_the_right_number():
    assert [counted(n, "photograph") for n in (0, 1, 2)] == ["0 photographs", "1 photograph", "2 photographs"]
    assert [counted(n, "verified match") for n in (1, 7)] == ["1 verified match", "7 verified matches"]
    assert counted(1200, "face", "1 200") == "1 200 faces"


def test_one_point_is_projected_to_one_pixel_and_records_print_as_one_line(camera):
    np.testing.assert_array_equal(camera.project([1.0, 2, 4]), camera.project([[1.0, 2, 4]])[0])
    assert camera.project([1.0, 2, 4]).shape == (2,)
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        camera.project([1.0, 2, 4, 1])
    tracks = Tracks(np.arange(9000), np.arange(9000), np.ones((9000, 2)), 9000, 9000)
    assert repr(tracks).startswith(
        "Tracks(view_index=int64[9000], point_index=int64[9000], xy=float64[9000, 2],"
    )
    assert len(repr(replace(camera, std={f"k{i}": 0.1 for i in range(90)}))) <= 200

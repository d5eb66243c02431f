"""Lens distortion removed, and known cameras rectified, against truth and OpenCV."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon import Camera, match_rectified, rectify_cameras, undistort_image, undistort_points

K = np.array([[500.0, 0, 310], [0, 490, 250], [0, 0, 1]])
K2 = np.array([[520.0, 0, 330], [0, 515, 230], [0, 0, 1]])
SIZE = (640, 480)


def _rig():
    R = Rotation.from_rotvec([0.02, -0.08, 0.05]).as_matrix()
    second = Camera(K2, R, R @ [-0.8, 0.05, 0.1], SIZE, np.array([-0.05]))
    return [Camera(K, np.eye(3), np.zeros(3), SIZE, np.array([-0.2, 0.05, -0.01])), second]


def test_rectified_rows_correspond_and_Q_gives_the_points():
    rig = _rig()
    X = np.random.default_rng(0).uniform(-1, 1, (50, 3)) + np.array([0.0, 0, 5])
    for found in (rectify_cameras(rig), rectify_cameras(rig, K=K, size=(700, 500))):
        left, right = (found.rectified_from_original(i, c.project(X)) for i, c in enumerate(rig))
        np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-6)
        np.testing.assert_allclose(left, found.cameras[0].project(X), atol=1e-6)
        np.testing.assert_allclose(found.original_from_rectified(1, right), rig[1].project(X), atol=1e-6)
        Xh = np.column_stack([left, left[:, 0] - right[:, 0], np.ones(50)]) @ found.Q.T
        np.testing.assert_allclose(Xh[:, :3] / Xh[:, 3:], X @ found.cameras[0].R.T, atol=1e-6)
        assert (left[:, 0] > right[:, 0]).all()
    arrays = tuple(np.array([getattr(camera, name) for camera in rig]) for name in ("K", "R", "t"))
    assert rectify_cameras(arrays, sizes=SIZE).K.shape == (3, 3)
    refuses(ValueError, "two cameras; got 1", rectify_cameras, rig[:1])
    refuses(ValueError, "two camera centres", rectify_cameras, [rig[0], rig[0]])


@pytest.mark.parametrize(("lens", "k"), [
    ("fisheye", [0.02, -0.01, 0.003, 0.001]), ("brown", [-0.1, 0.02, 0.003, 0.002, 0.001]),
    ("division", [-0.1]),
])  # fmt: skip
def test_every_lens_is_removed_from_points_images_and_pairs(lens, k):
    X = np.random.default_rng(0).uniform(-1, 1, (50, 3)) + np.array([0.0, 0, 3])
    poses = np.zeros(3), np.array([-0.5, 0.05, 0.0])
    rig = [Camera(K, np.eye(3), t, SIZE, np.array(k), lens=lens) for t in poses]
    for camera, t in zip(rig, poses, strict=True):
        straight = Camera(K, np.eye(3), t, SIZE).project(X)
        np.testing.assert_allclose(undistort_points(camera.project(X), camera), straight, atol=1e-6)
    found = rectify_cameras(rig)
    rectified = found.rectified_from_original(1, rig[1].project(X))
    np.testing.assert_allclose(rectified, found.cameras[1].project(X), atol=1e-6)
    np.testing.assert_allclose(found.original_from_rectified(1, rectified), rig[1].project(X), atol=1e-6)
    # Levels tell the column.
    shown = undistort_image(np.tile((np.arange(640) // 3).astype(np.uint8), (480, 1)), rig[0])
    y, x = np.nonzero(shown.seen[::20, ::20])
    place = rig[0].project(shown.camera.unproject(20.0 * np.column_stack([x, y]), np.ones(len(x))))
    assert np.abs(3.0 * shown.image[20 * y, 20 * x, 0] + 1.0 - place[:, 0]).max() < 4.0


def test_rectified_images_show_the_same_rows():
    rig = [Camera(K, np.eye(3), t, (640, 480)) for t in (np.zeros(3), np.array([-0.5, 0.1, 0.0]))]
    y, x = np.mgrid[:480, :640]
    image = (128 + 60 * np.sin(x / 9.0) + 50 * np.sin(y / 7.0)).astype(np.uint8)
    found = rectify_cameras(rig)
    left, _ = found.images(image, image)
    xy = np.array([[200.0, 220], [420, 300]])
    at = found.rectified_from_original(0, xy).round().astype(int)
    back = found.original_from_rectified(0, at.astype(float)).round().astype(int)
    for (u, v), (a, b) in zip(at, back, strict=True):
        assert abs(float(left[v, u, 0]) - float(image[b, a])) < 12
    refuses(ValueError, "size of its camera", found.images, image[:100], image)


@pytest.mark.references
def test_points_and_images_are_undistorted_as_by_opencv():
    cv2 = pytest.importorskip("cv2")
    camera, lens = _rig()[0], np.array([-0.2, 0.05, 0, 0, -0.01])
    xy = np.random.default_rng(0).uniform([20, 20], [620, 460], (40, 2))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
    theirs = cv2.undistortPoints(xy[:, None], K, lens, None, None, K2, criteria)[:, 0]
    np.testing.assert_allclose(undistort_points(xy, camera, K2), theirs, atol=1e-6)
    y, x = np.mgrid[:480, :640]
    image = (128 + 60 * np.sin(x / 9.0) + 50 * np.sin(y / 7.0)).astype(np.uint8)
    found = undistort_image(image, camera)
    maps = cv2.initUndistortRectifyMap(K, lens, None, K, SIZE, cv2.CV_32FC1)
    theirs = cv2.remap(image, *maps, cv2.INTER_CUBIC)
    inside = found.seen.copy()
    inside[[0, 1, -1, -2]] = inside[:, [0, 1, -1, -2]] = False
    assert np.abs(found.image[..., 0].astype(int) - theirs)[inside].max() <= 3
    assert found.camera.is_pinhole


def test_points_beyond_the_range_of_a_lens_are_nan():
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE, np.array([-0.6]))
    xy = np.array([[310.0, 250.0], [3000.0, 250.0], [np.nan, 1.0]])
    found = undistort_points(xy, camera)
    assert np.isfinite(found).all(axis=1).tolist() == [True, False, False]


@pytest.mark.parametrize("shift", [-12, 7])
def test_disparities_may_begin_anywhere(shift):
    from scipy.ndimage import gaussian_filter

    texture = gaussian_filter(128 + 300 * np.random.default_rng(0).uniform(-1, 1, (60, 160)), 1.0)
    left, right = texture[:, 30:130], texture[:, 30 + shift : 130 + shift]
    found = match_rectified(left, right, min_disparity_px=shift - 3, max_disparity_px=shift + 4)
    assert found.disparity.shape == left.shape
    inner = found.disparity[5:-5, 20:-20]
    assert np.isfinite(inner).mean() > 0.8
    assert np.nanmedian(inner) == pytest.approx(shift, abs=0.1)
    refuses(ValueError, "min_disparity_px <= max", match_rectified, left, right, min_disparity_px=9,
            max_disparity_px=3)  # fmt: skip

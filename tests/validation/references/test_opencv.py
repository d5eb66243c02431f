"""Conventions between our arrays and OpenCV's, and the direction of F in every library."""

import numpy as np
import pytest

from tests.validation.references.conftest import skip_without
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.records import Image
from validation.metrics.fundamental_precision import rms_epipolar_distance
from validation.references.fundamental import SOLVERS, estimate_with, opencv_linear, opencv_polynomial
from validation.references.opencv import MODES, OpenCVSemiGlobal, harris_corners, sift_corners

skip_without("cv2", "pycolmap", "poselib")

AT = np.array([33.0, 28.0])


def spot(sigma):
    """A picture (64, 72, 3) of a round spot in the centre of the pixel ``AT``."""
    y, x = np.indices((64, 72))
    grey = 255.0 * np.exp(-((x - AT[0]) ** 2 + (y - AT[1]) ** 2) / (2.0 * sigma**2))
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("solve", [opencv_linear, opencv_polynomial])
def test_points_of_world_to_camera_matrices_are_where_they_were(solve, looked):
    assert callable(solve)
    np.testing.assert_allclose(dehomogenize(solve(looked.P, looked.xy)), looked.X, atol=1e-6)


def test_the_middle_of_a_pixel_is_a_whole_number():
    image = Image("spot", spot(4.0), (72, 64))
    np.testing.assert_allclose(sift_corners(image, 1)[0], AT, atol=0.01)
    # A corner of four fields: the edges lie between pixels 31 and 32, 27 and 28.
    fields = np.zeros((64, 72, 3), np.uint8)
    fields[:28, :32], fields[28:, 32:] = 200, 200
    found = harris_corners(Image("fields", fields, (72, 64)), 50)
    np.testing.assert_allclose(found[np.argmin(np.abs(found - 30).sum(axis=1))], [31.5, 27.5], atol=0.1)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("widened", [False, True])
def test_a_disparity_is_the_shift_to_the_left_in_the_right_image(mode, widened):
    left = np.random.default_rng(0).integers(0, 256, (48, 160, 3)).astype(np.uint8)
    right = np.roll(left, -7, axis=1)
    found = OpenCVSemiGlobal(mode, widened=widened).match(left, right, 32)
    inner = found[8:-8, 48:-40]
    assert np.isfinite(inner).mean() > 0.9
    assert np.nanmedian(inner) == 7.0
    # The columns that a disparity of 31 would take out of the photograph.
    assert np.isfinite(found[8:-8, 10:31]).any() == widened
    assert not (found < 0.0).any()


@pytest.mark.parametrize("method", SOLVERS)
def test_lines_in_the_second_image_are_f_times_points_of_the_first(method, looked):
    xy1, xy2 = looked.xy
    F, _ = estimate_with(method, xy1, xy2, threshold_px=1.0, seed=0)
    assert F is not None
    lines = np.column_stack([xy1, np.ones(len(xy1))]) @ F.T
    off = np.abs((lines * np.column_stack([xy2, np.ones(len(xy2))])).sum(axis=1))
    assert (off / np.linalg.norm(lines[:, :2], axis=1)).max() < 0.02
    assert rms_epipolar_distance(F.T, np.hstack([xy1, xy2])) > 5.0

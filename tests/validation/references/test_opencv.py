"""Conventions between our arrays and OpenCV's, at their border."""

import numpy as np
import PIL.Image
import pytest

from tests.synthetic import texture
from tests.validation.references.conftest import skip_without
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.records import Image
from validation.references.opencv import (
    MODES,
    OpenCVSemiGlobal,
    harris_corners,
    sift_corners,
)
from validation.references.triangulation import opencv_linear, opencv_polynomial
from validation.scenes.real_pairs import match_images

skip_without("cv2")

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


def test_matches_in_the_cache_are_those_of_these_images(tmp_path):
    found = []
    for number in range(2):
        paths = tuple(tmp_path / f"{number}" / "scene" / "images" / f"{side}.png" for side in "ab")
        paths[0].parent.mkdir(parents=True)
        for k, path in enumerate(paths):
            grey = texture(160, 200, 5 * number)[:, 10 * k : 150 + 10 * k]
            PIL.Image.fromarray(grey.astype(np.uint8)).save(path)
        found += [match_images(paths, tmp_path / "cache", ratio=0.8, mutual=True)[0] for _ in range(2)]
    first, again, other, _ = found
    assert len(first) > 10
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    one_way, _ = match_images(paths, tmp_path / "cache", ratio=0.8, mutual=False)
    assert len(one_way) >= len(other)


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

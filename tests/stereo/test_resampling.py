"""The compiled resampling against its plain twin, against what it must reproduce, and at the rim."""

from dataclasses import dataclass

import numpy as np
import pytest

from tests.textures import texture
from thesisrecon.stereo.planar import PlanarRectification
from thesisrecon.stereo.resampling import NOT_SHRUNK, STRIP_ROWS, sample_image, warp_image


def cubic(x):
    x = np.abs(x)
    near, far = 1.5 * x**3 - 2.5 * x**2 + 1.0, -0.5 * x**3 + 2.5 * x**2 - 4.0 * x + 2.0
    return np.where(x < 1.0, near, np.where(x < 2.0, far, 0.0))


def sample_plainly(image, xy, rows):
    """Twin of ``sample_image`` for lookups of at least two rows and columns, by one weight per pixel."""
    height, width = image.shape[:2]
    padded = np.pad(image.astype(np.float64), ((12, 12), (12, 12), (0, 0)), mode="edge")
    down = np.concatenate([np.diff(xy, axis=0), xy[-2:-1] - xy[-1:]])
    across = np.concatenate([np.diff(xy, axis=1), xy[:, -2:-1] - xy[:, -1:]], axis=1)
    spread = np.hypot(across, down)
    spread = np.where(spread > NOT_SHRUNK, spread, 1.0)
    out = np.full((rows, xy.shape[1], image.shape[2]), np.nan)
    for i, j in np.ndindex(rows, xy.shape[1]):
        x, y = xy[i, j]
        if not (0.0 <= x <= width - 1.0 and 0.0 <= y <= height - 1.0):
            continue
        u, v = np.arange(-12, width + 12), np.arange(-12, height + 12)
        w = np.outer(cubic((v - y) / spread[i, j, 1]), cubic((u - x) / spread[i, j, 0]))
        x0, y0 = int(x), int(y)
        if np.isnan(image[y0 : y0 + 2, x0 : x0 + 2]).any():
            continue
        known = np.isfinite(padded[:, :, 0])
        out[i, j] = np.sum(w[known][:, None] * padded[known], axis=0) / w[known].sum()
    return out


def a_map(scale):
    """A homography that shows the photograph ``1 / scale`` as large, turned."""
    c, s = scale * np.cos(0.3), scale * np.sin(0.3)
    H = np.linalg.inv(np.array([[c, -s, 20.0], [s, c, -4.0], [1e-4, 2e-4, 1.0]]))
    return PlanarRectification(H / H[2, 2], np.eye(3), (60, 50))


@pytest.mark.parametrize("scale", [0.6, 1.0, 2.3])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_kernel_is_its_plain_twin(scale, channels):
    rng = np.random.default_rng(0)
    image = rng.uniform(0.0, 255.0, (70, 90, channels)).astype(np.float32)
    image[30:33, 40:44] = np.nan
    xy = a_map(scale).lookup(0, range(51))
    out = np.empty((50, 60, channels), np.float32)
    sample_image(image, xy, out)
    plain = sample_plainly(image, xy, 50)
    np.testing.assert_array_equal(np.isnan(out), np.isnan(plain))
    assert np.isfinite(out).mean() > 0.2
    np.testing.assert_allclose(out, plain, atol=0.02, equal_nan=True)


def test_strips_do_not_show_and_grey_is_one_channel():
    image = texture(260, 200).astype(np.float32)
    H = np.array([[0.8, 0.1, 3.0], [-0.1, 0.7, 20.0], [1e-4, 0.0, 1.0]])
    rectified = PlanarRectification(H, H, (150, 2 * STRIP_ROWS + 1))
    whole = np.empty((rectified.size[1], 150, 1), np.float32)
    sample_image(image[:, :, None], rectified.lookup(0, range(rectified.size[1])), whole)
    grey = rectified.warp(image, 0)
    np.testing.assert_array_equal(grey, whole[:, :, 0])
    colour = rectified.warp(np.repeat(image[:, :, None], 3, axis=2), 1)
    assert colour.shape == (*grey.shape, 3)
    np.testing.assert_array_equal(colour[:, :, 2], grey)


def test_whole_pixels_are_kept_and_quadratics_are_reproduced():
    image = texture(40, 50).astype(np.float32)
    same = PlanarRectification(np.eye(3), np.eye(3), (50, 40))
    np.testing.assert_allclose(same.warp(image, 0), image, atol=1e-4)
    y, x = np.mgrid[0:40, 0:50].astype(np.float64)
    quadratic = (0.05 * x**2 - 0.03 * x * y + 0.02 * y**2 + x).astype(np.float32)
    H = np.array([[1.3, 0.2, -5.0], [-0.2, 1.4, 2.0], [0.0, 0.0, 1.0]])
    larger = PlanarRectification(H, H, (60, 60))
    found = larger.warp(quadratic, 0)
    u, v = np.moveaxis(larger.lookup(0, range(60)), 2, 0)
    inner = (u > 2) & (u < 47) & (v > 2) & (v < 37)
    expected = 0.05 * u**2 - 0.03 * u * v + 0.02 * v**2 + u
    np.testing.assert_allclose(found[inner], expected[inner], atol=1e-3)


def test_what_is_too_fine_for_the_frame_becomes_grey_not_another_pattern():
    stripes = np.zeros((200, 200), np.float32)
    stripes[:, ::2] = 200.0
    third = PlanarRectification(np.diag([1 / 3, 1 / 3, 1.0]), np.eye(3), (66, 66))
    inner = third.warp(stripes, 0)[5:-5, 5:-5]
    assert np.abs(inner - 100.0).max() < 8.0


@dataclass(frozen=True)
class OneRow:
    """The lookup of a frame of a single pixel."""

    size: tuple[int, int] = (1, 1)

    def lookup(self, side, rows):
        return np.full((len(rows), 1, 2), 3.0 + side)


def test_small_frames_and_wrong_images():
    image = texture(8, 9).astype(np.float32)
    assert warp_image(OneRow(), image, 0)[0, 0] == pytest.approx(image[3, 3], abs=1e-4)
    same = PlanarRectification(np.eye(3), np.eye(3), (9, 8))
    for wrong in (np.zeros(3, np.float32), np.zeros((0, 4), np.float32)):
        with pytest.raises(ValueError, match="image to warp"):
            same.warp(wrong, 0)
    with pytest.raises(ValueError, match="side"):
        same.warp(image, 2)
    assert np.isnan(PlanarRectification(np.eye(3), np.eye(3), (12, 8)).warp(image, 0)[:, 9:]).all()

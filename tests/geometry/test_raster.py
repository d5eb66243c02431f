import numpy as np
import pytest
from scipy.ndimage import convolve1d

from tests.textures import texture
from thesisrecon.geometry.raster import gaussian_taps, halve, resample, smooth


def test_smoothing_equals_its_numpy_twin():
    image = texture(37, 52).astype(np.float32)
    taps = gaussian_taps(1.5)
    twin = convolve1d(convolve1d(image, taps, axis=0, mode="nearest"), taps, axis=1, mode="nearest")
    assert np.abs(smooth(image, 1.5) - twin).max() < 1e-3


@pytest.mark.parametrize(("height", "width"), [(31, 44), (30, 45)])
def test_halving_equals_its_numpy_twin(height, width):
    image = texture(height, width).astype(np.float32)
    padded = np.pad(image, 1, mode="edge")
    rows = (padded[0:-3:2] + 3 * padded[1:-2:2] + 3 * padded[2:-1:2] + padded[3::2])[: height // 2] / 8
    twin = (rows[:, 0:-3:2] + 3 * rows[:, 1:-2:2] + 3 * rows[:, 2:-1:2] + rows[:, 3::2])[:, : width // 2] / 8
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


def test_halving_takes_a_pixel_to_the_place_the_convention_says():
    y, x = np.mgrid[0:40, 0:40].astype(np.float32)
    half = halve(x + 10.0 * y)
    # Pixel 5 of the half image lies at (5 + 0.5) 2 - 0.5 = 10.5 of the full one.
    assert half[7, 5] == pytest.approx(10.5 + 10.0 * 14.5, abs=1e-3)


def test_wrong_sizes_are_named():
    with pytest.raises(ValueError, match="2 x 2"):
        halve(np.zeros((1, 9), np.float32))
    with pytest.raises(ValueError, match="1 x 1"):
        resample(np.zeros((4, 4), np.float32), 0, 3)

"""How like two pictures are."""

import numpy as np
import pytest

from thesisrecon.records import RenderedView
from thesisrecon.views.image_similarity import GREY, covered_pixels, match_exposure, psnr_db, ssim, ssim_map


def pictures():
    rng = np.random.default_rng(0)
    y, x = np.indices((40, 50))
    clean = 128 + 60 * np.sin(x / 4.0) * np.cos(y / 5.0)
    real = np.repeat(clean[..., None], 3, axis=2) + np.array([0, 10, -10])
    return real.round().astype(np.uint8), (real + rng.normal(0, 12, real.shape)).round().astype(np.uint8)


def test_psnr_is_that_of_its_formula():
    real, noisy = pictures()
    mask = np.zeros((40, 50), bool)
    mask[5:20, 3:40] = True
    wanted = 10 * np.log10(255**2 / np.mean((real[mask].astype(float) - noisy[mask]) ** 2))
    assert psnr_db(real, noisy, mask) == pytest.approx(wanted)
    assert psnr_db(real, real, mask) == float("inf")


def test_ssim_is_that_of_its_windows():
    real, noisy = pictures()
    a, b = real @ GREY, noisy @ GREY
    y, x = 17, 21
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    w = np.outer(taps, taps) / taps.sum() ** 2
    p, q = (image[y - 5 : y + 6, x - 5 : x + 6] for image in (a, b))
    mean_p, mean_q = (w * p).sum(), (w * q).sum()
    spread_p, spread_q = (w * p * p).sum() - mean_p**2, (w * q * q).sum() - mean_q**2
    common = (w * p * q).sum() - mean_p * mean_q
    c1, c2 = 2.55**2, 7.65**2
    value = (2 * mean_p * mean_q + c1) / (mean_p**2 + mean_q**2 + c1)
    value *= (2 * common + c2) / (spread_p + spread_q + c2)
    everything = np.ones(a.shape, bool)
    assert ssim_map(real, noisy, everything)[y, x] == pytest.approx(value, abs=1e-3)
    assert ssim(real, real, everything) == pytest.approx(1.0)
    assert 0.3 < ssim(real, noisy, everything) < 0.95


def test_what_is_not_compared_takes_no_part():
    real, noisy = pictures()
    mask = np.hypot(*(np.indices((40, 50)) - np.array([17, 21])[:, None, None])) < 9
    spoiled = np.where(mask[..., None], noisy, 0).astype(np.uint8)
    assert ssim(real, spoiled, mask) == pytest.approx(ssim(real, noisy, mask))


def test_exposure_is_made_alike():
    real, _ = pictures()
    darker = np.rint(real * [0.5, 0.8, 1.0]).astype(np.uint8)
    mask = np.ones(real.shape[:2], bool)
    assert psnr_db(real, match_exposure(real, darker, mask), mask) > 45.0


def test_pixels_at_the_rim_are_not_whole():
    valid = np.zeros((6, 7), bool)
    valid[1:5, 2:6] = True
    rendered = RenderedView(np.zeros((6, 7, 3), np.uint8), np.zeros((6, 7), np.float32), valid)
    wanted = np.zeros((6, 7), bool)
    wanted[2:4, 3:5] = True
    np.testing.assert_array_equal(covered_pixels(rendered), wanted)


@pytest.mark.parametrize("compare", [psnr_db, ssim, match_exposure])
def test_pictures_that_do_not_belong_together_are_refused(compare):
    real, noisy = pictures()
    with pytest.raises(ValueError, match="one size"):
        compare(real, noisy[:-1], np.ones((40, 50), bool))
    with pytest.raises(ValueError, match="no pixel is shown by both"):
        compare(real, noisy, np.zeros((40, 50), bool))

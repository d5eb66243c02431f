"""Every variant on pairs whose disparity is known, and on pairs that have none."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tests.conftest import refuses
from tests.constants import with_constants
from tests.synthetic import texture
from thesisrecon.stereo._cost import estimate_noise, prepare_stereo_images, row_strips
from thesisrecon.stereo.correspondence import PairMatching
from thesisrecon.stereo.depth import MultiViewStereo
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline, _occlusion_cost
from thesisrecon.stereo.semi_global import SemiGlobalMatching

VARIANTS = [SemiGlobalMatching(), MaximumLikelihoodScanline()]
HEIGHT, WIDTH = 120, 180
names = pytest.mark.parametrize("variant", VARIANTS, ids=["default", "thesis"])


@cache
def _pair_with_truth():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    wall, square = texture(HEIGHT, 2 * WIDTH, 0), texture(HEIGHT, 2 * WIDTH, 1)
    # Of the middle frame u a surface of disparity d is seen at u + d / 2 left and at u - d / 2 right.
    slope, offset, near = 0.03, 3.0, 14.0

    def seen(sign):
        u = (x - sign * offset / 2.0) / (1.0 + sign * slope / 2.0)
        image = map_coordinates(wall, [y, u + WIDTH / 2.0], order=3)
        v = x - sign * near / 2.0
        front = (np.abs(y - 60.0) < 30.0) & (np.abs(v - 90.0) < 35.0)
        image[front] = map_coordinates(square, [y, v + WIDTH / 2.0], order=3)[front]
        return (image + rng.normal(0.0, 1.0, image.shape)).astype(np.float32), front, offset + slope * u

    (left, front_l, back), (right, front_r, _) = seen(1.0), seen(-1.0)
    truth = np.where(front_l, near, back)
    partner = np.rint(x - truth).astype(int)
    covered = front_r[y.astype(int), np.maximum(partner, 0)] & ~front_l
    return left, right, truth, (partner >= 0) & ~covered


def pair_with_truth():
    """A slanted wall behind a square: left and right image, left disparities, which pixels both see."""
    return [part.copy() for part in _pair_with_truth()]


def require_right(found, truth, both, *, known):
    """Most disparities that both images see are known, and hardly one of them is wrong."""
    seen = np.isfinite(found.disparity) & both
    assert seen.mean() > known
    assert np.mean(np.abs(found.disparity - truth)[seen] > 1.0) < 0.03


@names
def test_disparities_of_a_scene_are_found(variant):
    left, right, truth, both = pair_with_truth()
    found = variant.match(left, right, disparity_range=(0, 24))
    error = np.abs(found.disparity - truth)
    known = np.isfinite(found.disparity)
    assert known[both].mean() > 0.93
    assert np.mean(error[known & both] > 1.0) < 0.02
    assert np.median(error[known & both]) < (0.3 if variant == VARIANTS[1] else 0.12)
    assert np.mean(np.abs(found.filled() - truth)[both] > 1.0) < 0.03
    assert ((found.confidence >= 0.0) & (found.confidence <= known)).all()
    assert found.disparity.dtype == found.confidence.dtype == np.float32
    assert np.median(error[known & both]) < 1.5 * found.sigma_px < 0.6
    hidden = ~both
    hidden[:, :20] = False
    assert hidden.sum() > 300
    assert known[hidden].mean() < 0.5


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_disparities_do_not_prefer_whole_pixels(noise):
    rng = np.random.default_rng(1)
    y, x = np.mgrid[0:160, 0:400].astype(float)
    fine, truth = texture(160, 500, 2), 6.0 + 0.02 * x + 0.01 * y
    pair = [map_coordinates(fine, [y, u + 60.0], order=3) for u in (x - truth, x)]
    left, right = (np.rint(np.clip(one + noise * rng.normal(size=x.shape), 0, 255)) for one in pair)
    found = SemiGlobalMatching().match(left, right, disparity_range=(0, 20)).disparity
    used = np.abs(found - truth) < 1.0
    used[:, :20] = used[:, -20:] = False
    error, part = (found - truth)[used], (10.0 * (truth[used] % 1.0)).astype(int)
    assert np.abs(np.bincount(part, error) / np.bincount(part)).max() < 0.024
    assert 0.1 < np.mean(np.abs(found[used] - np.rint(found[used])) < 0.1) < 0.3
    assert used.mean() > 0.8


@names
def test_a_range_may_span_zero_and_invalid_pixels_have_no_disparity(variant):
    left, right, truth, both = pair_with_truth()
    shifted = np.full_like(right, np.nan)
    shifted[:, 10:] = right[:, :-10]
    require_right(variant.match(left, shifted, disparity_range=(-12, 12)), truth - 10.0, both, known=0.7)
    left[:20], left[100:, 90:] = np.nan, np.nan
    found = variant.match(left, right, disparity_range=(0, 24))
    assert np.isnan(found.disparity[np.isnan(left)]).all()
    require_right(found, truth, both, known=0.5)


def test_strips_change_little():
    left, right, _, _ = pair_with_truth()
    whole, strips = (
        kind().match(left, right, disparity_range=(0, 24)).disparity
        for kind in (SemiGlobalMatching, with_constants(SemiGlobalMatching, memory_mb=1.2))
    )
    assert (np.isfinite(whole) == np.isfinite(strips)).mean() > 0.99
    both = np.isfinite(whole) & np.isfinite(strips)
    assert np.mean(np.abs(whole - strips)[both] > 0.5) < 0.002


@names
@pytest.mark.parametrize("kind", ["uniform", "noise", "shade"])
def test_walls_without_features_are_not_invented(variant, kind):
    rng = np.random.default_rng(1)
    level = np.full((HEIGHT, WIDTH), 120.0)
    if kind == "shade":
        level += np.linspace(-40.0, 40.0, WIDTH)
    sigma = 0.0 if kind == "uniform" else 2.0
    left, right = (level + sigma * rng.normal(size=level.shape) for _ in range(2))
    found = variant.match(left, right, disparity_range=(0, 30))
    known = np.isfinite(found.disparity)
    if isinstance(variant, MaximumLikelihoodScanline):
        # It has a disparity for everything that is not hidden, but says how little it is worth.
        assert np.median(found.confidence) < 0.5
    else:
        assert known.mean() < 0.02
        assert np.quantile(found.confidence, 0.99) < 0.1


@names
def test_unrelated_images_are_mostly_unknown_or_unlikely(variant):
    left, right = texture(HEIGHT, WIDTH, 5), texture(HEIGHT, WIDTH, 6)
    found = variant.match(left, right, disparity_range=(0, 30))
    assert np.isfinite(found.disparity).mean() < 0.3


@names
def test_odd_images_do_no_harm(variant):
    for left in (np.full((20, 30), np.nan), np.zeros((1, 1)), np.zeros((2, 40)), np.zeros((40, 2, 3))):
        found = variant.match(left, left, disparity_range=(0, 8))
        assert found.disparity.shape == left.shape[:2]
        assert np.isnan(found.disparity).all() or isinstance(variant, MaximumLikelihoodScanline)
    left, right, _, _ = pair_with_truth()
    assert np.isnan(variant.match(left, right, disparity_range=(500, 520)).disparity).all()
    assert variant.match(left, right, disparity_range=(4, 4)).disparity.shape == left.shape


@names
def test_wrong_calls_are_refused(variant):
    image, row = np.zeros((10, 12)), np.zeros(5)
    for words, left, right, limits in (
        ("same shape", image, np.zeros((10, 13)), (0, 4)), (r"must be \(H, W\)", row, row, (0, 4)),
        ("first <= last", image, image, (4, 0)),
    ):  # fmt: skip
        refuses(ValueError, words, variant.match, left, right, disparity_range=limits)
    for kind, wrong in (
        (SemiGlobalMatching, {"census_share": 1.2}),
        (MaximumLikelihoodScanline, {"radius": 9}),
    ):
        refuses(ValueError, next(iter(wrong)), kind, **wrong)


def test_rectified_images_are_matched_by_the_matcher_of_the_stage():
    left, right, truth, both = pair_with_truth()
    color = [np.repeat(np.clip(image, 0, 255)[..., None], 3, axis=2) for image in (left, right)]
    stereo = MultiViewStereo()
    found = stereo.match_rectified(*[image.astype(np.uint8) for image in color], max_disparity_px=23.2)
    require_right(found, truth, both, known=0.8)
    thesis = MultiViewStereo(pairs=PairMatching(matcher=MaximumLikelihoodScanline()))
    disparity = thesis.match_rectified(left, right, max_disparity_px=24).disparity
    assert set(np.unique(disparity[np.isfinite(disparity)] % 1.0)) == {0.0}
    for wrong in (-1.0, np.nan, np.inf):
        refuses(ValueError, "max_disparity_px", stereo.match_rectified, left, right, max_disparity_px=wrong)


def test_noise_and_the_cost_of_a_hidden_pixel():
    assert _occlusion_cost(1, 4.0) == pytest.approx(8.528, abs=1e-3)
    rng = np.random.default_rng(2)
    clean = texture(200, 300, 3)
    for sigma in (0.0, 2.0, 5.0):
        noisy = np.clip(clean + sigma * rng.normal(size=clean.shape), 0, 255)
        side, _ = prepare_stereo_images(noisy, noisy)
        assert estimate_noise(side) == pytest.approx(sigma, abs=1.2)


def test_strips_cover_every_row_once_and_fit():
    for height, per_row, memory in ((100, 10, 1e6), (500, 1000, 2e5), (333, 7, 1.0)):
        strips = row_strips(height, per_row, memory)
        assert [s[0] for s in strips] == [0, *[s[1] for s in strips[:-1]]]
        assert strips[-1][1] == height
        assert all(0 <= top <= first and last <= bottom <= height for first, last, top, bottom in strips)
    assert all((s[3] - s[2]) * 1000 <= 2e5 for s in row_strips(500, 1000, 2e5))

"""Photographs that corners and correlation cannot relate, and odd ones that they can, by the front door."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom

from tests.synthetic import disparity, photograph, sideways_fundamental, stereo_scene, texture
from thesisrecon import match_pair
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.errors import StageFailure
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.matching.strength import StrengthOfMatch

SHAPE = (300, 420)
PRESETS = pytest.mark.parametrize("name", ["default", "thesis"])


def gray(values):
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def stereo():
    left, right = stereo_scene()
    return left.rgb, right.rgb


def related(first, second, name):
    """The pair, or None where it is refused as one that does not match."""
    try:
        return match_pair(first, second, config=preset(name))
    except StageFailure as failure:
        if "do not match" not in str(failure):
            raise
        return None


@PRESETS
@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_photograph_without_texture_is_named(name, level):
    with pytest.raises(StageFailure, match="blank"):
        match_pair(np.full(SHAPE, level, np.uint8), stereo()[1], config=preset(name))


@PRESETS
def test_an_image_of_32_pixels_is_rejected_with_the_required_size(name):
    left, right = stereo()
    with pytest.raises(StageFailure, match="32 x 32 pixels; the minimum is 64 x 64"):
        match_pair(left[:32, :32].copy(), right[:32, :32].copy(), config=preset(name))


@pytest.mark.parametrize("growth", [True, False])
def test_images_in_fog_have_seeds_but_no_corners_and_do_not_match(growth):
    """All that is left in a faint and blurred image is seen at the coarser levels of the seeds only."""
    haze = gaussian_filter(np.random.default_rng(0).normal(size=(620, 1040)), 20.0)
    haze = gray(128.0 + 4.0 * haze / haze.std())
    detector, matcher = MultiScaleCorners(), SeedsAndGrowth(growth=growth)
    images = [photograph(part) for part in (haze[:600, :1000], haze[6:606, 20:1020])]
    views = [matcher.prepare(image, detector.detect(image)) for image in images]
    assert min(len(view.features.seeds.xy) for view in views) > 100
    assert max(len(view.features.xy) for view in views) == 0
    options = {"estimate_fundamental": PipelineConfig().epipolar.estimate, "rng": np.random.default_rng(0)}
    assert len(matcher.match(*views, pair=(0, 1), **options).xy1) == 0


@pytest.mark.parametrize(
    ("detector", "matcher"),
    [(MultiScaleCorners(), SeedsAndGrowth()), (HarrisCorners(), StrengthOfMatch())],
    ids=["default", "thesis"],
)
def test_the_stages_themselves_take_32_pixels(detector, matcher):
    image = photograph(texture(32, 32))
    view = matcher.prepare(image, detector.detect(image))
    rng = np.random.default_rng(0)
    found = matcher.match(view, view, pair=(0, 1), estimate_fundamental=sideways_fundamental, rng=rng)
    assert np.abs(found.xy1 - found.xy2).max(initial=0.0) < 1.0


@PRESETS
def test_saturated_images_match_correctly_or_not_at_all(name):
    """Six times too long exposed: only the darkest spots are left."""
    left, right = (gray(image[:, :, 0] * 6.0) for image in stereo())
    pair = related(left, right, name)
    if pair is not None:
        assert np.median(np.abs(pair.xy1[:, 0] - pair.xy2[:, 0] - disparity(pair.xy2))) < 0.3


@PRESETS
@pytest.mark.parametrize("kind", ["chequers", "stripes", "noise"])
def test_repeated_patterns_lines_and_noise_do_not_match(name, kind):
    rng = np.random.default_rng(0)
    rows, columns = np.indices(SHAPE)
    first = {
        "chequers": 20.0 + 200.0 * ((rows // 20 + columns // 20) % 2),
        "stripes": np.repeat(texture(1, SHAPE[1], 3), SHAPE[0], axis=0),
        "noise": rng.uniform(0, 255, SHAPE),
    }[kind]
    second = rng.uniform(0, 255, SHAPE) if kind == "noise" else np.roll(first, 7, axis=1)
    # On noisy stripes corners slide along them and all agree with one F: the aperture problem (section 4.1).
    scale = 0.0 if kind == "stripes" else 3.0
    noisy = [gray(image + rng.normal(scale=scale, size=SHAPE)) for image in (first, second)]
    with pytest.raises(StageFailure, match="do not match"):
        match_pair(*noisy, config=preset(name))


@PRESETS
def test_one_photograph_twice_stays_where_it_is_and_determines_no_geometry(name):
    left = stereo()[0]
    pair = related(left, left.copy(), name)
    if pair is not None:
        assert np.abs(pair.xy1 - pair.xy2).max() < 0.01
        assert pair.undetermined


def test_photographs_of_different_sizes_match():
    left, right = stereo()
    half = match_pair(left, gray(zoom(right[:, :, 0].astype(np.float64), 0.5, order=1)))
    # scipy's zoom keeps the centres of the corner pixels.
    step = (np.array(SHAPE[::-1]) - 1.0) / (np.array(SHAPE[::-1]) / 2.0 - 1.0)
    whole = half.xy2 * step
    assert half.inliers > 500
    assert np.median(np.abs(half.xy1[:, 0] - whole[:, 0] - disparity(whole))) < 0.3
    upright = match_pair(left, right[:, 60:260].copy())
    whole = upright.xy2 + np.array([60.0, 0.0])
    assert upright.inliers > 500
    assert np.median(np.abs(upright.xy1[:, 0] - whole[:, 0] - disparity(whole))) < 0.1


def test_float_arrays_are_rejected_as_images():
    with pytest.raises(ValueError, match="uint8"):
        match_pair(np.full(SHAPE, np.nan), stereo()[1])

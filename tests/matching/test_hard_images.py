"""Photographs that corners and correlation cannot relate, odd ones that they can, and many of them."""

import numpy as np
import PIL.Image
import pytest
from scipy.ndimage import gaussian_filter, zoom

from tests.conftest import refuses, same_pairs
from tests.synthetic import disparity, photograph, sideways_fundamental, stereo_scene, texture
from thesisrecon import load, match_pair, reconstruct
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.errors import StageFailure
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.io._images import demo_images
from thesisrecon.matching._prepared import strongest_corners, strongest_share
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.matching.strength import StrengthOfMatch
from thesisrecon.pipeline import matching
from thesisrecon.records import Features

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
def test_photographs_that_cannot_be_matched_are_named(name):
    left, right = stereo()
    for error, words, images in (
        *((StageFailure, "blank", (np.full(SHAPE, level, np.uint8), right)) for level in (0, 128, 255)),
        (StageFailure, "32 x 32 pixels; the minimum is 64 x 64", (left[:32, :32], right[:32, :32])),
        (ValueError, "no finite level", (np.full(SHAPE, np.nan), right)),
    ):
        refuses(error, words, match_pair, *images, config=preset(name))


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


def pattern(kind):
    """Levels of a pattern that fills an image."""
    rows, columns = np.indices(SHAPE)
    bricks = (rows % 16 < 3) | ((columns + 12 * (rows // 16 % 2)) % 24 < 3)
    waves = (
        np.cos(0.3 * columns) + np.cos(0.15 * columns + 0.26 * rows) + np.cos(0.15 * columns - 0.26 * rows)
    )
    return {
        "chequers": 20.0 + 200.0 * ((rows // 20 + columns // 20) % 2),
        "dots": 220.0 - 200.0 * ((rows % 24 - 12) ** 2 + (columns % 24 - 12) ** 2 < 40),
        "bricks": 200.0 - 160.0 * bricks,
        "waves": 128.0 + 40.0 * waves,
        "stripes": np.repeat(texture(1, SHAPE[1], 3), SHAPE[0], axis=0),
    }[kind]


def require_no_match(first, second, scale, name, seed=0):
    rng = np.random.default_rng(seed)
    noisy = [gray(image + rng.normal(scale=scale, size=SHAPE)) for image in (first, second)]
    with pytest.raises(StageFailure, match="do not match"):
        match_pair(*noisy, config=preset(name))


@PRESETS
@pytest.mark.parametrize("kind", ["chequers", "stripes", "noise"])
def test_repeated_patterns_lines_and_noise_do_not_match(name, kind):
    if kind == "noise":
        first, second = np.random.default_rng(0).uniform(0, 255, (2, *SHAPE))
    else:
        first = pattern(kind)
        second = np.roll(first, 7, axis=1)
    # On noisy stripes corners slide along them and all agree with one F: the aperture problem (section 4.1).
    require_no_match(first, second, 0.0 if kind == "stripes" else 3.0, name)


@pytest.mark.parametrize(
    ("kind", "noise"), [("chequers", 0.5), ("dots", 3.0), ("bricks", 8.0), ("waves", 1.0)]
)
def test_patterns_are_not_matched_by_shifts_of_their_period(kind, noise):
    require_no_match(pattern(kind), np.roll(pattern(kind), 13, axis=1), noise, "default", seed=1)


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


def test_the_strongest_corners_of_each_scale_and_seeds_of_each_level_are_kept():
    features = MultiScaleCorners().detect(photograph(texture(200, 260)))
    fewer, rows = strongest_share(features, 0.5), strongest_corners(features, 0.5)
    assert np.array_equal(fewer.xy, features.xy[rows])
    assert (np.diff(rows) > 0).all()
    for scale in np.unique(features.scale):
        every, kept = (f.response[f.scale == scale] for f in (features, fewer))
        assert len(kept) == (len(every) + 1) // 2
        assert kept.min() >= np.sort(every)[-len(kept)]
    levels, kept = (
        np.unique(np.where(s.angle == 0.0, s.scale, -s.scale), return_counts=True)[1]
        for s in (features.seeds, fewer.seeds)
    )
    assert np.array_equal(kept, (levels + 1) // 2)
    assert len(fewer.seeds.patches) == len(fewer.seeds.xy) == kept.sum()


def test_pairs_of_many_images_have_fewer_matches_unless_all_are_needed(tmp_path, monkeypatch):
    def pairs(name, many_images):
        config = PipelineConfig(matching=SeedsAndGrowth(many_images=many_images))
        result = reconstruct(
            demo_images()[:3], tmp_path / name, config=config, max_size=480, until="matches", threads=2
        )
        assert same_pairs(load(tmp_path / name), result)
        return result

    every, fewer = pairs("all", 3), pairs("fewer", 2)
    for whole, part in zip(every.pairs, fewer.pairs, strict=True):
        assert part.accepted
        assert 240 <= part.inliers < 0.65 * whole.inliers
        # The numbers are those of all corners.
        assert np.array_equal(part.xy1, every.features[part.i].xy[part.index1])
        assert np.abs(part.xy2 - every.features[part.j].xy[part.index2]).max() < 10.0
    for name, value in (("MIN_VERIFIED", 10**6), ("has_narrow_cut", lambda _: True)):
        with monkeypatch.context() as patch:
            patch.setattr(matching, name, value)
            again = pairs(name, 2).pairs
        for whole, pair in zip(every.pairs, again, strict=True):
            assert np.array_equal(whole.index1, pair.index1)
            assert np.array_equal(whole.xy2, pair.xy2)


def test_images_of_nothing_in_common_are_a_failure_for_any_number(tmp_path):
    """More images than `many_images`, one of them without corners, and no accepted pair."""
    none = np.zeros(0, np.float32)
    assert len(strongest_share(Features(np.zeros((0, 2)), none, none), 0.5).xy) == 0
    smooth = np.tile(np.linspace(60.0, 190.0, 128), (96, 1))
    paths = []
    for k, gray in enumerate([*(texture(96, 128, seed=k) for k in range(3)), smooth]):
        paths.append(tmp_path / f"{k}.png")
        PIL.Image.fromarray(photograph(gray).rgb).save(paths[-1])
    config = PipelineConfig(matching=SeedsAndGrowth(many_images=2))
    with pytest.raises(StageFailure, match="no two images could be matched"):
        reconstruct(paths, tmp_path / "out", config=config, until="metric", threads=2)

from __future__ import annotations

import numpy as np
import pytest

from tests.textures import disparity, photograph, sideways_fundamental, stereo_scene, texture
from thesisrecon.errors import StageFailure
from thesisrecon.features import HarrisCorners, MultiScaleCorners
from thesisrecon.matching import PreparedView, SeedsAndGrowth, StrengthOfMatch
from thesisrecon.matching.seeds import match_seeds, neighbour_support
from thesisrecon.types import F64, FundamentalFit, Image, Matches

Detector = HarrisCorners | MultiScaleCorners
Variant = SeedsAndGrowth | StrengthOfMatch
VARIANTS: list[tuple[Detector, Variant]] = [
    (MultiScaleCorners(), SeedsAndGrowth()),
    (HarrisCorners(), StrengthOfMatch()),
]
BOTH = pytest.mark.parametrize(("detector", "variant"), VARIANTS, ids=["seeds", "strength"])


def views(detector: Detector, variant: Variant, *images: Image) -> list[PreparedView]:
    return [variant.prepare(image, detector.detect(image)) for image in images]


def run(variant: Variant, one: PreparedView, two: PreparedView) -> Matches:
    rng = np.random.default_rng(0)
    return variant.match(one, two, pair=(2, 5), estimate_fundamental=sideways_fundamental, rng=rng)


def no_fundamental(xy1: F64, xy2: F64, rng: np.random.Generator) -> FundamentalFit:
    raise StageFailure("no geometry", f"{len(xy1)} matches of {len(xy2)}, {rng}")


@BOTH
def test_matches_are_right_one_to_one_and_reproducible(detector: Detector, variant: Variant) -> None:
    one, two = views(detector, variant, *stereo_scene())
    matches, again = run(variant, one, two), run(variant, one, two)
    error = np.linalg.norm(
        matches.xy1 - matches.xy2 - np.c_[disparity(matches.xy2), 0 * matches.score], axis=1
    )
    assert (matches.i, matches.j) == (2, 5)
    assert len(matches.xy1) > 300
    assert (error < 1.5).mean() > 0.9
    assert len(np.unique(matches.index1)) == len(np.unique(matches.index2)) == len(matches.index1)
    assert np.abs(one.features.xy[matches.index1] - matches.xy1).max() < 1e-9
    assert np.linalg.norm(two.features.xy[matches.index2] - matches.xy2, axis=1).max() < 6.0
    for name in ("index1", "index2", "xy1", "xy2", "score", "affine"):
        assert np.array_equal(getattr(matches, name), getattr(again, name))


def test_alignment_brings_matches_to_a_twentieth_of_a_pixel() -> None:
    variant = SeedsAndGrowth()
    matches = run(variant, *views(MultiScaleCorners(), variant, *stereo_scene()))
    error = matches.xy1 - matches.xy2 - np.c_[disparity(matches.xy2), 0 * matches.score]
    assert np.median(np.linalg.norm(error, axis=1)) < 0.05
    assert (np.linalg.norm(error, axis=1) < 0.5).mean() > 0.97


@BOTH
def test_photographs_of_different_things_share_nothing_or_little(
    detector: Detector, variant: Variant
) -> None:
    one, two = views(detector, variant, photograph(texture(300, 400, 1)), photograph(texture(300, 400, 2)))
    matches = run(variant, one, two)
    assert len(matches.xy1) == 0 or isinstance(variant, StrengthOfMatch)


@BOTH
@pytest.mark.parametrize("size", [(1, 1), (12, 12), (40, 60)])
def test_blank_tiny_and_noisy_photographs_give_an_empty_answer(
    detector: Detector, variant: Variant, size: tuple[int, int]
) -> None:
    noise = np.random.default_rng(1).uniform(0, 255, size)
    images = [photograph(np.full(size, 9.0)), photograph(noise), photograph(noise[::-1])]
    prepared = views(detector, variant, *images)
    for one in prepared:
        matches = run(variant, one, prepared[0])
        assert len(matches.xy1) == 0
        assert matches.affine.shape == (0, 2, 2)
        run(variant, one, prepared[2])


def test_no_fundamental_matrix_leaves_no_matches() -> None:
    variant = SeedsAndGrowth()
    one, two = views(MultiScaleCorners(), variant, *stereo_scene())
    rng = np.random.default_rng(0)
    matches = variant.match(one, two, pair=(0, 1), estimate_fundamental=no_fundamental, rng=rng)
    assert len(matches.xy1) == 0


def test_corners_without_seeds_are_refused() -> None:
    variant = SeedsAndGrowth()
    one, two = views(HarrisCorners(), variant, *stereo_scene(120, 160))
    with pytest.raises(ValueError, match="seeds"):
        run(variant, one, two)


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_seeds_find_a_photograph_that_was_turned(quarter_turns: int) -> None:
    gray = texture(300, 420, 4)
    seeds = [MultiScaleCorners().detect(photograph(g)).seeds for g in (gray, np.rot90(gray, quarter_turns))]
    assert seeds[0] is not None
    assert seeds[1] is not None
    found = match_seeds(seeds[0], seeds[1], turned=True, ratio=0.8)
    x, y = found.xy1.T
    w, h = 420, 300
    truth = {1: (y, w - 1 - x), 2: (w - 1 - x, h - 1 - y), 3: (h - 1 - y, x)}[quarter_turns]
    right = np.linalg.norm(found.xy2 - np.stack(truth, 1), axis=1) < 3.0
    support = neighbour_support(found)
    assert right.sum() > 200
    assert right.mean() > 0.9
    assert support[right].mean() > 5.0 > 2.0 > support[~right].mean() if (~right).any() else True

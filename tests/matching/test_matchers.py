from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.ndimage import affine_transform, gaussian_filter

from tests.conftest import refuses
from tests.constants import with_constants
from tests.synthetic import disparity, photograph, sideways_fundamental, stereo_scene, texture
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.matching._seeds import corners_of_seeds, match_seeds, neighbour_support, seed_matches
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.matching.strength import StrengthOfMatch
from thesisrecon.records import FundamentalFit, Image, Matches

VARIANTS = [(MultiScaleCorners(), SeedsAndGrowth()), (HarrisCorners(), StrengthOfMatch())]
SWITCHED = [
    SeedsAndGrowth(), SeedsAndGrowth(growth=False), SeedsAndGrowth(rematch=False),
    SeedsAndGrowth(neighbours=1), SeedsAndGrowth(align=False), SeedsAndGrowth(growth=False, align=False),
    StrengthOfMatch(weight="relative-difference", min_correlation=0.7, min_strength=0.15),
    StrengthOfMatch(window=11, colour=True), StrengthOfMatch(align=True),
]  # fmt: skip
BOTH = pytest.mark.parametrize(("detector", "variant"), VARIANTS, ids=["seeds", "strength"])


def views(detector, variant, *images):
    return [variant.prepare(image, detector.detect(image)) for image in images]


def run(variant, one, two):
    rng = np.random.default_rng(0)
    return variant.match(one, two, pair=(2, 5), estimate_fundamental=sideways_fundamental, rng=rng)


def errors(matches):
    found = matches.xy1 - matches.xy2 - np.c_[disparity(matches.xy2), 0 * matches.score]
    return np.asarray(np.linalg.norm(found, axis=1))


@BOTH
def test_matches_are_right_one_to_one_and_reproducible(detector, variant):
    one, two = views(detector, variant, *stereo_scene())
    matches, again = run(variant, one, two), run(variant, one, two)
    assert (matches.i, matches.j) == (2, 5)
    assert len(matches.xy1) > 300
    assert (errors(matches) < 1.5).mean() > 0.9
    assert len(np.unique(matches.index1)) == len(np.unique(matches.index2)) == len(matches.index1)
    assert np.abs(one.features.xy[matches.index1] - matches.xy1).max() < 1e-9
    assert np.linalg.norm(two.features.xy[matches.index2] - matches.xy2, axis=1).max() < 6.0
    for name in ("index1", "index2", "xy1", "xy2", "score", "affine"):
        assert np.array_equal(getattr(matches, name), getattr(again, name))


@BOTH
def test_photographs_of_different_things_share_nothing_or_little(detector, variant):
    one, two = views(detector, variant, photograph(texture(300, 400, 1)), photograph(texture(300, 400, 2)))
    matches = run(variant, one, two)
    assert len(matches.xy1) == 0 or isinstance(variant, StrengthOfMatch)


@BOTH
@pytest.mark.parametrize("size", [(1, 1), (12, 12), (40, 60)])
def test_blank_tiny_and_noisy_images_give_an_empty_result(detector, variant, size):
    noise = np.random.default_rng(1).uniform(0, 255, size)
    images = [photograph(np.full(size, 9.0)), photograph(noise), photograph(noise[::-1])]
    prepared = views(detector, variant, *images)
    if isinstance(detector, MultiScaleCorners):
        for view, image in zip(prepared[:], images, strict=True):
            oblique = replace(view.features, oblique=detector.oblique_seeds(image))
            prepared.append(variant.prepare(image, oblique))
    for one in prepared:
        matches = run(variant, one, prepared[0])
        assert len(matches.xy1) == 0
        assert matches.affine.shape == (0, 2, 2)
        run(variant, one, prepared[2])


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_seeds_find_a_photograph_that_was_turned(quarter_turns):
    gray = texture(300, 420, 4)
    seeds = [MultiScaleCorners().detect(photograph(g)).seeds for g in (gray, np.rot90(gray, quarter_turns))]
    found = match_seeds(*seeds, (0, 1), rotated=True, ratio=0.8)
    x, y = found.xy1.T
    w, h = 420, 300
    truth = {1: (y, w - 1 - x), 2: (w - 1 - x, h - 1 - y), 3: (h - 1 - y, x)}[quarter_turns]
    right = np.linalg.norm(found.xy2 - np.stack(truth, 1), axis=1) < 3.0
    support = neighbour_support(found)
    assert right.sum() > 200
    assert right.mean() > 0.9
    assert support[right].mean() > 5.0 > 2.0 > support[~right].mean() if (~right).any() else True


def test_seeds_of_simulated_views_lead_to_matches_of_an_oblique_and_turned_photograph():
    gray, variant = texture(300, 420, 5), SeedsAndGrowth()
    detector = with_constants(MultiScaleCorners, upsample_below_px=0)()
    c, s = np.cos(0.6), np.sin(0.6)
    A = np.array([[c, -s], [s, c]]) @ np.diag([0.3, 0.95]) @ np.array([[c, s], [-s, c]])
    B, centre = np.linalg.inv(A), np.array([209.5, 149.5])
    fine = gaussian_filter(gray, 0.8)
    seen = affine_transform(fine, B[::-1, ::-1], (centre - B @ centre)[::-1], order=1, cval=128.0)
    one, two = (
        variant.prepare(image, replace(detector.detect(image), oblique=detector.oblique_seeds(image)))
        for image in (photograph(gray), photograph(seen))
    )

    def off(xy1, xy2):
        return np.linalg.norm(xy2 - ((xy1 - centre) @ A.T + centre), axis=1)

    ((found, support),) = seed_matches(one.features, two.features, (0, 1), ratio=0.8)
    right, supported = off(found.xy1, found.xy2) < 4.0, support(found) >= 2.0
    assert right.sum() > 60
    assert right[supported].mean() > 0.8 > 0.6 > right.mean()
    assert supported[right].mean() > 0.5
    assert np.median(np.linalg.norm(found.affine[right] - A, axis=(1, 2))) < 0.35

    def fit(xy1, xy2, rng):
        del rng
        # Any F = [e]x H explains a plane.
        H = np.eye(3)
        H[:2, :2], H[:2, 2] = A, centre - A @ centre
        F = cross_matrix(np.array([1.0, 0.3, 0.0])) @ H
        return FundamentalFit(F, off(xy1, xy2) < 4.0, 0.1, np.zeros((9, 9)))

    rng = np.random.default_rng(0)
    matches = variant.match(one, two, pair=(0, 1), estimate_fundamental=fit, rng=rng)
    error = off(matches.xy1, matches.xy2)
    assert len(error) > 60
    assert np.median(error) < 0.15
    assert (error < 1.0).mean() > 0.95


@pytest.fixture(scope="module")
def stereo():
    return views(MultiScaleCorners(), SeedsAndGrowth(), *stereo_scene())


@pytest.mark.parametrize("variant", SWITCHED, ids=repr)
def test_every_switch_leaves_right_matches_one_to_one(stereo, variant):
    strength = isinstance(variant, StrengthOfMatch)
    one, two = views(HarrisCorners(), variant, *stereo_scene()) if strength else stereo
    matches = run(variant, one, two)
    assert len(matches.xy1) > 100
    assert (errors(matches) < 1.5).mean() > 0.9
    assert len(np.unique(matches.index1)) == len(np.unique(matches.index2)) == len(matches.index1)
    if variant.align:
        assert np.median(errors(matches)) < 0.05
        assert (errors(matches) < 0.5).mean() > 0.9
    else:
        assert np.array_equal(matches.xy2, two.features.xy[matches.index2])


def test_growth_multiplies_the_matches_and_alignment_makes_them_finer_but_not_without_f(stereo):
    whole = run(SeedsAndGrowth(), *stereo)
    seeds, corners = run(SeedsAndGrowth(growth=False), *stereo), run(SeedsAndGrowth(align=False), *stereo)
    assert len(whole.xy1) > 1.5 * len(seeds.xy1)
    assert np.median(errors(corners)) > 3.0 * np.median(errors(whole))

    def fails(xy1, xy2, rng):
        raise StageFailure("no geometry", f"{len(xy1)} matches of {len(xy2)}, {rng}")

    rng = np.random.default_rng(0)
    assert len(SeedsAndGrowth().match(*stereo, pair=(0, 1), estimate_fundamental=fails, rng=rng).xy1) == 0


def test_growth_reaches_where_f_is_uncertain(stereo):
    """F is off by up to 10 px at the right edge, as its covariance says."""
    change = np.zeros((3, 3))
    change[2, 0] = 10.0 / stereo[0].size[0] / np.sqrt(2.0)

    def tilted(xy1, xy2, rng, std=1.0):
        fit = sideways_fundamental(xy1, xy2, rng)
        covariance = std**2 * np.outer(change, change)
        return replace(fit, F=fit.F + change, covariance=covariance)

    def grown(estimate):
        rng = np.random.default_rng(0)
        matches = SeedsAndGrowth().match(*stereo, pair=(0, 1), estimate_fundamental=estimate, rng=rng)
        assert (errors(matches) < 1.5).mean() > 0.9
        return len(matches.xy1)

    known = grown(sideways_fundamental)
    assert grown(tilted) > 0.95 * known
    assert grown(partial(tilted, std=0.0)) < 0.5 * known


def test_relative_difference_and_thresholds_drop_wrong_matches():
    """Half of the second photograph shows something else."""
    left, right = stereo_scene()
    rgb = right.rgb.copy()
    rgb[150:] = photograph(texture(150, 420, 77)).rgb
    mixed = Image("mixed.png", rgb, right.original_size)
    wrong = []
    for weight, least in (("product", 0.0), ("product", 0.4), ("relative-difference", 0.4)):
        variant = StrengthOfMatch(weight=weight, min_strength=least)
        matches = run(variant, *views(HarrisCorners(), variant, left, mixed))
        wrong.append(int((errors(matches) >= 1.5).sum()))
        assert (errors(matches) < 1.5).sum() > 700
    assert wrong[0] > 400
    assert wrong[1] < 0.2 * wrong[0]
    assert wrong[2] < 0.2 * wrong[1]


def test_settings_that_cannot_be_and_corners_without_seeds_are_refused():
    for kind, wrong in (
        (StrengthOfMatch, {"window": 8, "radius_rel": 0.0, "candidates": 0, "min_strength": 5.0}),
        (SeedsAndGrowth, {"neighbours": 0, "ratio": 0.0, "oblique_pairs": -1}),
    ):
        for field, value in wrong.items():
            refuses(ValueError, field, kind, **{field: value})
    corners = views(HarrisCorners(), SeedsAndGrowth(), *stereo_scene(120, 160))
    refuses(UsageError, r"features\.kind=multi-scale-corners", run, SeedsAndGrowth(), *corners)


def test_corners_of_seeds_are_one_to_one_and_follow_the_map():
    rng = np.random.default_rng(3)
    xy1 = rng.uniform(0, 400, (60, 2))
    turn = np.array([[0.0, -1.2], [1.2, 0.0]])
    order = rng.permutation(60)
    xy2 = (xy1 @ turn.T)[order]
    seeds = xy1[:30] + rng.uniform(-1, 1, (30, 2))
    seeds, rows = np.vstack([seeds, seeds[:5], [[-50.0, -50.0]]]), np.arange(36)
    score, maps = np.linspace(1, 0.5, 36).astype(np.float32), np.tile(turn, (36, 1, 1))
    found = corners_of_seeds(xy1, xy2, Matches(0, 1, rows, rows, seeds, seeds @ turn.T, score, maps))
    one, two = found.index1, found.index2
    assert set(one.tolist()) <= set(range(60))
    assert len(one) >= 29
    assert (order[two] == one).all()
    assert np.array_equal(found.xy2, xy2[two])

"""What only the default estimator promises: the bound at any noise, inliers in the tail, agreement."""

import numpy as np
import pytest

from tests.epipolar.pairs import make_pair, spoil
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac, estimate_fundamental
from thesisrecon.epipolar.refinement import refine_reprojection
from thesisrecon.geometry.two_view import sampson_residuals, symmetric_residuals

FAST = LocallyOptimisedRansac()


def squared_error(F, pair, good):
    return float(np.mean(symmetric_residuals(F, pair.xy1[good], pair.xy2[good]) ** 2) / 2.0)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("n", [30, 100])
def test_it_is_as_good_as_the_gold_standard_at_any_noise(n, sigma):
    """At 2 px most right matches lie beyond the threshold of 1 px."""
    ours, gold, sigmas = [], [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        pair = make_pair(n, rng)
        xy1, xy2, _ = spoil(pair, rng, sigma=sigma, outliers=0.0)
        fit, everyone = estimate_fundamental(xy1, xy2, seed=seed), np.ones(n, dtype=bool)
        ours.append(squared_error(fit.F, pair, everyone))
        gold.append(squared_error(refine_reprojection(pair.F, xy1, xy2), pair, everyone))
        sigmas.append(fit.sigma_px / sigma)
        assert fit.inliers.mean() > 0.9
    assert np.sqrt(np.mean(ours) / np.mean(gold)) < 1.15
    assert np.median(sigmas) == pytest.approx(1.0, abs=0.1)


def test_noise_with_a_heavy_tail_keeps_its_tail_as_inliers_where_it_is_asked_for():
    rng = np.random.default_rng(5)
    pair = make_pair(400, rng)
    xy1, xy2, wrong = spoil(pair, rng, sigma=0.3, outliers=0.3)
    tail = ~wrong & (rng.random(400) < 0.15)
    xy1[tail] += rng.normal(0.0, 1.2, (int(tail.sum()), 2))
    everything = FAST.estimate(xy1, xy2, np.random.default_rng(0))
    precise = LocallyOptimisedRansac(inlier_sigmas=2.5).estimate(xy1, xy2, np.random.default_rng(0))
    assert everything.inliers[~wrong].mean() > 0.97
    assert everything.inliers[wrong].mean() < 0.05
    assert precise.inliers[tail].mean() < 0.75
    np.testing.assert_array_equal(precise.F, everything.F)
    r = np.abs(sampson_residuals(precise.F, xy1, xy2))
    np.testing.assert_array_equal(precise.inliers, r < max(2.5 * precise.sigma_px, 0.3))


def test_noise_beyond_the_threshold_is_not_invented_for_wrong_matches():
    """Of many wrong matches some are near any wide band: they must not widen the noise."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pair = make_pair(200, rng)
        xy1, xy2, wrong = spoil(pair, rng, sigma=0.3, outliers=0.75)
        fit = estimate_fundamental(xy1, xy2, seed=seed)
        assert fit.sigma_px < 0.5
        assert fit.inliers[wrong].mean() < 0.05


def test_other_ends_of_the_search_are_told_as_rivals():
    """Two motions of as many matches each: the one that is not taken is the first rival."""
    rng = np.random.default_rng(0)
    one, other = make_pair(60, rng), make_pair(60, np.random.default_rng(1))
    xy1, xy2 = np.vstack([one.xy1, other.xy1]), np.vstack([one.xy2, other.xy2])
    noisy1, noisy2 = (xy + rng.normal(0.0, 0.2, xy.shape) for xy in (xy1, xy2))
    fit = LocallyOptimisedRansac(starts=8).estimate(noisy1, noisy2, np.random.default_rng(0))
    everyone = np.ones(60, dtype=bool)
    errors = [
        [squared_error(F, pair, everyone) for pair in (one, other)] for F in (fit.F, *fit.competing_models)
    ]
    taken = int(np.argmin(errors[0]))
    assert errors[0][taken] < 0.5
    assert min(error[1 - taken] for error in errors[1:]) < 0.5


def test_searches_that_disagree_are_repeated():
    rng = np.random.default_rng(2)
    pair = make_pair(100, rng)
    xy1, xy2, _ = spoil(pair, rng, sigma=0.3, outliers=0.2)
    drawn = [
        LocallyOptimisedRansac(starts=k).estimate(xy1, xy2, np.random.default_rng(0)).iterations
        for k in (1, 3, 5)
    ]
    assert drawn[1] >= 3 * drawn[0]
    assert drawn[2] >= 5 * drawn[0]
    hopeless = rng.uniform(0.0, 1000.0, (2, 60, 2))
    fit = LocallyOptimisedRansac(max_starts=8).estimate(*hopeless, np.random.default_rng(0))
    assert fit.inliers.mean() < 0.5
    # Eight searches at the threshold and eight with the wider gate, of a share of the samples each.
    assert 3 * 1024 < fit.iterations <= 2 * FAST.max_samples


@pytest.mark.parametrize("wrong_call", [{"starts": 5, "max_starts": 4}, {"inlier_sigmas": 0.0}])
def test_impossible_settings_are_refused(wrong_call):
    with pytest.raises(ValueError, match=next(reversed(wrong_call))):
        LocallyOptimisedRansac(**wrong_call)

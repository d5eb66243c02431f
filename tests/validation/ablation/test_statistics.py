"""Intervals, p-values and effect sizes against a hand, SciPy and simulations."""

import numpy as np
import pytest
from scipy import stats

from validation.ablation.statistics import (
    STUDENTISED_FROM,
    holm,
    mean_ranks,
    on_front,
    paired_interval,
    resampled_t,
)


def test_five_differences_by_hand():
    # 1 2 3 4 5: mean 3, variance 2.5, standard error sqrt(2.5 / 5), t = 4.2426 with 4 degrees of freedom,
    # whose 97.5 % quantile is 2.7764; Hedges' factor 1 - 3 / 15.
    found = paired_interval([np.arange(1.0, 6.0)], "draws")
    assert found.mean == 3.0
    assert found.low == pytest.approx(3.0 - 2.7764 * 0.70711, abs=1e-4)
    assert found.high == pytest.approx(3.0 + 2.7764 * 0.70711, abs=1e-4)
    assert found.p == pytest.approx(0.0132, abs=1e-4)
    assert found.effect == pytest.approx(3.0 / 1.58114 * 0.8, abs=1e-4)
    assert (found.pairs, found.sample, found.count) == (5, "draws", 5)


def test_two_scenes_are_welch():
    # The mean of two means has the standard error and the freedom of Welch's test of their difference.
    rng = np.random.default_rng(2)
    a, b = rng.normal(1.0, 1.0, 5), rng.normal(2.0, 3.0, 7)
    found, known = paired_interval([a, b], "draws"), stats.ttest_ind(a, -b, equal_var=False)
    assert found.mean == pytest.approx((a.mean() + b.mean()) / 2.0)
    assert found.p == pytest.approx(known.pvalue)
    low, high = known.confidence_interval(0.95)
    assert (2.0 * found.low, 2.0 * found.high) == pytest.approx((low, high))


def test_the_studentised_bootstrap_is_that_of_scipy():
    d = np.random.default_rng(3).exponential(size=STUDENTISED_FROM)
    t = resampled_t([[np.array([v]) for v in d]], resamples=20000)

    def statistic(x, axis=-1):
        return (x.mean(axis=axis) - d.mean()) / (x.std(axis=axis, ddof=1) / np.sqrt(x.shape[axis]))

    known = stats.bootstrap(
        (d,), statistic, n_resamples=20000, rng=np.random.default_rng(4), method="percentile"
    )
    for q in (0.5, 0.9, 0.95):
        assert np.quantile(t, q) == pytest.approx(
            np.quantile(np.abs(known.bootstrap_distribution), q), rel=0.04
        )


def test_scenes_are_the_sample_by_their_means():
    rng = np.random.default_rng(5)
    groups = [rng.normal(mean, 0.1, 5) for mean in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)]
    scenes, draws = paired_interval(groups, "scenes"), paired_interval(groups, "draws")
    means = np.array([g.mean() for g in groups])
    assert scenes.p == pytest.approx(stats.ttest_1samp(means, 0.0).pvalue)
    assert (scenes.pairs, scenes.count, draws.count) == (30, 6, 30)
    assert scenes.high - scenes.low > 5.0 * (draws.high - draws.low)


def test_draws_that_change_nothing_have_no_interval():
    settled = [np.array([1.0, 1.0 + 1e-9, 1.0]), np.array([2.0, 2.0, 2.0 - 1e-9])]
    found = paired_interval(settled, "draws")
    assert found.mean == pytest.approx(1.5)
    assert np.isnan([found.low, found.high, found.p]).all()


DRAWS = {
    "normal": (lambda rng, n: rng.normal(size=n), 0.0),
    "heavy tails": (lambda rng, n: rng.standard_t(3, size=n), 0.0),
    "even": (lambda rng, n: rng.uniform(-1.0, 1.0, n), 0.0),
}


@pytest.mark.parametrize("count", [5, 10, 20])
@pytest.mark.parametrize("kind", DRAWS)
def test_at_most_five_per_cent_of_null_effects_are_reported(kind, count):
    draw, mean = DRAWS[kind]
    rng = np.random.default_rng(7)
    trials = 400
    found = [paired_interval([draw(rng, count)], "draws") for _ in range(trials)]
    held = sum(f.low <= mean <= f.high for f in found)
    # Two standard deviations of a count of trials that each hold in 95 of 100.
    assert held >= 0.95 * trials - 2.0 * np.sqrt(trials * 0.05 * 0.95)
    assert sum(f.p > 0.05 for f in found) == pytest.approx(held, abs=2)


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, float("nan")])[:3] == pytest.approx([0.03, 0.06, 0.06])
    assert np.isnan(holm([0.01, float("nan")])[1])
    assert holm([0.6, 0.7]) == pytest.approx([1.0, 1.0])
    assert holm([]) == []


def test_ranks_share_places_and_put_failures_last():
    blocks = np.array([[1.0, 2.0, 2.0], [3.0, np.nan, 1.0]])
    assert mean_ranks(blocks) == pytest.approx([1.5, 2.75, 1.75])


def test_the_front_is_not_dominated():
    cost, loss = np.array([1.0, 2.0, 3.0, 2.0, np.nan]), np.array([5.0, 3.0, 4.0, 3.0, 0.0])
    assert on_front(cost, loss).tolist() == [True, True, False, True, False]

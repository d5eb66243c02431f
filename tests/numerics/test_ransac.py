"""Sampling, stopping and noise scale; nothing here knows what is sampled."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from thesisrecon.numerics.noise import noise_scale, noise_width, trimmed_noise_scale
from thesisrecon.numerics.ransac import SampleConsensus, draw_sample, required_samples


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 9), st.integers(0, 40), st.integers(0, 2**31))
def test_samples_are_distinct_sorted_and_in_range_and_equal_the_plain_code(size, extra, seed):
    n = size + extra
    uniforms = np.random.default_rng(seed).random(size)
    compiled, plain = np.empty(size, np.int64), np.empty(size, np.int64)
    draw_sample(uniforms, n, compiled)
    draw_sample.py_func(uniforms, n, plain)
    np.testing.assert_array_equal(compiled, plain)
    assert (np.diff(compiled) > 0).all()
    assert compiled[0] >= 0
    assert compiled[-1] < n


def test_uniform_number_of_one_stays_in_range():
    sample = np.empty(3, np.int64)
    draw_sample(np.ones(3), 5, sample)
    np.testing.assert_array_equal(sample, [2, 3, 4])


def test_every_subset_is_equally_likely():
    rng = np.random.default_rng(0)
    counts = dict.fromkeys(combinations(range(6), 3), 0)
    sample = np.empty(3, np.int64)
    for uniforms in rng.random((4000, 3)):
        draw_sample(uniforms, 6, sample)
        counts[tuple(int(v) for v in sample)] += 1
    assert chisquare(list(counts.values())).pvalue > 1e-3


def test_required_samples_follow_the_formula_and_its_limits():
    assert required_samples(0.5, 7, 0.99, 10**6) == int(np.ceil(np.log(0.01) / np.log(1 - 0.5**7)))
    assert required_samples(0.0, 7, 0.99, 1000) == 1000
    assert required_samples(1.0, 7, 0.99, 1000) == 1
    assert required_samples(0.3, 7, 0.99, 50) == 50


@settings(max_examples=20, deadline=None)
@given(st.floats(0.01, 100.0), st.integers(0, 2**31))
def test_noise_scale_finds_sigma_and_bears_outliers(sigma, seed):
    rng = np.random.default_rng(seed)
    residuals = rng.normal(0.0, sigma, 3000)
    assert noise_scale(residuals, parameters=7) == pytest.approx(sigma, rel=0.12)
    residuals[:300] *= 1000.0
    assert noise_scale(residuals, parameters=7) == pytest.approx(sigma, rel=0.3)


def test_noise_scale_has_the_small_sample_factor():
    assert noise_scale(np.ones(12), parameters=7) == pytest.approx(2 * 1.4826022)


@pytest.mark.parametrize("residuals", [np.ones(7), np.array([np.nan] * 9)])
def test_noise_scale_refuses(residuals):
    with pytest.raises(ValueError, match="noise_scale"):
        noise_scale(residuals, parameters=7)


@dataclass(frozen=True)
class Line:
    """y = a x + b through two points."""

    x: np.ndarray
    y: np.ndarray
    sample_size: int = 2

    def solve(self, sample):
        x, y = self.x[sample], self.y[sample]
        if x[0] == x[1]:
            return []
        a = (y[1] - y[0]) / (x[1] - x[0])
        return [(a, y[0] - a * x[0])]

    def residuals(self, model):
        return self.y - model[0] * self.x - model[1]


def test_consensus_finds_the_line_among_outliers():
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 10, 100)
    y = 2 * x + 1
    y[:40] = rng.uniform(0, 20, 40)
    found = SampleConsensus(0.01, max_samples=200).search(Line(x, y), 100, rng)
    assert found is not None
    assert found.model == pytest.approx((2.0, 1.0))
    assert found.inliers[40:].all()
    assert found.samples == 200


def test_consensus_stops_at_the_share_that_is_enough_and_breaks_ties_by_the_spread():
    x = np.arange(10.0)
    found = SampleConsensus(0.1, max_samples=500, enough_share=0.9).search(
        Line(x, x), 10, np.random.default_rng(0)
    )
    assert found is not None
    assert found.samples == 1
    y = x + np.array([0, 0, 0, 0, 0, 0, 0, 0, 0.2, 0.0])
    found = SampleConsensus(0.25, max_samples=300).search(Line(x, y), 10, np.random.default_rng(0))
    assert found is not None
    assert found.inliers.all()
    spread = np.std(Line(x, y).residuals(found.model))
    assert spread < np.std(y - x) * 1.05


def test_consensus_without_a_model_is_none_and_too_few_data_are_refused():
    problem = Line(np.zeros(5), np.arange(5.0))
    assert SampleConsensus(1.0, max_samples=10).search(problem, 5, np.random.default_rng(0)) is None
    with pytest.raises(ValueError, match="at least 2"):
        SampleConsensus(1.0).search(problem, 1, np.random.default_rng(0))


@pytest.mark.parametrize("sigma", [0.1, 0.5, 1.0, 2.0])
def test_the_noise_is_seen_to_its_end(sigma):
    rng = np.random.default_rng(0)
    wrong = rng.uniform(0.0, 300.0, 500)
    r = np.abs(np.concatenate([rng.normal(0.0, sigma, 1000), wrong]))
    width = noise_width(r, 1.0)
    assert max(1.0, 2.2 * sigma) <= width <= max(1.0, 5.0 * sigma)
    found = trimmed_noise_scale(r, noise_scale(r[r < width]))
    assert found == pytest.approx(sigma, rel=0.1)


def test_wrong_matches_do_not_widen_the_noise():
    r = np.random.default_rng(1).uniform(0.0, 300.0, 20000)
    assert noise_width(r, 1.0) == 1.0
    assert noise_width(r[:5], 1.0) == 1.0
    assert trimmed_noise_scale(r[:10], 0.5) == 0.5
    assert trimmed_noise_scale(np.zeros(50), 0.5) == 0.0

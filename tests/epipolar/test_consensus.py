"""RANSAC, and the noise among wrong residuals."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare, norm

from tests.conftest import refuses
from tests.epipolar.pairs import make_pair
from thesisrecon.epipolar._matches import (
    TAIL,
    NoiseMixture,
    PairFrame,
    _fit_mixture,
    noise_scale,
    noise_width,
    trimmed_noise_scale,
)
from thesisrecon.epipolar._sampling import draw_sample, required_samples
from thesisrecon.epipolar.linear import seven_point
from thesisrecon.epipolar.ransac import _search
from thesisrecon.geometry.two_view import sampson_residuals


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
    draw_sample(np.ones(size), n, compiled)
    np.testing.assert_array_equal(compiled, np.arange(extra, n))


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


def test_noise_scale_has_the_small_sample_factor_and_refuses_too_few_residuals():
    assert noise_scale(np.ones(12), parameters=7) == pytest.approx(2 * 1.4826022)
    for residuals in (np.ones(7), np.array([np.nan] * 9)):
        refuses(ValueError, "noise_scale", noise_scale, residuals, parameters=7)


def test_consensus_takes_most_inliers_then_the_least_spread_or_the_least_median():
    rng = np.random.default_rng(1)
    pair = make_pair(40, rng)
    frame = PairFrame.of(pair.xy1, pair.xy2)
    points = frame.points(pair.xy1, pair.xy2)
    points[:15, 2:] = rng.uniform(-1.5, 1.5, (15, 2))

    def distances(f):
        return np.abs(sampson_residuals(f.reshape(3, 3), points[:, :2], points[:, 2:]))

    sample, models, after = np.empty(7, np.int64), [], np.random.default_rng(0)
    for _ in range(120):
        draw_sample(after.random(7), 40, sample)
        models += list(seven_point(points[sample][None])[0])
    r = np.array([distances(f) for f in models])
    for gate, best in (
        (
            0.05,
            np.argmax(
                (r < 0.05).sum(axis=1) - 1e-3 * np.sqrt(np.mean(np.where(r < 0.05, r, 0) ** 2, axis=1))
            ),
        ),
        (1e3, np.argmin(np.mean(r**2, axis=1))),
        (np.inf, np.argmin(np.sort(r, axis=1)[:, 20])),
    ):
        rng = np.random.default_rng(0)
        f, inliers, drawn = _search(points, distances, rng, gate=gate, samples=120)
        np.testing.assert_allclose(f, models[best])
        expected = r[best] < gate if gate < np.inf else r[best] <= np.sort(r[best])[20]
        np.testing.assert_array_equal(inliers, expected)
        assert drawn == 120
        assert rng.random() == np.random.default_rng(0).random(841)[-1]
    rng = np.random.default_rng(0)
    assert _search(points[15:], lambda _: np.zeros(25), rng, gate=1.0, samples=500, enough=20.0)[2] == 1
    assert rng.random() == np.random.default_rng(0).random(8)[-1]
    assert _search(np.ones((9, 4)), distances, rng, gate=1.0, samples=10)[0] is None


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


def draw(n, wrong, tail, seed):
    """Absolute residuals in order: noise of 0.5, a tail four times as wide, wrong ones up to 300."""
    rng = np.random.default_rng(seed)
    kind = rng.random(n)
    r = rng.normal(0.0, 0.5, n) * np.where(kind < tail, TAIL, 1.0)
    r[kind > 1.0 - wrong] = rng.uniform(0.0, 300.0, int(np.sum(kind > 1.0 - wrong)))
    return np.sort(np.abs(r))


def test_one_round_is_the_textbook_step():
    r = draw(60, 0.3, 0.2, 0)
    mixture = np.array([0.7, 80.0, 0.5, 0.2, 0.3])
    widths = np.array([0.7, 0.7 * TAIL, 80.0])
    p = mixture[2:] * 2.0 * norm.pdf(r[:, None], scale=widths)
    posterior = p / p.sum(axis=1, keepdims=True)
    squares = posterior.T @ r**2
    counts = posterior.sum(axis=0)
    likelihood = _fit_mixture(r, 7.0, 50.0, 1, mixture)
    sigma = np.sqrt((squares[0] + squares[1] / TAIL**2) / (counts[0] + counts[1] - 7.0))
    assert mixture[0] == pytest.approx(sigma, rel=1e-9)
    assert mixture[1] == pytest.approx(np.sqrt((squares[2] + 50.0**2) / (counts[2] + 1.0)), rel=1e-9)
    np.testing.assert_allclose(mixture[2:], (counts + np.array([1.0, 0.5, 1.0])) / 62.5, rtol=1e-9)
    # The factor 2 / sqrt(2 pi) of half-normal densities is left out.
    assert likelihood == pytest.approx(np.mean(np.log(p.sum(axis=1))) - np.log(2.0 * norm.pdf(0.0)), rel=1e-9)


@pytest.mark.parametrize(("n", "wrong"), [(100, 0.0), (1000, 0.0), (1000, 0.3), (1000, 0.6), (5000, 0.5)])
@pytest.mark.parametrize("start", [0.4, 1.0])
def test_the_noise_is_found_among_wrong_residuals(n, wrong, start):
    found = NoiseMixture.fit(draw(n, wrong, 0.0, 2), start, spread=150.0, parameters=0)
    assert found.sigma == pytest.approx(0.5, rel=0.15)
    assert found.wrong == pytest.approx(wrong, abs=0.05)
    assert found.core + found.tail + found.wrong == pytest.approx(1.0)
    assert 2.5 * found.sigma < found.limit < 15.0 * found.sigma


def test_a_heavy_tail_moves_the_end_of_the_noise_outwards_and_of_its_core_inwards():
    light = NoiseMixture.fit(draw(2000, 0.3, 0.02, 3), 0.5, spread=150.0)
    heavy = NoiseMixture.fit(draw(2000, 0.3, 0.25, 3), 0.5, spread=150.0)
    assert heavy.tail > 0.15 > 0.06 > light.tail
    assert heavy.limit > light.limit
    assert heavy.core_limit / heavy.sigma < light.core_limit / light.sigma


@settings(max_examples=50, deadline=None)
@given(st.floats(-4.0, 4.0), st.integers(0, 1000))
def test_the_mixture_scales_with_its_residuals(power, seed):
    r, s = draw(80, 0.3, 0.1, seed), 10.0**power
    one, other = NoiseMixture.fit(r, 0.5, spread=150.0), NoiseMixture.fit(s * r, 0.5 * s, spread=150.0 * s)
    assert other.sigma == pytest.approx(s * one.sigma, rel=1e-6)
    assert other.limit == pytest.approx(s * one.limit, rel=1e-4)
    assert other.log_likelihood == pytest.approx(one.log_likelihood - np.log(s), abs=1e-6)


def test_exact_residuals_give_a_finite_mixture():
    found = NoiseMixture.fit(np.zeros(40), 1e-9, spread=1.0)
    assert 0.0 < found.sigma < 1e-9
    assert np.isfinite([found.limit, found.core_limit, found.log_likelihood]).all()

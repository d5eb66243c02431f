"""The mixture of noise, its tail and wrong residuals; the width of Huber's loss that suits residuals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from thesisrecon.numerics.noise import (
    TAIL,
    NoiseMixture,
    best_huber_width,
    effective_noise,
    fit_noise_mixture,
)


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
    likelihood = fit_noise_mixture(r, 7.0, 50.0, 1, mixture)
    sigma = np.sqrt((squares[0] + squares[1] / TAIL**2) / (counts[0] + counts[1] - 7.0))
    assert mixture[0] == pytest.approx(sigma, rel=1e-9)
    assert mixture[1] == pytest.approx(np.sqrt((squares[2] + 50.0**2) / (counts[2] + 1.0)), rel=1e-9)
    np.testing.assert_allclose(mixture[2:], (counts + np.array([1.0, 0.5, 1.0])) / 62.5, rtol=1e-9)
    # The factor 2 / sqrt(2 pi) of half-normal densities is left out.
    assert likelihood == pytest.approx(np.mean(np.log(p.sum(axis=1))) - np.log(2.0 * norm.pdf(0.0)), rel=1e-9)


def test_the_compiled_mixture_equals_the_plain_code():
    r, a = draw(200, 0.4, 0.1, 1), np.array([0.3, 100.0, 0.5, 0.1, 0.4])
    b = a.copy()
    assert fit_noise_mixture(r, 7.0, 90.0, 5, a) == pytest.approx(
        fit_noise_mixture.py_func(r, 7.0, 90.0, 5, b), rel=1e-12
    )
    np.testing.assert_allclose(a, b, rtol=1e-12)


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


def test_the_truer_model_is_the_likelier():
    r = draw(300, 0.3, 0.0, 5)
    worse = np.sort(np.hypot(r, 0.5))
    fits = [NoiseMixture.fit(x, 0.5, spread=150.0) for x in (r, worse)]
    assert fits[0].log_likelihood > fits[1].log_likelihood


def test_exact_residuals_give_a_finite_mixture():
    found = NoiseMixture.fit(np.zeros(40), 1e-9, spread=1.0)
    assert 0.0 < found.sigma < 1e-9
    assert np.isfinite([found.limit, found.core_limit, found.log_likelihood]).all()


def test_normal_residuals_want_least_squares_and_heavy_ones_a_bend():
    rng = np.random.default_rng(7)
    normal = np.abs(rng.normal(0.0, 0.5, 2000))
    assert best_huber_width(normal, 0.5) == np.inf
    assert effective_noise(normal, np.inf) == pytest.approx(0.5, rel=0.05)
    # Huber's width of 1.345 sigma keeps 95 % of the information of normal noise.
    assert effective_noise(normal, 1.345 * 0.5) == pytest.approx(0.5 / np.sqrt(0.95), rel=0.05)
    laplace = rng.exponential(0.5, 2000)
    width = best_huber_width(laplace, 0.5)
    assert width <= 1.0
    # The best M-estimator of a Laplace scale b has variance b^2, least squares 2 b^2.
    assert effective_noise(laplace, width) < 0.9 * np.sqrt(2.0) * 0.5


def test_the_noise_of_a_fit_allows_for_what_was_fitted():
    r = np.ones(17)
    assert effective_noise(r, np.inf, parameters=7) == pytest.approx(np.sqrt(1.7))
    assert effective_noise(r, 0.5, parameters=7) > 1.0

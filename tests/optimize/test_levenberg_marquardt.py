"""Levenberg-Marquardt, robust losses, the noise of a fit, and Morton order."""

from collections import OrderedDict

import numpy as np
import pytest

from tests.conftest import refuses
from thesisrecon.geometry.small_matrices import solve_positive
from thesisrecon.optimize import least_squares
from thesisrecon.optimize import least_squares as optimizer
from thesisrecon.optimize.bundle.projection import cached_pair_order


def test_normal_residuals_want_least_squares_and_heavy_ones_a_bend():
    rng = np.random.default_rng(7)
    normal = np.abs(rng.normal(0.0, 0.5, 2000))
    assert least_squares.best_huber_width(normal, 0.5) == np.inf
    assert least_squares.effective_noise(normal, np.inf) == pytest.approx(0.5, rel=0.05)
    # Huber's width of 1.345 sigma keeps 95 % of the information of normal noise.
    assert least_squares.effective_noise(normal, 1.345 * 0.5) == pytest.approx(0.5 / np.sqrt(0.95), rel=0.05)
    laplace = rng.exponential(0.5, 2000)
    width = least_squares.best_huber_width(laplace, 0.5)
    assert width <= 1.0
    # The best M-estimator of a Laplace scale b has variance b^2, least squares 2 b^2.
    assert least_squares.effective_noise(laplace, width) < 0.9 * np.sqrt(2.0) * 0.5
    # The noise allows for what was fitted.
    assert least_squares.effective_noise(np.ones(17), np.inf, parameters=7) == pytest.approx(np.sqrt(1.7))
    assert least_squares.effective_noise(np.ones(17), 0.5, parameters=7) > 1.0


def times_made(first, second, room):
    """How often a view is made where those asked for last are kept in a room for so many."""
    kept = OrderedDict()
    made = 0
    for view in np.stack([first, second], axis=1).ravel().tolist():
        made += view not in kept
        kept[view] = None
        kept.move_to_end(view)
        if len(kept) > room:
            kept.popitem(last=False)
    return made


def test_every_pair_is_visited_once_and_a_pair_and_its_turned_one_together():
    i, j = np.array([5, 3, 9, 5, 0]), np.array([3, 5, 2, 9, 1])
    order = cached_pair_order(i, j)
    assert sorted(order) == [0, 1, 2, 3, 4]
    places = np.argsort(order)
    assert abs(places[0] - places[1]) == 1
    assert len(cached_pair_order([], [])) == 0


@pytest.mark.parametrize("room", [16, 60, 120])
def test_views_are_loaded_few_times_with_any_memory(room):
    i, j = np.divmod(np.arange(300 * 300), 300)
    i, j = i[i != j], j[i != j]
    order = cached_pair_order(i, j)
    # Tiles with one side of half the room are the best there is, up to a factor.
    assert times_made(i[order], j[order], room) < 2.0 * 300**2 / room
    assert times_made(i, j, room) > 0.9 * len(i)


@pytest.mark.parametrize("rho", [least_squares.huber, least_squares.soft_l1])
def test_weight_is_the_derivative_of_the_loss(rho):
    s = np.array([0.01, 0.5, 1.9, 2.3, 9.0, 400.0])
    h = 1e-6 * s
    slope = (rho(s + h, 1.5)[0] - rho(s - h, 1.5)[0]) / (2 * h)
    np.testing.assert_allclose(rho(s, 1.5)[1], slope, rtol=1e-5, atol=1e-8)
    assert np.all(np.diff(rho(s, 1.5)[0]) >= 0.0)
    np.testing.assert_allclose(rho(np.array([1e-8]), 1.5)[0], 1e-8, rtol=1e-6)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("weak", [1e-4, 5e-5])
def test_a_small_gain_of_a_damped_step_is_no_minimum(seed, weak):
    """Nearly dependent columns: the first damped step along their difference gains next to nothing."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4000, 3))
    A[:, 1] = A[:, 0] + weak * A[:, 1]
    true, noise = rng.normal(size=3), rng.normal(size=4000)
    best = true + np.linalg.lstsq(A, noise, rcond=None)[0]
    std = np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
    # The strong directions start at the minimum, the weak one 2 standard deviations from it.
    start = best + 2.0 * std[0] * np.array([1.0, -1.0, 0.0])
    found = least_squares.minimize_residuals(lambda x: A @ (x - true) - noise, start, tolerance=1e-7)
    assert np.abs((found.x - best) / std).max() < 0.1


@pytest.mark.parametrize("unit", [2.0**-40, 2.0**40])
def test_the_path_does_not_depend_on_the_unit_of_the_residuals(unit):
    def path(unit):
        states = []

        def residual(x):
            states.append(x.copy())
            return unit * np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0], 0.5])

        assert (
            np.abs(
                least_squares.minimize_residuals(residual, np.array([-1.2, 1.0]), max_iterations=200).x - 1.0
            ).max()
            < 1e-4
        )
        return states

    np.testing.assert_allclose(path(unit), path(1.0), rtol=1e-9, atol=1e-9)


def test_covariances_are_those_of_the_textbook_and_useless_parameters_harmless():
    rng = np.random.default_rng(1)
    u = np.linspace(0.0, 1.0, 400)
    y = 2.0 - 3.0 * u + 0.1 * rng.normal(size=400)
    A = np.column_stack([np.ones_like(u), u])
    answer = least_squares.minimize_residuals(lambda x: A @ x - y, np.zeros(2))
    expected = np.sum((A @ answer.x - y) ** 2) / 398 * np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(answer.covariance, expected, rtol=1e-6)
    answer = least_squares.minimize_residuals(lambda x: np.array([x[0] + x[1] - 3.0, 0.0]), np.zeros(3))
    assert answer.cost < 1e-12
    assert answer.x[2] == 0.0
    assert np.isfinite(answer.covariance).all()


def test_states_outside_the_domain_and_singular_systems_are_refused_not_raised(monkeypatch):
    def residual(x):
        return np.where(x > 0.0, np.log(np.maximum(x, 1e-300)) - 2.0, np.nan)

    answer = least_squares.minimize_residuals(residual, np.array([0.01]), max_iterations=100)
    np.testing.assert_allclose(answer.x, np.exp(2.0), rtol=1e-6)
    refuses(ValueError, "finite", least_squares.minimize_residuals, residual, np.array([-1.0]))
    refuses(ValueError, "finite", least_squares.minimize_residuals, lambda x: x[:1], np.array([1.0, np.nan]))
    assert solve_positive(-np.eye(2), np.ones(2)) is None
    assert solve_positive(np.array([[np.nan]]), np.ones(1)) is None
    assert np.isinf(least_squares.invert_information(np.array([[np.nan]]))).all()
    covariance = least_squares.invert_information(np.diag([4.0, 0.0]))
    assert covariance[0, 0] == pytest.approx(0.25)
    assert np.isfinite(covariance).all()
    # Large information is inverted like small.
    A = np.random.default_rng(0).normal(size=(300, 60))
    information, flat = A.T @ A, np.diag([1.0, 1.0, 0.0])
    small = [least_squares.invert_information(S) for S in (information, flat)]
    monkeypatch.setattr(optimizer, "_MANY", 2)
    np.testing.assert_allclose(least_squares.invert_information(information), small[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(least_squares.invert_information(flat), small[1])


@pytest.mark.parametrize("unit", [0.1, 1.0, 30.0])
def test_the_trimmed_noise_is_that_of_the_normal_residuals_in_any_unit(unit):
    residuals = np.abs(np.random.default_rng(0).normal(size=4000))
    residuals[:200] = 50.0
    assert least_squares.trimmed_noise_scale(unit * residuals, 3.0 * unit) == pytest.approx(unit, rel=0.05)

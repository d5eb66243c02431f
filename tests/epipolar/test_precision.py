"""The bound, the intervals of epipolar distances and of epipoles, and the estimators that reach them."""

import numpy as np
import pytest
from scipy import stats

from tests.conftest import refuses
from tests.epipolar.pairs import make_pair
from thesisrecon.api.pairs import epipolar_lines
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import enforce_rank_two, epipolar_distance_std, epipoles
from thesisrecon.records import FundamentalFit
from validation.metrics.fundamental_precision import (
    _degrees_of_freedom,
    _ellipse_95,
    _student_95,
    epipoles_of,
    fundamental_bound,
)
from validation.scenes.two_views import make_two_views
from validation.studies.epipolar_methods import DEFAULT, LEAST, check_precision


def bound_of(seed, n=40, sigma=0.5):
    scene = make_two_views(Configuration.GENERAL, n, np.random.default_rng(seed))
    return scene, fundamental_bound(scene.P1, scene.P2, scene.X, sigma_px=sigma)


@pytest.mark.parametrize(("sigma", "n"), [(1.0, 60), (2.0, 30)])
def test_gold_standard_reaches_the_bound_and_its_intervals_hold_the_truth(sigma, n):
    values = {row.name: row.values[LEAST] for row in check_precision(sigma, n, 150) if LEAST in row.values}
    assert values["RMS distance over bound"] == pytest.approx(1.0, abs=0.05)
    assert values["coverage of distances"] == pytest.approx(0.95, abs=0.02)
    assert values["coverage of epipoles"] == pytest.approx(0.95, abs=0.03)
    assert values["coverage of epipoles in pixels"] == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize("nu", [1.0, 3.0, 23.0, 1e4, np.inf])
def test_quantiles_are_those_of_student_and_fisher(nu):
    finite = min(nu, 1e9)
    assert _student_95(nu) == pytest.approx(stats.t.ppf(0.975, finite), rel=1e-6)
    assert _ellipse_95(nu) == pytest.approx(2.0 * stats.f.ppf(0.95, 2, finite), rel=1e-6)


def test_degrees_of_freedom_are_the_inliers_without_seven():
    inliers = np.arange(20) < 12
    fit = FundamentalFit(np.eye(3), inliers, 1.0, np.eye(9))
    assert _degrees_of_freedom(fit) == 5.0
    assert _degrees_of_freedom(FundamentalFit(np.eye(3), inliers[9:], 1.0, np.eye(9))) == 1.0


def of_many(F, covariance):
    return epipoles_of(FundamentalFit(F, np.ones(10**6, dtype=bool), 1.0, covariance))


def test_little_noise_gives_the_first_order_interval():
    _, bound = bound_of(2)
    for found in of_many(bound.F, 1e-8 * bound.covariance):
        e = found.direction
        D = np.hstack([np.eye(2), -e[:2, None] / e[2]]) / e[2]
        xy, half = e[:2] / e[2], 1.96 * np.sqrt(np.diag(D @ found.covariance @ D.T))
        assert found.contains_xy(xy + 0.99 * half).all()
        assert found.contains_xy(xy - 0.99 * half).all()
        assert not found.contains_xy(xy + 1.01 * half).any()
        assert found.contains(-e)


@pytest.mark.parametrize(("sigma", "n"), [(0.25, 100), (0.5, 300), (2.0, 1000)])
def test_the_default_comes_near_the_bound_at_its_default_threshold(sigma, n):
    values = {row.name: row.values[DEFAULT] for row in check_precision(sigma, n, 30) if DEFAULT in row.values}
    assert values["RMS distance over bound"] < 1.1
    assert values["coverage of distances"] > 0.92


def test_bound_grows_with_the_noise_and_falls_with_the_points():
    scene, bound = bound_of(0)
    assert np.linalg.matrix_rank(bound.covariance, tol=1e-9 * np.linalg.norm(bound.covariance, 2)) <= 7
    np.testing.assert_allclose(bound.covariance @ bound.F.ravel(), 0.0, atol=1e-9 * bound.covariance.max())
    twice = fundamental_bound(scene.P1, scene.P2, scene.X, sigma_px=1.0)
    np.testing.assert_allclose(twice.covariance, 4.0 * bound.covariance)
    assert twice.rms_distance_px == pytest.approx(2.0 * bound.rms_distance_px)
    doubled = fundamental_bound(scene.P1, scene.P2, np.r_[scene.X, scene.X], sigma_px=0.5)
    np.testing.assert_allclose(doubled.covariance, bound.covariance / 2.0, rtol=1e-6)
    # Seven parameters, each of n residuals: the mean squared Sampson distance is 7 sigma^2 / n.
    assert bound.rms_distance_px == pytest.approx(0.5 * np.sqrt(2.0 * 7.0 / 40.0), rel=0.1)


def test_distances_and_epipoles_move_as_their_derivatives_say():
    scene, bound = bound_of(1)
    direction = np.linalg.eigh(bound.covariance)[1][:, -1]
    step = 1e-7
    moved = enforce_rank_two(bound.F + step * direction.reshape(3, 3))
    covariance = np.outer(direction, direction)
    lines = epipolar_lines(moved, scene.xy1)
    change = np.abs(np.sum(homogenize(scene.xy2) * lines, axis=1)) / step
    std = epipolar_distance_std(bound.F, covariance, scene.xy1, scene.xy2)
    np.testing.assert_allclose(change, std, rtol=1e-2, atol=2e-3 * std.max())
    for found, e, after in zip(of_many(bound.F, covariance), epipoles(bound.F), epipoles(moved), strict=True):
        difference = (after * np.sign(after @ e) - e) / step
        np.testing.assert_allclose(
            np.outer(difference, difference), found.covariance, atol=1e-2 * np.abs(found.covariance).max()
        )


def test_wrong_calls():
    pair = make_pair(20, np.random.default_rng(0))
    X = np.random.default_rng(1).uniform((-1.0, -1.0, 4.0), (1.0, 1.0, 6.0), (20, 3))
    refuses(ValueError, "different centres", fundamental_bound, pair.P1, pair.P1, X, sigma_px=1.0)

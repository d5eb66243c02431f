"""F by method name and homographies: inliers, noise and covariance against known truth."""

from typing import get_args

import numpy as np
import pytest

import thesisrecon
from tests.conftest import refuses
from tests.epipolar.pairs import SIZE, angle_between, make_pair, spoil
from thesisrecon.epipolar.degeneracy import Method
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import unit_norm
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import plane_homography

LINEAR = ("eight-point", "gold-standard")


def squared_in_covariance(error, covariance, rank):
    """Mean squared error in the directions of a covariance, in its standard deviations."""
    values, vectors = np.linalg.eigh(covariance)
    return np.mean((vectors[:, -rank:].T @ error.ravel()) ** 2 / values[-rank:])


@pytest.mark.parametrize("method", sorted(set(get_args(Method)) - {"seven-point"}))
def test_every_method_gives_f_with_inliers_noise_and_covariance(method):
    ratios, sigmas = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        pair = make_pair(150, rng)
        exact = thesisrecon.estimate_fundamental(pair.xy1, pair.xy2, method=method)
        assert angle_between(exact.F, pair.F) < 1e-6
        assert exact.inliers.all()
        assert exact.sigma_px < 1e-6
        xy1, xy2, wrong = spoil(pair, rng, sigma=0.5, outliers=0.0 if method in LINEAR else 0.3)
        fit = thesisrecon.estimate_fundamental(xy1, xy2, method=method, threshold_px=1.5, seed=seed)
        assert fit.inliers[~wrong].mean() > 0.88
        assert fit.inliers[wrong].sum() <= 0.1 * wrong.sum()
        error = fit.F * np.sign(np.sum(fit.F * pair.F)) - pair.F
        ratios.append(squared_in_covariance(error, fit.covariance, 7))
        sigmas.append(fit.sigma_px)
    assert 0.4 < np.median(sigmas) < 0.6
    # The covariance is that of the least squares fit; the eight-point algorithm is worse.
    assert 0.4 < np.median(ratios) < (40.0 if method == "eight-point" else 2.0)


def test_without_a_threshold_all_matches_are_right():
    rng = np.random.default_rng(0)
    xy = spoil(make_pair(50, rng), rng, sigma=0.5, outliers=0.0)[:2]
    every = thesisrecon.estimate_fundamental(*xy, method="gold-standard")
    assert np.array_equal(thesisrecon.estimate_fundamental(*xy, threshold_px=None).F, every.F)


def test_seven_matches_give_all_solutions():
    pair = make_pair(7, np.random.default_rng(4))
    fit = thesisrecon.estimate_fundamental(pair.xy1, pair.xy2, method="seven-point")
    assert min(angle_between(F, pair.F) for F in (fit.F, *fit.competing_models)) < 1e-6
    assert np.isnan(fit.sigma_px)
    flat = make_pair(7, np.random.default_rng(4), planar=True)
    refuses(
        StageFailure, "seven matches do not determine", thesisrecon.estimate_fundamental,
        flat.xy1, flat.xy2, method="seven-point",
    )  # fmt: skip
    refuses(
        ValueError, "unknown method 'eight'; did you mean", thesisrecon.estimate_fundamental,
        pair.xy1, pair.xy2, method="eight",
    )  # fmt: skip


def plane_matches(n, rng):
    """Exact matches of a plane, and their homography."""
    pair = make_pair(n, rng, planar=True)
    # Points X + (0, 0, 5) of the plane Z = 0.3 X - 0.2 Y.
    return pair.xy1, pair.xy2, plane_homography(pair.P1, pair.P2, np.array([0.3, -0.2, -1.0, 5.0]))


@pytest.mark.parametrize("n", [4, 5, 60])
def test_a_homography_of_exact_matches_is_exact(n):
    xy1, xy2, H = plane_matches(n, np.random.default_rng(n))
    for threshold_px in (1.0, None):
        fit = thesisrecon.estimate_homography(xy1, xy2, threshold_px=threshold_px)
        assert angle_between(fit.H, H) < 1e-9
        assert fit.inliers.all()
        assert np.isnan(fit.sigma_px) if n == 4 else fit.sigma_px < 1e-6


def test_a_homography_of_noisy_matches_has_their_noise_and_its_covariance():
    ratios, sigmas = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        xy1, xy2, H = plane_matches(100, rng)
        xy1, xy2 = xy1 + rng.normal(0.0, 0.5, xy1.shape), xy2 + rng.normal(0.0, 0.5, xy2.shape)
        xy2[:40] = rng.uniform((0.0, 0.0), SIZE, (40, 2))
        fit = thesisrecon.estimate_homography(xy1, xy2, seed=seed)
        assert fit.inliers[40:].mean() > 0.9
        assert fit.inliers[:40].sum() <= 1
        error = fit.H * np.sign(np.sum(fit.H * H)) - H
        ratios.append(squared_in_covariance(error, fit.covariance, 8))
        sigmas.append(fit.sigma_px)
        # H has unit norm: no part of its error is along H.
        along = fit.covariance @ fit.H.ravel()
        assert np.linalg.norm(along) < 1e-9 * np.linalg.norm(fit.covariance)
    assert 0.45 < np.mean(sigmas) < 0.55
    assert 0.7 < np.mean(ratios) < 1.5


def test_matches_that_determine_no_homography_are_named():
    call, rng = thesisrecon.estimate_homography, np.random.default_rng(0)
    xy = rng.uniform(0.0, 500.0, (20, 2))
    line = np.outer(np.arange(20.0), [1.0, 2.0])
    refuses(StageFailure, "do not determine a homography; 3 matches", call, xy[:3], xy[:3])
    refuses(StageFailure, "rank below 8", call, line, line + 5.0)
    refuses(StageFailure, "at least 4 different", call, np.ones((9, 2)), np.ones((9, 2)))
    refuses(ValueError, r"needs xy1 \(N, 2\), xy2 \(N, 2\)", call, xy, xy[:5])
    refuses(ValueError, "threshold_px must be positive", call, xy, xy, threshold_px=0.0)
    moved = dehomogenize(homogenize(xy) @ unit_norm(np.diag([2.0, 2.0, 1.0])).T)
    assert thesisrecon.estimate_homography(xy, moved).inliers.all()

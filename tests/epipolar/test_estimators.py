"""Estimators of the fundamental matrix, their parts, maps and precision, and homographies."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import thesisrecon
from tests.conftest import refuses
from tests.constants import with_constants
from tests.epipolar.pairs import angle_between, make_pair, spoil
from tests.geometry.properties import holds_for_every
from thesisrecon.api.pairs import epipolar_lines, estimate_fundamental
from thesisrecon.epipolar import ransac
from thesisrecon.epipolar._matches import noise_scale
from thesisrecon.epipolar.degeneracy import Method
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.refinement import refine_fundamental
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.errors import StageFailure
from thesisrecon.geometry import two_view
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, unit_norm
from thesisrecon.geometry.two_view import enforce_rank_two, epipolar_distance_std, epipoles, plane_homography
from thesisrecon.optimize.least_squares import central_differences
from thesisrecon.records import FundamentalFit
from validation.metrics.fundamental_precision import _ellipse_95, _student_95, epipoles_of, fundamental_bound
from validation.scenes.two_views import make_two_views
from validation.studies.epipolar_methods import DEFAULT, LEAST, check_precision

seeds = st.integers(0, 2**31)


ROBUST = [
    LocallyOptimisedRansac(),
    ransac.ThesisRansac(samples=300),
    ransac.ThesisRansac(samples=300, epipolar_distance=True),
]


def error_px(F, pair):
    """RMS distance of exact matches to their epipolar lines."""
    return float(np.sqrt(np.mean(two_view.symmetric_residuals(F, pair.xy1, pair.xy2) ** 2) / 2))


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(8, 50), st.booleans())
def test_eight_point_is_exact_without_noise(seed, n, normalized):
    pair = make_pair(n, np.random.default_rng(seed))
    F = ransac.estimate_eight_point(pair.xy1, pair.xy2, normalized=normalized)
    assert np.linalg.norm(F) == pytest.approx(1.0)
    assert error_px(F, pair) < (1e-6 if normalized else 1e-2)


def test_normalisation_and_rank_matter_under_noise():
    errors = {True: [], False: []}
    for seed in range(10):
        rng = np.random.default_rng(seed)
        pair = make_pair(100, rng)
        xy1, xy2, _ = spoil(pair, rng, sigma=0.5, outliers=0.0)
        for normalized in errors:
            errors[normalized].append(
                error_px(ransac.estimate_eight_point(xy1, xy2, normalized=normalized), pair)
            )
        full = ransac.estimate_eight_point(xy1, xy2, rank_two=False)
        assert np.linalg.matrix_rank(full, tol=1e-15) == 3
    assert np.median(errors[True]) < 0.3 * np.median(errors[False])


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_seven_point_contains_the_truth_and_every_solution_is_valid(seed):
    pair = make_pair(7, np.random.default_rng(seed))
    F = ransac.estimate_seven_point(pair.xy1, pair.xy2)
    assert 1 <= len(F) <= 3
    for candidate in F:
        assert np.linalg.norm(candidate) == pytest.approx(1.0)
        assert np.linalg.svd(candidate, compute_uv=False)[2] < 1e-10
        assert two_view.symmetric_residuals(candidate, pair.xy1, pair.xy2).max() < 1e-4
    assert min(angle_between(candidate, pair.F) for candidate in F) < 1e-5


@pytest.mark.parametrize("estimator", ROBUST)
def test_same_generator_same_bytes(estimator):
    rng = np.random.default_rng(4)
    xy1, xy2, _ = spoil(make_pair(120, rng), rng, sigma=0.3, outliers=0.3)
    first, second = (estimator.estimate(xy1, xy2, np.random.default_rng(9)) for _ in range(2))
    for name in ("F", "inliers", "covariance"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@settings(max_examples=10, deadline=None)
@given(seeds, st.floats(0.2, 5.0), st.floats(-1e3, 1e3), st.floats(-np.pi, np.pi))
def test_the_default_moves_with_the_pixels(seed, scale, shift, turn):
    """A similarity of both images moves the answer with it: F' = S^-T F S^-1 and sigma by the scale."""
    rng = np.random.default_rng(seed)
    xy1, xy2, _ = spoil(make_pair(150, rng), rng, sigma=0.2, outliers=0.2)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved1, moved2 = scale * xy1 @ R.T + shift, scale * xy2 @ R.T - shift
    fit = LocallyOptimisedRansac().estimate(xy1, xy2, np.random.default_rng(0))
    moved = LocallyOptimisedRansac(threshold_px=scale).estimate(moved1, moved2, np.random.default_rng(0))
    r = np.abs(two_view.sampson_residuals(fit.F, xy1, xy2)[fit.inliers])
    r_moved = np.abs(two_view.sampson_residuals(moved.F, moved1, moved2)[fit.inliers])
    np.testing.assert_allclose(r_moved / scale, r, atol=0.05)
    assert moved.sigma_px / scale == pytest.approx(fit.sigma_px, rel=0.1)


def test_both_images_are_treated_alike():
    rng = np.random.default_rng(3)
    pair = make_pair(200, rng)
    xy1, xy2, _ = spoil(pair, rng, sigma=0.1, outliers=0.2)
    forth, back = estimate_fundamental(xy1, xy2), estimate_fundamental(xy2, xy1)
    assert error_px(back.F.T, pair) == pytest.approx(error_px(forth.F, pair), abs=0.03)
    # The units and the origin of either image do not matter to the normalised eight-point method.
    pair = make_pair(40, np.random.default_rng(3))
    xy1, xy2, _ = spoil(pair, np.random.default_rng(3), sigma=0.5, outliers=0.0)
    F = ransac.estimate_eight_point(xy1, xy2)
    for s, t in ((1e-3, 1.0), (1.0, 1e-3)):
        S, T = np.array([[[s, 0, 5.0], [0, s, 3.0], [0, 0, 1]], [[t, 0, -2.0], [0, t, 7.0], [0, 0, 1]]])
        moved = ransac.estimate_eight_point(s * xy1 + [5.0, 3.0], t * xy2 + [-2.0, 7.0])
        assert angle_between(two_view.unit_norm(T.T @ moved @ S), F) < 1e-9


@pytest.mark.parametrize("estimator", ROBUST)
def test_matches_that_cannot_be_are_refused(estimator):
    rng, good = np.random.default_rng(0), np.random.default_rng(1).uniform(0, 1000, (30, 2))
    line, point = np.linspace(0, 1000, 30)[:, None] * [1.0, 0.7] + 5.0, np.full((30, 2), 7.0)
    for words, xy1, xy2 in (
        ("found 0, needed at least 8", good[:0], good[:0]),
        ("found 7, needed at least 8", good[:7], good[:7]),
        ("collinear in the first image", line, good),
        ("collinear in the second image", good, line),
        ("collinear in the first image", point, good),
    ):
        refuses(StageFailure, words, estimator.estimate, xy1, xy2, rng)


def test_parts_and_settings_that_cannot_be_are_refused():
    for kind, changed in (
        (LocallyOptimisedRansac, {"threshold_px": 0.0}), (LocallyOptimisedRansac, {"confidence": 1.0}),
        (LocallyOptimisedRansac, {"starts": 0}), (LocallyOptimisedRansac, {"starts": 11}),
        (LocallyOptimisedRansac, {"inlier_sigmas": 0.0}), (ransac.ThesisRansac, {"threshold_px": np.nan}),
        (ransac.ThesisRansac, {"samples": 0}), (ransac.ThesisRansac, {"rounds": -1}),
        (ransac.ThesisRansac, {"inlier_test": "both"}),
    ):  # fmt: skip
        refuses(ValueError, next(iter(changed)), kind, **changed)
    assert ransac.ThesisRansac(samples=1, rounds=0).samples == 1
    plane = make_pair(30, np.random.default_rng(0), planar=True)
    xy1, xy2 = plane.xy1, plane.xy2
    for wrong in (np.ones((8, 2)), np.full((7, 2), np.nan)):
        refuses(ValueError, "needs", ransac.estimate_seven_point, wrong, np.ones(wrong.shape))
    refuses(StageFailure, "plane", ransac.estimate_eight_point, xy1, xy2)
    assert ransac.estimate_seven_point(xy1[:7], xy2[:7]).shape == (0, 3, 3)
    assert ransac.estimate_seven_point(np.ones((7, 2)), xy2[:7]).shape == (0, 3, 3)
    for F in (np.zeros((3, 3)), np.full((3, 3), np.nan), np.eye(4)):
        refuses(ValueError, "rank 2", refine_fundamental, F, xy1, xy2)
    refuses(ValueError, "unknown criterion .*mean sampson", refine_fundamental, plane.F, xy1, xy2, "samson")


def test_algorithm_2_minimises_the_chosen_criterion():
    pair = make_pair(60, np.random.default_rng(5))
    # One image smaller: there the two criteria differ. After ten rounds the inliers stay the same.
    xy1, xy2, _ = spoil(pair, np.random.default_rng(5), sigma=0.5, outliers=0.0)
    xy2 = 0.25 * xy2
    algorithm = ransac.ThesisRansac(threshold_px=3.0, epipolar_distance=True, rounds=10)
    fit = algorithm.estimate(xy1, xy2, np.random.default_rng(0))
    kept = fit.inliers
    again = refine_fundamental(fit.F, xy1[kept], xy2[kept], "epipolar-distance")
    other = refine_fundamental(fit.F, xy1[kept], xy2[kept])
    assert angle_between(fit.F, again) < 0.1 * angle_between(other, again)


@holds_for_every()
def test_5_5_and_5_6_the_two_distances_are_multiples_of_one_residual(rng):
    F, xy1, xy2 = rng.normal(size=(3, 3)), rng.normal(size=(20, 2)), rng.normal(size=(20, 2))
    d, symmetric = two_view.epipolar_distances(F, xy1, xy2), two_view.symmetric_residuals(F, xy1, xy2)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), symmetric, rtol=1e-9)
    # 1 / s^2 = 1 / d1^2 + 1 / d2^2: the Sampson distance is the shorter of all three.
    s = np.abs(two_view.sampson_residuals(F, xy1, xy2))
    np.testing.assert_allclose(s * symmetric, d[:, 0] * d[:, 1], rtol=1e-9)


@pytest.mark.parametrize(("test", "share"), list(zip(ransac.INLIER_TESTS, (0.95, 0.95, 0.916), strict=True)))
def test_the_share_of_right_matches_that_pass(test, share):
    rng = np.random.default_rng(1)
    pair = make_pair(4000, rng)
    F = two_view.fundamental_from_cameras(pair.P1, pair.P2)
    xy1, xy2 = (xy + rng.normal(0.0, 0.5, xy.shape) for xy in (pair.xy1, pair.xy2))
    sigma, inliers = ransac.discard_outliers(F, xy1, xy2, test=test)
    assert sigma == pytest.approx(0.5, rel=0.1)
    assert inliers.mean() == pytest.approx(share, abs=0.035)


@holds_for_every()
def test_the_noise_within_a_limit_of_zero_is_that_of_the_eight_nearest_matches(rng):
    F, xy1, xy2 = rng.normal(size=(3, 3)), rng.normal(size=(60, 2)), rng.normal(size=(60, 2))
    nearest = np.sort(np.abs(two_view.sampson_residuals(F, xy1, xy2)))[: ransac.MINIMUM]
    assert ransac.discard_outliers(F, xy1, xy2, limit_px=0.0)[0] == noise_scale(nearest)


@pytest.mark.parametrize("inlier_test", ["epipolar-distance", "symmetric-distance"])
def test_algorithm_2_with_the_tests_of_the_text_finds_the_right_matches(inlier_test):
    rng = np.random.default_rng(2)
    xy1, xy2, _ = spoil(make_pair(150, rng), rng, sigma=0.3, outliers=0.3)
    fit = ransac.ThesisRansac(samples=300, inlier_test=inlier_test).estimate(xy1, xy2, rng)
    usual = ransac.ThesisRansac(samples=300).estimate(xy1, xy2, np.random.default_rng(2))
    assert np.mean(fit.inliers == usual.inliers) > 0.9
    assert fit.sigma_px == pytest.approx(usual.sigma_px, rel=0.2)


def test_heavy_tails_stay_where_asked_for_and_no_noise_is_invented():
    rng = np.random.default_rng(5)
    pair = make_pair(400, rng)
    xy1, xy2, wrong = spoil(pair, rng, sigma=0.3, outliers=0.3)
    tail = ~wrong & (rng.random(400) < 0.15)
    xy1[tail] += rng.normal(0.0, 1.2, (int(tail.sum()), 2))
    everything = LocallyOptimisedRansac().estimate(xy1, xy2, np.random.default_rng(0))
    precise = LocallyOptimisedRansac(inlier_sigmas=2.5).estimate(xy1, xy2, np.random.default_rng(0))
    assert everything.inliers[~wrong].mean() > 0.97
    assert everything.inliers[wrong].mean() < 0.05
    assert precise.inliers[tail].mean() < 0.75
    np.testing.assert_array_equal(precise.F, everything.F)
    r = np.abs(two_view.sampson_residuals(precise.F, xy1, xy2))
    np.testing.assert_array_equal(precise.inliers, r < max(2.5 * precise.sigma_px, 0.3))
    # Of many wrong matches some are near any wide band: they must not widen the noise.
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pair = make_pair(200, rng)
        xy1, xy2, wrong = spoil(pair, rng, sigma=0.3, outliers=0.75)
        fit = estimate_fundamental(xy1, xy2, seed=seed)
        assert fit.sigma_px < 0.5
        assert error_px(fit.F, pair) < 0.5
        assert fit.inliers[~wrong].mean() > 0.9
        assert fit.inliers[wrong].mean() < 0.05


def test_other_minima_are_reported_as_competing_models():
    """Two motions of as many matches each: the one that is not taken is the first competing model."""
    rng = np.random.default_rng(0)
    pairs = make_pair(60, rng), make_pair(60, np.random.default_rng(1))
    xy1, xy2 = (np.vstack([getattr(p, k) for p in pairs]) for k in ("xy1", "xy2"))
    noisy1, noisy2 = (xy + rng.normal(0.0, 0.2, xy.shape) for xy in (xy1, xy2))
    fit = LocallyOptimisedRansac(starts=8).estimate(noisy1, noisy2, np.random.default_rng(0))
    errors = [[error_px(F, pair) for pair in pairs] for F in (fit.F, *fit.competing_models)]
    taken = int(np.argmin(errors[0]))
    assert errors[0][taken] < 0.7
    assert min(error[1 - taken] for error in errors[1:]) < 0.7


def test_searches_that_disagree_are_repeated():
    rng = np.random.default_rng(2)
    xy1, xy2, _ = spoil(make_pair(100, rng), rng, sigma=0.3, outliers=0.2)

    def drawn(estimator, *xy):
        return estimator.estimate(*xy, np.random.default_rng(0))

    one, three, five = (drawn(LocallyOptimisedRansac(starts=k), xy1, xy2).iterations for k in (1, 3, 5))
    assert three >= 3 * one
    assert five >= 5 * one
    hopeless = rng.uniform(0.0, 1000.0, (2, 60, 2))
    fit = drawn(with_constants(LocallyOptimisedRansac, max_starts=8)(), *hopeless)
    assert fit.inliers.mean() < 0.5
    assert 3 * 1024 < fit.iterations <= 2 * LocallyOptimisedRansac.max_samples
    # Searches at a threshold below the noise and with the wider gate.
    assert 6000 < drawn(LocallyOptimisedRansac(0.02, max_samples=6000), xy1, xy2).iterations <= 12000
    assert 500 < estimate_fundamental(*hopeless, max_samples=1000).iterations <= 2000
    assert estimate_fundamental(xy1, xy2, confidence=0.5).iterations <= one * 5


LINEAR = ("eight-point", "gold-standard")


@pytest.mark.parametrize("method", sorted(set(get_args(Method)) - {"seven-point"}))
def test_every_method_gives_f_with_inliers_noise_and_covariance(method):
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
        assert fit.inliers[wrong].sum() <= 0.05 * wrong.sum() + 1
        assert np.linalg.svd(fit.F, compute_uv=False)[2] < 1e-12
        assert np.linalg.norm(fit.F) == pytest.approx(1.0)
        # Seven parameters: F has unit norm and rank two.
        assert np.linalg.norm(fit.covariance @ fit.F.ravel()) < 1e-8 * np.linalg.norm(fit.covariance)
        assert np.linalg.eigvalsh(fit.covariance)[:2].max() < 1e-9 * np.linalg.norm(fit.covariance)


def test_all_matches_count_without_a_threshold_and_seven_give_all_solutions():
    rng = np.random.default_rng(0)
    xy = spoil(make_pair(50, rng), rng, sigma=0.5, outliers=0.0)[:2]
    every = thesisrecon.estimate_fundamental(*xy, method="gold-standard")
    assert np.array_equal(thesisrecon.estimate_fundamental(*xy, threshold_px=None).F, every.F)
    call, pair = thesisrecon.estimate_fundamental, make_pair(7, np.random.default_rng(4))
    fit = call(pair.xy1, pair.xy2, method="seven-point")
    assert min(angle_between(F, pair.F) for F in (fit.F, *fit.competing_models)) < 1e-6
    assert np.isnan(fit.sigma_px)
    flat = make_pair(7, np.random.default_rng(4), planar=True)
    undetermined = StageFailure, "seven matches do not determine"
    refuses(*undetermined, call, flat.xy1, flat.xy2, method="seven-point")
    unknown = "unknown method 'eight'; did you mean"
    refuses(ValueError, unknown, call, pair.xy1, pair.xy2, method="eight")


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


def test_the_covariance_of_a_homography_is_the_inverse_of_its_information():
    rng, H = np.random.default_rng(0), np.array([[0.9, 0.12, 0.4], [-0.1, 0.95, 0.6], [0.1, -0.05, 1.0]])
    xy1 = rng.uniform(1.0, 3.0, (30, 2))
    xy2 = dehomogenize(homogenize(xy1) @ H.T) + 1e-3 * rng.normal(size=(30, 2))
    fit = thesisrecon.estimate_homography(xy1, xy2, threshold_px=None)

    def residuals(h):
        return np.array([two_view.homography_sampson_residuals(x.reshape(3, 3), xy1, xy2).ravel() for x in h])

    h = fit.H.reshape(1, 9)
    assert fit.sigma_px == pytest.approx(np.sqrt(np.sum(residuals(h) ** 2) / (2 * 30 - 8)), rel=1e-6)
    J = central_differences(residuals, h)[0]
    expected = fit.sigma_px**2 * np.linalg.pinv(J.T @ J, rcond=1e-10, hermitian=True)
    np.testing.assert_allclose(fit.covariance, expected, atol=1e-3 * np.abs(expected).max())
    # H has unit norm: no part of its error is along H.
    assert np.abs(fit.covariance @ fit.H.ravel()).max() < 1e-9 * np.abs(expected).max()


def test_matches_that_determine_no_homography_are_named():
    call, rng = thesisrecon.estimate_homography, np.random.default_rng(0)
    xy = rng.uniform(0.0, 500.0, (20, 2))
    line = np.outer(np.arange(20.0), [1.0, 2.0])
    refuses(StageFailure, "do not determine a homography; 3 matches", call, xy[:3], xy[:3])
    refuses(StageFailure, "have three on one line", call, line, line + 5.0)
    refuses(StageFailure, "rank below 8", call, line, line + 5.0, threshold_px=None)
    refuses(StageFailure, "at least 4 different", call, np.ones((9, 2)), np.ones((9, 2)))
    refuses(ValueError, r"needs xy1 \(N, 2\), xy2 \(N, 2\)", call, xy, xy[:5])
    refuses(ValueError, "threshold_px must be positive", call, xy, xy, threshold_px=0.0)
    moved = dehomogenize(homogenize(xy) @ unit_norm(np.diag([2.0, 2.0, 1.0])).T)
    assert thesisrecon.estimate_homography(xy, moved).inliers.all()


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


def of_many(F, covariance):
    return epipoles_of(FundamentalFit(F, np.ones(10**6, dtype=bool), 1.0, covariance))


@pytest.mark.parametrize(
    ("sigma", "n"), [(0.25, 100), (0.5, 30), (0.5, 300), (1.0, 30), (2.0, 30), (2.0, 100), (2.0, 1000)]
)
def test_the_default_comes_near_the_bound_at_its_default_threshold(sigma, n):
    """At 2 px most right matches lie beyond the threshold of 1 px."""
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

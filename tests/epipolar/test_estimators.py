"""Linear solvers, refinements and the robust estimators on scenes with truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.epipolar.pairs import angle_between, make_pair, spoil
from thesisrecon.epipolar.linear import estimate_eight_point, estimate_seven_point
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac, estimate_fundamental
from thesisrecon.epipolar.ransac import LeastMedianOfSquares, ThesisRansac, discard_outliers
from thesisrecon.epipolar.refinement import refine_epipolar_distance, refine_reprojection, refine_sampson
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.two_view import sampson_residuals, symmetric_residuals

seeds = st.integers(0, 2**31)
ROBUST = [
    LocallyOptimisedRansac(),
    ThesisRansac(samples=300),
    ThesisRansac(samples=300, epipolar_distance=True),
    LeastMedianOfSquares(samples=300),
]


def error_px(F, pair):
    """RMS distance of exact matches to their epipolar lines."""
    return float(np.sqrt(np.mean(symmetric_residuals(F, pair.xy1, pair.xy2) ** 2) / 2))


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(8, 50), st.booleans())
def test_eight_point_is_exact_without_noise(seed, n, normalized):
    pair = make_pair(n, np.random.default_rng(seed))
    F = estimate_eight_point(pair.xy1, pair.xy2, normalized=normalized)
    assert np.linalg.norm(F) == pytest.approx(1.0)
    assert error_px(F, pair) < (1e-6 if normalized else 1e-2)


def test_normalisation_and_rank_matter_under_noise():
    errors = {True: [], False: []}
    for seed in range(10):
        rng = np.random.default_rng(seed)
        pair = make_pair(100, rng)
        xy1, xy2, _ = spoil(pair, rng, sigma=0.5, outliers=0.0)
        for normalized in errors:
            errors[normalized].append(error_px(estimate_eight_point(xy1, xy2, normalized=normalized), pair))
        full = estimate_eight_point(xy1, xy2, rank_two=False)
        assert np.linalg.matrix_rank(full, tol=1e-15) == 3
    assert np.median(errors[True]) < 0.3 * np.median(errors[False])


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_seven_point_holds_the_truth_and_every_answer_is_an_answer(seed):
    pair = make_pair(7, np.random.default_rng(seed))
    F = estimate_seven_point(pair.xy1, pair.xy2)
    assert 1 <= len(F) <= 3
    for candidate in F:
        assert np.linalg.norm(candidate) == pytest.approx(1.0)
        assert np.linalg.svd(candidate, compute_uv=False)[2] < 1e-10
        assert symmetric_residuals(candidate, pair.xy1, pair.xy2).max() < 1e-4
    assert min(angle_between(candidate, pair.F) for candidate in F) < 1e-5


def test_seven_point_of_degenerate_matches_is_empty():
    pair = make_pair(7, np.random.default_rng(0), planar=True)
    assert estimate_seven_point(pair.xy1, pair.xy2).shape == (0, 3, 3)
    assert estimate_seven_point(np.ones((7, 2)), pair.xy2).shape == (0, 3, 3)


@pytest.mark.parametrize("refine", [refine_sampson, refine_epipolar_distance, refine_reprojection])
def test_refinement_reaches_the_bound_of_the_noise(refine):
    """Sampson distances of a fit with 7 parameters have mean square sigma^2 (n - 7) / n (HZ 5.1)."""
    n, sigma, ratios = 60, 0.4, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        pair = make_pair(n, rng)
        xy1, xy2, _ = spoil(pair, rng, sigma=sigma, outliers=0.0)
        F = refine(estimate_eight_point(xy1, xy2), xy1, xy2)
        assert np.linalg.svd(F, compute_uv=False)[2] < 1e-12
        ratios.append(np.mean(sampson_residuals(F, xy1, xy2) ** 2) / (sigma**2 * (n - 7) / n))
    assert np.mean(ratios) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (n - 7) / 60))


def test_gradient_criterion_beats_the_linear_estimate():
    linear, refined = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        pair = make_pair(40, rng)
        xy1, xy2, _ = spoil(pair, rng, sigma=0.5, outliers=0.0)
        F = estimate_eight_point(xy1, xy2)
        linear.append(error_px(F, pair))
        refined.append(error_px(refine_sampson(F, xy1, xy2), pair))
    assert np.mean(refined) < np.mean(linear)


@pytest.mark.parametrize("estimator", ROBUST)
def test_exact_matches_give_the_exact_matrix(estimator):
    pair = make_pair(50, np.random.default_rng(1))
    fit = estimator.estimate(pair.xy1, pair.xy2, np.random.default_rng(0))
    assert error_px(fit.F, pair) < 1e-6
    assert fit.sigma_px < 1e-6
    assert np.isfinite(fit.covariance).all()


@pytest.mark.parametrize("estimator", ROBUST)
@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_outliers_are_found_and_the_geometry_is_right(estimator, outliers):
    """The median over scenes for the thesis' search, whose hard trimming sticks in one of twelve."""
    errors, sigmas = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pair = make_pair(300, rng)
        xy1, xy2, wrong = spoil(pair, rng, sigma=0.3, outliers=outliers)
        fit = estimator.estimate(xy1, xy2, rng)
        errors.append(error_px(fit.F, pair))
        sigmas.append(fit.sigma_px)
        assert (fit.inliers & wrong).sum() <= 0.05 * wrong.sum() + 1
        assert fit.inliers[~wrong].mean() > 0.85
        assert np.linalg.svd(fit.F, compute_uv=False)[2] < 1e-12
        assert np.linalg.norm(fit.F) == pytest.approx(1.0)
    summary = np.max if isinstance(estimator, LocallyOptimisedRansac) else np.median
    assert summary(errors) < 0.2
    assert summary(sigmas) == pytest.approx(0.3, rel=0.15)


def test_the_default_works_with_seventy_percent_of_outliers():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        pair = make_pair(600, rng)
        xy1, xy2, wrong = spoil(pair, rng, sigma=0.3, outliers=0.7)
        fit = estimate_fundamental(xy1, xy2, seed=seed)
        assert error_px(fit.F, pair) < 0.5
        assert fit.inliers[~wrong].mean() > 0.9


def test_covariance_predicts_the_spread_of_the_estimates():
    rng = np.random.default_rng(7)
    pair = make_pair(200, rng)
    F, predicted = [], []
    for seed in range(60):
        xy1, xy2, _ = spoil(pair, np.random.default_rng(seed), sigma=0.2, outliers=0.0)
        fit = estimate_fundamental(xy1, xy2)
        f = fit.F.ravel()
        F.append(f * np.sign(f @ pair.F.ravel()))
        predicted.append(fit.covariance)
        assert np.abs(fit.covariance @ f).max() <= 1e-9 * np.abs(fit.covariance).max() + 1e-18
    mean = np.mean(predicted, axis=0)
    deviations = np.stack(F) - pair.F.ravel()
    values, vectors = np.linalg.eigh(mean)
    assert values[:2].max() < 1e-9 * values[-1]
    z = deviations @ vectors[:, 2:] / np.sqrt(values[2:])
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("estimator", ROBUST)
def test_same_generator_same_bytes(estimator):
    rng = np.random.default_rng(4)
    xy1, xy2, _ = spoil(make_pair(120, rng), rng, sigma=0.3, outliers=0.3)
    first, second = (estimator.estimate(xy1, xy2, np.random.default_rng(9)) for _ in range(2))
    assert first.F.tobytes() == second.F.tobytes()
    assert first.inliers.tobytes() == second.inliers.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


@settings(max_examples=10, deadline=None)
@given(seeds, st.floats(0.2, 5.0), st.floats(-1e3, 1e3), st.floats(-np.pi, np.pi))
def test_the_default_moves_with_the_pixels(seed, scale, shift, turn):
    """A similarity of both images moves the answer with it: F' = S^-T F S^-1 and sigma by the scale."""
    rng = np.random.default_rng(seed)
    xy1, xy2, _ = spoil(make_pair(150, rng), rng, sigma=0.2, outliers=0.2)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved1, moved2 = scale * xy1 @ R.T + shift, scale * xy2 @ R.T - shift
    fit = LocallyOptimisedRansac().estimate(xy1, xy2, np.random.default_rng(0))
    variant = LocallyOptimisedRansac(threshold_px=scale, inlier_floor_px=0.3 * scale)
    moved = variant.estimate(moved1, moved2, np.random.default_rng(0))
    r = np.abs(sampson_residuals(fit.F, xy1, xy2)[fit.inliers])
    r_moved = np.abs(sampson_residuals(moved.F, moved1, moved2)[fit.inliers])
    np.testing.assert_allclose(r_moved / scale, r, atol=0.05)
    assert moved.sigma_px / scale == pytest.approx(fit.sigma_px, rel=0.1)


def test_swapping_the_images_transposes_the_matrix():
    rng = np.random.default_rng(3)
    pair = make_pair(200, rng)
    xy1, xy2, _ = spoil(pair, rng, sigma=0.1, outliers=0.2)
    forth, back = estimate_fundamental(xy1, xy2), estimate_fundamental(xy2, xy1)
    assert error_px(back.F.T, pair) == pytest.approx(error_px(forth.F, pair), abs=0.03)


@pytest.mark.parametrize("estimator", ROBUST)
def test_wrong_calls_are_value_errors(estimator):
    rng, good = np.random.default_rng(0), np.random.default_rng(1).uniform(0, 100, (20, 2))
    for xy1, xy2 in ((good, good[:-1]), (good.T, good.T), (np.c_[good, good], np.c_[good, good])):
        with pytest.raises(ValueError, match=r"\(N, 2\)"):
            estimator.estimate(xy1, xy2, rng)
    for bad in (np.nan, np.inf):
        broken = good.copy()
        broken[3, 1] = bad
        with pytest.raises(ValueError, match="finite"):
            estimator.estimate(broken, good, rng)


@pytest.mark.parametrize("estimator", ROBUST)
@pytest.mark.parametrize("n", [0, 1, 7])
def test_too_few_matches_fail_with_a_sentence(estimator, n):
    xy = np.random.default_rng(0).uniform(0, 100, (n, 2))
    with pytest.raises(StageFailure, match=f"found {n}, needed at least 8"):
        estimator.estimate(xy, xy, np.random.default_rng(0))


@pytest.mark.parametrize("estimator", ROBUST)
def test_points_on_one_line_fail_with_a_sentence(estimator):
    rng = np.random.default_rng(0)
    good = rng.uniform(0, 1000, (30, 2))
    line = np.linspace(0, 1000, 30)[:, None] * [1.0, 0.7] + 5.0
    point = np.full((30, 2), 7.0)
    for xy1, xy2, image in ((line, good, "first"), (good, line, "second"), (point, good, "first")):
        with pytest.raises(StageFailure, match=f"one line in the {image} image"):
            estimator.estimate(xy1, xy2, rng)


@pytest.mark.parametrize("estimator", ROBUST)
@pytest.mark.parametrize("kind", ["same", "plane", "random", "few", "two places", "huge", "tiny"])
def test_hard_data_give_finite_numbers_or_a_stage_failure(estimator, kind):
    rng = np.random.default_rng(0)
    xy1 = rng.uniform(0, 1000, (40, 2))
    plane = make_pair(40, rng, planar=True)
    xy1, xy2 = {
        "same": (xy1, xy1.copy()),
        "plane": (plane.xy1, plane.xy2),
        "random": (xy1, rng.uniform(0, 1000, (40, 2))),
        "few": (xy1[:8], rng.uniform(0, 1000, (8, 2))),
        "two places": (np.repeat(xy1[:2], 20, axis=0) + rng.normal(0, 1e-3, (40, 2)), xy1),
        "huge": (1e12 * xy1, 1e12 * xy1 + 1e9 * rng.normal(size=(40, 2))),
        "tiny": (1e-12 * xy1, 1e-12 * rng.uniform(0, 1000, (40, 2))),
    }[kind]
    try:
        fit = estimator.estimate(xy1, xy2, rng)
    except StageFailure:
        return
    assert np.isfinite(fit.F).all()
    assert np.isfinite(fit.covariance).all()
    assert np.isfinite(fit.sigma_px)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: LocallyOptimisedRansac(threshold_px=0.0),
        lambda: LocallyOptimisedRansac(confidence=1.0),
        lambda: LocallyOptimisedRansac(starts=0),
        lambda: LocallyOptimisedRansac(gates=()),
        lambda: ThesisRansac(threshold_px=np.nan),
        lambda: ThesisRansac(samples=0),
        lambda: LeastMedianOfSquares(samples=0),
        lambda: discard_outliers(np.eye(3), np.ones((7, 2)), np.ones((7, 2))),
        lambda: estimate_eight_point(np.ones((7, 2)), np.ones((7, 2))),
        lambda: estimate_seven_point(np.ones((8, 2)), np.ones((8, 2))),
        lambda: estimate_seven_point(np.full((7, 2), np.nan), np.ones((7, 2))),
    ],
)
def test_wrong_parameters_are_value_errors(wrong):
    with pytest.raises(ValueError, match=r"must|needs"):
        wrong()


def test_linear_estimate_of_a_plane_is_refused():
    plane = make_pair(30, np.random.default_rng(0), planar=True)
    with pytest.raises(StageFailure, match="plane"):
        estimate_eight_point(plane.xy1, plane.xy2)


@pytest.mark.parametrize("F", [np.zeros((3, 3)), np.full((3, 3), np.nan), np.eye(4)])
def test_refinement_refuses_a_start_without_rank(F):
    pair = make_pair(10, np.random.default_rng(0))
    with pytest.raises(ValueError, match="rank 2"):
        refine_sampson(F, pair.xy1, pair.xy2)
    with pytest.raises(ValueError, match="loss_px"):
        refine_sampson(pair.F, pair.xy1, pair.xy2, loss_px=0.0)

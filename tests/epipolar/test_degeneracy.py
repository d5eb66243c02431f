"""Degeneracy of F is assessed from the matches off the plane, not from the number of inliers."""

import pickle

import numpy as np
import pytest
import scipy

from tests.conftest import refuses
from tests.epipolar.facade import FacadeMaker
from tests.epipolar.pairs import make_pair, spoil
from thesisrecon.api.pairs import estimate_fundamental
from thesisrecon.epipolar import degeneracy as assessment
from thesisrecon.epipolar import homography
from thesisrecon.epipolar._matches import PairFrame, log10_false_alarms, multiplicity_weights
from thesisrecon.epipolar.degeneracy import _contradicted_ratios, assess_degeneracy
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import unit_norm
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import (
    epipoles,
    homography_linear,
    homography_sampson_residuals,
    sampson_residuals,
    symmetric_residuals,
)
from thesisrecon.records import FundamentalFit

RELIEF = FacadeMaker(matches=500, relief=0.03, off_plane=0.15, wrong=0.2, repeated=0.2, sigma_px=0.3)
WINDOWS = FacadeMaker(matches=500, relief=0.0, off_plane=0.0, wrong=0.4, repeated=0.7, sigma_px=0.3)


def judged(xy1, xy2, seed=0):
    fit = estimate_fundamental(xy1, xy2, seed=seed)
    return fit, fit.degeneracy


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_a_general_scene_is_determined(outliers):
    for seed in range(5):
        pair = make_pair(400, np.random.default_rng(seed))
        xy1, xy2, _ = spoil(pair, np.random.default_rng(seed), sigma=0.5, outliers=outliers)
        _, degeneracy = judged(xy1, xy2)
        assert degeneracy.determined, degeneracy.reasons
        assert degeneracy.reasons == ()
        assert degeneracy.log10_false_alarms < -10
        assert degeneracy.expected_error_px < 0.5


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_a_plane_is_not_determined_however_many_inliers(outliers):
    for seed in range(8):
        pair = make_pair(500, np.random.default_rng(seed), planar=True)
        xy1, xy2, _ = spoil(pair, np.random.default_rng(seed), sigma=0.4, outliers=outliers)
        fit, degeneracy = judged(xy1, xy2)
        assert fit.inliers.sum() > 300
        assert not degeneracy.determined
        assert degeneracy.reasons


def test_relief_determines_a_facade():
    sure = 0
    for seed in range(8):
        facade = RELIEF.make(np.random.default_rng(seed))
        fit, degeneracy = judged(facade.xy1, facade.xy2)
        assert np.sqrt(np.mean(symmetric_residuals(fit.F, facade.exact1, facade.exact2) ** 2) / 2.0) < 1.0
        sure += degeneracy.determined
    assert sure >= 6


def test_matches_between_windows_do_not_determine_a_facade():
    contradicted = 0
    for seed in range(12):
        facade = WINDOWS.make(np.random.default_rng(seed))
        fit, degeneracy = judged(facade.xy1, facade.xy2)
        assert not degeneracy.determined
        # More matches agree than are right: the row of windows has an epipolar geometry of its own.
        assert fit.inliers.sum() > 0.95 * facade.right.sum()
        contradicted += degeneracy.contradicted > 0.5 * degeneracy.off_plane
    assert contradicted >= 9


def test_a_wrong_f_of_the_right_plane_has_the_right_one_as_competing_model():
    """All matches of a plane and few others; a wrong F fits some of these."""
    rng = np.random.default_rng(3)
    flat = make_pair(300, np.random.default_rng(8), planar=True)
    X = np.c_[rng.uniform(-1.0, 1.0, (30, 2)), rng.uniform(4.0, 4.6, 30)]
    Xh = np.c_[X, np.ones(30)]
    away1, away2 = (Xh @ P.T for P in (flat.P1, flat.P2))
    xy1 = np.r_[flat.xy1, away1[:, :2] / away1[:, 2:]] + rng.normal(0.0, 0.3, (330, 2))
    xy2 = np.r_[flat.xy2, away2[:, :2] / away2[:, 2:]] + rng.normal(0.0, 0.3, (330, 2))
    H = homography_linear(flat.xy1, flat.xy2)
    _, e2 = epipoles(flat.F)
    wrong_pole = e2 + np.array([0.0, 0.4, 0.0]) * np.linalg.norm(e2)
    cross = np.cross(np.eye(3), wrong_pole) * -1.0
    F = unit_norm(cross @ H)
    inliers = np.abs(sampson_residuals(F, xy1, xy2)) < 0.75
    assert inliers[:300].mean() > 0.95
    fit = FundamentalFit(F, inliers, 0.3, 1e-12 * np.eye(9))
    degeneracy = assess_degeneracy(fit, xy1, xy2, rng=np.random.default_rng(0))
    assert not degeneracy.determined
    assert degeneracy.competing_model is not None
    assert degeneracy.competing_margin < 0.0
    assert np.mean(np.abs(sampson_residuals(degeneracy.competing_model, xy1, xy2)) < 0.9) > 0.97
    assert any("another F" in reason for reason in degeneracy.reasons)


def test_a_model_far_from_the_estimate_must_also_explain_much_more():
    for error, gained, differs in [(2.0, 100.0, True), (0.5, 100.0, False), (2.0, 0.0, False)]:
        other = assessment._CompetingModel(np.ones(9), lost=20.0, gained=gained, error=error, apart=0.1)
        assert other.differs(1.0) == differs


def test_a_wide_covariance_is_a_reason():
    pair = make_pair(300, np.random.default_rng(0))
    xy1, xy2, _ = spoil(pair, np.random.default_rng(0), sigma=0.3, outliers=0.0)
    fit = estimate_fundamental(xy1, xy2)
    vague = FundamentalFit(fit.F, fit.inliers, fit.sigma_px, fit.covariance * 1e4)
    degeneracy = assess_degeneracy(vague, xy1, xy2, rng=np.random.default_rng(0))
    assert not degeneracy.determined
    assert degeneracy.expected_error_px > 1.0
    assert "covariance" in degeneracy.reasons[0]


def test_an_estimate_is_tested_when_this_is_read():
    pair = make_pair(200, np.random.default_rng(1))
    xy1, xy2, _ = spoil(pair, np.random.default_rng(1), sigma=0.3, outliers=0.2)
    fit = estimate_fundamental(xy1, xy2)
    expected = assess_degeneracy(fit, xy1, xy2, rng=np.random.default_rng(0))
    sent = pickle.loads(pickle.dumps(fit))
    xy1[:], xy2[:] = xy2.copy(), 0.0
    assert "degeneracy" not in vars(fit)
    for one in (fit, sent, pickle.loads(pickle.dumps(fit))):
        assert (one.determined, one.reasons) == (True, ())
        assert repr(one.degeneracy) == repr(expected)
        np.testing.assert_array_equal(one.F, fit.F)


@pytest.mark.parametrize("outliers", [0, 60])
def test_a_pure_rotation_does_not_determine_f(outliers):
    K = np.array([[800.0, 0.0, 500.0], [0.0, 800.0, 400.0], [0.0, 0.0, 1.0]])
    R = scipy.spatial.transform.Rotation.from_rotvec([0.05, 0.2, 0.03]).as_matrix()
    for seed in range(4):
        rng = np.random.default_rng(seed)
        xy1 = rng.uniform(0.0, (1000.0, 800.0), (300, 2))
        x2 = np.c_[xy1, np.ones(300)] @ (K @ R @ np.linalg.inv(K)).T
        xy2 = x2[:, :2] / x2[:, 2:] + rng.normal(0.0, 0.4, (300, 2))
        xy2[:outliers] = rng.uniform(0.0, (1000.0, 800.0), (outliers, 2))
        fit = estimate_fundamental(xy1, xy2)
        assert fit.inliers.sum() > 220
        assert not fit.determined
        assert any("dominant plane" in reason or "covariance" in reason for reason in fit.reasons)


def test_few_matches_do_not_determine_f():
    pair = make_pair(8, np.random.default_rng(1))
    xy1, xy2, _ = spoil(pair, np.random.default_rng(1), sigma=0.5, outliers=0.0)
    for fit, words in (
        (estimate_fundamental(xy1, xy2), "matches off the dominant plane"),
        (estimate_fundamental(xy1[:7], xy2[:7], method="seven-point"), "7 matches are too few"),
    ):
        assert not fit.determined
        assert words in fit.reasons[0]


def test_the_same_generator_gives_the_same_report():
    rng = np.random.default_rng(5)
    facade = FacadeMaker().make(rng)
    first, second = (judged(facade.xy1, facade.xy2, seed=4)[1] for _ in range(2))
    assert first.reasons == second.reasons
    assert first.competing_margin == second.competing_margin


def test_wrong_and_hopeless_calls():
    pair = make_pair(40, np.random.default_rng(0))
    fit = FundamentalFit(pair.F, np.ones(39, bool), 0.3, np.eye(9))
    rng = np.random.default_rng(0)
    refuses(ValueError, "39", assess_degeneracy, fit, pair.xy1, pair.xy2, rng=rng)
    refuses(StageFailure, "needed at least 8", assess_degeneracy, fit, pair.xy1[:7], pair.xy2[:7], rng=rng)
    without_inliers = FundamentalFit(pair.F, np.zeros(40, bool), 0.3, np.eye(9))
    assert not assess_degeneracy(without_inliers, pair.xy1, pair.xy2, rng=rng).determined


def test_the_equations_of_a_plane_are_whitened_and_weighted():
    rng = np.random.default_rng(5)
    H = np.array([[1.1, 0.2, -0.1], [-0.15, 0.9, 0.3], [0.2, -0.3, 1.0]])
    xy1 = rng.uniform(-1.0, 1.0, (30, 2))
    xy2 = dehomogenize(homogenize(xy1) @ H.T) + rng.normal(0.0, 0.05, (30, 2))
    expected, distances = np.zeros((9, 9)), []
    for one, two in zip(homogenize(xy1), xy2, strict=True):
        A = np.vstack([np.kron([1.0, 0.0, -two[0]], one), np.kron([0.0, 1.0, -two[1]], one)])
        J = np.hstack([(H[:2] - np.outer(two, H[2]))[:, :2], -(one @ H[2]) * np.eye(2)])
        inverse = np.linalg.inv(J @ J.T)
        distances.append((A @ H.ravel()) @ inverse @ (A @ H.ravel()))
        expected += max(1.0 - distances[-1] / 0.05**2, 0.0) ** 2 * A.T @ inverse @ A
    points = np.hstack([xy1, xy2])
    np.testing.assert_allclose(homography.squared_plane_distances(H, points), distances, rtol=1e-9)
    np.testing.assert_allclose(
        distances, np.sum(homography_sampson_residuals(H, xy1, xy2) ** 2, axis=1), rtol=1e-9
    )
    assert 1 < np.sum(np.array(distances) < 0.05**2) < 29
    G = homography._normal_matrix(H, points, 0.05)
    np.testing.assert_allclose(G, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_fundamentals_of_a_plane_keep_the_plane_and_the_two_matches():
    rng = np.random.default_rng(4)
    flat = make_pair(40, rng, planar=True)
    frame = PairFrame.of(flat.xy1, flat.xy2)
    points = frame.points(flat.xy1, flat.xy2)
    H = homography_linear(points[:, :2], points[:, 2:])
    away = points[:6].copy()
    away[:, 2:] += rng.uniform(0.2, 0.5, (6, 2))
    pairs = np.array([[0, 1], [2, 5]])
    F, agree, sums = homography.fundamentals_of_plane(H, away, np.ones((1, 6)), pairs, 1e-6)
    for f, (a, b) in zip(F, ((0, 1), (2, 5)), strict=True):
        r = np.abs(sampson_residuals(f.reshape(3, 3), points[:, :2], points[:, 2:]))
        assert r.max() < 1e-9
        r = np.abs(sampson_residuals(f.reshape(3, 3), away[:, :2], away[:, 2:]))
        assert r[[a, b]].max() < 1e-9
    np.testing.assert_array_equal(agree.sum(axis=1), sums[:, 0])
    assert (sums[:, 0] >= 2).all()


def test_the_dominant_plane_is_found_among_others():
    rng = np.random.default_rng(6)
    flat = make_pair(120, np.random.default_rng(9), planar=True)
    X = np.c_[rng.uniform(-1.0, 1.0, (80, 2)), rng.uniform(4.0, 6.0, 80), np.ones(80)]
    far1, far2 = (X @ P.T for P in (flat.P1, flat.P2))
    xy1 = np.r_[flat.xy1, far1[:, :2] / far1[:, 2:]] + rng.normal(0.0, 0.3, (200, 2))
    xy2 = np.r_[flat.xy2, far2[:, :2] / far2[:, 2:]] + rng.normal(0.0, 0.3, (200, 2))
    frame = PairFrame.of(xy1, xy2)
    plane = homography.find_dominant_plane(
        frame.matrix_in_frame(flat.F),
        frame.points(xy1, xy2),
        np.ones(200, bool),
        sigma=0.3 * frame.scale,
        rng=np.random.default_rng(0),
    )
    assert plane is not None
    off = plane[1] > homography.OFF_PLANE
    assert not off[:120].any()
    assert off[120:].mean() > 0.9


def test_the_covariance_of_a_homography_is_that_of_trials():
    rng = np.random.default_rng(7)
    pair = make_pair(60, rng, planar=True)
    frame = PairFrame.of(pair.xy1, pair.xy2)
    exact, found = frame.points(pair.xy1, pair.xy2), []
    truth = homography_linear(exact[:, :2], exact[:, 2:])
    for _ in range(300):
        H = homography.refine_plane(truth, exact + rng.normal(0.0, 1e-3, exact.shape), 1e3, 5)
        found.append(H.ravel() * np.sign(np.sum(H * truth)))
    predicted = np.trace(homography.plane_covariance(truth, exact, 1e-3))
    assert np.trace(np.cov(np.array(found).T)) == pytest.approx(predicted, rel=0.15)


def test_chance_and_surprise():
    assert log10_false_alarms(2.0, 50.0, chance=0.05, free=2) == 0.0
    assert log10_false_alarms(7.0, 100.0, chance=0.05, free=2) > 0.0
    assert log10_false_alarms(30.0, 100.0, chance=0.02, free=2) < -15.0
    # More tried matches make the same number less of a surprise.
    few, many = (log10_false_alarms(12.0, n, chance=0.02, free=2) for n in (30.0, 300.0))
    assert few < many


def test_matches_that_share_a_place_count_once():
    xy1 = np.array([[10.0, 10.0], [50.0, 80.0], [90.0, 20.0], [200.0, 200.0]])
    xy2 = np.array([[30.0, 30.0], [30.2, 30.1], [30.4, 30.3], [90.0, 90.0]])
    np.testing.assert_allclose(multiplicity_weights(xy1, xy2), [1 / 3, 1 / 3, 1 / 3, 1.0])


def test_one_that_would_change_places_with_the_wall_is_contradicted():
    x, y = np.meshgrid(np.arange(10.0), np.arange(10.0))
    points = np.column_stack([x.ravel(), y.ravel(), x.ravel(), y.ravel()])
    lone, patch = 44, (77, 78, 79, 87, 88, 89, 97, 98, 99)
    points[lone, 2] += 3.0
    points[list(patch), 2] += 3.0
    on_plane = np.ones(100, bool)
    on_plane[[lone, *patch]] = False
    shares = _contradicted_ratios(np.eye(3), points, on_plane, np.array([lone, 88]), 0.1)
    assert shares[0] == 1.0
    assert shares[1] == 0.0

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
from thesisrecon.epipolar.degeneracy import NEIGHBOURS, _contradicted_ratios, assess_degeneracy
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import unit_norm
from thesisrecon.geometry.two_view import (
    epipoles,
    homography_linear,
    homography_residuals,
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


# ---------------------------------------------------------------- the pieces


def test_plane_distances_match_their_numpy_twin():
    pair = make_pair(50, np.random.default_rng(2), planar=True)
    xy1, xy2, _ = spoil(pair, np.random.default_rng(2), sigma=2.0, outliers=0.1)
    H = homography_linear(pair.xy1, pair.xy2)
    expected = np.sum(homography_sampson_residuals(H, xy1, xy2) ** 2, axis=1)
    np.testing.assert_allclose(
        homography._plane_distances(H.ravel(), np.hstack([xy1, xy2])), expected, rtol=1e-6
    )


def test_normal_equations_of_a_plane_match_their_numpy_twin():
    rng = np.random.default_rng(5)
    h = np.array([1.1, 0.2, -0.1, -0.15, 0.9, 0.3, 0.2, -0.3, 1.0])
    xy1 = rng.uniform(-1.0, 1.0, (30, 2))
    p = np.column_stack([xy1, np.ones(30)])
    images = p @ h.reshape(3, 3).T
    xy2 = images[:, :2] / images[:, 2:] + rng.normal(0.0, 0.05, (30, 2))
    expected, total = np.zeros((9, 9)), 0.0
    for one, two in zip(p, xy2, strict=True):
        A = np.vstack([np.kron([1.0, 0.0, -two[0]], one), np.kron([0.0, 1.0, -two[1]], one)])
        w = one @ h[6:]
        J = np.hstack([(h[:6].reshape(2, 3) - np.outer(two, h[6:]))[:, :2], -w * np.eye(2)])
        inverse = np.linalg.inv(J @ J.T)
        share = min((A @ h) @ inverse @ (A @ h) / 0.05**2, 1.0)
        total += share
        expected += (1.0 - share) ** 2 * A.T @ inverse @ A
    G = np.empty((9, 9))
    assert homography._plane_normal_equations(h, np.hstack([xy1, xy2]), 0.05, G) == pytest.approx(
        total, rel=1e-9
    )
    assert 1.0 < total < 29.0
    np.testing.assert_allclose(G, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_contradicted_ratios_match_their_numpy_twin():
    rng = np.random.default_rng(8)
    h = np.array([1.1, 0.2, -0.1, -0.15, 0.9, 0.3, 0.2, -0.3, 1.0])
    points = np.hstack([rng.uniform(-1.0, 1.0, (60, 2)), np.zeros((60, 2))])
    images = np.column_stack([points[:, :2], np.ones(60)]) @ h.reshape(3, 3).T
    points[:, 2:] = images[:, :2] / images[:, 2:] + rng.normal(0.0, 0.15, (60, 2))
    parallax = points[:, 2:] - images[:, :2] / images[:, 2:]
    on_plane, chosen = rng.random(60) < 0.7, np.arange(0, 60, 3)
    expected = []
    for k in chosen:
        apart = np.linalg.norm(points[:, :2] - points[k, :2], axis=1)
        near = np.argsort(np.where(apart < 0.05, np.inf, apart))[:NEIGHBOURS]
        over = np.linalg.norm(parallax[near] - parallax[k], axis=1) > apart[near]
        expected.append(np.mean(on_plane[near] & over))
    assert 0.1 < np.mean(expected) < 0.9
    np.testing.assert_allclose(_contradicted_ratios(h, points, on_plane, chosen, 0.05), expected)


def test_transfers_are_counted_as_by_numpy():
    pair = make_pair(60, np.random.default_rng(3))
    H = np.stack([homography_linear(pair.xy1[k : k + 12], pair.xy2[k : k + 12]) for k in (0, 12, 24)])
    expected = [int(np.sum(homography_residuals(h, pair.xy1, pair.xy2) < 30.0)) for h in H]
    np.testing.assert_array_equal(homography.count_transferred(H, pair.xy1, pair.xy2, 30.0), expected)


def test_fundamentals_of_a_plane_keep_the_plane_and_the_two_matches():
    rng = np.random.default_rng(4)
    flat = make_pair(40, rng, planar=True)
    frame = PairFrame.of(flat.xy1, flat.xy2)
    points = frame.points(flat.xy1, flat.xy2)
    h = homography_linear(points[:, :2], points[:, 2:]).ravel()
    away = points[:6].copy()
    away[:, 2:] += rng.uniform(0.2, 0.5, (6, 2))
    F, agree, sums = homography.fundamentals_of_plane(
        h, away, np.ones((1, 6)), np.array([[0, 1], [2, 5]]), 1e-6
    )
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
    truth = homography_linear(exact[:, :2], exact[:, 2:]).ravel()
    for _ in range(300):
        h = truth.copy()
        homography.refine_plane(h, exact + rng.normal(0.0, 1e-3, exact.shape), 1e3, 5)
        found.append(h * np.sign(h @ truth))
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
    shares = _contradicted_ratios(np.eye(3).ravel(), points, on_plane, np.array([lone, 88]), 0.1)
    assert shares[0] == 1.0
    assert shares[1] == 0.0

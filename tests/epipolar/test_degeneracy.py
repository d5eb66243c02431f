"""Degeneracy of F is assessed from the matches off the plane, not from the number of inliers.

Facades are one plane with rows of windows, a little relief, and matches shifted by whole windows.

The matches of the plane leave the epipoles free, those of the relief fix them, and those from one window to
its neighbour agree with an epipolar geometry of their own: parallax along the row, which the plane does not
contradict. With little relief it has more matches than the right one.
"""

import pickle
from collections import namedtuple
from dataclasses import replace

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.epipolar.pairs import SIZE, K, make_pair, spoil, with_points
from thesisrecon.api.pairs import estimate_fundamental
from thesisrecon.camera import compose_camera
from thesisrecon.epipolar import degeneracy as assessment
from thesisrecon.epipolar import homography
from thesisrecon.epipolar._matches import PairFrame, multiplicity_weights
from thesisrecon.epipolar.degeneracy import _contradicted_fraction, assess_degeneracy
from thesisrecon.errors import StageFailure
from thesisrecon.geometry import two_view
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import cross_matrix, dehomogenize, homogenize, unit_norm
from thesisrecon.optimize.ransac import log10_false_alarms
from thesisrecon.records import FundamentalFit

DISTANCE = 10.0
RELIEF_LEVELS = (0.0, 0.0, 0.0, 0.5, 1.0)
"""Wall, frames and panes: set back by so much of the relief, the wall three times as often."""

Facade = namedtuple("Facade", "xy1 xy2 right exact1 exact2")
"""Matches (N, 2) with noise, which are right, and the exact points of the right ones."""


def make_facade(rng, *, relief, off_plane, wrong, repeated, n=500):
    """A facade before two cameras that moved by a tenth to a third of the distance; noise of 0.3 px.

    Panes are ``relief`` distances behind the wall, a share ``off_plane`` of the right matches before or after
    it. Of the share ``wrong``, ``repeated`` lead to another window, the rest anywhere.
    """
    P1, P2, turned = _cameras(rng)
    period = rng.uniform(0.6, 1.6, 2)
    X = _points(relief, off_plane, period, n, rng) @ turned.T + [0.0, 0.0, DISTANCE]
    is_wrong = rng.random(n) < wrong
    shifted = is_wrong & (rng.random(n) < repeated)
    shift = np.zeros((n, 3))
    shift[shifted, :2] = _whole_periods(int(shifted.sum()), rng) * period
    exact = project(P1, X), project(P2, X)
    seen2, anywhere = project(P2, X + shift @ turned.T), is_wrong & ~shifted
    seen2[anywhere] = rng.uniform((0.0, 0.0), SIZE, (int(anywhere.sum()), 2))
    xy = np.stack([exact[0], seen2]) + rng.normal(0.0, 0.3, (2, n, 2))
    inside = np.all((xy > -0.5) & (xy < np.array(SIZE) - 0.5), axis=(0, 2))
    right = inside & ~is_wrong
    return Facade(*xy[:, inside], ~is_wrong[inside], exact[0][right], exact[1][right])


def _points(relief, off_plane, period, n, rng):
    """Return window corners, in a few positions each, and points off the wall."""
    kinds = rng.random((12, 2))
    depth = relief * DISTANCE * rng.choice(RELIEF_LEVELS, 12)
    kind, cell = rng.integers(0, 12, n), rng.integers(-5, 6, (n, 2))
    X = np.column_stack([(cell + kinds[kind]) * period, depth[kind]])
    free = rng.random(n) < off_plane
    X[free] = _things(int(free.sum()), rng)
    return X


def _things(n, rng):
    """n points on one to four boards before or behind the wall: cars, trees, balconies, a side street."""
    boards = int(rng.integers(1, 5))
    centre = rng.uniform((-4.0, -3.0, -0.2 * DISTANCE), (4.0, 3.0, 0.1 * DISTANCE), (boards, 3))
    size, tilt = rng.uniform(0.3, 1.2, (boards, 2)), rng.uniform(-0.3, 0.3, (boards, 2))
    board = rng.integers(0, boards, n)
    on_board = rng.uniform(-1.0, 1.0, (n, 2)) * size[board]
    return centre[board] + np.column_stack([on_board, np.sum(on_board * tilt[board], axis=1)])


def _cameras(rng):
    """Two cameras (3, 4) and the rotation (3, 3) of the facade, whose normal is its third column."""
    direction = rng.normal(size=3) * [1.0, 0.4, 0.4]
    centre = direction / np.linalg.norm(direction) * rng.uniform(0.1, 0.33) * DISTANCE
    # The second camera turns back toward the facade.
    back = np.array([centre[1], -centre[0], 0.0]) / DISTANCE
    R = Rotation.from_rotvec(back + rng.normal(0.0, 0.03, 3)).as_matrix()
    turned = Rotation.from_rotvec(rng.normal(0.0, [0.15, 0.3, 0.05])).as_matrix()
    return compose_camera(K, np.eye(3), np.zeros(3)), compose_camera(K, R, -R @ centre), turned


def _whole_periods(n, rng):
    """Steps (n, 2) to another window: mostly to the next of the row, seldom of another floor; never 0."""
    along, steps = rng.random(n) < 0.8, rng.choice([-2.0, -1.0, -1.0, 1.0, 1.0, 2.0], n)
    return np.column_stack([np.where(along, steps, 0.0), np.where(along, 0.0, steps)])


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_a_general_scene_is_determined(outliers):
    for seed in range(5):
        pair = make_pair(400, np.random.default_rng(seed))
        xy1, xy2, _ = spoil(pair, np.random.default_rng(seed), sigma=0.5, outliers=outliers)
        degeneracy = estimate_fundamental(xy1, xy2).degeneracy
        assert (degeneracy.determined, degeneracy.reasons) == (True, ())
        assert degeneracy.log10_false_alarms < -10
        assert degeneracy.expected_error_px < 0.5


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_a_plane_is_not_determined_however_many_inliers(outliers):
    for seed in range(8):
        pair = make_pair(500, np.random.default_rng(seed), planar=True)
        xy1, xy2, _ = spoil(pair, np.random.default_rng(seed), sigma=0.4, outliers=outliers)
        fit = estimate_fundamental(xy1, xy2)
        assert fit.inliers.sum() > 300
        assert not fit.determined
        assert fit.reasons


def test_relief_determines_a_facade():
    sure = 0
    for seed in range(8):
        scene = make_facade(np.random.default_rng(seed), relief=0.03, off_plane=0.15, wrong=0.2, repeated=0.2)
        fit = estimate_fundamental(scene.xy1, scene.xy2)
        assert (
            np.sqrt(np.mean(two_view.symmetric_residuals(fit.F, scene.exact1, scene.exact2) ** 2) / 2.0) < 1.0
        )
        sure += fit.determined
    assert sure >= 6


def test_matches_between_windows_do_not_determine_a_facade():
    contradicted = 0
    for seed in range(12):
        scene = make_facade(np.random.default_rng(seed), relief=0.0, off_plane=0.0, wrong=0.4, repeated=0.7)
        fit = estimate_fundamental(scene.xy1, scene.xy2)
        assert not fit.determined
        # More matches agree than are right: the row of windows has an epipolar geometry of its own.
        assert fit.inliers.sum() > 0.95 * scene.right.sum()
        contradicted += fit.degeneracy.contradicted > 0.5 * fit.degeneracy.off_plane
    assert contradicted >= 9


def test_a_wrong_f_of_the_right_plane_competes_with_the_right_one_and_a_far_one_must_explain_more():
    """All matches of a plane and few others; a wrong F fits some of these."""
    rng = np.random.default_rng(3)
    flat = make_pair(300, np.random.default_rng(8), planar=True)
    X = np.c_[rng.uniform(-1.0, 1.0, (30, 2)), rng.uniform(4.0, 4.6, 30)]
    xy1, xy2 = with_points(flat, X, sigma=0.3, rng=rng)
    e2 = two_view.epipoles(flat.F)[1]
    wrong_pole = e2 + np.array([0.0, 0.4, 0.0]) * np.linalg.norm(e2)
    F = unit_norm(cross_matrix(wrong_pole) @ two_view.homography_linear(flat.xy1, flat.xy2))
    inliers = np.abs(two_view.sampson_residuals(F, xy1, xy2)) < 0.75
    assert inliers[:300].mean() > 0.95
    fit = FundamentalFit(F, inliers, 0.3, 1e-12 * np.eye(9))
    degeneracy = assess_degeneracy(fit, xy1, xy2, rng=np.random.default_rng(0))
    assert not degeneracy.determined
    assert degeneracy.competing_margin < 0.0
    assert np.mean(np.abs(two_view.sampson_residuals(degeneracy.competing_model, xy1, xy2)) < 0.9) > 0.97
    assert any("another F" in reason for reason in degeneracy.reasons)
    for error, gained, differs in [(2.0, 100.0, True), (0.5, 100.0, False), (2.0, 0.0, False)]:
        other = assessment._CompetingModel(np.ones(9), lost=20.0, gained=gained, error=error, apart=0.1)
        assert other.differs(1.0) == differs


def test_a_wide_covariance_and_few_matches_are_reasons():
    pair = make_pair(300, np.random.default_rng(0))
    xy1, xy2, _ = spoil(pair, np.random.default_rng(0), sigma=0.3, outliers=0.0)
    fit = estimate_fundamental(xy1, xy2)
    vague = FundamentalFit(fit.F, fit.inliers, fit.sigma_px, fit.covariance * 1e4)
    degeneracy = assess_degeneracy(vague, xy1, xy2, rng=np.random.default_rng(0))
    assert not degeneracy.determined
    assert degeneracy.expected_error_px > 1.0
    assert "covariance" in degeneracy.reasons[0]
    # The noise of 20 matches is known by 13 degrees of freedom: Student's quantile decides.
    few = replace(fit, inliers=fit.inliers & (np.arange(300) < 20))
    stated = assess_degeneracy(few, xy1, xy2, rng=np.random.default_rng(0)).expected_error_px
    limit = scipy.stats.norm.ppf(0.975) / scipy.stats.t.ppf(0.975, few.inliers.sum() - 7)
    for error in (0.999, 1.001):
        vague = replace(few, covariance=few.covariance * (error * limit / stated) ** 2)
        reasons = assess_degeneracy(vague, xy1, xy2, rng=np.random.default_rng(0)).reasons
        assert any("errors of 1 px" in reason for reason in reasons) == (error > 1.0)
    pair = make_pair(8, np.random.default_rng(1))
    xy1, xy2, _ = spoil(pair, np.random.default_rng(1), sigma=0.5, outliers=0.0)
    for fit, words in (
        (estimate_fundamental(xy1, xy2), "matches off the dominant plane"),
        (estimate_fundamental(xy1[:7], xy2[:7], method="seven-point"), "7 matches are too few"),
    ):
        assert not fit.determined
        assert words in fit.reasons[0]


def test_an_estimate_is_tested_when_this_is_read():
    pair = make_pair(200, np.random.default_rng(1))
    xy1, xy2, _ = spoil(pair, np.random.default_rng(1), sigma=0.3, outliers=0.2)
    fit = estimate_fundamental(xy1, xy2)
    of_noise = replace(fit, covariance=fit.noise_covariance)
    expected = assess_degeneracy(of_noise, xy1, xy2, rng=np.random.default_rng(0))
    sent = pickle.loads(pickle.dumps(fit))
    xy1[:], xy2[:] = xy2.copy(), 0.0
    assert "degeneracy" not in vars(fit)
    for one in (fit, sent, pickle.loads(pickle.dumps(fit))):
        assert (one.determined, one.reasons) == (True, ())
        assert one.degeneracy == expected
        np.testing.assert_array_equal(one.F, fit.F)


@pytest.mark.parametrize("outliers", [0, 60])
def test_a_pure_rotation_does_not_determine_f(outliers):
    H = K @ scipy.spatial.transform.Rotation.from_rotvec([0.05, 0.2, 0.03]).as_matrix() @ np.linalg.inv(K)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        xy1 = rng.uniform(0.0, SIZE, (300, 2))
        xy2 = dehomogenize(homogenize(xy1) @ H.T) + rng.normal(0.0, 0.4, (300, 2))
        xy2[:outliers] = rng.uniform(0.0, SIZE, (outliers, 2))
        fit = estimate_fundamental(xy1, xy2)
        assert fit.inliers.sum() > 220
        assert not fit.determined
        assert any("dominant plane" in reason or "covariance" in reason for reason in fit.reasons)


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
        distances, np.sum(two_view.homography_sampson_residuals(H, xy1, xy2) ** 2, axis=1), rtol=1e-9
    )
    assert 1 < np.sum(np.array(distances) < 0.05**2) < 29
    G = homography._normal_matrix(H, points, 0.05)
    np.testing.assert_allclose(G, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_fundamentals_of_a_plane_keep_the_plane_and_the_two_matches():
    rng = np.random.default_rng(4)
    flat = make_pair(40, rng, planar=True)
    points = PairFrame.of(flat.xy1, flat.xy2).points(flat.xy1, flat.xy2)
    H = two_view.homography_linear(points[:, :2], points[:, 2:])
    away = points[:6].copy()
    away[:, 2:] += rng.uniform(0.2, 0.5, (6, 2))
    pairs = np.array([[0, 1], [2, 5]])
    F, agree, sums = homography.fundamentals_of_plane(H, away, np.ones((1, 6)), pairs, 1e-6)
    for f, pair in zip(F, pairs, strict=True):
        for kept in (points, away[pair]):
            assert np.abs(two_view.sampson_residuals(f.reshape(3, 3), kept[:, :2], kept[:, 2:])).max() < 1e-9
    np.testing.assert_array_equal(agree.sum(axis=1), sums[:, 0])
    assert (sums[:, 0] >= 2).all()
    # One match twice determines no epipole.
    assert not homography.fundamentals_of_plane(H, away, np.ones((1, 6)), np.array([[3, 3]]), 0.1)[1].any()


def test_votes_of_matches_off_the_plane():
    assert log10_false_alarms(2.0, 50.0, chance=0.05, free=2) == 0.0
    assert log10_false_alarms(7.0, 100.0, chance=0.05, free=2) > 0.0
    assert log10_false_alarms(30.0, 100.0, chance=0.02, free=2) < -15.0
    # More tried matches make the same number less of a surprise.
    few, many = (log10_false_alarms(12.0, n, chance=0.02, free=2) for n in (30.0, 300.0))
    assert few < many
    xy1 = np.array([[10.0, 10.0], [50.0, 80.0], [90.0, 20.0], [200.0, 200.0]])
    xy2 = np.array([[30.0, 30.0], [30.2, 30.1], [30.4, 30.3], [90.0, 90.0]])
    np.testing.assert_allclose(multiplicity_weights(xy1, xy2), [1 / 3, 1 / 3, 1 / 3, 1.0])
    x, y = np.meshgrid(np.arange(10.0), np.arange(10.0))
    points = np.column_stack([x.ravel(), y.ravel(), x.ravel(), y.ravel()])
    lone, patch = 44, (77, 78, 79, 87, 88, 89, 97, 98, 99)
    points[lone, 2] += 3.0
    points[list(patch), 2] += 3.0
    off = np.isin(np.arange(100), [lone, *patch])
    # Of the patch, its middle alone counts.
    weights = np.zeros(100)
    weights[[lone, 88]] = 3.0, 1.0
    assert _contradicted_fraction(points, weights, np.eye(3), off, 0.1) == 0.75

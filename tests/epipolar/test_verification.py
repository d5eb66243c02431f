"""Verification of pairs: planes, rotations and translations are named at every noise."""

import re

import numpy as np
import pytest

from tests.conftest import real_data, refuses
from tests.epipolar.pairs import SIZE, make_pair, spoil, with_points
from thesisrecon.api.pairs import estimate_fundamental
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.ransac import ThesisRansac, estimate_eight_point
from thesisrecon.epipolar.verification import (
    Configuration,
    PairVerification,
    _refine_translation,
    _rotation_homography,
    _rotation_test,
    classify_configuration,
    homography_inlier_ratio,
)
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import cross_matrix, dehomogenize, homogenize
from thesisrecon.geometry.two_view import (
    fundamental_from_cameras,
    homography_residuals,
    homography_sampson_residuals,
    sampson_residuals,
)
from thesisrecon.optimize.least_squares import minimize_residuals
from thesisrecon.records import FundamentalFit, Matches
from validation.scenes.two_views import make_two_views


def as_matches(xy1, xy2):
    n = len(xy1)
    affine = np.tile(np.eye(2), (n, 1, 1))
    return Matches(2, 5, np.arange(n), np.arange(n)[::-1].copy(), xy1, xy2, np.ones(n, np.float32), affine)


def verified(pair, *, outliers):
    xy1, xy2, _ = spoil(pair, np.random.default_rng(0), sigma=0.3, outliers=outliers)
    fit = estimate_fundamental(xy1, xy2)
    return PairVerification().verify(as_matches(xy1, xy2), fit, np.random.default_rng(0)), fit


def test_a_good_pair_and_a_plane_are_accepted_and_the_plane_is_reported_at_much_noise_too():
    pair, fit = verified(make_pair(300, np.random.default_rng(0)), outliers=0.3)
    assert (pair.accepted, pair.reason, pair.configuration, pair.undetermined) == (True, "", "general", False)
    assert (pair.i, pair.j, pair.candidates, pair.inliers) == (2, 5, 300, fit.inliers.sum())
    np.testing.assert_array_equal(pair.index1, np.flatnonzero(fit.inliers))
    np.testing.assert_array_equal(pair.index2, 299 - np.flatnonzero(fit.inliers))
    assert len(pair.affine) == pair.inliers
    assert pair.homography_inlier_ratio < 0.5
    assert pair.degeneracy is not None
    pair, _ = verified(make_pair(300, np.random.default_rng(1), planar=True), outliers=0.2)
    assert (pair.accepted, pair.configuration, pair.undetermined) == (True, "plane", True)
    assert pair.homography_inlier_ratio > 0.97
    assert "one homography explains the matches (plane)" in pair.degeneracy.reasons
    pair = make_pair(300, np.random.default_rng(4), planar=True)
    xy1, xy2, _ = spoil(pair, np.random.default_rng(4), sigma=2.0, outliers=0.0)
    fit = FundamentalFit(pair.F, np.ones(300, dtype=bool), 2.0, 1e-12 * np.eye(9))
    found = PairVerification().verify(as_matches(xy1, xy2), fit, np.random.default_rng(0))
    assert found.homography_inlier_ratio > 0.95


@pytest.mark.parametrize(
    ("n", "outliers", "words"),
    [
        (40, 0.0, r"only \d+ of 40 matches.*60 are needed"),
        (400, 0.77, r"of 400 matches agree.*25 % are needed"),
    ],
)
def test_few_inliers_and_a_small_share_are_refused_with_numbers(n, outliers, words):
    pair, _ = verified(make_pair(n, np.random.default_rng(4)), outliers=outliers)
    assert not pair.accepted
    assert re.search(words, pair.reason)
    assert (pair.inliers >= 60) == (n == 400)


def test_unrelated_matches_are_refused():
    rng = np.random.default_rng(5)
    xy1, xy2 = rng.uniform((0, 0), SIZE, (300, 2)), rng.uniform((0, 0), SIZE, (300, 2))
    fit = estimate_fundamental(xy1, xy2)
    pair = PairVerification().verify(as_matches(xy1, xy2), fit, np.random.default_rng(0))
    assert not pair.accepted
    assert pair.reason


def test_share_of_a_dominant_plane_is_measured():
    rng = np.random.default_rng(6)
    flat = make_pair(140, rng, planar=True)
    xy1, xy2 = with_points(flat, rng.uniform((-1.2, -1.2, 3.8), (1.2, 1.2, 6.2), (60, 3)))
    share = homography_inlier_ratio(flat.F, xy1, xy2, tolerance_px=2.0, rng=np.random.default_rng(0))
    assert 0.69 < share < 0.8


def test_verification_is_the_same_every_time_and_safe_on_nothing():
    xy = np.random.default_rng(0).uniform(0, 100, (12, 2))
    for inliers in (np.zeros(12, bool), np.arange(12) < 4, np.ones(12, bool)):
        fit = FundamentalFit(np.diag([1.0, 1.0, 0.0]) / np.sqrt(2), inliers, 0.1, np.zeros((9, 9)))
        found = [
            PairVerification().verify(as_matches(xy, xy), fit, np.random.default_rng(0)) for _ in range(2)
        ]
        assert len({(one.homography_inlier_ratio, one.configuration) for one in found}) == 1
        assert np.isfinite(found[0].homography_inlier_ratio)
        assert not found[0].accepted


def test_exact_and_wrong_calls():
    xy = np.random.default_rng(0).uniform(0, 100, (12, 2))
    fit = FundamentalFit(np.eye(3), np.ones(11, bool), 0.1, np.zeros((9, 9)))
    refuses(ValueError, "11", PairVerification().verify, as_matches(xy, xy), fit, np.random.default_rng(0))
    refuses(ValueError, "min_inliers", PairVerification, min_inliers=3)
    pair = make_pair(40, np.random.default_rng(0))
    assert classify_configuration(pair.F, pair.xy1, pair.xy2) is Configuration.GENERAL
    xy1, xy2, _ = spoil(pair, np.random.default_rng(0), sigma=0.3, outliers=0.0)
    refuses(StageFailure, "needed at least 12", classify_configuration, pair.F, xy1[:11], xy2[:11])
    refuses(ValueError, "11", classify_configuration, pair.F, xy1, xy2, inliers=np.ones(11, bool))
    refuses(ValueError, "rank 2", classify_configuration, np.zeros((3, 3)), xy1, xy2)


@pytest.mark.real
@pytest.mark.parametrize("estimator", [LocallyOptimisedRansac(), ThesisRansac()])
@pytest.mark.parametrize("view", [0, 9, 20])
def test_turntable_tracks(estimator, view):
    tracks = np.loadtxt(real_data("dinosaur/tracks.txt"))
    P = np.loadtxt(real_data("dinosaur/projections.txt")).reshape(-1, 3, 4)
    seen = tracks.reshape(len(tracks), -1, 2)[:, view : view + 2]
    seen = seen[(seen != -1).all(axis=(1, 2))]
    xy1, xy2 = seen[:, 0].copy(), seen[:, 1].copy()
    good = np.abs(sampson_residuals(fundamental_from_cameras(P[view], P[view + 1]), xy1, xy2)) < 1.0
    rng = np.random.default_rng(view)
    wrong = rng.random(len(xy1)) < 0.2
    xy2[wrong] = rng.uniform(xy2.min(axis=0), xy2.max(axis=0), (int(wrong.sum()), 2))
    fit = estimator.estimate(xy1, xy2, rng)
    assert fit.sigma_px < 0.5
    assert fit.inliers[good & ~wrong].mean() > 0.8
    assert fit.inliers[wrong].mean() < 0.1


def noisy_matches(kind, n, sigma, rng, *, wrong=0.0):
    """Matches of a scene of this kind; this share of them is replaced by wrong ones."""
    scene = make_two_views(kind, n, rng)
    xy1, xy2 = (xy + rng.normal(0.0, sigma, xy.shape) for xy in (scene.xy1, scene.xy2))
    replaced = rng.random(n) < wrong
    xy2[replaced] = rng.uniform((0.0, 0.0), (1280.0, 960.0), (int(replaced.sum()), 2))
    return xy1, xy2


@pytest.mark.parametrize("gate", [np.inf, 0.3])
def test_the_translation_is_where_no_other_epipole_has_less_error(gate):
    rng = np.random.default_rng(2)
    e = np.array([0.6, -0.5, 0.62]) / np.linalg.norm([0.6, -0.5, 0.62])
    f, x1 = (cross_matrix(e) / np.sqrt(2.0)).ravel(), rng.normal(size=(60, 2))
    x2 = x1 + rng.uniform(0.05, 0.3, (60, 1)) * (e[:2] / e[2] - x1)
    x1, x2 = (x + rng.normal(0.0, 0.03, (60, 2)) for x in (x1, x2))
    x2[::20] += 2.0 if np.isfinite(gate) else 0.0
    _refine_translation(f, np.column_stack([x1, x2]), gate)
    kept = np.abs(sampson_residuals(cross_matrix(e), x1, x2)) < gate

    def cost(e):
        return float(np.sum(sampson_residuals(cross_matrix(e), x1[kept], x2[kept]) ** 2))

    best = np.array([f[7], f[2], f[3]])
    assert kept.sum() == (57 if np.isfinite(gate) else 60)
    assert np.linalg.norm(f) == pytest.approx(1.0)
    for d in np.eye(3):
        assert min(cost(best + 1e-3 * d), cost(best - 1e-3 * d)) > cost(best)


@pytest.mark.parametrize(
    ("kind", "n", "sigma"),
    [(kind, 100, sigma) for kind in Configuration for sigma in (0.1, 0.5, 2.0)]
    # The parameters that F and the homography take from the residuals are allowed for.
    + [(Configuration.PLANE, 24, 0.5)],
)
def test_every_kind_is_named_at_every_noise(kind, n, sigma):
    right = 0
    for seed in range(25):
        xy1, xy2 = noisy_matches(kind, n, sigma, np.random.default_rng(seed))
        right += classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2) is kind
    assert right >= 24


@pytest.mark.parametrize("kind", list(Configuration))
@pytest.mark.parametrize("sigma", [0.25, 1.0])
def test_every_kind_is_named_with_wrong_matches_too(kind, sigma):
    right = 0
    for seed in range(15):
        xy1, xy2 = noisy_matches(kind, 200, sigma, np.random.default_rng(seed), wrong=0.3)
        fit = estimate_fundamental(xy1, xy2, threshold_px=max(1.0, 2.0 * sigma))
        right += classify_configuration(fit.F, xy1, xy2, inliers=fit.inliers) is kind
    assert right >= 14


def test_special_scenes_are_named():
    flat = make_two_views(Configuration.PLANE, 800, np.random.default_rng(6))
    rng = np.random.default_rng(7)
    # Parallax of about the noise: hardly a match stands off the plane, but all together do.
    relief = flat.X + np.c_[np.zeros((800, 2)), rng.normal(0.0, 0.025, 800)]
    tenth_off = np.r_[flat.X[:180], rng.uniform((-1.2, -1.2, 3.8), (1.2, 1.2, 6.2), (20, 3))]
    still = rng.uniform((0.0, 0.0), (1280.0, 960.0), (80, 2))
    for xy, sigma, kind in (
        ([project(P, relief) for P in (flat.P1, flat.P2)], 0.7, Configuration.GENERAL),
        ([project(P, tenth_off) for P in (flat.P1, flat.P2)], 0.3, Configuration.GENERAL),
        ([still, still], 0.5, Configuration.ROTATION),
    ):
        xy1, xy2 = (a + rng.normal(0.0, sigma, a.shape) for a in xy)
        assert classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2) is kind


@pytest.mark.parametrize("focal", [0.8, 3.0])
def test_a_rotated_camera_is_distinguished_from_a_homography_with_rotation_eigenvalues(focal):
    """H = A R A^-1 has those eigenvalues for every A; only for an A of square pixels is it a rotation's."""
    rng = np.random.default_rng(1)
    xy1 = rng.uniform(-1.2, 1.2, (100, 2))
    turn = _rotation_homography(np.array([np.log(focal), 0.1, -0.2, 0.02, 0.15, -0.05]))
    skewed = np.diag([1.0, 2.5, 1.0])
    for H, is_turn in ((turn, True), (skewed @ turn @ np.linalg.inv(skewed), False)):
        xy2 = dehomogenize(homogenize(xy1) @ H.T)
        ratios = []
        for seed in range(20):
            noisy = [xy + np.random.default_rng(seed).normal(0.0, 1e-3, xy.shape) for xy in (xy1, xy2)]
            fitted = minimize_residuals(
                lambda h, noisy=noisy: homography_sampson_residuals(h.reshape(3, 3), *noisy).ravel(),
                H.ravel(),
            ).x.reshape(3, 3)
            ratios.append(_rotation_test(fitted, *noisy))
        assert (np.array(ratios) <= 1.0).sum() == (20 if is_turn else 0)
        assert min(ratios) >= -1e-6


def test_homography_distances_are_half_the_transfer_of_a_similarity():
    """For an isometry the nearest exact match shares the error between the images."""
    xy1, xy2 = np.random.default_rng(4).uniform(0.0, 100.0, (2, 30, 2))
    H = np.array([[0.8, -0.6, 3.0], [0.6, 0.8, -5.0], [0.0, 0.0, 1.0]])
    whitened = np.linalg.norm(homography_sampson_residuals(H, xy1, xy2), axis=1)
    np.testing.assert_allclose(whitened, homography_residuals(H, xy1, xy2) / np.sqrt(2.0))

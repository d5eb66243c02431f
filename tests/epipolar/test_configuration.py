"""Planes, rotations and translations are named, at every noise; general scenes are not called degenerate."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.epipolar.pairs import make_pair, spoil
from thesisrecon.api.pairs import estimate_fundamental
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.verification import (
    Configuration,
    _eigenvalue_errors,
    _rotation_homography,
    _rotation_test,
    classify_configuration,
)
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import homography_residuals, homography_sampson_residuals
from thesisrecon.optimize.least_squares import minimize_residuals
from validation.scenes.two_views import make_two_views


def noisy_matches(kind, n, sigma, rng, *, wrong=0.0):
    """Matches of a scene of this kind; this share of them is replaced by wrong ones."""
    scene = make_two_views(kind, n, rng)
    xy1, xy2 = (xy + rng.normal(0.0, sigma, xy.shape) for xy in (scene.xy1, scene.xy2))
    replaced = rng.random(n) < wrong
    xy2[replaced] = rng.uniform((0.0, 0.0), (1280.0, 960.0), (int(replaced.sum()), 2))
    return xy1, xy2


@pytest.mark.parametrize("kind", list(Configuration))
@pytest.mark.parametrize("sigma", [0.1, 0.5, 2.0])
def test_every_kind_is_named_at_every_noise(kind, sigma):
    right = 0
    for seed in range(25):
        xy1, xy2 = noisy_matches(kind, 100, sigma, np.random.default_rng(seed))
        found = classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2)
        right += found is kind
    assert right >= 24


@pytest.mark.parametrize("kind", list(Configuration))
@pytest.mark.parametrize("sigma", [0.25, 1.0])
def test_every_kind_is_named_with_wrong_matches_too(kind, sigma):
    right = 0
    for seed in range(15):
        xy1, xy2 = noisy_matches(kind, 200, sigma, np.random.default_rng(seed), wrong=0.3)
        fit = estimate_fundamental(xy1, xy2, threshold_px=max(1.0, 2.0 * sigma))
        found = classify_configuration(fit.F, xy1, xy2, inliers=fit.inliers)
        right += found is kind
    assert right >= 14


def test_relief_of_the_size_of_the_noise_is_seen_in_many_matches():
    """Parallax of about the noise: hardly a match stands off the plane, but all together do."""
    flat = make_two_views(Configuration.PLANE, 800, np.random.default_rng(6))
    rng = np.random.default_rng(7)
    X = flat.X + np.c_[np.zeros((800, 2)), rng.normal(0.0, 0.025, 800)]
    xy1, xy2 = (project(P, X) + rng.normal(0.0, 0.7, (800, 2)) for P in (flat.P1, flat.P2))
    found = classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2)
    assert found is Configuration.GENERAL


def test_wrong_matches_that_f_fits_do_not_hide_a_plane():
    xy1, xy2 = noisy_matches(Configuration.PLANE, 200, 0.3, np.random.default_rng(0), wrong=0.3)
    fit = estimate_fundamental(xy1, xy2)
    found = classify_configuration(fit.F, xy1[fit.inliers], xy2[fit.inliers])
    assert found is Configuration.PLANE


def test_a_tenth_of_the_matches_off_a_plane_make_the_scene_general():
    rng = np.random.default_rng(1)
    flat = make_two_views(Configuration.PLANE, 180, np.random.default_rng(5))
    X = np.r_[flat.X, rng.uniform((-1.2, -1.2, 3.8), (1.2, 1.2, 6.2), (20, 3))]
    xy1, xy2 = (project(P, X) + rng.normal(0.0, 0.3, (200, 2)) for P in (flat.P1, flat.P2))
    assert classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2) is Configuration.GENERAL


def test_a_camera_that_did_not_move_is_a_rotation():
    rng = np.random.default_rng(2)
    xy1 = rng.uniform((0.0, 0.0), (1280.0, 960.0), (80, 2))
    xy2 = xy1 + rng.normal(0.0, 0.5, xy1.shape)
    found = classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2)
    assert found is Configuration.ROTATION


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
    rng = np.random.default_rng(4)
    xy1, xy2 = rng.uniform(0.0, 100.0, (2, 30, 2))
    H = np.array([[0.8, -0.6, 3.0], [0.6, 0.8, -5.0], [0.0, 0.0, 1.0]])
    whitened = np.linalg.norm(homography_sampson_residuals(H, xy1, xy2), axis=1)
    np.testing.assert_allclose(whitened, homography_residuals(H, xy1, xy2) / np.sqrt(2.0))


def test_exact_and_wrong_calls():
    pair = make_pair(40, np.random.default_rng(0))
    assert classify_configuration(pair.F, pair.xy1, pair.xy2) is Configuration.GENERAL
    xy1, xy2, _ = spoil(pair, np.random.default_rng(0), sigma=0.3, outliers=0.0)
    refuses(StageFailure, "needed at least 12", classify_configuration, pair.F, xy1[:11], xy2[:11])
    refuses(ValueError, "11", classify_configuration, pair.F, xy1, xy2, inliers=np.ones(11, bool))
    refuses(ValueError, "rank 2", classify_configuration, np.zeros((3, 3)), xy1, xy2)


@pytest.mark.parametrize("scale", [0.1, 30.0, -2.0])
def test_the_eigenvalues_of_a_homography_do_not_depend_on_its_scale(scale):
    rng = np.random.default_rng(2)
    H = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix() + 1e-3 * rng.normal(size=(3, 3))
    root = 1e-4 * rng.normal(size=(9, 9))
    expected = _eigenvalue_errors(H, root @ root.T)
    assert 0.0 < expected < np.inf
    assert _eigenvalue_errors(scale * H, scale**2 * root @ root.T) == pytest.approx(expected, rel=1e-6)

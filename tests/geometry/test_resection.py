"""Cameras from points and pixels with noise and wrong matches, against known truth."""

import numpy as np
import pytest

import thesisrecon
from tests.conftest import refuses
from thesisrecon.camera import compose_camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project

K = np.array([[900.0, 2.0, 400.0], [0.0, 910.0, 290.0], [0.0, 0.0, 1.0]])
R = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
R *= np.linalg.det(R)
T = np.array([0.3, -0.2, 6.0])
P = compose_camera(K, R, T)


def points(n, rng, *, flat=False):
    X = rng.uniform(-1.5, 1.5, (n, 3)) * [1.0, 1.0, 0.0 if flat else 1.0]
    return X, project(P, X)


@pytest.mark.parametrize("threshold_px", [1.0, None])
@pytest.mark.parametrize(("given", "n"), [(None, 6), (None, 40), (K, 4), (K, 40)])
def test_exact_points_give_the_camera(given, n, threshold_px):
    X, xy = points(n, np.random.default_rng(n))
    found = thesisrecon.resect(X, xy, given, threshold_px=threshold_px)
    np.testing.assert_allclose(found.P, P, atol=1e-4, rtol=1e-6)
    np.testing.assert_allclose(found.P, compose_camera(found.K, found.R, found.t), atol=1e-9)
    np.testing.assert_allclose(found.K, K, atol=1e-3)
    assert found.inliers.all()


def test_a_calibrated_camera_is_found_from_a_plane():
    X, xy = points(30, np.random.default_rng(0), flat=True)
    np.testing.assert_allclose(thesisrecon.resect(X, xy, K).t, T, atol=1e-6)
    refuses(StageFailure, "lie in one plane; add points off it, or give", thesisrecon.resect, X, xy)


@pytest.mark.parametrize("given", [None, K])
def test_noise_inliers_and_covariance_are_those_of_the_errors(given):
    ratios, sigmas = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        X, xy = points(100, rng)
        xy += rng.normal(0.0, 0.5, xy.shape)
        xy[:30] += rng.uniform(20.0, 200.0, (30, 2))
        found = thesisrecon.resect(X, xy, given, threshold_px=2.0, seed=seed)
        assert found.inliers[30:].mean() > 0.88
        assert not found.inliers[:30].any()
        sigmas.append(found.sigma_px)
        if given is None:
            # Of other points: entries of P have second-order errors beyond their smallest deviations.
            X, xy = points(50, rng)
            Xh = np.column_stack([X, np.ones(50)]) / (np.column_stack([X, np.ones(50)]) @ found.P[2])[:, None]
            J = np.einsum("nc,nrs->nrsc", Xh, np.eye(3)[:2] - project(found.P, X)[:, :, None] * np.eye(3)[2])
            J = J.reshape(50, 2, 12)
            variance = np.einsum("nri,ij,nrj->nr", J, found.covariance, J)
            ratios.append(np.mean((project(found.P, X) - xy) ** 2 / variance))
            continue
        # x -> exp(w) x + d of the camera frame, to first order.
        turn = R @ found.R.T
        w = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        values, vectors = np.linalg.eigh(found.covariance)
        ratios.append(np.mean((vectors.T @ np.append(w, T - turn @ found.t)) ** 2 / values))
    assert 0.45 < np.mean(sigmas) < 0.55
    assert 0.7 < np.mean(ratios) < 1.6


def test_points_that_cannot_work_are_named():
    X, xy = points(20, np.random.default_rng(0))
    wrong = np.random.default_rng(1).uniform(0.0, 800.0, xy.shape)
    refuses(
        StageFailure,
        "too few points for resection; 5 points, 6 are needed",
        thesisrecon.resect,
        X[:5],
        xy[:5],
    )
    refuses(StageFailure, "no camera explains the points", thesisrecon.resect, X, wrong)
    refuses(StageFailure, "no camera explains the points", thesisrecon.resect, X, wrong, K)
    refuses(ValueError, r"needs X \(N, 3\), xy \(N, 2\)", thesisrecon.resect, xy, X)
    refuses(ValueError, "threshold_px must be positive", thesisrecon.resect, X, xy, threshold_px=-1.0)


@pytest.mark.parametrize("threshold_px", [1.0, None])
def test_mirrored_points_and_equal_pixels_have_no_camera(threshold_px):
    X, xy = points(30, np.random.default_rng(0))
    resect, failed = thesisrecon.resect, "no camera explains the points"
    refuses(StageFailure, failed, resect, X * [1.0, 1.0, -1.0], xy, threshold_px=threshold_px)
    for given in (None, K):
        same = np.full_like(xy, 100.0)
        refuses(StageFailure, failed, resect, X, same, given, threshold_px=threshold_px)
    xy[:20] = 100.0
    assert np.linalg.det(resect(X, xy, K, threshold_px=threshold_px).R) == pytest.approx(1.0)


@pytest.mark.parametrize("wrong", [2.0 * K, np.diag([900.0, 0.0, 1.0]), np.diag([-1.0, -1.0, 1.0]) @ K, K.T])
def test_a_matrix_that_is_no_calibration_is_refused(wrong):
    X, xy = points(20, np.random.default_rng(0))
    refuses(ValueError, "resect needs K upper triangular with positive", thesisrecon.resect, X, xy, wrong)


@pytest.mark.parametrize("threshold_px", [1.0, None])
def test_points_without_a_pose_are_no_camera(threshold_px):
    X = np.outer([0.0, 1.0, 2.0, 3.0], [1.0, 1.0, 0.5]) + 1e-5 * np.random.default_rng(0).normal(size=(4, 3))
    xy = np.array([[100.0, 100.0], [700.0, 150.0], [120.0, 500.0], [650.0, 520.0]])
    found = (thesisrecon.resect, X, xy, K)
    refuses(StageFailure, "no camera explains the points; 0 of 4", *found, threshold_px=threshold_px)

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.optimize.bundle_scenes import make_block
from thesisrecon.optimize.bundle.partial import refine_camera, refine_points, refine_pose

NONE = np.zeros(6, dtype=bool)


def _reproject(P, X):
    z = X @ P.T
    return z[:, :2] / z[:, 2:]


def test_points_reach_the_least_squares_optimum_of_each():
    block = make_block(points=15)
    rng = np.random.default_rng(1)
    xy = block.xy + 0.5 * rng.normal(size=block.xy.shape)
    start = (block.Xh + 0.05 * rng.normal(size=block.Xh.shape)) * rng.choice([-2.0, 3.0], (15, 1))
    P = block.cameras.P
    X = refine_points(P, start, block.view, block.point, xy, loss_px=1e3, iterations=30)
    np.testing.assert_allclose(np.linalg.norm(X, axis=1), np.linalg.norm(start, axis=1))
    assert (np.sum(X * start, axis=1) > 0.0).all()
    for j in range(15):
        k = np.flatnonzero(block.point == j)

        def residual(x, k=k):
            z = P[block.view[k]] @ np.append(x, 1.0)
            return (z[:, :2] / z[:, 2:] - xy[k]).ravel()

        best = least_squares(residual, block.X[j], xtol=1e-14, ftol=1e-14).x
        np.testing.assert_allclose(X[j, :3] / X[j, 3], best, atol=1e-5)


def test_unusable_points_are_left_alone():
    block = make_block(points=6)
    X = block.Xh.copy()
    X[0] = 0.0
    X[1] = np.nan
    once = (block.point != 2) | (block.view == 0)
    out = refine_points(
        block.cameras.P, X, block.view[once], block.point[once], block.xy[once] + 0.2, iterations=5
    )
    np.testing.assert_array_equal(out[:3], X[:3])
    assert np.isfinite(out[3:]).all()
    assert np.abs(out[3:] - X[3:]).max() > 1e-6


def test_camera_is_recovered_and_its_covariance_is_that_of_monte_carlo():
    block = make_block(points=120)
    P = block.cameras.P[1] * -0.01
    exact = _reproject(P, block.Xh)
    rng = np.random.default_rng(3)
    moved = P * (1.0 + 0.02 * rng.normal(size=P.shape))
    fit, _ = refine_camera(moved, block.Xh, exact, iterations=50)
    np.testing.assert_allclose(fit / np.linalg.norm(fit), P / np.linalg.norm(P), atol=1e-8)
    predicted = refine_camera(P, block.Xh, exact, loss_px=1e3)[1] * 0.5**2
    fits = [
        refine_camera(P, block.Xh, exact + 0.5 * rng.normal(size=exact.shape), loss_px=1e3)[0]
        for _ in range(150)
    ]
    measured = np.cov(np.array(fits).reshape(-1, 12).T)
    np.testing.assert_allclose(np.sqrt(np.diag(measured) / np.diag(predicted)), 1.0, atol=0.25)


def test_a_plane_leaves_the_camera_uncertain():
    block = make_block(points=120)
    P = block.cameras.P[1]
    plane = block.Xh * [1.0, 1.0, 0.0, 1.0] + [0.0, 0.0, 0.3, 0.0]
    off_plane = np.array([[1.0, -2.0, 1.5, 1.0]])

    def spread(X):
        C = refine_camera(P, X, _reproject(P, X))[1].reshape(3, 4, 3, 4)
        return np.sqrt(np.einsum("a,rasb,b->rs", off_plane[0], C, off_plane[0])[0, 0])

    assert spread(plane) > 1e3 * spread(block.Xh)
    assert np.isfinite(spread(plane))


def test_pose_and_focal_are_recovered_despite_outliers():
    block = make_block(points=200)
    c = block.cameras
    xy = block.xy[block.view == 0].copy()
    X = block.X[block.point[block.view == 0]]
    xy[::20] += 80.0
    R = Rotation.from_rotvec([0.03, -0.02, 0.05]).as_matrix() @ c.R[0]
    start = c.intrinsics[0] * [1.1, 1, 1, 1, 1, 1]
    free = np.array([True, False, False, False, False, False])
    fit = refine_pose(R, c.t[0] + 0.1, start, X, xy, free=free, loss_px=0.01, iterations=100)
    assert fit.intrinsics[0] == pytest.approx(1200.0, rel=1e-3)
    np.testing.assert_allclose(fit.R, c.R[0], atol=1e-3)
    np.testing.assert_allclose(fit.t, c.t[0], atol=2e-2)
    assert fit.covariance.shape == (7, 7)


def test_pose_covariance_agrees_with_monte_carlo():
    block = make_block(points=60)
    c = block.cameras
    xy = block.xy[block.view == 0]
    X = block.X[block.point[block.view == 0]]
    rng = np.random.default_rng(5)
    predicted = refine_pose(c.R[0], c.t[0], c.intrinsics[0], X, xy, free=NONE, loss_px=1e3).covariance
    errors = []
    for _ in range(150):
        noisy = xy + rng.normal(size=xy.shape)
        fit = refine_pose(c.R[0], c.t[0], c.intrinsics[0], X, noisy, free=NONE, loss_px=1e3)
        w = Rotation.from_matrix(fit.R @ c.R[0].T)
        errors.append(np.concatenate([w.as_rotvec(), fit.t - w.as_matrix() @ c.t[0]]))
    ratio = np.array(errors).std(axis=0) / np.sqrt(np.diag(predicted))
    np.testing.assert_allclose(ratio, 1.0, atol=0.25)


def test_few_observations_raise_nothing():
    block = make_block(points=8)
    P = block.cameras.P
    once = block.view == 0
    alone = refine_points(P, block.Xh, block.view[once], block.point[once], block.xy[once])
    np.testing.assert_array_equal(alone, block.Xh)
    _, covariance = refine_camera(P[0], block.Xh[:3], _reproject(P[0], block.Xh[:3]) + 0.1)
    assert np.isfinite(covariance).all()

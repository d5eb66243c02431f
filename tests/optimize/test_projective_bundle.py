"""Projective bundle adjustment, and refinement of single cameras and points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.optimize.bundle_scenes import make_block
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import whitening_transform
from thesisrecon.optimize.bundle.partial import refine_camera, refine_points, refine_pose
from thesisrecon.optimize.bundle.projection import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle


def _start(block):
    """The truth, moved a little, in a random projective frame with random scales and signs."""
    rng = np.random.default_rng(1)
    H = np.eye(4) + 0.2 * rng.normal(size=(4, 4))
    P = block.cameras.P * (1.0 + 0.003 * rng.normal(size=block.cameras.P.shape))
    X = block.Xh + 0.003 * rng.normal(size=block.Xh.shape)
    scale_P, scale_X = (rng.uniform(0.5, 2.0, len(a)) * rng.choice([-1.0, 1.0], len(a)) for a in (P, X))
    return P @ np.linalg.inv(H) * scale_P[:, None, None], X @ H.T * scale_X[:, None]


def test_exact_observations_are_reached_from_a_perturbed_start():
    block = make_block()
    P, X = _start(block)
    result = refine_projective_bundle(P, X, block.seen(), max_iterations=60)
    assert np.abs(result.residual_px).max() < 1e-4
    # Norms and signs are the caller's, and the residuals belong to the returned arrays.
    np.testing.assert_allclose(np.linalg.norm(result.X, axis=1), np.linalg.norm(X, axis=1))
    np.testing.assert_allclose(np.linalg.norm(result.P, axis=(1, 2)), np.linalg.norm(P, axis=(1, 2)))
    before, after = (
        np.einsum("kb,kb->k", p[block.view, 2], x[block.point]) for p, x in ((P, X), (result.P, result.X))
    )
    assert (np.sign(after) == np.sign(before)).all()
    np.testing.assert_allclose(block.image(result.P, result.X) - block.xy, result.residual_px, atol=1e-6)


def test_the_cost_reached_does_not_depend_on_the_frame_or_the_order():
    block, rng = make_block(), np.random.default_rng(0)
    xy = block.xy + 0.3 * rng.normal(size=block.xy.shape)
    P, X = _start(block)
    first = refine_projective_bundle(P, X, block.seen(xy), max_iterations=60)
    H, order = np.eye(4) + 0.4 * rng.normal(size=(4, 4)), rng.permutation(len(xy))
    seen = Observations(block.view[order], block.point[order], xy[order])
    second = refine_projective_bundle(P @ np.linalg.inv(H), X @ H.T, seen, max_iterations=60)
    assert second.cost == pytest.approx(first.cost, rel=1e-4)
    np.testing.assert_allclose(second.residual_px, first.residual_px[order], atol=0.02)


def test_fixed_and_unseen_parameters_stay_unchanged():
    block = make_block()
    P, X = (np.concatenate([a, np.zeros((1, *a.shape[1:]))]) for a in _start(block))
    fixed = np.arange(len(P)) < 2
    start, result = (
        refine_projective_bundle(P, X, block.seen(), fixed_views=fixed, max_iterations=n) for n in (0, 10)
    )
    np.testing.assert_array_equal(result.P[[0, 1, -1]], P[[0, 1, -1]])
    np.testing.assert_array_equal(result.X[-1], X[-1])
    assert result.cost < 0.5 * start.cost


def test_degenerate_input_is_guarded():
    block = make_block()
    P, X = _start(block)
    empty, zero = np.zeros(0, dtype=np.int64), np.array([0])
    assert refine_projective_bundle(P, X, Observations(empty, empty, np.zeros((0, 2)))).cost == 0.0
    lonely = refine_projective_bundle(P, X, Observations(zero, zero, np.array([[5.0, 5.0]])))
    assert np.isfinite(lonely.P).all()
    cameras, plane = block.cameras.P, block.Xh * [1.0, 1.0, 0.0, 1.0]
    seen = block.seen(block.image(cameras, plane) + 0.1)
    start, flat = (refine_projective_bundle(cameras, plane, seen, max_iterations=n) for n in (0, 10))
    assert np.isfinite(flat.P).all()
    assert flat.cost <= start.cost
    refuses(ValueError, "finite", refine_projective_bundle, P, X, block.seen(block.xy * np.nan))


def test_whitening_spreads_directions_evenly_and_keeps_orientation():
    X = make_block(points=300).Xh * [5.0, 0.1, 1.0, 1.0]
    M = whitening_transform(X, rounds=30)
    moved = X @ M.T
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    np.testing.assert_allclose(moved.T @ moved / len(X), np.eye(4) / 4.0, atol=0.01)
    assert np.linalg.det(M) > 0.0


def test_unusable_points_are_left_alone_and_norms_and_signs_are_the_callers():
    block = make_block(points=6)
    P, X = block.cameras.P, block.Xh * np.array([[1.0], [1.0], [1.0], [-2.0], [3.0], [1.0]])
    X[0], X[1] = 0.0, np.nan
    once = (block.point != 2) | (block.view == 0)
    out = refine_points(P, X, block.view[once], block.point[once], block.xy[once] + 0.2, iterations=5)
    np.testing.assert_array_equal(out[:3], X[:3])
    assert np.isfinite(out[3:]).all()
    assert np.abs(out[3:] - X[3:]).max() > 1e-6
    np.testing.assert_allclose(np.linalg.norm(out[3:], axis=1), np.linalg.norm(X[3:], axis=1))
    assert (np.sum(out[3:] * X[3:], axis=1) > 0.0).all()
    alone = block.view == 0
    once = refine_points(P, block.Xh, block.view[alone], block.point[alone], block.xy[alone])
    np.testing.assert_array_equal(once, block.Xh)
    assert np.isfinite(refine_camera(P[0], block.Xh[:3], project(P[0], block.Xh[:3]) + 0.1)[1]).all()


def test_a_plane_leaves_the_camera_uncertain():
    block = make_block(points=120)
    P, off_plane = block.cameras.P[1], np.array([1.0, -2.0, 1.5, 1.0])
    plane = block.Xh * [1.0, 1.0, 0.0, 1.0] + [0.0, 0.0, 0.3, 0.0]

    def spread(X):
        C = refine_camera(P, X, project(P, X))[1].reshape(3, 4, 3, 4)
        return np.sqrt(off_plane @ C[0, :, 0] @ off_plane)

    assert spread(plane) > 1e3 * spread(block.Xh)
    assert np.isfinite(spread(plane))


def test_pose_and_focal_are_recovered_despite_outliers():
    block = make_block(points=200)
    c, first = block.cameras, block.view == 0
    X, xy = block.X[block.point[first]], block.xy[first].copy()
    xy[::20] += 80.0
    R = Rotation.from_rotvec([0.03, -0.02, 0.05]).as_matrix() @ c.R[0]
    start, free = c.intrinsics[0] * [1.1, 1, 1, 1, 1, 1], np.arange(6) == 0
    fit = refine_pose(R, c.t[0] + 0.1, start, X, xy, free=free, loss_px=0.01, iterations=100)
    assert fit.intrinsics[0] == pytest.approx(1200.0, rel=1e-3)
    np.testing.assert_allclose(fit.R, c.R[0], atol=1e-3)
    np.testing.assert_allclose(fit.t, c.t[0], atol=2e-2)
    assert fit.covariance.shape == (7, 7)

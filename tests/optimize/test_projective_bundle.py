import numpy as np
import pytest

from tests.optimize.bundle_scenes import make_block
from thesisrecon.geometry.conditioning import whitening_transform
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle


def _start(block, *, seed=1, size=0.003):
    """The truth, moved a little, in a random projective frame with random scales and signs."""
    rng = np.random.default_rng(seed)
    H = np.eye(4) + 0.2 * rng.normal(size=(4, 4))
    P = block.cameras.P * (1.0 + size * rng.normal(size=block.cameras.P.shape))
    X = block.Xh + size * rng.normal(size=block.Xh.shape)
    scale_P = rng.uniform(0.5, 2.0, len(P)) * rng.choice([-1.0, 1.0], len(P))
    scale_X = rng.uniform(0.5, 2.0, len(X)) * rng.choice([-1.0, 1.0], len(X))
    return P @ np.linalg.inv(H) * scale_P[:, None, None], X @ H.T * scale_X[:, None]


def test_exact_observations_are_reached_from_a_perturbed_start():
    block = make_block()
    P, X = _start(block)
    result = refine_projective_bundle(
        P, X, Observations(block.view, block.point, block.xy), max_iterations=60
    )
    assert np.abs(result.residual_px).max() < 1e-4
    # Norms and signs are the caller's, and the residuals belong to the returned arrays.
    np.testing.assert_allclose(np.linalg.norm(result.X, axis=1), np.linalg.norm(X, axis=1))
    np.testing.assert_allclose(np.linalg.norm(result.P, axis=(1, 2)), np.linalg.norm(P, axis=(1, 2)))
    z = np.einsum("kab,kb->ka", result.P[block.view], result.X[block.point])
    before = np.einsum("kab,kb->ka", P[block.view], X[block.point])[:, 2]
    assert (np.sign(z[:, 2]) == np.sign(before)).all()
    np.testing.assert_allclose(z[:, :2] / z[:, 2:] - block.xy, result.residual_px, atol=1e-6)


def test_the_cost_reached_does_not_depend_on_the_frame_or_the_order():
    block = make_block()
    rng = np.random.default_rng(0)
    xy = block.xy + 0.3 * rng.normal(size=block.xy.shape)
    P, X = _start(block)
    first = refine_projective_bundle(P, X, Observations(block.view, block.point, xy), max_iterations=60)
    H = np.eye(4) + 0.4 * rng.normal(size=(4, 4))
    order = rng.permutation(len(xy))
    second = refine_projective_bundle(
        P @ np.linalg.inv(H),
        X @ H.T,
        Observations(block.view[order], block.point[order], xy[order]),
        max_iterations=60,
    )
    assert second.cost == pytest.approx(first.cost, rel=1e-4)
    np.testing.assert_allclose(second.residual_px, first.residual_px[order], atol=0.02)


def test_noise_leaves_the_residual_that_its_freedoms_leave():
    block = make_block(points=150)
    noise = 0.3 * np.random.default_rng(6).normal(size=block.xy.shape)
    P, X = _start(block, size=0.001)
    result = refine_projective_bundle(
        P, X, Observations(block.view, block.point, block.xy + noise), loss_px=100.0, max_iterations=60
    )
    freedoms = 2 * len(noise) - 11 * len(P) - 3 * len(X) + 15
    assert 2.0 * result.cost / 0.09 == pytest.approx(freedoms, abs=4.0 * np.sqrt(2.0 * freedoms))


def test_fixed_and_unseen_parameters_stay_unchanged():
    block = make_block()
    P, X = _start(block)
    P = np.concatenate([P, np.zeros((1, 3, 4))])
    X = np.concatenate([X, np.zeros((1, 4))])
    fixed = np.zeros(len(P), bool)
    fixed[:2] = True
    start, result = (
        refine_projective_bundle(
            P, X, Observations(block.view, block.point, block.xy), fixed_views=fixed, max_iterations=n
        )
        for n in (0, 10)
    )
    np.testing.assert_array_equal(result.P[[0, 1, -1]], P[[0, 1, -1]])
    np.testing.assert_array_equal(result.X[-1], X[-1])
    assert result.cost < 0.5 * start.cost


def test_degenerate_input_is_guarded():
    block = make_block()
    P, X = _start(block)
    empty = np.zeros(0, dtype=np.int64)
    nothing = refine_projective_bundle(P, X, Observations(empty, empty, np.zeros((0, 2))))
    assert nothing.cost == 0.0
    lonely = refine_projective_bundle(
        P, X, Observations(np.array([0]), np.array([0]), np.array([[5.0, 5.0]]))
    )
    assert np.isfinite(lonely.P).all()
    plane = np.concatenate([block.Xh[:, :2], np.zeros((len(X), 1)), np.ones((len(X), 1))], axis=1)
    z = np.einsum("kab,kb->ka", block.cameras.P[block.view], plane[block.point])
    xy = z[:, :2] / z[:, 2:] + 0.1
    start, flat = (
        refine_projective_bundle(
            block.cameras.P, plane, Observations(block.view, block.point, xy), max_iterations=n
        )
        for n in (0, 10)
    )
    assert np.isfinite(flat.P).all()
    assert flat.cost <= start.cost
    with pytest.raises(ValueError, match="finite"):
        refine_projective_bundle(P, X, Observations(block.view, block.point, block.xy * np.nan))
    with pytest.raises(ValueError, match="beyond"):
        refine_projective_bundle(P, X, Observations(block.view + 99, block.point, block.xy))


def test_whitening_spreads_directions_evenly_and_keeps_orientation():
    X = make_block(points=300).Xh * [5.0, 0.1, 1.0, 1.0]
    M = whitening_transform(X, rounds=30)
    moved = X @ M.T
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    np.testing.assert_allclose(moved.T @ moved / len(X), np.eye(4) / 4.0, atol=0.01)
    assert np.linalg.det(M) > 0.0

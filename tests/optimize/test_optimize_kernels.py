"""Compiled kernels against plain NumPy and finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.optimize.bundle_scenes import make_block, project_block
from thesisrecon.optimize import kernels
from thesisrecon.optimize.levenberg_marquardt import floored_diagonal
from thesisrecon.optimize.losses import LOSS_CODES, LOSSES
from thesisrecon.optimize.metric_bundle import MetricCameras
from thesisrecon.optimize.schur import Columns, Jacobians, assemble_system, sort_observations


def _linearized_metric(block, xy, code=0, delta=1.0, sigma=1.0):
    c, n = block.cameras, len(xy)
    width = c.intrinsics.shape[1]
    J = Jacobians.allocate(n, 6, width)
    cost = kernels.linearize_metric(
        c.R, c.t, c.intrinsics, c.group, block.X, block.view, block.point, xy, np.arange(width),
        sigma, code, delta, J.residual, J.A, J.G, J.B,
    )  # fmt: skip
    return cost, J


def _moved(cameras, pose, intrinsics):
    turn = Rotation.from_rotvec(pose[:, :3]).as_matrix()
    q = cameras.intrinsics + intrinsics
    q[:, 0] = cameras.intrinsics[:, 0] * np.exp(intrinsics[:, 0])
    t = np.einsum("vab,vb->va", turn, cameras.t) + pose[:, 3:]
    return MetricCameras(turn @ cameras.R, t, q, cameras.group)


@pytest.mark.parametrize("lens", [(), (-0.03, 0.02)])
def test_metric_jacobians_match_finite_differences(lens):
    block = make_block(k1=0.05, lens=lens, groups=2)
    _, J = _linearized_metric(block, block.xy + 3.0)
    V, G, h = len(block.cameras.R), 2, 1e-6

    def difference(pose, intrinsics, X):
        ends = [
            project_block(
                _moved(block.cameras, s * h * pose, s * h * intrinsics),
                block.X + s * h * X,
                block.view,
                block.point,
            )
            for s in (1.0, -1.0)
        ]
        return (ends[0] - ends[1]) / (2.0 * h)

    C = 6 + len(lens)
    none = np.zeros((V, 6)), np.zeros((G, C)), np.zeros_like(block.X)
    for c in range(6):
        unit = np.eye(6)[c]
        np.testing.assert_allclose(J.A[:, :, c], difference(none[0] + unit, *none[1:]), rtol=2e-5, atol=2e-4)
    for c in range(C):
        unit = np.eye(C)[c]
        np.testing.assert_allclose(
            J.G[:, :, c], difference(none[0], none[1] + unit, none[2]), rtol=2e-5, atol=2e-4
        )
    for c in range(3):
        np.testing.assert_allclose(
            J.B[:, :, c], difference(none[0], none[1], none[2] + np.eye(3)[c]), rtol=2e-5, atol=2e-4
        )


def test_projective_jacobians_match_finite_differences():
    rng = np.random.default_rng(4)
    P = rng.normal(size=(3, 12))
    X = rng.normal(size=(7, 4))
    P /= np.linalg.norm(P, axis=1, keepdims=True)
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    view, point = (a.ravel() for a in np.meshgrid(np.arange(3), np.arange(7)))
    xy = rng.normal(size=(21, 2))
    vP, bP, vX, bX = np.empty_like(P), np.empty(3), np.empty_like(X), np.empty(7)
    kernels.tangent_reflectors(P, vP, bP)
    kernels.tangent_reflectors(X, vX, bX)
    J = Jacobians.allocate(21, 11, 0)
    cost = kernels.linearize_projective(P, vP, bP, X, vX, bX, view, point, xy, 0, 1.0, J.residual, J.A, J.B)
    z = np.einsum("kab,kb->ka", P.reshape(3, 3, 4)[view], X[point])
    np.testing.assert_allclose(J.residual, z[:, :2] / z[:, 2:] - xy, rtol=1e-12)
    assert cost == pytest.approx(0.5 * np.sum(J.residual**2))

    def residual(sP, sX):
        moved_P, moved_X = np.empty_like(P), np.empty_like(X)
        kernels.tangent_step(P, vP, bP, sP, moved_P)
        kernels.tangent_step(X, vX, bX, sX, moved_X)
        u = np.einsum("kab,kb->ka", moved_P.reshape(3, 3, 4)[view], moved_X[point])
        return u[:, :2] / u[:, 2:]

    h = 1e-7
    for c in range(11):
        step = h * np.tile(np.eye(11)[c], (3, 1))
        slope = (residual(step, np.zeros((7, 3))) - residual(-step, np.zeros((7, 3)))) / (2 * h)
        np.testing.assert_allclose(J.A[:, :, c], slope, rtol=1e-4, atol=1e-5 * np.abs(J.A).max())
    for c in range(3):
        step = h * np.tile(np.eye(3)[c], (7, 1))
        slope = (residual(np.zeros((3, 11)), step) - residual(np.zeros((3, 11)), -step)) / (2 * h)
        np.testing.assert_allclose(J.B[:, :, c], slope, rtol=1e-4, atol=1e-5 * np.abs(J.B).max())


@pytest.mark.parametrize("loss", sorted(LOSSES))
def test_losses_of_the_kernels_are_those_of_numpy(loss):
    block = make_block()
    noise = np.random.default_rng(0).normal(size=block.xy.shape) * 2.0
    cost, J = _linearized_metric(block, block.xy - noise, LOSS_CODES[loss], 1.5, 2.0)
    s = np.sum((noise / 2.0) ** 2, axis=1)
    rho, weight = LOSSES[loss](s, 1.5)
    assert cost == pytest.approx(0.5 * rho.sum())
    np.testing.assert_allclose(J.residual, np.sqrt(weight)[:, None] * noise / 2.0, rtol=1e-9, atol=1e-9)


def test_elimination_gives_the_step_of_the_full_dense_system():
    block = make_block(views=4, points=12, groups=2)
    rng = np.random.default_rng(2)
    o = sort_observations(block.view, block.point, block.xy, 4, 12)
    cost, J = _linearized_metric(block, block.xy + rng.normal(size=block.xy.shape))
    # View 0 is held, so its columns are absent; views 1..3 have 6 each, then two groups of 6.
    first = np.array([-1, 0, 6, 12])[block.view]
    group = 18 + 6 * block.cameras.group[block.view]
    system = assemble_system(cost, o.start, Columns(first, group, 30), J)
    step, gain = system.solve(1e-3)

    full = np.zeros((2 * len(block.xy), 30 + 36))
    for k in range(len(block.xy)):
        rows = slice(2 * k, 2 * k + 2)
        if first[k] >= 0:
            full[rows, first[k] : first[k] + 6] = J.A[k]
        full[rows, group[k] : group[k] + 6] = J.G[k]
        full[rows, 30 + 3 * block.point[k] : 33 + 3 * block.point[k]] = J.B[k]
    r = J.residual.ravel()
    H, g = full.T @ full, full.T @ r
    damped = H + 1e-3 * np.diag(floored_diagonal(np.diag(H)))
    expected = np.linalg.solve(damped, -g)
    np.testing.assert_allclose(step.cameras, expected[:30], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(step.points.ravel(), expected[30:], rtol=1e-6, atol=1e-9)
    assert gain == pytest.approx(-g @ expected - 0.5 * expected @ H @ expected, rel=1e-6)


def test_tangent_steps_keep_unit_norm_and_side():
    rng = np.random.default_rng(8)
    p = rng.normal(size=(20, 4))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    v, beta, out = np.empty_like(p), np.empty(20), np.empty_like(p)
    kernels.tangent_reflectors(p, v, beta)
    kernels.tangent_step(p, v, beta, 3.0 * rng.normal(size=(20, 3)), out)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0, rtol=1e-12)
    assert (np.sum(p * out, axis=1) > 0.0).all()

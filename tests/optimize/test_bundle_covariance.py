"""Covariances against Monte Carlo, and the two ways to them against each other."""

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

from tests.optimize.bundle_scenes import make_block, project_block
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.optimize.bundle import covariance as bundle_covariance
from thesisrecon.optimize.bundle.covariance import robust_sigma
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from thesisrecon.optimize.bundle.metric_kernels import MetricCameras
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.records import IntrinsicsPrior

FREE = np.array([True, False, False, True, True, True])


def _own_focals(block, populations):
    """Focals of their own, the rest common; with ``populations`` views 1 to 5 are of one kind, 0 is held."""
    c = block.cameras
    rows = np.tile(c.intrinsics[0], (6, 1))
    rows[:, 0] = [1200.0, 1150.0, 1240.0, 1180.0, 1210.0, 1260.0]
    shared = np.zeros((6, 6), dtype=np.int64)
    shared[:, 0] = np.arange(6)
    cameras = MetricCameras(c.R, c.t, rows, np.arange(6), shared)
    if not populations:
        return cameras, None
    std = np.full((6, 6), np.inf)
    std[0, 0] = 0.0
    spread = np.array([0.03, *[np.inf] * 5])
    return cameras, IntrinsicsPrior.unshared(rows, std, kind=np.array([-1, 1, 1, 1, 1, 1]), spread=spread)


@pytest.mark.parametrize("populations", [False, True])
def test_the_banded_way_gives_the_covariances_of_the_dense_one(monkeypatch, populations):
    block = make_block(k1=0.02, points=60)
    cameras, prior = _own_focals(block, populations)
    xy = project_block(cameras, block.X, block.view, block.point)
    xy += 0.3 * np.random.default_rng(0).normal(size=xy.shape)

    def fit():
        return refine_metric_bundle(
            cameras, block.X, Observations(block.view, block.point, xy), free=FREE, prior=prior,
            options=BundleOptions(covariance=True, point_covariance=True),
        )  # fmt: skip

    dense = fit()
    monkeypatch.setattr(bundle_covariance, "MAX_DENSE", 0)
    banded = fit()
    scale = np.abs(dense.intrinsics_covariance).max(axis=0) + 1e-30
    assert (np.abs(banded.intrinsics_covariance - dense.intrinsics_covariance) / scale).max() < 1e-3
    scale = np.abs(dense.pose_covariance).max(axis=(1, 2), keepdims=True) + 1e-30
    assert (np.abs(banded.pose_covariance - dense.pose_covariance) / scale).max() < 1e-3
    scale = np.abs(dense.point_covariance).max(axis=(1, 2), keepdims=True)
    assert (np.abs(banded.point_covariance - dense.point_covariance) / scale).max() < 1e-3
    assert bool(dense.intrinsics_covariance[0, 0, 0] > 0.0) is not populations


def _inner_frame(block):
    """Origin and scale of the frame inside, where the gauge is the inner one, and its motions of the poses
    (6 V, 7) and the points (3 N, 7)."""
    origin = np.median(block.X, axis=0)
    scale = 1.0 / np.median(np.linalg.norm(block.X - origin, axis=1))
    c = block.cameras
    t, X = scale * (c.t + c.R @ origin), scale * (block.X - origin)
    turned, still = -cross_matrix(t) @ c.R, np.zeros_like(c.R)
    poses = np.block([[-still, -c.R, np.zeros((len(t), 3, 1))], [-c.R, turned, t[:, :, None]]])
    points = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(X), 3, 3)), -cross_matrix(X), X[:, :, None]], axis=2
    )
    return origin, scale, poses.reshape(-1, 7), points.reshape(-1, 7)


@pytest.mark.parametrize("own", [False, True])
def test_covariances_of_points_are_those_of_the_full_normal_equations(own):
    block = make_block(k1=0.02, points=25, views=4)
    c, sigma = block.cameras, 0.4
    rows = np.tile(c.intrinsics[0], (4, 1))
    shared = np.repeat(np.arange(4)[:, None] * own, 6, axis=1)
    shared[:, 1:] = 0
    cameras = MetricCameras(c.R, c.t, rows, np.arange(4), shared)
    # Exact data stay at the minimum, and the floor is the noise.
    fit = refine_metric_bundle(
        cameras, block.X, Observations(block.view, block.point, block.xy), free=FREE,
        options=BundleOptions(sigma, covariance=True, point_covariance=True, noise_floor_px=sigma),
    )  # fmt: skip
    _, scale, G, _ = _inner_frame(block)
    n_focals = 4 if own else 1
    sizes = [24, n_focals, 3, 75]

    def project(unknowns):
        poses, focal, lens, X = np.split(unknowns, np.cumsum(sizes)[:-1])
        w, d = np.split(poses.reshape(4, 6), 2, axis=1)
        turn = Rotation.from_rotvec(w).as_matrix()
        table = rows.copy()
        table[:, 0] *= np.exp(focal)
        table[:, 3:] += lens
        t = np.einsum("vab,vb->va", turn, c.t) + d / scale
        moved = MetricCameras(turn @ c.R, t, table, np.arange(4))
        return project_block(moved, block.X + X.reshape(-1, 3), block.view, block.point).ravel()

    steps = 1e-6 * np.eye(sum(sizes))
    J = np.stack([(project(h) - project(-h)) / 2e-6 for h in steps], axis=1)
    # All unknowns that satisfy the gauge: the cameras do not move along a similarity.
    constraint = np.zeros((sum(sizes), 7))
    constraint[:24] = G
    Z = scipy.linalg.null_space(constraint.T)
    covariance = Z @ np.linalg.inv(Z.T @ J.T @ J @ Z) @ Z.T * sigma**2
    units = np.tile([1.0, 1.0, 1.0, scale, scale, scale], 4)
    for v in range(4):
        part = slice(6 * v, 6 * v + 6)
        expected = covariance[part, part] / np.outer(units[part], units[part])
        np.testing.assert_allclose(fit.pose_covariance[v], expected, rtol=0, atol=1e-4 * expected.max())
    for j in range(25):
        part = slice(len(covariance) - 75 + 3 * j, len(covariance) - 72 + 3 * j)
        expected = covariance[part, part]
        np.testing.assert_allclose(fit.point_covariance[j], expected, rtol=0, atol=1e-4 * expected.max())


def test_noise_is_found_beside_outliers_and_points_that_fit_anything():
    rng = np.random.default_rng(0)
    residual, leverage = 0.3 * rng.normal(size=(5000, 2)), np.zeros((5000, 2))
    assert robust_sigma(residual, leverage, 0) == pytest.approx(0.3, rel=0.02)
    residual[:100] *= 100.0
    assert robust_sigma(residual, leverage, 0) == pytest.approx(0.3, rel=0.04)
    # A coordinate keeps the share of its variance that neither its point nor the cameras took.
    leverage[:] = 0.5
    assert robust_sigma(np.sqrt(0.25) * residual, leverage, 2500) == pytest.approx(0.3, rel=0.04)
    leverage[2500:], residual[2500:] = 1.0, 0.0
    assert robust_sigma(np.sqrt(0.25) * residual, leverage, 2500) == pytest.approx(0.3, rel=0.05)
    assert robust_sigma(residual, np.ones_like(leverage), 0) == 0.0
    assert robust_sigma(np.zeros((0, 2)), np.zeros((0, 2)), 0) == 0.0


@pytest.mark.parametrize("populations", [False, True])
def test_errors_are_as_large_as_the_covariances_say(populations):
    block = make_block(k1=0.02, points=60)
    cameras, prior = _own_focals(block, populations)
    exact, sigma, trials = project_block(cameras, block.X, block.view, block.point), 0.4, 120
    rng = np.random.default_rng(11)
    origin, scale, G, G_points = _inner_frame(block)
    c = block.cameras
    z_intrinsics, z_poses, z_points, sigmas = [], [], [], []
    for _ in range(trials):
        true = cameras.intrinsics.copy()
        xy = exact
        if prior is not None:
            # The truth of each member is drawn from the hierarchical prior.
            true[1:, 0] = 1200.0 * np.exp(0.03 * rng.normal(size=5))
            moved = MetricCameras(c.R, c.t, true, np.arange(6))
            xy = project_block(moved, block.X, block.view, block.point)
        fit = refine_metric_bundle(
            MetricCameras(c.R, c.t, true, np.arange(6), cameras.shared),
            block.X,
            Observations(block.view, block.point, xy + sigma * rng.normal(size=exact.shape)),
            free=FREE,
            prior=prior,
            options=BundleOptions(sigma, np.inf, 15, covariance=True, point_covariance=True),
        )
        error = fit.cameras.intrinsics - true
        std = np.sqrt(fit.intrinsics_covariance[:, range(6), range(6)])
        free = std > 0.0
        z_intrinsics.append((error[free] / std[free]) ** 2)
        turn = Rotation.from_matrix(fit.cameras.R @ np.swapaxes(c.R, 1, 2))
        shift = fit.cameras.t - np.einsum("vab,vb->va", turn.as_matrix(), c.t + c.R @ origin)
        shift += fit.cameras.R @ origin
        delta = np.concatenate([turn.as_rotvec(), scale * shift], axis=1).ravel()
        moved = np.linalg.lstsq(G, delta, rcond=None)[0]
        delta -= G @ moved
        units = np.array([1.0, 1.0, 1.0, scale, scale, scale])
        z_poses.append(delta**2 / (np.diagonal(fit.pose_covariance, axis1=1, axis2=2) * units**2).ravel())
        delta = (fit.X - block.X) - (G_points @ moved).reshape(-1, 3) / scale
        z_points.append(np.einsum("na,nab,nb->n", delta, np.linalg.inv(fit.point_covariance), delta) / 3.0)
        sigmas.append(fit.sigma_px)
    assert np.sqrt(np.mean(z_intrinsics)) == pytest.approx(1.0, abs=0.08)
    assert np.sqrt(np.mean(z_poses)) == pytest.approx(1.0, abs=0.08)
    assert np.sqrt(np.mean(z_points)) == pytest.approx(1.0, abs=0.05)
    assert np.mean(sigmas) == pytest.approx(sigma, rel=0.01)

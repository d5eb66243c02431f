"""The scatter between parts of a scene: 1 on independent noise, more where noise or model are otherwise."""

import numpy as np
import pytest

from tests.numerics.bundle_scenes import make_block
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.block_scatter import block_scatter, point_blocks
from thesisrecon.numerics.metric_bundle import BundleOptions, refine_metric_bundle
from thesisrecon.numerics.observations import Observations

FREE = np.array([True, False, False, True, True, True])
SIGMA = 0.5


def _scatter(block, xy, *, free=FREE, loss=20.0, std=np.inf):
    seen = Observations(block.view, block.point, xy)
    q = block.cameras.intrinsics
    prior = IntrinsicsPrior.unshared(q, np.full_like(q, 1.0) * std)
    options = BundleOptions(sigma_px=SIGMA, loss_px=loss * SIGMA, max_iterations=30, covariance=True)
    fit = refine_metric_bundle(block.cameras, block.X, seen, free=free, prior=prior, options=options)
    noise = (SIGMA, loss * SIGMA)
    return fit, block_scatter(fit.cameras, fit.X, seen, free=free, prior=prior, noise=noise)


def test_the_variance_is_that_of_bundle_adjustment():
    block = make_block(points=200)
    xy = block.xy + SIGMA * np.random.default_rng(0).normal(size=block.xy.shape)
    fit, scatter = _scatter(block, xy)
    scale = SIGMA / fit.sigma_px
    expected = scale**2 * np.diagonal(fit.intrinsics_covariance, axis1=1, axis2=2)
    expected[:, 0] /= fit.cameras.intrinsics[:, 0] ** 2
    np.testing.assert_allclose(scatter.variance, expected, rtol=0.02)
    np.testing.assert_allclose(scatter.shared_variance, scatter.variance[0], rtol=1e-6)
    assert np.isnan(scatter.ratio[0, 1])
    assert scatter.blocks >= 8


def test_one_camera_behind_all_photographs_is_known_better_than_one_each():
    one, many = make_block(points=200), make_block(points=200, groups=6)
    noise = SIGMA * np.random.default_rng(0).normal(size=one.xy.shape)
    shared, own = _scatter(one, one.xy + noise)[1], _scatter(many, many.xy + noise)[1]
    np.testing.assert_allclose(own.shared_variance[FREE], shared.variance[0, FREE], rtol=0.1)
    assert (own.variance[:, 0] > 1.5 * own.shared_variance[0]).all()


def test_independent_noise_has_the_ratio_one_whatever_its_distribution():
    block = make_block(points=400)
    rng = np.random.default_rng(1)
    normal, heavy = [], []
    for _ in range(12):
        noise = SIGMA * rng.normal(size=block.xy.shape)
        normal.append(_scatter(block, block.xy + noise)[1])
        noise *= np.where(rng.random(len(noise)) < 0.2, 4.0, 1.0)[:, None]
        heavy.append(_scatter(block, block.xy + noise, loss=1.5)[1])
    assert np.mean([s.median_ratio for s in normal]) == pytest.approx(1.0, abs=0.15)
    assert np.mean([s.overdispersion for s in normal]) == pytest.approx(1.0, abs=0.12)
    assert np.mean([s.overdispersion for s in heavy]) == pytest.approx(1.0, abs=0.15)
    # Four times as wide in a fifth of the matches: more than the size of the core says.
    assert np.mean([s.median_ratio for s in heavy]) > 1.3


def test_priors_do_not_pass_for_contradictions():
    block = make_block(points=200, groups=6)
    rng = np.random.default_rng(5)
    free = _scatter(block, block.xy + SIGMA * rng.normal(size=block.xy.shape))[1]
    std = 0.3 * np.sqrt(np.median(free.model, axis=0))
    told = [_scatter(block, block.xy + SIGMA * rng.normal(size=block.xy.shape), std=std)[1] for _ in range(6)]
    assert np.median([s.model[:, 3] / free.model[:, 3] for s in told]) < 0.15
    assert np.mean([s.overdispersion for s in told]) == pytest.approx(1.0, abs=0.25)


def test_noise_that_neighbours_share_is_seen():
    block = make_block(points=400)
    rng = np.random.default_rng(2)
    # A smooth field of errors in each image beside a little noise.
    wave = rng.normal(size=(len(block.cameras.R), 2, 2))
    field = np.sin(np.einsum("kab,kb->ka", wave[block.view], block.xy / 150.0))
    _, scatter = _scatter(block, block.xy + 0.3 * SIGMA * rng.normal(size=field.shape) + SIGMA * field)
    assert scatter.overdispersion > 2.0


def test_blocks_are_of_neighbours_and_of_equal_size():
    rng = np.random.default_rng(3)
    X, used = rng.normal(size=(500, 3)) * [5.0, 1.0, 1.0], rng.random(500) < 0.9
    block = point_blocks(X, used)
    assert (block[~used] == -1).all()
    counts = np.bincount(block[used])
    assert len(counts) == 32
    assert counts.min() > 0.8 * counts.mean()
    within = np.mean([np.var(X[block == b], axis=0).sum() for b in range(32)])
    assert within < 0.3 * np.var(X, axis=0).sum()
    assert point_blocks(X[:20], np.ones(20, bool)).max() == 0

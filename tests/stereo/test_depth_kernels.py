"""The compiled loops against plain NumPy."""

import numpy as np

from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo import _depth_fusion as kernels
from thesisrecon.stereo._plane_kernels import fit_planes

SHAPE = (23, 31)


def pixels():
    x, y = np.meshgrid(np.arange(float(SHAPE[1])), np.arange(float(SHAPE[0])))
    return np.stack([x, y], axis=-1)


def motion(rng):
    return np.eye(3) + 1e-3 * rng.normal(size=(3, 3)), np.array([9.0, 2.0, 0.01])


def holes(rng, values):
    return np.where(rng.random(values.shape) < 0.2, np.nan, values).astype(np.float32)


def test_inverse_depths_equal_least_squares_on_the_line():
    rng = np.random.default_rng(0)
    H, e = motion(rng)
    truth = rng.uniform(0.5, 2.0, SHAPE)
    q = homogenize(pixels()) @ H.T + truth[..., None] * e
    xy = (q[..., :2] / q[..., 2:] + rng.normal(0.0, 0.1, (*SHAPE, 2))).astype(np.float32)
    sigma = holes(rng, np.full(SHAPE, 0.3))
    rho, std = np.empty(SHAPE, np.float32), np.empty(SHAPE, np.float32)
    kernels.inverse_depths(xy, sigma, H, e, rho, std)
    h = homogenize(pixels()) @ H.T
    a, b = e[:2] - xy * e[2], xy * h[..., 2:] - h[..., :2]
    wanted = (a * b).sum(-1) / (a * a).sum(-1)
    wanted_std = sigma * (h[..., 2] + wanted * e[2]) / np.linalg.norm(a, axis=-1)
    known = np.isfinite(sigma)
    assert (np.isfinite(rho) == known).all()
    np.testing.assert_allclose(rho[known], wanted[known], rtol=1e-5)
    np.testing.assert_allclose(std[known], wanted_std[known], rtol=1e-5)
    assert np.abs(rho[known] - truth[known]).max() < 0.06


def test_fusion_is_the_weighted_mean_of_the_largest_party():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.5, 2.0, SHAPE)
    std = rng.uniform(0.005, 0.02, (5, *SHAPE)).astype(np.float32)
    rho = truth + std * rng.normal(size=std.shape)
    rho[rng.random(std.shape) < 0.25] += 0.7
    rho = holes(rng, rho)
    out, out_std = np.empty(SHAPE, np.float32), np.empty(SHAPE, np.float32)
    support, rivals = np.empty(SHAPE, np.uint8), np.empty(SHAPE, np.uint8)
    kernels.fuse_inverse_depths(rho, std, 3.0, out, out_std, support, rivals)
    apart = np.abs(rho[:, None].astype(float) - rho[None])
    agree = apart <= 3.0 * np.hypot(std[:, None].astype(float), std[None])
    weight = 1.0 / std.astype(float) ** 2
    votes, certain = agree.sum(1), np.where(agree, weight[None], 0.0).sum(1)
    best = np.argmax(votes + certain / (certain.max() * 2.0), axis=0)
    party = np.take_along_axis(agree, best[None, None], 0)[0] & np.isfinite(rho)
    total = np.where(party, weight, 0.0).sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(party, weight * rho, 0.0).sum(0) / total
        chi = np.where(party, weight * (rho - mean) ** 2, 0.0).sum(0) / (party.sum(0) - 1)
        wanted_std = np.sqrt(np.where(party.sum(0) > 1, np.maximum(chi, 1.0), 1.0) / total)
        wanted_std[total == 0.0] = np.nan
    assert (support == party.sum(0)).all()
    assert (rivals == np.isfinite(rho).sum(0) - party.sum(0)).all()
    np.testing.assert_allclose(out, mean, rtol=1e-5)
    np.testing.assert_allclose(out_std, wanted_std, rtol=1e-4)


def test_the_filter_ends_at_the_first_outlier():
    rng = np.random.default_rng(2)
    rho, std = holes(rng, rng.uniform(1.0, 1.1, SHAPE)), np.full(SHAPE, 0.05, np.float32)
    new, new_std = holes(rng, rng.uniform(0.8, 1.3, SHAPE)), np.full(SHAPE, 0.03, np.float32)
    alive, support = (rng.random(SHAPE) < 0.8).astype(np.uint8), np.ones(SHAPE, np.uint8)
    before, was = rho.copy(), alive.copy()
    kernels.update_kalman(rho, std, new, new_std, 3.0, alive, support)
    inside = np.abs(new - before) <= 3.0 * np.hypot(0.05, 0.03)
    first, measured = np.isnan(before), np.isfinite(new)
    taken = (was == 1) & measured & (first | inside)
    assert (alive == taken).all()
    gain = 0.05**2 / (0.05**2 + 0.03**2)
    wanted = np.where(first, new, before + gain * (new - before))
    np.testing.assert_allclose(rho, np.where(taken, wanted, before), rtol=1e-5)
    assert (support == np.where(taken & ~first, 2, 1)).all()
    np.testing.assert_allclose(std[taken & ~first], np.sqrt(1.0 - gain) * 0.05, rtol=1e-5)


def test_planes_are_fitted_to_similar_pixels():
    rng = np.random.default_rng(4)
    xy = pixels()
    rho = (1.0 + 1e-3 * xy[..., 0] - 2e-3 * xy[..., 1]).astype(np.float32)
    rho[:, 20:] += 0.5
    rho = holes(rng, rho)
    gx, gy = np.empty(SHAPE, np.float32), np.empty(SHAPE, np.float32)
    fit_planes(rho, 3, 0.1, gx, gy)
    known = np.isfinite(rho)
    assert (np.isfinite(gx) == known).all()
    np.testing.assert_allclose(gx[known], 1e-3, atol=2e-6)
    np.testing.assert_allclose(gy[known], -2e-3, atol=2e-6)

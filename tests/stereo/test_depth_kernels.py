"""The compiled loops against plain NumPy."""

import numpy as np

from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo import _depth_kernels as kernels
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


def test_agreement_counts_consistent_and_contradicted_depths():
    rng = np.random.default_rng(3)
    to = np.column_stack([np.eye(3), [3.0, 1.0, 0.0]])
    back = np.column_stack([np.eye(3), [-3.0, -1.0, 0.0]])
    depth, other = holes(rng, np.full(SHAPE, 1.0)), holes(rng, np.full(SHAPE, 1.0))
    depth[5:9, 5:9] = 0.9
    other[12:16, 20:24] = 0.8
    std = np.full(SHAPE, 1e-3, np.float32)
    agree, contradict = np.zeros(SHAPE, np.uint8), np.zeros(SHAPE, np.uint8)
    limits = np.array([1.0, 0.01, 2.0])
    kernels.count_agreement((depth, std), to, (other, std), back, limits, agree, contradict)
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    x, y = u + 3.0 / depth, v + 1.0 / depth
    inside = (x > -0.5) & (x < SHAPE[1] - 0.5) & (y > -0.5) & (y < SHAPE[0] - 0.5)
    q, p = (np.where(inside, np.floor(c + 0.5), 0).astype(int) for c in (y, x))
    found = np.where(inside, other[q, p], np.nan)
    bound = 0.01 * depth + 2.0 * np.hypot(std, std)
    assert (contradict == (found > depth + bound)).all()
    assert (agree == (np.abs(found - depth) <= bound)).all()
    assert contradict.sum() > 8
    assert agree.sum() > 300


def test_depths_land_on_the_nearest_pixels_of_another_view_the_nearer_before_the_farther():
    rng = np.random.default_rng(5)
    to = np.column_stack([np.diag([1.0, 1.0, 1.1]), [3.0, -1.0, 0.2]])
    depth = holes(rng, rng.choice([0.5, 1.0], SHAPE))
    out = np.full((19, 25), np.nan, np.float32)
    out[4, 5], out[6, 7] = 0.1, 9.0
    wanted = out.copy()
    kernels.splat_depths(depth, to, out)
    z = depth.astype(float)
    w = 1.1 * z + 0.2
    p, q = (
        np.floor((z * c + d) / w + 0.5) for c, d in zip(pixels().transpose(2, 0, 1), (3.0, -1.0), strict=True)
    )
    good = (w > 0) & (p >= 0) & (q >= 0) & (p < 25) & (q < 19)
    np.fmin.at(wanted, (q[good].astype(int), p[good].astype(int)), w[good].astype(np.float32))
    np.testing.assert_allclose(out, wanted, rtol=1e-6)
    assert np.isnan(out).any()


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


def test_continued_surfaces_lie_on_the_plane_of_certain_pixels():
    rng = np.random.default_rng(6)
    y, x = np.indices(SHAPE)
    rho = (1.0 + 2e-3 * x - 1e-3 * y + 1e-4 * rng.normal(size=SHAPE)).astype(np.float32)
    rho[:, 22:] += 0.4
    sure = (rng.random(SHAPE) < 0.6).astype(np.uint8)
    sure[:, 26:] = 0
    doubtful = (sure == 0) & (rng.random(SHAPE) < 0.5)
    rho[doubtful] += rng.choice([0.0, 2e-3], int(doubtful.sum())).astype(np.float32)
    rho = holes(rng, rho)
    sure[np.isnan(rho)] = 0
    std = np.full(SHAPE, 4e-4, np.float32)
    joins = np.empty(SHAPE, np.uint8)
    kernels.surface_continuation(rho, std, sure, 3, 0.05, 2.0, joins)
    wanted = np.zeros(SHAPE, bool)
    for v, u in np.argwhere((sure == 0) & np.isfinite(rho)):
        near = (np.abs(x - u) <= 3) & (np.abs(y - v) <= 3) & (sure > 0)
        near &= np.abs(rho - rho[v, u]) <= 0.05 * rho[v, u]
        dx, dy = x[near] - u, y[near] - v
        if near.sum() < 49 // 4 or dx.mean() ** 2 + dy.mean() ** 2 > 0.5 * (dx.var() + dy.var()):
            continue
        A = np.stack([np.ones(len(dx)), dx, dy], axis=1)
        plane = np.linalg.lstsq(A, rho[near].astype(float), rcond=None)[0]
        wanted[v, u] = abs(plane[0] - rho[v, u]) <= 2.0 * std[v, u]
    assert (joins.astype(bool) == wanted).all()
    assert wanted.sum() > 20
    assert ((sure == 0) & np.isfinite(rho) & ~wanted).sum() > 20

"""Compiled loops of stereo matching and depth estimation against plain ones."""

import itertools

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo import _depth_fusion, _postprocessing
from thesisrecon.stereo._cost import census, cost_volume, prepare_stereo_images, support_masks
from thesisrecon.stereo.correspondence import Correspondence
from thesisrecon.stereo.scanline import NO_MATCH, OCCLUDED, _solve_row
from thesisrecon.stereo.semi_global import adaptive_P2, scratch_size, sum_paths


def random_side(rng, height=13, width=21, channels=3):
    values = rng.integers(0, 200, (channels, height, width)).astype(np.int16)
    valid = np.where(rng.random((height, width)) < 0.9, 255, 0).astype(np.uint8)
    return census(values.sum(axis=0, dtype=np.int16)), values, valid


def test_channels_and_census_of_valid_and_invalid_pixels():
    image = np.array([[[0.0, 255.0], [10.1, np.nan]], [[300.0, -4.0], [np.inf, 1.0]]], np.float32)
    side = prepare_stereo_images(image, image)[0]
    channels, grey, valid = side.channels, side.grey, side.valid
    assert valid.tolist() == [[255, 0], [255, 0]]
    assert channels[0].tolist() == [[0, 40], [1020, 0]]
    assert channels[1].tolist() == [[1020, 0], [0, 4]]
    assert (grey == channels.sum(axis=0)).all()
    bits, channels, _ = random_side(np.random.default_rng(1))
    grey = channels.sum(axis=0)
    around = sliding_window_view(np.pad(grey, 2, mode="edge"), (5, 5)).reshape(*grey.shape, 25)
    darker = np.delete(around < grey[..., None], 12, axis=2)
    assert (bits == darker @ (1 << np.arange(24)[::-1])).all()


@pytest.mark.parametrize(("first", "n"), [(0, 6), (-4, 9), (15, 12), (30, 3), (-40, 3)])
def test_costs_and_their_means_over_supports_equal_plain_loops(first, n):
    rng = np.random.default_rng(2)
    left, right = random_side(rng), random_side(rng)
    left[1][:] //= 8
    (bits, levels, valid), (bits2, levels2, valid2) = left, right
    height, width = bits.shape
    found, costs = np.empty((height, n, width), np.uint8), np.full((height, n, width), 33)
    for y, q, x in np.ndindex(costs.shape):
        u = x - first - q
        if 0 <= u < width and valid[y, x] and valid2[y, u]:
            apart = np.abs(levels[:, y, x].astype(int) - levels2[:, y, u]).sum()
            ones = int(bits[y, x] ^ bits2[y, u]).bit_count()
            costs[y, q, x] = (400 * ones + 9 * min(apart, 300)) >> 8
    given = left, right, np.zeros((4, 2, height, width), np.uint8), first, np.array([400, 9, 300], np.int16)
    cost_volume(*given, np.uint8(33), found)
    assert (found == costs).all()

    def arm(y, x, dy, dx):
        for s in (1, 2):
            v, u = y + s * dy, x + s * dx
            if not (0 <= v < height and 0 <= u < width and valid[v, u]):
                return s - 1
            if (np.abs(levels[:, v, u] - levels[:, y, x]) > 12).any():
                return s - 1
        return 2

    masks = support_masks(levels, valid, np.int16(12))
    steps = ((0, -1), (0, 1), (-1, 0), (1, 0))
    arms = np.array([[[arm(y, x, *step) for x in range(width)] for y in range(height)] for step in steps])
    assert (masks == np.where(arms[:, None] > np.arange(2)[:, None, None], 255, 0)).all()
    assert set(np.unique(arms)) == {0, 1, 2}
    cost_volume(left, right, masks, *given[3:], np.uint8(33), found)
    for y, x in np.ndindex(height, width):
        north, south = arms[2:, y, x]
        rows = [
            costs[v, :, x - arms[0, v, x] : x + arms[1, v, x] + 1] for v in range(y - north, y + south + 1)
        ]
        mean = np.concatenate(rows, axis=1).mean(axis=1)
        assert np.abs(found[y, :, x] - mean).max() < 0.501


@pytest.mark.parametrize("shape", [(11, 6, 14), (200, 1, 9), (1, 5, 8), (6, 4, 1)])
def test_sums_of_paths(shape):
    rng = np.random.default_rng(5)
    height, _, width = shape
    costs = rng.integers(0, 49, shape).astype(np.uint8)
    grey = rng.integers(0, 3000, (height, width)).astype(np.int16)
    jumps = adaptive_P2(grey, 70.0, 30.0, 200.0)

    def penalty(y, x, v, u):
        return int(max(30.0, 70.0 * 200.0 / (200.0 + abs(int(grey[y, x]) - int(grey[v, u])))))

    total = np.empty((2, *shape), np.uint8)
    sum_paths(costs, jumps, np.uint8(20), total, np.empty((2, scratch_size(*shape)), np.uint8))
    for found, (dy, dx) in zip(total, [(0, 1), (1, 0)], strict=True):
        there, back = (path_sum(costs, penalty, 20, (s * dy, s * dx)) for s in (1, -1))
        assert (found == there + back).all()


def test_best_disparities_of_both_sides_equal_plain_loops():
    sums = np.random.default_rng(6).integers(0, 250, (2, 5, 7, 15)).astype(np.uint8)
    left, right, confidence = (np.empty((3, 15), np.float32) for _ in range(3))
    _postprocessing.best_disparities(sums, 1, -2, (left, right, confidence), 40.0)
    total = sums.sum(axis=0, dtype=int)[1:4]
    for y, x in np.ndindex(3, 15):
        mine = total[y, :, x]
        best = int(mine.argmin())
        a, b = (mine[best - 1] - mine[best], mine[best + 1] - mine[best]) if 0 < best < 6 else (1, 1)
        assert left[y, x] == pytest.approx(best - 2 + 0.5 * (a - b) / max(a, b))
        margin = min(value for q, value in enumerate(mine) if abs(q - best) > 1) - mine[best]
        assert confidence[y, x] == pytest.approx(margin / (margin + 40.0))
        seen = {q: total[y, q, x + q - 2] for q in range(7) if 0 <= x + q - 2 < 15}
        assert right[y, x] == min(seen, key=lambda q: (seen[q], q)) - 2


def test_contradictions_and_peaks_go_and_pinholes_are_filled():
    disparity = np.zeros((9, 12), np.float32)
    disparity[2:4, 2:4] = 5.0
    disparity[:, 8:] += np.arange(1, 5, dtype=np.float32)
    before = disparity.copy()
    _postprocessing.remove_speckles(disparity, np.ones((9, 12), bool), np.float32(1.0), 5)
    gone = np.isnan(disparity)
    assert gone.sum() == 4
    assert gone[2:4, 2:4].all()
    assert (disparity[~gone] == before[~gone]).all()
    _postprocessing.remove_speckles(disparity, np.zeros((9, 12), bool), np.float32(1.0), 5)
    assert np.isnan(disparity).all()
    disparity = np.arange(30, dtype=np.float32).reshape(5, 6)
    disparity[2, 2] = np.nan
    disparity[:, 5] = np.nan
    out = _postprocessing.fill_pinholes(disparity, 5)
    assert out[2, 2] == np.nanmedian(disparity[1:4, 1:4])
    assert np.isnan(out[:, 5]).all()
    known = ~np.isnan(disparity)
    assert (out[known] == disparity[known]).all()
    left = np.array([[2.0, 1.0, 1.0, 1.2, np.nan, 3.0]], np.float32)
    right = np.array([[1.0, 1.0, 3.0, 1.0, 1.0, np.nan]], np.float32)
    confidence = np.ones((1, 6), np.float32)
    _postprocessing.check_left_right(left, right, confidence, 1.0, 0.1)
    np.testing.assert_array_equal(left, np.array([[np.nan, 1, 1, np.nan, np.nan, 3]], np.float32))
    confidence[0, 1] = 0.05
    _postprocessing.check_left_right(left, right, confidence, 1.0, 0.1)
    assert np.isnan(left[0, 1])
    assert left[0, 2] == 1.0


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("first", "n"), [(0, 5), (-3, 6), (2, 4)])
def test_rows_of_greatest_likelihood(first, n, seed):
    rng = np.random.default_rng(seed)
    width = 12
    costs = rng.integers(0, 30, (n, width)).astype(np.int32)
    costs[rng.random(costs.shape) < 0.1] = NO_MATCH
    for q in range(n):
        x = np.arange(width)
        costs[q, (x - first - q < 0) | (x - first - q >= width)] = NO_MATCH
    above = tuple(
        np.where(rng.random(width) < 0.3, OCCLUDED, rng.integers(first, first + n, width)).astype(np.int32)
        for _ in range(2)
    )
    left, right = np.empty(width, np.int32), np.empty(width, np.int32)
    for prices in ((11, 5), (11, 11), (40, 5)):
        _solve_row(costs, first, prices, above, left, right)
        found = price_of(costs, first, prices, above, left, right)
        assert found == most_likely_row(costs, first, prices, above)


def price_of(costs, first, prices, above, left, right):
    """Cost and discontinuities of a correspondence; it must be ordered and unique."""
    width = costs.shape[1]
    pairs = [(x, x - int(left[x])) for x in range(width) if left[x] != OCCLUDED]
    assert all(right[j] == x - j for x, j in pairs)
    assert (right != OCCLUDED).sum() == len(pairs)
    assert all(b[0] > a[0] and b[1] > a[1] for a, b in itertools.pairwise(pairs))
    # No other match is left: the dynamic program returns the cost of these alone.
    fixed = np.full_like(costs, NO_MATCH)
    for x, j in pairs:
        fixed[x - j - first, x] = costs[x - j - first, x]
    return most_likely_row(fixed, first, prices, above)


def path_sum(costs, penalty, step, direction):
    """Least costs (H, D, W) of paths that arrive by ``direction`` (dy, dx); ``penalty(y, x, v, u)``."""
    height, _, width = costs.shape
    out, (dy, dx) = costs.astype(np.int64), direction
    rows, columns = (range(n)[:: -1 if d < 0 else 1] for n, d in ((height, dy), (width, dx)))
    for y, x in itertools.product(rows, columns):
        v, u = y - dy, x - dx
        if 0 <= v < height and 0 <= u < width:
            before = out[v, :, u]
            padded = np.pad(before, 1, constant_values=10**6) + step
            far = before.min() + penalty(y, x, v, u)
            best = np.minimum(np.minimum(padded[:-2], padded[2:]), np.minimum(before, far))
            out[y, :, x] += best - before.min()
    return out


def most_likely_row(costs, first, prices, above):
    """(cost, discontinuities) of the best correspondence of a row, by recursion over whole solutions."""
    n, width = costs.shape
    hidden, border = prices
    best, ends = {}, []
    for i, j in itertools.product(range(width + 1), range(width + 1)):
        q = i - j - first
        if not 0 <= q < n:
            continue
        # A row begins with pixels beyond the border of one image: no state is a break there.
        found = {0: [((i + j) * border, 0)] if 0 in (i, j) else [], 1: [], 2: []}
        for state, (a, b) in enumerate(((i - 1, j - 1), (i - 1, j), (i, j - 1))):
            if 0 in (i, j) or (state == 0 and costs[q, i - 1] == NO_MATCH):
                continue
            up, aside = above[0][i - 1], above[1][j - 1]
            if state == 0:
                price, breaks = int(costs[q, i - 1]), sum(d not in (OCCLUDED, i - j) for d in (up, aside))
            else:
                price, breaks = hidden, (up if state == 1 else aside) != OCCLUDED
            for before in range(3):
                if (a, b, before) in best:
                    cost, count = best[a, b, before]
                    found[state].append((cost + price, count + (before != state) + breaks))
        for state, values in found.items():
            if values:
                best[i, j, state] = cost, count = min(values)
                if width in (i, j):
                    ends.append((cost + (2 * width - i - j) * border, count))
    return min(ends)


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
    rho, std = _depth_fusion.inverse_depths(np.eye(3, 4), np.column_stack([H, e]), Correspondence(xy, sigma))
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
    found = _depth_fusion.fuse_inverse_depths(list(zip(rho, std, strict=True)), SHAPE)
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
    assert (found.views == party.sum(0)).all()
    assert (found.conflicts == np.isfinite(rho).sum(0) - party.sum(0)).all()
    np.testing.assert_allclose(found.value, mean, rtol=1e-5)
    np.testing.assert_allclose(found.std, wanted_std, rtol=1e-4)


def test_the_filter_ends_at_the_first_outlier():
    rng = np.random.default_rng(2)
    rho, std = holes(rng, rng.uniform(1.0, 1.1, SHAPE)), np.full(SHAPE, 0.05, np.float32)
    new, new_std = holes(rng, rng.uniform(0.8, 1.3, SHAPE)), np.full(SHAPE, 0.03, np.float32)
    alive, support = rng.random(SHAPE) < 0.8, (~np.isnan(rho)).astype(np.uint8)
    before, was = rho.copy(), alive.copy()
    _depth_fusion.update_kalman(_depth_fusion.InverseDepth(rho, std, support, support), (new, new_std), alive)
    inside = np.abs(new - before) <= 3.0 * np.hypot(0.05, 0.03)
    first, measured = np.isnan(before), np.isfinite(new)
    taken = was & measured & (first | inside)
    assert (alive == taken).all()
    gain = 0.05**2 / (0.05**2 + 0.03**2)
    wanted = np.where(first, new, before + gain * (new - before))
    np.testing.assert_allclose(rho, np.where(taken, wanted, before), rtol=1e-5)
    assert (support == ~first + taken.astype(int)).all()
    np.testing.assert_allclose(std[taken & ~first], np.sqrt(1.0 - gain) * 0.05, rtol=1e-5)


def test_planes_are_fitted_to_similar_pixels():
    rng = np.random.default_rng(4)
    xy = pixels()
    rho = (1.0 + 1e-3 * xy[..., 0] - 2e-3 * xy[..., 1]).astype(np.float32)
    rho[:, 20:] += 0.5
    rho = holes(rng, rho)
    planes, known = _depth_fusion.fit_planes(rho, 3), np.isfinite(rho)
    np.testing.assert_array_equal(planes[..., 0], rho)
    np.testing.assert_allclose(planes[known, 1], 1e-3, atol=2e-6)
    np.testing.assert_allclose(planes[known, 2], -2e-3, atol=2e-6)

"""Compiled loops against their plain twins."""

import itertools

import numpy as np
import pytest

from tests.stereo import twins
from thesisrecon.stereo import _postprocessing
from thesisrecon.stereo._cost import census, cost_volume, split_channels, support_masks
from thesisrecon.stereo.scanline import NO_MATCH, OCCLUDED, _solve_row
from thesisrecon.stereo.semi_global import adaptive_P2, scratch_size, sum_paths


def random_side(rng, height=13, width=21, channels=3):
    values = rng.integers(0, 200, (channels, height, width)).astype(np.int16)
    valid = np.where(rng.random((height, width)) < 0.9, 255, 0).astype(np.uint8)
    bits = np.empty((height, width), np.int32)
    census(values.sum(axis=0, dtype=np.int16), bits)
    return bits, values, valid


def test_channels_are_quarter_levels_and_invalid_pixels_are_rejected():
    image = np.array([[[0.0, 255.0], [10.1, np.nan]], [[300.0, -4.0], [np.inf, 1.0]]], np.float32)
    channels, grey = np.empty((2, 2, 2), np.int16), np.empty((2, 2), np.int16)
    valid = np.empty((2, 2), np.uint8)
    split_channels(image, channels, grey, valid)
    assert valid.tolist() == [[255, 0], [255, 0]]
    assert channels[0].tolist() == [[0, 40], [1020, 0]]
    assert channels[1].tolist() == [[1020, 0], [0, 4]]
    assert (grey == channels.sum(axis=0)).all()


def test_census():
    bits, channels, _ = random_side(np.random.default_rng(1))
    assert (bits == twins.census(channels.sum(axis=0))).all()


@pytest.mark.parametrize(("first", "n"), [(0, 6), (-4, 9), (15, 12), (30, 3), (-40, 3)])
def test_costs_of_pixels(first, n):
    rng = np.random.default_rng(2)
    left, right = random_side(rng), random_side(rng)
    weights = np.array([400, 9, 300], np.int16)
    volume = np.empty((13, n, 21), np.uint8)
    none = np.empty((4, 0, 13, 21), np.uint8)
    cost_volume(left, right, none, first, weights, np.uint8(33), volume)
    assert (volume == twins.costs(left, right, first, n, weights, 33)).all()


def test_costs_over_supports():
    rng = np.random.default_rng(3)
    left, right = random_side(rng), random_side(rng)
    left[1][:] //= 8
    masks = np.empty((4, 2, 13, 21), np.uint8)
    support_masks(left[1], left[2], np.int16(12), masks)
    arms = twins.arm_lengths(left[1], left[2], 12)
    assert ((masks > 0).sum(axis=1) == arms).all()
    assert set(np.unique(arms)) == {0, 1, 2}
    weights = np.array([400, 9, 300], np.int16)
    volume = np.empty((13, 7, 21), np.uint8)
    cost_volume(left, right, masks, -2, weights, np.uint8(33), volume)
    pixels = twins.costs(left, right, -2, 7, weights, 33)
    assert np.abs(volume - twins.mean_over_support(pixels, arms)).max() <= 1
    assert np.mean(volume == twins.mean_over_support(pixels, arms)) > 0.99


@pytest.mark.parametrize("pairs", [2, 4])
@pytest.mark.parametrize("shape", [(11, 6, 14), (200, 1, 9), (1, 5, 8), (6, 4, 1)])
def test_sums_of_paths(shape, pairs):
    rng = np.random.default_rng(5)
    height, _, width = shape
    costs = rng.integers(0, 49, shape).astype(np.uint8)
    grey = rng.integers(0, 3000, (height, width)).astype(np.int16)
    jumps = np.empty((4, height, width), np.uint8)
    adaptive_P2(grey, np.float32(70.0), np.float32(30.0), np.float32(200.0), jumps)

    def penalty(y, x, v, u):
        apart = abs(int(grey[y, x]) - int(grey[v, u]))
        return int(max(30.0, 70.0 * 200.0 / (200.0 + apart)))

    total = np.empty((pairs, *shape), np.uint8)
    scratch = np.empty((2, scratch_size(*shape)), np.uint8)
    sum_paths(costs, jumps, np.uint8(20), total, scratch)
    directions = [(0, 1), (1, 0), (1, 1), (1, -1)]
    for k in range(pairs):
        dy, dx = directions[k]
        there = twins.path_sum(costs, penalty, 20, (dy, dx))
        assert (total[k] == there + twins.path_sum(costs, penalty, 20, (-dy, -dx))).all()


def test_best_disparities_of_both_sides():
    rng = np.random.default_rng(6)
    sums = rng.integers(0, 250, (2, 5, 7, 15)).astype(np.uint8)
    left, right, confidence = (np.empty((3, 15), np.float32) for _ in range(3))
    _postprocessing.best_disparities(sums, 1, -2, (left, right, confidence), 40.0)
    total = sums.sum(axis=0, dtype=int)[1:4]
    best = total.argmin(axis=1)
    assert (np.abs(left - (best - 2)) <= 0.5).all()
    for y, x in np.ndindex(3, 15):
        mine = total[y, :, x]
        rivals = [value for q, value in enumerate(mine) if abs(q - best[y, x]) > 1]
        margin = min(rivals) - mine.min()
        assert confidence[y, x] == pytest.approx(margin / (margin + 40.0))
        seen = {q: total[y, q, x + q - 2] for q in range(7) if 0 <= x + q - 2 < 15}
        assert right[y, x] == min(seen, key=lambda q: (seen[q], q)) - 2


def test_sides_that_contradict_each_other():
    left = np.array([[2.0, 1.0, 1.0, 1.2, np.nan, 3.0]], np.float32)
    right = np.array([[1.0, 1.0, 3.0, 1.0, 1.0, np.nan]], np.float32)
    confidence = np.ones((1, 6), np.float32)
    _postprocessing.check_left_right(left, right, confidence, 1.0, 0.1)
    np.testing.assert_array_equal(left, np.array([[np.nan, 1, 1, np.nan, np.nan, 3]], np.float32))
    confidence[0, 1] = 0.05
    _postprocessing.check_left_right(left, right, confidence, 1.0, 0.1)
    assert np.isnan(left[0, 1])
    assert left[0, 2] == 1.0


def test_peaks_go_and_surfaces_stay_where_there_is_texture():
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


def test_pinholes_take_the_median_and_large_holes_stay():
    disparity = np.arange(30, dtype=np.float32).reshape(5, 6)
    disparity[2, 2] = np.nan
    disparity[:, 5] = np.nan
    out = _postprocessing.fill_pinholes(disparity, 5)
    assert out[2, 2] == np.nanmedian(disparity[1:4, 1:4])
    assert np.isnan(out[:, 5]).all()
    known = ~np.isnan(disparity)
    assert (out[known] == disparity[known]).all()


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
    for prices in ((11, 5, 1, 1), (11, 11, 1, 0), (11, 5, 0, 0), (40, 5, 1, 1)):
        _solve_row(costs, first, prices, above, left, right)
        found = price_of(costs, first, prices, above, left, right)
        assert found == twins.most_likely_row(costs, first, prices, above)


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
    return twins.most_likely_row(fixed, first, prices, above)

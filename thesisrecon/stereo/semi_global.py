"""Semi-global matching of rectified pairs (thesis, section 2.5; Hirschmüller, PAMI 30(2), 2008).

It sums the minimal costs of the four paths that reach a pixel along its row and column. Occlusions are found
afterwards by the left-right check. All inner loops run over pixels of a row so that the compiler vectorises
them; horizontal paths are computed on transposed blocks.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon._numba import copy_to, empty, full, kernel, zeros
from thesisrecon.arrays import I16, U8
from thesisrecon.errors import require_range
from thesisrecon.records import DisparityMap
from thesisrecon.stereo import _cost, _postprocessing

TOP = 127  #: upper limit of matching cost plus penalty: the sum of two opposite path costs then fits one byte
BLOCK = 192  #: rows transposed together for the horizontal paths
TILE = 64  #: rows and columns transposed together
P1, P2, MIN_P2 = 0.43, 1.6, 0.65
"""Penalties of a disparity change of 1, of larger ones, and limit of the adapted P2, in maximal costs."""
MAX_COST = int(TOP / (1.0 + P2))
"""Maximal matching cost: the largest for which cost and penalty fit one byte."""


def adaptive_P2(grey: I16, largest: float, least: float, scale: float) -> U8:
    """Penalties P2 (2, H, W) from the left and the upper neighbour of each pixel.

    They decrease with the intensity step, ``largest`` / (1 + step / ``scale``), at least ``least``
    (Hirschmüller 2008, section 2.2).
    """
    penalties = np.full((2, *grey.shape), largest, np.uint8)
    top, width = np.float32(largest) * np.float32(scale), np.float32(scale)
    for axis, out in ((1, penalties[0, :, 1:]), (0, penalties[1, 1:])):
        step = np.abs(np.diff(grey.astype(np.float32), axis=axis))
        out[:] = np.maximum(top / (width + step), np.float32(least))
    return penalties


@kernel
def _extend(cost: U8, before: tuple[U8, U8, U8], base: U8, p2: U8, P1: np.uint8, path: U8, least: U8) -> None:
    """Path costs of one disparity: L = C + min(L'(d), L'(d +- 1) + P1, min L' + P2) - min L'."""
    # `before` are the rows L'(d - 1), L'(d), L'(d + 1) of the previous pixels, `base` their minimum over d;
    # `least` is updated with the minimum of this row.
    below, same, above = before
    for x in range(len(cost)):
        # Loads precede the selections: a load inside one would prevent vectorisation.
        near, other, value, floor = below[x], above[x], same[x], base[x]
        near = other if other < near else near
        near = np.uint8(near + P1)
        value = near if near < value else value
        far = np.uint8(floor + p2[x])
        value = far if far < value else value
        value = np.uint8(np.uint8(value - floor) + cost[x])
        path[x] = value
        so_far = least[x]
        least[x] = value if value < so_far else so_far


@kernel
def _extend_row(
    cost: U8, before: U8, base: U8, p2: U8, P1: np.uint8, unreachable: U8, path: U8, least: U8
) -> None:
    """Path costs (D, W) of a row from the previous one, of penalties ``p2``."""
    n = len(cost)
    least[:] = 255
    for q in range(n):
        below = before[q - 1] if q > 0 else unreachable
        above = before[q + 1] if q < n - 1 else unreachable
        _extend(cost[q], (below, before[q], above), base, p2, P1, path[q], least)


@kernel
def _sum_opposite(costs: U8, P2: U8, P1: np.uint8, total: U8) -> None:
    """Sum path costs from above and the opposite ones to ``total`` (N, D, W)."""
    rows, n, width = costs.shape
    unreachable = full(width, np.uint8(255 - P1), np.uint8)
    # Paths begin behind a row of zeros.
    paths, least = zeros((2, n, width), np.uint8), zeros((2, width), np.uint8)
    before = paths[0]
    for y in range(rows):
        # The sum still holds the path from above only, from which the next row continues.
        _extend_row(costs[y], before, least[y & 1], P2[y], P1, unreachable, total[y], least[(y + 1) & 1])
        before = total[y]
    least[0] = 0
    for k in range(rows):
        y = rows - 1 - k
        p2, path = P2[min(y + 1, rows - 1)], paths[(k + 1) & 1]
        _extend_row(costs[y], paths[k & 1], least[k & 1], p2, P1, unreachable, path, least[(k + 1) & 1])
        for q in range(n):
            values, sums = path[q], total[y, q]
            for x in range(width):
                sums[x] = np.uint8(sums[x] + values[x])


@kernel
def _transpose(source: U8, out: U8) -> None:
    """Transpose (N, D, W) to (W, D, N)."""
    # Tiles stay in the cache; their rows are longer than a power of two, which would map them to few lines.
    rows, n, width = source.shape
    tile = empty((TILE, TILE + 8), np.uint8)
    for q in range(n):
        for top in range(0, rows, TILE):
            high = min(TILE, rows - top)
            for left in range(0, width, TILE):
                wide = min(TILE, width - left)
                for y in range(high):
                    copy_to(tile[y, :wide], source[top + y, q, left : left + wide])
                for x in range(wide):
                    column = out[left + x, q, top : top + high]
                    for y in range(high):
                        column[y] = tile[y, x]


def scratch_size(height: int, disparities: int, width: int) -> int:
    """Bytes of a block of transposed costs."""
    return width * disparities * min(height, BLOCK)


@kernel
def sum_paths(costs: U8, P2: U8, P1: np.uint8, total: U8, scratch: U8) -> None:
    """Sum the minimal costs of all paths that end in a pixel of costs (H, D, W), two at a time."""
    # `P2` (2, H, W) of `adaptive_P2`; `total` (2, H, D, W): along rows, along columns.
    height, n, width = costs.shape
    # Horizontal paths are sequential in x: transposed rows are vectorised over y.
    for start in range(0, height, BLOCK):
        rows = min(BLOCK, height - start)
        transposed = scratch[0, : width * n * rows].reshape((width, n, rows))
        summed = scratch[1, : width * n * rows].reshape((width, n, rows))
        _transpose(costs[start : start + rows], transposed)
        p2 = zeros((width, rows), np.uint8)
        for y in range(rows):
            copy_to(p2[:, y], P2[0, start + y])
        _sum_opposite(transposed, p2, P1, summed)
        _transpose(summed, total[0, start : start + rows])
    _sum_opposite(costs, P2[1], P1, total[1])


@dataclass(frozen=True)
class SemiGlobalMatching:
    """Semi-global matching with census and colour costs.

    The cost is the Hamming distance of 5 x 5 census transforms (Zabih and Woodfill 1994), which are invariant
    to exposure, plus the truncated colour difference, which distinguishes regions of equal pattern. Costs are
    averaged over cross-shaped regions (Zhang, Lu and Lafruit 2009) with arms of 2 pixels. They improve little
    with diagonal paths, which extend foreground disparities beyond the corners of objects.
    """

    census_share: float = 0.56  #: share of the census in the maximal cost; the colours have the rest
    truncation: float = 10.0  #: largest colour difference in the cost, in standard deviations of the noise

    # Limit for costs and path sums of one strip of rows.
    memory_mb = 256.0

    def __post_init__(self) -> None:
        require_range(self, census_share="[0, 1]", truncation="(0, inf]")

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Compute the disparities of the left image, NaN where occluded or ambiguous.

        The images (H, W) or (H, W, K <= 4) hold grey levels 0 .. 255, NaN = no pixel. The range includes both
        ends, of either sign; x_right = x_left - d.
        """
        # Standard deviation in grey levels of quantisation and viewpoint change, added to the image noise.
        min_noise = 1.0
        first, last = _cost.checked_range(disparity_range)
        images = _cost.prepare_stereo_images(left, right)
        measured = float(np.mean([_cost.estimate_noise(image) for image in images]))
        noise = float(np.hypot(min_noise, measured))
        (height, width), n = images[0].valid.shape, last - first + 1
        bits = [_cost.census(image.grey) for image in images]
        # The colour difference at which an arm of the support ends is five standard deviations.
        tolerance = np.int16(min(round(5.0 * noise * _cost.LEVELS), 255 * _cost.LEVELS))
        arms = _cost.support_masks(images[0].channels, images[0].valid, tolerance)
        # A partner outside the image costs a share of the maximal cost.
        weights, outside = self._weights(len(images[0].channels), noise), np.uint8(round(0.4 * MAX_COST))
        edge = 14.0  # Intensity step that halves P2, in standard deviations of the noise
        scale, P1_cost = edge * noise * _cost.LEVELS * len(images[0].channels), np.uint8(round(P1 * MAX_COST))
        penalties = adaptive_P2(images[0].grey, P2 * MAX_COST, MIN_P2 * MAX_COST, scale)
        # Confidence 1/2 if the second best disparity costs P1 more on every path.
        half = float(4 * P1 * MAX_COST)
        found = np.empty((3, height, width), np.float32)
        # One byte per pixel and disparity for the cost, and one for each of two pairs of opposite paths.
        memory = 1e6 * self.memory_mb
        room = max(memory - 2 * scratch_size(height, n, width), 0.5 * memory)
        for start, stop, top, bottom in _cost.row_strips(height, 3 * width * n, room):
            rows = slice(top, bottom)
            features = [
                (bits[side][rows], np.ascontiguousarray(image.channels[:, rows]), image.valid[rows])
                for side, image in enumerate(images)
            ]
            # One allocation gets large memory pages.
            cells, transposed = (bottom - top) * n * width, scratch_size(bottom - top, n, width)
            whole = np.empty(3 * cells + 2 * transposed, np.uint8)
            volume, sums, scratch = np.split(whole, [cells, 3 * cells])
            volume, sums = volume.reshape(-1, n, width), sums.reshape(2, -1, n, width)
            support = np.ascontiguousarray(arms[:, :, rows])
            _cost.cost_volume(features[0], features[1], support, first, weights, outside, volume)
            steps = np.ascontiguousarray(penalties[:, rows])
            sum_paths(volume, steps, P1_cost, sums, scratch.reshape(2, transposed))
            own = found[:, start:stop]
            _postprocessing.best_disparities(sums, start - top, first, (own[0], own[1], own[2]), half)
        found[0][images[0].valid == 0] = np.nan
        # The disparities of the left image are checked, filtered and smoothed.
        disparity, right_disparity, confidence = found
        texture = _postprocessing.texture_of(images[0], measured)
        step = np.float32(1.0)  # Largest disparity difference of neighbours on one surface
        _postprocessing.check_left_right(disparity, right_disparity, confidence, largest_px=1.0, least=0.02)
        # Noise does not reach this texture. Smaller regions, and larger ones without texture, are removed.
        _postprocessing.remove_speckles(disparity, texture > np.float32(1.7), step, 60)
        refined = _postprocessing.refine_by_gradient(disparity, *images, passes=2)
        closed, smooth = _postprocessing.fill_pinholes(refined, least=5), np.empty_like(refined)
        closed[np.isnan(texture)] = np.nan
        _postprocessing.edge_preserving_mean(closed, step, 2, smooth)
        confidence = _postprocessing.final_confidence(confidence, refined, smooth, texture)
        return DisparityMap(smooth, confidence, _postprocessing.disparity_noise(closed, smooth))

    def _weights(self, channels: int, noise: float) -> I16:
        """Weights of a census bit and of a quarter level, and truncation, for noise in grey levels."""
        one = MAX_COST << _cost.WEIGHT_SHIFT
        unit = _cost.LEVELS * channels
        cap = min(max(round(self.truncation * noise * unit), channels), 255 * unit)
        of_bit = round(self.census_share * one / _cost.CENSUS_BITS)
        of_level = max(round((1.0 - self.census_share) * one / cap), int(self.census_share < 1.0))
        return np.array([of_bit, of_level, cap], np.int16)

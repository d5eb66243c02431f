"""Maximum-likelihood scanline matching by dynamic programming (thesis, section 2.5).

Cox, Hingorani, Rao and Maggs, "A maximum likelihood stereo algorithm", CVIU 63(3), 1996, [26] of the thesis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon._numba import full, kernel, zeros
from thesisrecon.arrays import F32, F64, I32, I64, U8
from thesisrecon.errors import require_range
from thesisrecon.records import DisparityMap
from thesisrecon.stereo._cost import LEVELS, StereoImage, checked_range, estimate_noise, prepare_stereo_images
from thesisrecon.stereo._postprocessing import final_confidence, texture_of

OCCLUDED = -32768  #: disparity of an occluded pixel
NO_MATCH = -1  #: cost of a match with a missing pixel
INFINITE = 1 << 60
RADIX = 1 << 24
"""Keys are cost * RADIX + number of discontinuities: the smaller key has the greater likelihood or, if equal,
fewer discontinuities.
"""
MATCHED, LEFT_OCCLUDED, RIGHT_OCCLUDED = 0, 1, 2
ROWS, WARM_UP = 96, 8  #: rows of a strip, and rows above it that are solved first to provide a previous row


@kernel
def _trace_back(states: U8, last: tuple[int, int, int], first: int, left: I32, right: I32) -> None:
    i, q, state = last
    while i > 0 and i - (q + first) > 0:
        before = (states[i, q] >> (2 * state)) & 3
        if state == MATCHED:
            left[i - 1] = q + first
            right[i - (q + first) - 1] = q + first
            i -= 1
        elif state == LEFT_OCCLUDED:
            i -= 1
            q -= 1
        else:
            q += 1
        state = before


@kernel
def _least(matched: int, left_occluded: int, right_occluded: int) -> tuple[int, int]:
    best, state = matched, MATCHED
    state = LEFT_OCCLUDED if left_occluded < best else state
    best = min(left_occluded, best)
    state = RIGHT_OCCLUDED if right_occluded < best else state
    return min(right_occluded, best), state


@kernel
def _enter_column(
    i: int, first: int, costs: I32, occluded: int, above: tuple[I32, I32], keys: tuple[I64, I64], states: U8
) -> None:
    """Keys (3, D) of the nodes (i, j) from those with i - 1, and ``states`` (D,): predecessors, two bits."""
    n, width = costs.shape
    previous, present = keys
    up = above[0][i - 1]
    for q in range(min(n - 1, i - first - 1), max(-1, i - first - width - 1), -1):
        d = first + q
        aside = above[1][i - d - 1]
        # Unreachable keys stay far above all others and need no test.
        key, state = _least(previous[0, q], previous[1, q] + 1, previous[2, q] + 1)
        key += (up != OCCLUDED and up != d) + (aside != OCCLUDED and aside != d)
        cost = costs[q, i - 1]
        present[0, q] = key + cost * RADIX if cost != NO_MATCH else INFINITE
        traced = state
        if q > 0:
            key, state = _least(previous[0, q - 1] + 1, previous[1, q - 1], previous[2, q - 1] + 1)
            present[1, q] = key + occluded + (up != OCCLUDED)
            traced |= state << 2
        if q < n - 1:
            key, state = _least(present[0, q + 1] + 1, present[1, q + 1] + 1, present[2, q + 1])
            present[2, q] = key + occluded + (aside != OCCLUDED)
            traced |= state << 4
        states[q] = traced


@kernel
def _solve_row(
    costs: I32, first: int, penalties: tuple[int, int], above: tuple[I32, I32], left: I32, right: I32
) -> None:
    """Find the maximum-likelihood correspondences of one row from costs (D, W), ``NO_MATCH`` without a match.

    A node (i, j) has passed i left and j right pixels, i - j = d; it is entered by a match or an occluded
    left or right pixel, its three states. Of equal likelihoods the fewest discontinuities, to the row
    ``above`` too, count. ``penalties``: of an occluded pixel and one out of view; ``left``, ``right`` (W,):
    ``OCCLUDED`` or disparities.
    """
    n, width = costs.shape
    occluded, border = penalties
    keys = full((2, 3, n), INFINITE, np.int64)
    states = zeros((width + 1, n), np.uint8)
    best, last = INFINITE, (0, 0, MATCHED)
    left[:], right[:] = OCCLUDED, OCCLUDED
    for i in range(width + 1):
        previous, present = keys[1 - (i & 1)], keys[i & 1]
        present[:] = INFINITE
        if i - first >= 0 and i - first < n:
            present[MATCHED, i - first] = i * border * RADIX
        if i > 0:
            _enter_column(i, first, costs, occluded * RADIX, above, (previous, present), states[i])
        else:
            for q in range(min(n, -first)):
                if first + q >= -width:
                    present[MATCHED, q] = -(first + q) * border * RADIX
        q_end = i - width - first
        for q in range(n) if i == width else range(max(q_end, 0), min(q_end + 1, n)):
            j = i - first - q
            if 0 <= j <= width:
                for state in range(3):
                    key = present[state, q] + (2 * width - i - j) * border * RADIX
                    if key < best:
                        best, last = key, (i, q, state)
    if best < INFINITE:
        _trace_back(states, last, first, left, right)


def _row_costs(
    sides: Sequence[StereoImage], rows: slice, disparities: range, radius: int, scale: float
) -> I32:
    """Costs (H, D, W) of some rows: squared differences summed over channels and window, times ``scale``."""
    left, right = [(side.channels[:, rows].astype(np.int32), side.valid[rows] > 0) for side in sides]
    height, width = left[1].shape
    costs = np.full((height, len(disparities), width), NO_MATCH, np.int32)
    for q, d in enumerate(disparities):
        lo, hi = min(max(d, 0), width), max(min(width, width + d), 0)
        if hi > lo:
            here, there = np.s_[..., lo:hi], np.s_[..., lo - d : hi - d]
            total = ((left[0][here] - right[0][there]) ** 2).sum(axis=0, dtype=np.int32)
            for axis in (0, 1):
                total = scipy.ndimage.correlate1d(total, np.ones(2 * radius + 1), axis, mode="nearest")
            known = left[1][here] & right[1][there]
            costs[:, q, lo:hi] = np.where(known, (total * scale + 0.5).astype(np.int32), NO_MATCH)
    return costs


def _posterior(costs: I32, first: int, found: I32, likelihood: F64) -> F32:
    """Probability (W,) of the disparities found, or adjacent ones, among all of a row's costs (D, W)."""
    known = costs != NO_MATCH
    least = np.where(known, costs, np.iinfo(np.int32).max).min(axis=0)
    share = np.where(known, likelihood[np.clip(costs - least, 0, len(likelihood) - 1)], 0.0)
    near = np.abs(np.arange(first, first + len(costs))[:, None] - found) <= 1
    total = np.where(found == OCCLUDED, 1.0, share.sum(axis=0))
    return np.asarray(np.where(near, share, 0.0).sum(axis=0) / total, np.float32)


@dataclass(frozen=True)
class MaximumLikelihoodScanline:
    """Dynamic programming for the maximum-likelihood correspondences of every scanline.

    Two measurements of one scene point are normal about its true value with variance s^2 in each of their m
    components; with the mean as the unknown true value a match costs |z - z'|^2 / (4 s^2). An occluded pixel
    costs ln(P_D phi^m / ((1 - P_D) (2 pi s^2)^(m / 2))) with the detection probability P_D and values uniform
    over phi = 256 grey levels. Ordering and uniqueness hold by construction, and occlusions are part of the
    solution. Among solutions of equal likelihood the one with the fewest discontinuities is taken (MLMH+V).
    """

    radius: int = 1
    """A measurement consists of the colours within this radius; the paper uses single pixels (0)."""
    out_of_view: bool = True
    """Pixels outside the other camera's view cost as much as an expected match, which does not bias the
    disparities; the paper charges them as occluded, which pulls both row ends to disparity 0."""

    def __post_init__(self) -> None:
        require_range(self, radius="[0, 4]")

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """See `thesisrecon.stereo.semi_global.SemiGlobalMatching.match`; the disparities are whole numbers.

        The confidence is the probability of the disparity (or an adjacent one) among the range given the two
        measurements alone, 3 / D if they are indistinguishable. It is reduced where texture is missing,
        because errors of neighbouring pixels are then not independent.
        """
        # Expected cost of a match per component: (z - z')^2 / (2 s^2) is chi-square distributed.
        match_nats = 0.5
        # Cost steps per nat; smaller differences are equal. The grey levels and s^2 = 4 of the paper give 16.
        steps_per_nat = 16.0
        significant = 30.0  # Nats above the minimum from which the probability is taken as 0
        rounding_px = float(1.0 / np.sqrt(12.0))  # Standard deviation of an integer disparity
        min_variance = 4.0  # Variance s^2 of the paper; that of the measured image noise is added
        first, last = checked_range(disparity_range)
        sides = prepare_stereo_images(left, right)
        noise = float(np.mean([estimate_noise(side) for side in sides]))
        variance = min_variance + noise**2
        components = len(sides[0].channels) * (2 * self.radius + 1) ** 2
        occluded = _occlusion_cost(components, variance)
        scale = steps_per_nat / (4.0 * variance * LEVELS**2)
        border = match_nats * components if self.out_of_view else occluded
        penalties = round(steps_per_nat * occluded), round(steps_per_nat * border)
        likelihood = np.exp(-np.arange(int(significant * steps_per_nat) + 2) / steps_per_nat)
        likelihood[-1] = 0.0
        height, width = sides[0].valid.shape
        disparity, confidence = np.empty((2, height, width), np.float32)
        for start in range(0, height, ROWS):
            top, bottom = max(start - WARM_UP, 0), min(start + ROWS + self.radius, height)
            costs = _row_costs(sides, slice(top, bottom), range(first, last + 1), self.radius, scale)
            above = np.full((2, width), OCCLUDED, np.int32)
            for y in range(top, min(start + ROWS, height)):
                found = np.empty((2, width), np.int32)
                _solve_row(costs[y - top], first, penalties, (above[0], above[1]), found[0], found[1])
                if y >= start:
                    disparity[y] = np.where(found[0] == OCCLUDED, np.float32(np.nan), found[0])
                    confidence[y] = _posterior(costs[y - top], first, found[0], likelihood)
                above = found
        confidence = final_confidence(confidence, disparity, disparity, texture_of(sides[0], noise))
        return DisparityMap(disparity, confidence, rounding_px)


def _occlusion_cost(components: int, variance: float) -> float:
    """Cost of an occluded pixel in nats, with m components of one variance s^2."""
    grey_range = 256.0  # Grey levels over which the value of an occluded pixel is uniformly distributed
    detection = 0.99  # Detection probability P_D
    odds = np.log(detection / (1.0 - detection))
    return float(odds + components * np.log(grey_range / np.sqrt(2.0 * np.pi * variance)))

"""Compiled maximum-likelihood scanline program (Cox, Hingorani, Rao and Maggs 1996).

Maximum likelihood stereo, [26] of the thesis (Cox, Hingorani, Rao and Maggs, CVIU 63, 1996).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from thesisrecon.arrays import F32, F64, I16, I32, I64, U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo.cost import Strip, checked_range, estimate_noise, prepare_pair, run_strips
from thesisrecon.stereo.cost_kernels import LEVELS
from thesisrecon.stereo.postprocessing import rate, texture_of

NOTHING = -32768
"""Disparity of a pixel that is hidden in the other image."""
FORBIDDEN = -1
"""Cost of a match where one of the pixels is none."""
ENDLESS = 1 << 60
RADIX = 1 << 24
"""A likelihood cost in steps times this, plus a number of discontinuities below it, is one key: the smaller
key has the greater likelihood or, of equal ones, fewer discontinuities."""
MATCHED, LEFT_HIDDEN, RIGHT_HIDDEN = 0, 1, 2


@njit(cache=True, nogil=True)
def _add_squares(a: I16, b: I16, out: I32) -> None:
    for x in range(len(out)):
        apart = np.int32(a[x]) - np.int32(b[x])
        out[x] = np.int32(out[x] + apart * apart)


@njit(cache=True, nogil=True)
def _add_row(values: I32, out: I32) -> None:
    for x in range(len(out)):
        out[x] = np.int32(out[x] + values[x])


@njit(cache=True, nogil=True)
def squared_differences(y: int, left: I16, right: I16, first: int, out: I32) -> None:
    """Squared differences (D, W) of row y of (K, H, W) summed over channels, 0 beyond the image."""
    n, _, width = left.shape
    for q in range(len(out)):
        d = first + q
        lo, hi = min(max(d, 0), width), max(min(width, width + d), 0)
        out[q] = 0
        if hi > lo:
            for k in range(n):
                _add_squares(left[k, y, lo:hi], right[k, y, lo - d : hi - d], out[q, lo:hi])


@njit(cache=True, nogil=True)
def _window_costs(columns: I32, lo: int, hi: int, radius: int, scale: float, out: I32) -> None:
    """Sums of ``columns`` (W,) over 2 radius + 1 columns, the last ones repeated, in steps of ``scale``."""
    total = 0
    for dx in range(-radius, radius + 1):
        total += int(columns[min(max(lo + dx, lo), hi - 1)])
    for x in range(lo, hi):
        out[x] = np.int32(total * scale + 0.5)
        total += int(columns[min(x + radius + 1, hi - 1)]) - int(columns[max(x - radius, lo)])


@njit(cache=True, nogil=True)
def _trace_back(states: U8, last: tuple[int, int, int], first: int, left: I32, right: I32) -> None:
    i, q, state = last
    while i > 0 and i - (q + first) > 0:
        before = (states[i, q] >> (2 * state)) & 3
        if state == MATCHED:
            left[i - 1] = q + first
            right[i - (q + first) - 1] = q + first
            i -= 1
        elif state == LEFT_HIDDEN:
            i -= 1
            q -= 1
        else:
            q += 1
        state = before


@njit(cache=True, nogil=True)
def _least(matched: int, left_hidden: int, right_hidden: int) -> tuple[int, int]:
    best, state = matched, MATCHED
    state = LEFT_HIDDEN if left_hidden < best else state
    best = min(left_hidden, best)
    state = RIGHT_HIDDEN if right_hidden < best else state
    return min(right_hidden, best), state


@njit(cache=True, nogil=True)
def _enter_column(
    i: int,
    first: int,
    costs: I32,
    prices: tuple[int, int, int],
    above: tuple[I32, I32],
    keys: tuple[I64, I64],
    states: U8,
) -> None:
    """Keys (3, D) of the nodes with i > 0 left and j > 0 right pixels behind them, from those with i - 1.

    ``prices`` of a hidden pixel, and of discontinuities along and across, as keys. ``states`` (D,) takes how
    each of the three states was reached, two bits each.
    """
    n, width = costs.shape
    previous, present = keys
    hidden, along, across = prices
    up = above[0][i - 1]
    left_hidden = hidden + (across if up != NOTHING else 0)
    for q in range(min(n - 1, i - first - 1), max(-1, i - first - width - 1), -1):
        d = first + q
        aside = above[1][i - d - 1]
        # Every unreachable key stays far above all others, so none needs a question.
        key, state = _least(previous[0, q], previous[1, q] + along, previous[2, q] + along)
        key += across if up != NOTHING and up != d else 0
        key += across if aside != NOTHING and aside != d else 0
        cost = costs[q, i - 1]
        present[0, q] = key + cost * RADIX if cost != FORBIDDEN else ENDLESS
        traced = state
        if q > 0:
            key, state = _least(previous[0, q - 1] + along, previous[1, q - 1], previous[2, q - 1] + along)
            present[1, q] = key + left_hidden
            traced |= state << 2
        if q < n - 1:
            key, state = _least(present[0, q + 1] + along, present[1, q + 1] + along, present[2, q + 1])
            present[2, q] = key + hidden + (across if aside != NOTHING else 0)
            traced |= state << 4
        states[q] = traced


@njit(cache=True, nogil=True)
def solve_row(
    costs: I32,
    first: int,
    prices: tuple[int, int, int, int],
    above: tuple[I32, I32],
    left: I32,
    right: I32,
) -> None:
    """The correspondences of one row of greatest likelihood, and of these with the fewest discontinuities.

    ``costs`` (D, W) of left pixel x at disparity first + q, in steps, ``FORBIDDEN`` where there is no match.
    ``prices``: of a pixel without partner and of one at the border of an image, in steps; what a
    discontinuity along the row and one against the row above counts, 0 or 1. ``above`` are the disparities of
    both images there. ``left, right`` (W,) take the disparities, ``NOTHING`` where hidden.

    A node (i, j) has i left and j right pixels behind it, i - j = d; it is entered by a match, by a left
    pixel alone or by a right pixel alone, which are three states of it.
    """
    n, width = costs.shape
    hidden, border, along, across = prices
    keys = np.full((2, 3, n), ENDLESS, np.int64)
    states = np.zeros((width + 1, n), np.uint8)
    best, last = ENDLESS, (0, 0, MATCHED)
    left[:], right[:] = NOTHING, NOTHING
    for i in range(width + 1):
        previous, present = keys[1 - (i & 1)], keys[i & 1]
        present[:] = ENDLESS
        if i - first >= 0 and i - first < n:
            present[MATCHED, i - first] = i * border * RADIX
        if i > 0:
            priced = (hidden * RADIX, along, across)
            _enter_column(i, first, costs, priced, above, (previous, present), states[i])
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
    if best < ENDLESS:
        _trace_back(states, last, first, left, right)


@njit(cache=True, nogil=True)
def _posterior(costs: I32, first: int, found: I32, likelihood: F64, out: F32) -> None:
    """Probability (W,) of the disparities found, or of ones beside them, among all of the range;
    ``likelihood`` of 0, 1, ... steps of cost above the least."""
    n, width = costs.shape
    for x in range(width):
        out[x] = 0.0
        if found[x] == NOTHING:
            continue
        least = costs[found[x] - first, x]
        for q in range(n):
            if costs[q, x] != FORBIDDEN:
                least = min(least, costs[q, x])
        near, total = 0.0, 0.0
        for q in range(n):
            if costs[q, x] != FORBIDDEN:
                share = likelihood[min(costs[q, x] - least, len(likelihood) - 1)]
                total += share
                near += share if abs(first + q - found[x]) <= 1 else 0.0
        out[x] = np.float32(near / total)


@njit(cache=True, nogil=True)
def _forbid(valid_left: U8, valid_right: U8, first: int, costs: I32) -> None:
    n, width = costs.shape
    for q in range(n):
        for x in range(width):
            j = x - first - q
            if j < 0 or j >= width or valid_left[x] == 0 or valid_right[j] == 0:
                costs[q, x] = FORBIDDEN


@njit(cache=True, nogil=True)
def solve_rows(
    left: tuple[I16, U8],
    right: tuple[I16, U8],
    disparities: tuple[int, int],
    model: tuple[int, float, int, int, int, int],
    likelihood: F64,
    out: tuple[I32, F32],
) -> None:
    """Rows of both images, each (channels (K, H, W), valid (H, W)), from the top, each cohering with the one
    before.

    ``disparities`` first and last. ``model``: radius of the window, steps per squared unit of the channels,
    and the prices of :func:`solve_row`. ``out`` takes the disparities (H, W), ``NOTHING`` where hidden, and
    their probabilities.
    """
    first, last = disparities
    radius, scale, prices = model[0], model[1], (model[2], model[3], model[4], model[5])
    height, width = left[1].shape
    n, span = last - first + 1, 2 * radius + 1
    ring, total = np.empty((span, n, width), np.int32), np.empty(width, np.int32)
    costs = np.empty((n, width), np.int32)
    found = np.full((2, 2, width), NOTHING, np.int32)
    done = 0
    for y in range(height):
        while done < min(y + radius + 1, height):
            squared_differences(done, left[0], right[0], first, ring[done % span])
            done += 1
        for q in range(n):
            d = first + q
            lo, hi = min(max(d, 0), width), max(min(width, width + d), 0)
            total[:] = 0
            for dy in range(-radius, radius + 1):
                _add_row(ring[min(max(y + dy, 0), height - 1) % span, q], total)
            if hi > lo:
                _window_costs(total, lo, hi, radius, scale, costs[q])
        _forbid(left[1][y], right[1][y], first, costs)
        now, before = found[y & 1], found[1 - (y & 1)]
        solve_row(costs, first, prices, (before[0], before[1]), now[0], now[1])
        out[0][y] = now[0]
        _posterior(costs, first, now[0], likelihood, out[1][y])


Cohesion = Literal["none", "along", "along and across"]

GREY_RANGE = 256.0
"""Values that a hidden pixel may have: its density is uniform over them."""
ROUNDING_PX = float(1.0 / np.sqrt(12.0))
"""Deviation of a disparity that is the nearest whole number."""
ROWS, WARM_UP = 96, 8
"""Rows of a strip, and the rows above that are solved before so that its first row coheres with something."""
MATCH_NATS = 0.5
"""Expected cost of a match, per component: (z - z')^2 / (2 s^2) is the square of a standard normal."""
SIGNIFICANT = 30.0
"""Nats: what is less probable by more counts as impossible."""


@dataclass(frozen=True)
class MaximumLikelihoodScanline:
    """The correspondences of every scanline with the greatest likelihood, by dynamic programming.

    Two measurements of one thing are normal about its true value with variance s^2 in each of their m
    components, so with the mean for the unknown true value a match costs |z - z'|^2 / (4 s^2). A pixel
    without partner costs ln(P_D phi^m / ((1 - P_D) (2 pi s^2)^(m / 2))): it is seen by the other camera with
    probability P_D (``detection``), and a value of its own is uniform over phi = 256 grey levels. Ordering
    and uniqueness hold by construction; hidden pixels are found, not guessed.

    ``cohesion`` decides among solutions of equal likelihood: "along" the row as few discontinuities as
    possible (MLMH), "along and across" as few as possible along the row and against the row before (MLMH+V).
    As in the paper equality is that of whole numbers, ``steps_per_nat`` steps a nat; the paper's grey levels
    and s^2 = 4 make 16.

    A measurement is the colours of the pixel and of those within ``radius``; the paper's is the pixel alone
    (``radius`` 0), and says that any vector will do. s^2 is ``min_variance`` (the paper's 4) and what the
    images' own noise adds to it.

    The paper charges a pixel at the border, beyond the other camera's view, as a hidden one. That draws the
    disparities at both ends of a row to zero, and P_D says nothing of pixels that no camera is pointed at:
    with ``out_of_view`` they cost what a match is expected to, which draws nowhere.
    """

    detection: float = 0.99
    min_variance: float = 4.0
    radius: int = 1
    cohesion: Cohesion = "along and across"
    steps_per_nat: float = 16.0
    out_of_view: bool = True
    threads: int = 1

    def __post_init__(self) -> None:
        if not 0.5 <= self.detection < 1.0:
            raise ValueError(f"detection must be in [0.5, 1); got {self.detection}")
        if not (self.min_variance > 0.0 and self.steps_per_nat > 0.0 and 0 <= self.radius <= 4):
            raise ValueError("min_variance and steps_per_nat must be above 0, radius in 0 .. 4")
        if self.cohesion not in ("none", "along", "along and across"):
            raise ValueError(f"cohesion must be none, along, or along and across; got {self.cohesion}")

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Whole disparities of the left image; the arguments and the result are those of the default variant.

        ``confidence`` is the probability of the disparity (or one beside it) against all others of the range,
        given the two measurements alone: 3 / D where nothing tells them apart; and less where there is no
        texture, for the errors of neighbouring pixels are not as independent as that takes them to be.
        Ordered rows are all the memory it takes: a few rows of D costs.
        """
        first, last = checked_range(disparity_range)
        sides = prepare_pair(left, right)
        noise = float(np.mean([estimate_noise(side) for side in sides]))
        variance = self.min_variance + noise**2
        components = len(sides[0].channels) * (2 * self.radius + 1) ** 2
        hidden = self.hidden_cost(components, variance)
        model = (
            self.radius,
            self.steps_per_nat / (4.0 * variance * LEVELS**2),
            round(self.steps_per_nat * hidden),
            round(self.steps_per_nat * (MATCH_NATS * components if self.out_of_view else hidden)),
            int(self.cohesion != "none"),
            int(self.cohesion == "along and across"),
        )
        likelihood = np.exp(-np.arange(int(SIGNIFICANT * self.steps_per_nat) + 2) / self.steps_per_nat)
        likelihood[-1] = 0.0
        height, width = sides[0].valid.shape
        disparity, confidence = np.empty((height, width), np.float32), np.empty((height, width), np.float32)

        def work(strip: Strip) -> None:
            start, stop, top, bottom = strip
            rows = [(np.ascontiguousarray(s.channels[:, top:bottom]), s.valid[top:bottom]) for s in sides]
            found = np.empty((bottom - top, width), np.int32)
            probable = np.empty((bottom - top, width), np.float32)
            solve_rows(rows[0], rows[1], (first, last), model, likelihood, (found, probable))
            own = slice(start - top, stop - top)
            disparity[start:stop] = np.where(found[own] == NOTHING, np.float32(np.nan), found[own])
            confidence[start:stop] = probable[own]

        run_strips(work, self._strips(height), self.threads)
        rate(confidence, disparity, disparity, texture_of(sides[0], noise))
        return DisparityMap(disparity, confidence, ROUNDING_PX)

    def hidden_cost(self, components: int, variance: float) -> float:
        """Cost in nats of a pixel of so many components that the other camera does not see."""
        odds = np.log(self.detection / (1.0 - self.detection))
        return float(odds + components * np.log(GREY_RANGE / np.sqrt(2.0 * np.pi * variance)))

    def _strips(self, height: int) -> list[Strip]:
        below = self.radius
        return [
            (start, min(start + ROWS, height), max(start - WARM_UP, 0), min(start + ROWS + below, height))
            for start in range(0, height, ROWS)
        ]

"""Compiled last steps: the best disparity of both sides, sub-pixel fit, checks, smoothing.

Left-right check, peak filter, pinholes, smoothing, confidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from thesisrecon.arrays import B8, F32, I16, I32, U8, U16
from thesisrecon.records import DisparityMap
from thesisrecon.stereo.cost import StereoImage
from thesisrecon.stereo.cost_kernels import LEVELS

NONE = np.uint16(65535)
BLANK = np.float32(0.05)
"""What is left of the confidence where there is no texture."""
EVIDENT = 20
"""At least one pixel in so many of a surface must have texture."""


@njit(cache=True, nogil=True)
def _keep_best(total: U16, q: np.int16, best: U16, index: I16) -> None:
    for x in range(len(best)):
        # Read before the choice: a read inside of it would be a branch, and no vector instruction.
        value, least, at = total[x], best[x], index[x]
        index[x] = q if value < least else at
        best[x] = value if value < least else least


@njit(cache=True, nogil=True)
def _keep_rival(total: U16, q: np.int16, index: I16, rival: U16) -> None:
    """Least total of a disparity that is no neighbour of the best one."""
    for x in range(len(rival)):
        apart = np.int16(index[x] - q)
        apart = np.int16(-apart) if apart < 0 else apart
        value, least = total[x], rival[x]
        value = value if apart > 1 else NONE
        rival[x] = value if value < least else least


@njit(cache=True, nogil=True)
def _set_sum(a: U8, b: U8, out: U16) -> None:
    for x in range(len(out)):
        out[x] = np.uint16(np.uint16(a[x]) + np.uint16(b[x]))


@njit(cache=True, nogil=True)
def _add_bytes(values: U8, total: U16) -> None:
    for x in range(len(total)):
        total[x] = np.uint16(total[x] + np.uint16(values[x]))


@njit(cache=True, nogil=True)
def _best_of_row(total: U16, first: int, left: tuple[U16, I16, U16], right: tuple[U16, I16]) -> None:
    """Least totals and their places for the pixels of both sides, and the left one's rivals."""
    n, width = total.shape
    best, index, rival = left
    best[:], index[:], rival[:] = NONE, 0, NONE
    right[0][:], right[1][:] = NONE, -1
    for q in range(n):
        d = first + q
        _keep_best(total[q], np.int16(q), best, index)
        lo, hi = min(max(d, 0), width), max(min(width, width + d), 0)
        if hi > lo:
            _keep_best(total[q, lo:hi], np.int16(q), right[0][lo - d : hi - d], right[1][lo - d : hi - d])
    for q in range(n):
        _keep_rival(total[q], np.int16(q), index, rival)


@njit(cache=True, nogil=True)
def best_disparities(sums: U8, start: int, first: int, out: tuple[F32, F32, F32], half: float) -> None:
    """From path sums (P, N, D, W), row ``start`` and those below, to ``out``, each (H, W): the disparities of
    the left pixels, sub-pixel; those of the right ones, whole, NaN where the range leaves the image; and the
    confidence m / (m + ``half``), m by how much the best rival costs more.

    The sub-pixel place is the corner of two lines of equal and opposite slope through the best three totals;
    at an end of the range there is none.
    """
    pairs, _, n, width = sums.shape
    left, right, confidence = out
    total = np.empty((n, width), np.uint16)
    best, index, rival = np.empty(width, np.uint16), np.empty(width, np.int16), np.empty(width, np.uint16)
    best_r, index_r = np.empty(width, np.uint16), np.empty(width, np.int16)
    for y in range(len(left)):
        for q in range(n):
            _set_sum(sums[0, start + y, q], sums[1, start + y, q], total[q])
            for k in range(2, pairs):
                _add_bytes(sums[k, start + y, q], total[q])
        _best_of_row(total, first, (best, index, rival), (best_r, index_r))
        for x in range(width):
            q = int(index[x])
            value = np.float32(first + q)
            if 0 < q < n - 1:
                a = np.float32(total[q - 1, x]) - np.float32(best[x])
                b = np.float32(total[q + 1, x]) - np.float32(best[x])
                steep = max(a, b)
                if steep > 0:
                    value += np.float32(0.5) * (a - b) / steep
            left[y, x] = value
            margin = np.float32(rival[x]) - np.float32(best[x])
            confidence[y, x] = margin / (margin + np.float32(half))
            right[y, x] = np.float32(first + index_r[x]) if index_r[x] >= 0 else np.float32(np.nan)


@njit(cache=True, nogil=True)
def check_left_right(left: F32, right: F32, confidence: F32, limits: F32) -> None:
    """NaN to the disparities (H, W) of left pixels whose partner in the right image has one that differs by
    more than ``limits[0]``, and to those of less confidence than ``limits[1]``."""
    height, width = left.shape
    for y in range(height):
        for x in range(width):
            if np.isnan(left[y, x]):
                continue
            partner = int(np.floor(np.float32(x) - left[y, x] + np.float32(0.5)))
            if not (0 <= partner < width and abs(right[y, partner] - left[y, x]) <= limits[0]):
                left[y, x] = np.nan
            if confidence[y, x] < limits[1]:
                left[y, x] = np.nan


@njit(cache=True, nogil=True)
def rate(confidence: F32, confirmed: F32, disparity: F32, texture: F32) -> None:
    """Confidence (H, W) once all is known: 0 where there is no disparity, half where it was filled in and
    the neighbours alone speak for it, and less where ``texture`` is little more than 1."""
    height, width = confidence.shape
    for y in range(height):
        for x in range(width):
            excess = max(texture[y, x] - np.float32(1.0), np.float32(0.0))
            share = max(excess / (excess + np.float32(1.0)), BLANK)
            share = share * np.float32(0.5) if np.isnan(confirmed[y, x]) else share
            confidence[y, x] = np.float32(0.0) if np.isnan(disparity[y, x]) else confidence[y, x] * share


@njit(cache=True, nogil=True)
def _add_squares(before: I16, after: I16, sign: int, out: I32) -> None:
    for x in range(len(out)):
        apart = np.int32(after[x]) - np.int32(before[x])
        out[x] = np.int32(out[x] + np.int32(sign) * apart * apart)


@njit(cache=True, nogil=True)
def squared_gradient(channels: I16, radius: int, out: F32) -> None:
    """Mean over channels and a square window of (I(x + 1) - I(x - 1))^2, (H, W); beyond the image there is
    nothing."""
    n, height, width = channels.shape
    columns = np.zeros(width, np.int32)
    share = np.float32(1.0) / np.float32(n * (2 * radius + 1) ** 2)
    for y in range(-radius, height):
        # The window goes down: a row comes, another goes.
        for row, sign in ((y + radius, 1), (y - radius - 1, -1)):
            if 0 <= row < height and width > 2:
                for k in range(n):
                    line = channels[k, row]
                    _add_squares(line[: width - 2], line[2:], sign, columns[1 : width - 1])
        if y < 0:
            continue
        total = np.int64(0)
        for x in range(-radius, width):
            total += columns[x + radius] if x + radius < width else 0
            total -= columns[x - radius - 1] if x - radius - 1 >= 0 else 0
            if x >= 0:
                out[y, x] = np.float32(total) * share


@njit(cache=True, nogil=True)
def remove_peaks(disparity: F32, evident: B8, step: np.float32, smallest: int) -> None:
    """NaN to connected pieces of fewer than ``smallest`` pixels, or with fewer ``evident`` ones, in them and
    around them, than one in twenty; neighbours are connected where their disparities differ by no more than
    ``step``."""
    height, width = disparity.shape
    # A frame of unknown pixels, one column for both sides: every pixel then has four neighbours.
    line = width + 1
    flat = np.full((height + 2) * line, np.float32(np.nan), np.float32)
    counted = np.zeros((height + 2) * line, np.bool_)
    for y in range(height):
        start = (y + 1) * line
        flat[start : start + width] = disparity[y]
        counted[start : start + width] = evident[y]
    open_ = ~np.isnan(flat)
    queue = np.empty(height * width, np.int32)
    for seed in range(line, (height + 1) * line):
        if not open_[seed]:
            continue
        open_[seed] = False
        queue[0] = seed
        at, n, size = 0, 1, 0
        while at < n:
            place = queue[at]
            at += 1
            size += counted[place]
            here = flat[place]
            for k in range(4):
                other = place + (1 if k == 0 else -1 if k == 1 else line if k == 2 else -line)
                if not abs(flat[other] - here) <= step:
                    size += counted[other]
                elif open_[other]:
                    open_[other] = False
                    queue[n] = other
                    n += 1
        if n < smallest or EVIDENT * size < n:
            for k in range(n):
                y, x = queue[k] // line - 1, queue[k] % line
                disparity[y, x] = np.nan
                flat[queue[k]] = np.nan


@njit(cache=True, nogil=True)
def fill_pinholes(disparity: F32, least: int, out: F32) -> None:
    """Unknown pixels with at least ``least`` of 8 neighbours known take the median of these; (H, W)."""
    height, width = disparity.shape
    around = np.empty(8, np.float32)
    out[:] = disparity
    for y in range(height):
        for x in range(width):
            if not np.isnan(disparity[y, x]):
                continue
            n = 0
            for b in range(max(y - 1, 0), min(y + 2, height)):
                for a in range(max(x - 1, 0), min(x + 2, width)):
                    n += not np.isnan(disparity[b, a])
            if n < least:
                continue
            n = 0
            for b in range(max(y - 1, 0), min(y + 2, height)):
                for a in range(max(x - 1, 0), min(x + 2, width)):
                    value = disparity[b, a]
                    if not np.isnan(value):
                        place = n
                        while place > 0 and around[place - 1] > value:
                            around[place] = around[place - 1]
                            place -= 1
                        around[place] = value
                        n += 1
            out[y, x] = np.float32(0.5) * (around[(n - 1) // 2] + around[n // 2])


@njit(cache=True, nogil=True)
def _gather_alike(centre: F32, other: F32, step: np.float32, total: F32, count: F32) -> None:
    for x in range(len(centre)):
        value, summed, counted = other[x], total[x], count[x]
        # A comparison with NaN is false: unknown pixels neither give nor take.
        alike = abs(value - centre[x]) <= step
        total[x] = summed + (value if alike else np.float32(0.0))
        count[x] = counted + (np.float32(1.0) if alike else np.float32(0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_alike(disparity: F32, step: np.float32, radius: int, out: F32) -> None:
    """Mean over the square window of the disparities that differ from the centre's by no more than ``step``,
    (H, W): what varies on one surface is averaged, an edge is left."""
    height, width = disparity.shape
    total, count = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(height):
        total[:], count[:] = 0.0, 0.0
        for b in range(max(y - radius, 0), min(y + radius + 1, height)):
            for dx in range(-radius, radius + 1):
                lo, hi = min(max(-dx, 0), width), max(min(width, width - dx), 0)
                if hi > lo:
                    _gather_alike(
                        disparity[y, lo:hi],
                        disparity[b, lo + dx : hi + dx],
                        step,
                        total[lo:hi],
                        count[lo:hi],
                    )
        for x in range(width):
            out[y, x] = total[x] / count[x] if count[x] > 0 else np.float32(np.nan)


STEP_PX = np.float32(1.0)
"""Neighbours on one surface differ by no more."""
SPARSE = 5
"""Every fifth pixel of every fifth row suffices for a median."""
AROUND = 4
"""Pixels to each side that speak for the texture of a pixel: as far as its costs look."""
DIGITISATION = float(1.0 / np.sqrt(12.0))
"""Noise of whole grey levels."""
TEXTURED = np.float32(1.7)
"""Texture that noise does not make, in units of its own."""
LOCKING_PX = 0.17
"""What pixels draw a sub-pixel fit towards them: measured on pairs whose disparity is known."""
SURROUNDED = 5
"""Of eight neighbours that must be known for a pinhole to be closed."""


@dataclass(frozen=True)
class DisparityPostprocessing:
    """What is believed of the best disparities.

    ``left_right_px``: the partner's own best disparity may differ by as much. ``smallest_piece``: connected
    pieces of fewer pixels are peaks and go, as do larger ones all but without texture. ``min_confidence``:
    less is unknown. ``radius``: every
    disparity becomes the mean of those within so many pixels that differ from it by a pixel at most, which
    takes the noise of the sub-pixel fit from a surface and leaves its edges.
    """

    left_right_px: float = 1.0
    min_region_px: int = 60
    min_confidence: float = 0.02
    radius: int = 2

    def __post_init__(self) -> None:
        if not (self.left_right_px >= 0.0 and self.min_region_px >= 0 and self.radius >= 0):
            raise ValueError("left_right_px, smallest_piece and radius must not be negative")
        if not 0.0 <= self.min_confidence < 1.0:
            raise ValueError(f"min_confidence must be in [0, 1); got {self.min_confidence}")

    def apply(self, left: F32, right: F32, confidence: F32, texture: F32) -> DisparityMap:
        """The map of disparities (H, W) of the left pixels, given those of the right ones, NaN = none.

        ``texture`` (H, W) from :func:`texture_of`: what surfaces without any inherit from their rims is kept,
        with little confidence. Takes possession of ``left`` and ``confidence``.
        """
        limits = np.array([self.left_right_px, self.min_confidence], np.float32)
        check_left_right(left, right, confidence, limits)
        remove_peaks(left, texture > TEXTURED, STEP_PX, self.min_region_px)
        closed = np.empty_like(left)
        fill_pinholes(left, SURROUNDED, closed)
        closed[np.isnan(texture)] = np.nan
        smooth = np.empty_like(left)
        smooth_alike(closed, STEP_PX, self.radius, smooth)
        rate(confidence, left, smooth, texture)
        return DisparityMap(smooth, confidence, _noise(closed, smooth))


def texture_of(side: StereoImage, noise: float) -> F32:
    """(H, W) squared horizontal gradient about each pixel in units of what noise alone, of a standard
    deviation of so many grey levels, makes of it: 1 where there is nothing to match. NaN = no pixel."""
    out = np.empty(side.valid.shape, np.float32)
    squared_gradient(side.channels, AROUND, out)
    out /= np.float32(2.0 * LEVELS**2 * np.hypot(noise, DIGITISATION) ** 2)
    out[side.valid == 0] = np.nan
    return out


def _noise(raw: F32, smooth: F32) -> float:
    """Deviation of a disparity: about the smooth ones, from the median, and what smoothness does not show;
    NaN where nothing is known."""
    apart = np.abs(raw[::SPARSE, ::SPARSE] - smooth[::SPARSE, ::SPARSE])
    known = apart[np.isfinite(apart)]
    return float(np.hypot(1.4826 * np.median(known), LOCKING_PX)) if len(known) else float("nan")

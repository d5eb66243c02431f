"""The range of disparities that is searched.

Strips of rows, so that the memory of a pair is bounded and threads have something to share.

What every matcher needs of a rectified pair: whole-numbered channels, which pixels exist, the noise.

Matching costs of a strip of rows as bytes: census and truncated colour difference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thesisrecon.arrays import I16, I32, U8
from thesisrecon.stereo.cost_kernels import (
    ARM,
    LEVELS,
    WEIGHT_SHIFT,
    census,
    cost_volume,
    sampled_bounds,
    split_bytes,
    split_channels,
    support_masks,
)

LARGEST = 4096
"""Disparities in a range, at most."""


def checked_range(disparity_range: tuple[int, int]) -> tuple[int, int]:
    """First and last disparity, both included; ``ValueError`` where they are no range."""
    first, last = (int(d) for d in disparity_range)
    if not 0 <= last - first < LARGEST:
        raise ValueError(f"a disparity range needs first <= last < first + {LARGEST}; got {disparity_range}")
    return first, last


Result = TypeVar("Result")
Strip = tuple[int, int, int, int]

MARGIN = 24
"""Rows above and below that a strip also looks at: what is farther off hardly changes a path."""
LEAST = 32


def row_strips(height: int, bytes_per_row: int, memory_bytes: float) -> list[Strip]:
    """(first, last, from, to) of strips: rows [first, last) are its own, [from, to) it looks at.

    The fewest whose rows, margins included, fit the memory, but with at least ``LEAST`` rows of their own.
    They depend on the sizes alone, never on the number of threads.
    """
    fitting = int(memory_bytes // max(bytes_per_row, 1))
    if height <= fitting:
        return [(0, height, 0, height)]
    own = max(fitting - 2 * MARGIN, LEAST)
    count = -(-height // own)
    edges = [height * k // count for k in range(count + 1)]
    return [
        (first, last, max(first - MARGIN, 0), min(last + MARGIN, height)) for first, last in pairwise(edges)
    ]


def run_strips(work: Callable[[Strip], Result], strips: Sequence[Strip], threads: int) -> list[Result]:
    """``work`` of every strip, in order, on so many threads."""
    if threads < 2 or len(strips) < 2:
        return [work(strip) for strip in strips]
    with ThreadPoolExecutor(min(threads, len(strips))) as pool:
        return list(pool.map(work, strips))


ROWS_FOR_NOISE = 24
"""About as many rows, evenly spread, suffice for a median."""


@dataclass(frozen=True)
class Side:
    """One image of the pair: ``channels`` (K, H, W) in quarters of a grey level, ``valid`` (H, W) 255 where
    there is a pixel and 0 elsewhere, where the channels are 0; ``grey`` (H, W) their sum."""

    channels: I16
    grey: I16
    valid: U8


def prepare_pair(left: ArrayLike, right: ArrayLike) -> tuple[Side, Side]:
    """Both sides of a rectified pair, (H, W) or (H, W, K <= 4) grey levels 0 .. 255, NaN = no pixel.

    Raises
    ------
    ValueError
        Where the images are of no such shape, or not of the same number of rows, columns and channels.
    """
    sides = tuple(_side(np.asarray(image)) for image in (left, right))
    if sides[0].channels.shape != sides[1].channels.shape:
        raise ValueError(
            f"the images of a rectified pair must have one shape; got {np.shape(left)} and {np.shape(right)}"
        )
    return sides[0], sides[1]


def _side(image: NDArray[np.generic]) -> Side:
    if image.ndim not in (2, 3) or 0 in image.shape or (image.ndim == 3 and image.shape[2] > 4):
        raise ValueError(f"an image must be (H, W) or (H, W, K) with K <= 4; got {image.shape}")
    height, width, n = (*image.shape, 1)[:3]
    channels, grey = np.empty((n, height, width), np.int16), np.empty((height, width), np.int16)
    valid = np.full((height, width), 255, np.uint8)
    if image.dtype == np.uint8:
        split_bytes(np.ascontiguousarray(image.reshape(height, width, n), dtype=np.uint8), channels, grey)
    else:
        levels = np.ascontiguousarray(image.reshape(height, width, n), dtype=np.float32)
        split_channels(levels, channels, grey, valid)
    return Side(channels, grey, valid)


def estimate_noise(side: Side) -> float:
    """Standard deviation of the noise of one channel, grey levels.

    The median absolute response to the difference of two Laplacians, which no linear or quadratic shading
    moves (Immerkaer 1996; the median instead of the mean, for texture is no noise). 0 where fewer than 3 x 3
    pixels exist.
    """
    if min(side.valid.shape) < 3:
        return 0.0
    step = max(side.valid.shape[0] // ROWS_FOR_NOISE, 1)
    top = np.arange(0, side.valid.shape[0] - 2, step)
    rows = [side.channels[:, top + k].copy() for k in range(3)]
    mixed = rows[0] - 2 * rows[1] + rows[2]
    response = mixed[..., :-2] - 2 * mixed[..., 1:-1] + mixed[..., 2:]
    whole = np.minimum(np.minimum(side.valid[top], side.valid[top + 1]), side.valid[top + 2]) > 0
    inside = whole[:, :-2] & whole[:, 1:-1] & whole[:, 2:]
    if not inside.any():
        return 0.0
    # A median of whole numbers by counting them. The mask has the squares 1, 4, 1, 4, 16, 4, 1, 4, 1: 36.
    below = np.cumsum(np.bincount(np.abs(response[:, inside]).ravel()))
    median = int(np.searchsorted(below, 0.5 * below[-1]))
    return 1.4826 * median / 6.0 / LEVELS


CENSUS_BITS = 24


@dataclass(frozen=True)
class CostedSide:
    """What costs are made of: ``bits`` (H, W) the census, ``channels`` (K, H, W), their bounds ``low`` and
    ``high`` within half a pixel (the channels themselves where not asked for), ``valid`` (H, W)."""

    bits: I32
    channels: I16
    low: I16
    high: I16
    valid: U8

    def rows(self, start: int, stop: int) -> tuple[I32, I16, I16, I16, U8]:
        """The arrays of rows ``start`` to ``stop``, each in one piece."""
        part = slice(start, stop)
        whole = np.ascontiguousarray
        return (
            self.bits[part],
            whole(self.channels[:, part]),
            whole(self.low[:, part]),
            whole(self.high[:, part]),
            self.valid[part],
        )


def costed_side(side: Side, *, bounds: bool) -> CostedSide:
    """Census and, if asked for, bounds of one image."""
    bits = np.empty(side.valid.shape, np.int32)
    census(side.grey, bits)
    if not bounds:
        return CostedSide(bits, side.channels, side.channels, side.channels, side.valid)
    low, high = np.empty_like(side.channels), np.empty_like(side.channels)
    sampled_bounds(side.channels, low, high)
    return CostedSide(bits, side.channels, low, high, side.valid)


@dataclass(frozen=True)
class CensusAndColour:
    """Hamming distance of 5 x 5 census transforms plus the absolute difference of the channels, truncated.

    The census (Zabih and Woodfill 1994) stands changes of exposure, the colours tell apart what has the same
    pattern. ``census_share`` of the dearest cost is the census', the rest the colours'. These are truncated
    at ``truncation`` times the noise, for beyond it a difference only says "another thing". With ``support``
    the costs are averaged over the pixels within two of this one along its row and column, and then theirs,
    up to the first that differs by more than ``tolerance`` times the noise (Zhang, Lu and Lafruit 2009). With
    ``sampling_insensitive`` the colours are those of Birchfield and Tomasi (1998). ``outside`` is the cost of
    a partner beyond the image, as a share of the dearest.
    """

    census_share: float = 0.56
    truncation: float = 10.0
    support: bool = True
    tolerance: float = 5.0
    sampling_insensitive: bool = False
    outside: float = 0.4

    def __post_init__(self) -> None:
        for name in ("census_share", "outside"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be between 0 and 1; got {getattr(self, name)}")
        for name in ("truncation", "tolerance"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be above 0; got {getattr(self, name)}")

    def side(self, side: Side) -> CostedSide:
        """What the costs need of one image."""
        return costed_side(side, bounds=self.sampling_insensitive)

    def support_of(self, side: Side, noise: float) -> U8:
        """(4, 0 | ARM, H, W) arms of the support of every pixel."""
        height, width = side.valid.shape
        masks = np.empty((4, ARM if self.support else 0, height, width), np.uint8)
        if self.support:
            tolerance = np.int16(min(round(self.tolerance * noise * LEVELS), 255 * LEVELS))
            support_masks(side.channels, side.valid, tolerance, masks)
        return masks

    def fill(
        self,
        out: U8,
        left: CostedSide,
        right: CostedSide,
        support: U8,
        *,
        rows: tuple[int, int],
        first: int,
        noise: float,
        dearest: int,
    ) -> None:
        """Costs of the rows [a, b) at D disparities from ``first`` on, ``out`` (rows, D, W).

        ``support`` is that of the whole left image, ``noise`` the standard deviation of a grey level,
        ``dearest`` the cost of a match that could not be worse.
        """
        start, stop = rows
        cost_volume(
            left.rows(start, stop),
            right.rows(start, stop),
            np.ascontiguousarray(support[:, :, start:stop]),
            first,
            self._weights(len(left.channels), noise, dearest),
            np.uint8(round(self.outside * dearest)),
            out,
        )

    def _weights(self, channels: int, noise: float, dearest: int) -> I16:
        one = dearest << WEIGHT_SHIFT
        cap = min(max(round(self.truncation * noise * LEVELS * channels), channels), 255 * LEVELS * channels)
        of_bit = round(self.census_share * one / CENSUS_BITS)
        of_level = max(round((1.0 - self.census_share) * one / cap), int(self.census_share < 1.0))
        return np.array([of_bit, of_level, cap, self.sampling_insensitive], np.int16)

"""Matching costs of rectified pairs: image channels, noise, census and truncated colour differences.

Costs are computed strip by strip, which bounds the memory and gives the threads independent work.
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

MAX_DISPARITIES = 4096
"""Upper limit of the number of disparities searched."""
STRIP_MARGIN = 24
"""Additional rows above and below a strip: pixels farther away hardly change a path cost."""
MIN_STRIP_ROWS = 32
ROWS_FOR_NOISE = 24
"""Number of evenly spaced rows used for the median."""
CENSUS_BITS = 24


def checked_range(disparity_range: tuple[int, int]) -> tuple[int, int]:
    """Check a disparity range.

    Parameters
    ----------
    disparity_range : tuple of int
        First and last disparity, both included.

    Returns
    -------
    tuple of int
        The range.

    Raises
    ------
    ValueError
        If the range is empty or too large.
    """
    first, last = (int(d) for d in disparity_range)
    if not 0 <= last - first < MAX_DISPARITIES:
        raise ValueError(
            f"a disparity range must obey first <= last < first + {MAX_DISPARITIES}; got {disparity_range}"
        )
    return first, last


Result = TypeVar("Result")
Strip = tuple[int, int, int, int]


def row_strips(height: int, bytes_per_row: int, memory_bytes: float) -> list[Strip]:
    """Divide the rows of an image into the fewest strips that fit the memory.

    Parameters
    ----------
    height : int
        Rows of the image.
    bytes_per_row : int
        Memory of one row.
    memory_bytes : float
        Memory of one strip, margins included.

    Returns
    -------
    list of Strip
        (first, last, from, to): rows [first, last) are computed from rows [from, to). They do not depend on
        the number of threads.
    """
    fitting = int(memory_bytes // max(bytes_per_row, 1))
    if height <= fitting:
        return [(0, height, 0, height)]
    own = max(fitting - 2 * STRIP_MARGIN, MIN_STRIP_ROWS)
    count = -(-height // own)
    edges = [height * k // count for k in range(count + 1)]
    return [
        (first, last, max(first - STRIP_MARGIN, 0), min(last + STRIP_MARGIN, height))
        for first, last in pairwise(edges)
    ]


def run_strips(work: Callable[[Strip], Result], strips: Sequence[Strip], threads: int) -> list[Result]:
    """Call ``work`` for every strip.

    Parameters
    ----------
    work : callable
        Function of a strip.
    strips : sequence of Strip
    threads : int

    Returns
    -------
    list
        Results in the order of the strips.
    """
    if threads < 2 or len(strips) < 2:
        return [work(strip) for strip in strips]
    with ThreadPoolExecutor(min(threads, len(strips))) as pool:
        return list(pool.map(work, strips))


@dataclass(frozen=True)
class StereoImage:
    """One image of a rectified pair.

    Attributes
    ----------
    channels : ndarray (K, H, W) int16
        Channels in quarters of a grey level, 0 where there is no pixel.
    grey : ndarray (H, W) int16
        Sum of the channels.
    valid : ndarray (H, W) uint8
        255 where there is a pixel, else 0.
    """

    channels: I16
    grey: I16
    valid: U8


def prepare_stereo_images(left: ArrayLike, right: ArrayLike) -> tuple[StereoImage, StereoImage]:
    """Convert both images of a rectified pair to integer channels.

    Parameters
    ----------
    left, right : array_like (H, W) or (H, W, K <= 4)
        Grey levels 0 .. 255, NaN = no pixel.

    Returns
    -------
    tuple of StereoImage
        Left and right image.

    Raises
    ------
    ValueError
        If a shape is invalid or the shapes differ.
    """
    sides = tuple(_side(np.asarray(image)) for image in (left, right))
    if sides[0].channels.shape != sides[1].channels.shape:
        raise ValueError(
            f"rectified images must have the same shape; got {np.shape(left)} and {np.shape(right)}"
        )
    return sides[0], sides[1]


def _side(image: NDArray[np.generic]) -> StereoImage:
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
    return StereoImage(channels, grey, valid)


def estimate_noise(image: StereoImage) -> float:
    """Estimate the standard deviation of the image noise of one channel.

    The median absolute response to the difference of two Laplacians, which is insensitive to linear and
    quadratic shading (Immerkaer 1996, with the median instead of the mean because texture is not noise).

    Parameters
    ----------
    image : StereoImage

    Returns
    -------
    float
        Standard deviation in grey levels; 0 if fewer than 3 x 3 pixels exist.
    """
    if min(image.valid.shape) < 3:
        return 0.0
    step = max(image.valid.shape[0] // ROWS_FOR_NOISE, 1)
    top = np.arange(0, image.valid.shape[0] - 2, step)
    rows = [image.channels[:, top + k].copy() for k in range(3)]
    mixed = rows[0] - 2 * rows[1] + rows[2]
    response = mixed[..., :-2] - 2 * mixed[..., 1:-1] + mixed[..., 2:]
    whole = np.minimum(np.minimum(image.valid[top], image.valid[top + 1]), image.valid[top + 2]) > 0
    inimage = whole[:, :-2] & whole[:, 1:-1] & whole[:, 2:]
    if not inimage.any():
        return 0.0
    # Median of integers by counting. The squared filter coefficients sum to 36.
    below = np.cumsum(np.bincount(np.abs(response[:, inimage]).ravel()))
    median = int(np.searchsorted(below, 0.5 * below[-1]))
    return 1.4826 * median / 6.0 / LEVELS


@dataclass(frozen=True)
class CostFeatures:
    """Image features from which matching costs are computed.

    Attributes
    ----------
    bits : ndarray (H, W) int32
        Census transform.
    channels : ndarray (K, H, W) int16
        Channels in quarters of a grey level.
    low, high : ndarray (K, H, W) int16
        Bounds of the channels within half a pixel, or the channels themselves.
    valid : ndarray (H, W) uint8
        255 where there is a pixel, else 0.
    """

    bits: I32
    channels: I16
    low: I16
    high: I16
    valid: U8

    def rows(self, start: int, stop: int) -> tuple[I32, I16, I16, I16, U8]:
        """Return contiguous arrays of some rows.

        Parameters
        ----------
        start, stop : int
            First row, and the row after the last.

        Returns
        -------
        tuple of ndarray
            (bits, channels, low, high, valid) of the rows.
        """
        part = slice(start, stop)
        whole = np.ascontiguousarray
        return (
            self.bits[part],
            whole(self.channels[:, part]),
            whole(self.low[:, part]),
            whole(self.high[:, part]),
            self.valid[part],
        )


@dataclass(frozen=True)
class CensusAndColour:
    """Hamming distance of census transforms plus truncated absolute colour difference.

    The 5 x 5 census transform (Zabih and Woodfill 1994) is invariant to exposure; the colours distinguish
    regions of equal pattern. Truncation limits the influence of occlusions and outliers.

    Parameters
    ----------
    census_share : float
        Share of the census in the maximal cost; the colours have the rest.
    truncation : float
        Truncation of the colour difference, in standard deviations of the noise.
    support : bool
        Average the costs over cross-shaped support regions (Zhang, Lu and Lafruit 2009) with arms of 2
        pixels.
    tolerance : float
        Colour difference at which an arm ends, in standard deviations of the noise.
    sampling_insensitive : bool
        Use the sampling-insensitive difference of Birchfield and Tomasi (1998).
    outside : float
        Cost of a partner outside the image, as a share of the maximal cost.
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

    def features(self, image: StereoImage) -> CostFeatures:
        """Compute the features of one image.

        Parameters
        ----------
        image : StereoImage

        Returns
        -------
        CostFeatures
            Census transform and channel bounds.
        """
        bits = np.empty(image.valid.shape, np.int32)
        census(image.grey, bits)
        low, high = image.channels, image.channels
        if self.sampling_insensitive:
            low, high = np.empty_like(low), np.empty_like(high)
            sampled_bounds(image.channels, low, high)
        return CostFeatures(bits, image.channels, low, high, image.valid)

    def support_arms(self, image: StereoImage, noise: float) -> U8:
        """Compute the arms of the support region of every pixel.

        Parameters
        ----------
        image : StereoImage
            The left image.
        noise : float
            Standard deviation of its noise in grey levels.

        Returns
        -------
        ndarray (4, ARM, H, W) uint8
            Arms to the left, right, top and bottom; the second axis is empty without ``support``.
        """
        height, width = image.valid.shape
        masks = np.empty((4, ARM if self.support else 0, height, width), np.uint8)
        if self.support:
            tolerance = np.int16(min(round(self.tolerance * noise * LEVELS), 255 * LEVELS))
            support_masks(image.channels, image.valid, tolerance, masks)
        return masks

    def fill_volume(
        self,
        out: U8,
        left: CostFeatures,
        right: CostFeatures,
        support: U8,
        *,
        rows: tuple[int, int],
        first: int,
        noise: float,
        max_cost: int,
    ) -> None:
        """Compute the cost volume of some rows.

        Parameters
        ----------
        out : ndarray (rows, D, W) uint8
            Receives the costs.
        left, right : CostFeatures
            Features of both images.
        support : ndarray (4, ARM, H, W) uint8
            Support arms of the whole left image.
        rows : tuple of int
            First row, and the row after the last.
        first : int
            First disparity.
        noise : float
            Standard deviation of the noise in grey levels.
        max_cost : int
            Cost of the worst match.
        """
        start, stop = rows
        cost_volume(
            left.rows(start, stop),
            right.rows(start, stop),
            np.ascontiguousarray(support[:, :, start:stop]),
            first,
            self._weights(len(left.channels), noise, max_cost),
            np.uint8(round(self.outside * max_cost)),
            out,
        )

    def _weights(self, channels: int, noise: float, max_cost: int) -> I16:
        one = max_cost << WEIGHT_SHIFT
        cap = min(max(round(self.truncation * noise * LEVELS * channels), channels), 255 * LEVELS * channels)
        of_bit = round(self.census_share * one / CENSUS_BITS)
        of_level = max(round((1.0 - self.census_share) * one / cap), int(self.census_share < 1.0))
        return np.array([of_bit, of_level, cap, self.sampling_insensitive], np.int16)

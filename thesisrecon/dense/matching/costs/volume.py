"""Matching costs of a strip of rows as bytes: census and truncated colour difference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.dense.matching.costs.kernels import (
    ARM,
    LEVELS,
    WEIGHT_SHIFT,
    census,
    cost_volume,
    sampled_bounds,
    support_masks,
)
from thesisrecon.dense.matching.pair import Side

I16 = NDArray[np.int16]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]

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

"""Left-right check, peak filter, pinholes, smoothing, confidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.dense.matching.costs.kernels import LEVELS
from thesisrecon.dense.matching.finish.kernels import (
    check_left_right,
    fill_pinholes,
    rate,
    remove_peaks,
    smooth_alike,
    squared_gradient,
)
from thesisrecon.dense.matching.pair import Side
from thesisrecon.types import DisparityMap

F32 = NDArray[np.float32]

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
class Finish:
    """What is believed of the best disparities.

    ``left_right_px``: the partner's own best disparity may differ by as much. ``smallest_piece``: connected
    pieces of fewer pixels are peaks and go, as do larger ones all but without texture. ``least_confidence``:
    less is unknown. ``radius``: every
    disparity becomes the mean of those within so many pixels that differ from it by a pixel at most, which
    takes the noise of the sub-pixel fit from a surface and leaves its edges.
    """

    left_right_px: float = 1.0
    smallest_piece: int = 60
    least_confidence: float = 0.02
    radius: int = 2

    def __post_init__(self) -> None:
        if not (self.left_right_px >= 0.0 and self.smallest_piece >= 0 and self.radius >= 0):
            raise ValueError("left_right_px, smallest_piece and radius must not be negative")
        if not 0.0 <= self.least_confidence < 1.0:
            raise ValueError(f"least_confidence must be in [0, 1); got {self.least_confidence}")

    def apply(self, left: F32, right: F32, confidence: F32, texture: F32) -> DisparityMap:
        """The map of disparities (H, W) of the left pixels, given those of the right ones, NaN = none.

        ``texture`` (H, W) from :func:`texture_of`: what surfaces without any inherit from their rims is kept,
        with little confidence. Takes possession of ``left`` and ``confidence``.
        """
        limits = np.array([self.left_right_px, self.least_confidence], np.float32)
        check_left_right(left, right, confidence, limits)
        remove_peaks(left, texture > TEXTURED, STEP_PX, self.smallest_piece)
        closed = np.empty_like(left)
        fill_pinholes(left, SURROUNDED, closed)
        closed[np.isnan(texture)] = np.nan
        smooth = np.empty_like(left)
        smooth_alike(closed, STEP_PX, self.radius, smooth)
        rate(confidence, left, smooth, texture)
        return DisparityMap(smooth, confidence, _noise(closed, smooth))


def texture_of(side: Side, noise: float) -> F32:
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

"""What every matcher needs of a rectified pair: whole-numbered channels, which pixels exist, the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thesisrecon.dense.matching.costs.kernels import LEVELS, split_bytes, split_channels

F32 = NDArray[np.float32]
I16 = NDArray[np.int16]
U8 = NDArray[np.uint8]

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

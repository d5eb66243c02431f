"""Resampling a photograph into a rectified frame, strip by strip."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from thesisrecon.dense.rectification.kernels import sample_image
from thesisrecon.types import F32, F64

STRIP_ROWS = 64
"""Rows whose lookup is held in memory at a time."""


class Lookup(Protocol):
    """Where the pixels of a rectified frame come from."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frame, common to both sides."""

    def lookup(self, side: int, rows: range) -> F64:
        """(len(rows), width, 2) px in the photograph of ``side``."""


def warp_image(source: Lookup, image: F32, side: int) -> F32:
    """``image`` (H, W) or (H, W, C) in the frame of ``source``: float32, NaN outside.

    Cubic convolution; where the photograph shrinks the kernel is widened by as much. Beside the image itself
    the memory is that of ``STRIP_ROWS`` rows. ``ValueError`` for images of another shape or side.
    """
    if image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"an image to warp is (H, W) or (H, W, C); got shape {image.shape}")
    pixels = np.ascontiguousarray(image, dtype=np.float32)
    pixels = pixels[:, :, None] if pixels.ndim == 2 else pixels
    width, height = source.size
    out = np.empty((height, width, pixels.shape[2]), np.float32)
    for first in range(0, height, STRIP_ROWS):
        last = min(first + STRIP_ROWS, height)
        # One row more where there is one: distances of neighbours tell how the photograph shrinks.
        start = first - 1 if last == height and last - first == 1 and first > 0 else first
        places = source.lookup(side, range(start, min(last + 1, height)))
        strip = out[start:last] if start == first else np.empty((last - start, *out.shape[1:]), np.float32)
        sample_image(pixels, places, strip)
        out[first:last] = strip[first - start :]
    return out[:, :, 0] if image.ndim == 2 else out


def require_side(side: int) -> int:
    """0 or 1, else ``ValueError``."""
    if side not in (0, 1):
        raise ValueError(f"a side of a rectified pair is 0 or 1; got {side}")
    return side

"""Decoded images as 8-bit RGB at working size, within a known amount of memory.

The decoded image is held once, in the mode of its file. Rotation, conversion and reduction process a few rows
at a time: on the whole image each of them would need another four bytes per pixel.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import PIL.Image
from PIL.Image import Transpose

from thesisrecon.arrays import B8, F64, U8

_STRIPE_ROWS = 256
"""Rows converted at a time."""
_REDUCING_GAP = 3.0
"""Reduction left to the Lanczos filter; larger reductions average whole pixels first."""
_LANCZOS = PIL.Image.Resampling.LANCZOS
_DECODED_BYTES, _COEFFICIENT_BYTES = 4, 2
_DECODED_BYTES_OF = {"WEBP": 16, "AVIF": 14, "HEIF": 14, "JPEG2000": 20}
"""Measured bytes per pixel at the peak of decoding; these decoders hold the image several times."""


class UnusableImage(Exception):
    """An image that cannot be used; the text is the reason, to follow the file name."""


class MemoryBudget:
    """A memory limit in bytes that the threads of the program share."""

    def __init__(self, total: int) -> None:
        self._total, self._held, self._change = total, 0, threading.Condition()

    @contextmanager
    def reserve(self, amount: int) -> Iterator[None]:
        """Reserve bytes for a block; wait until they are free, or until nothing else is reserved."""
        with self._change:
            self._change.wait_for(lambda: not self._held or self._held + amount <= self._total)
            self._held += amount
        try:
            yield
        finally:
            with self._change:
                self._held -= amount
                self._change.notify_all()


def decoding_bytes(file: PIL.Image.Image) -> int:
    """Estimate the peak memory of decoding; a progressive JPEG also holds all its coefficients."""
    each = _DECODED_BYTES_OF.get(file.format or "", _DECODED_BYTES)
    if file.info.get("progressive"):
        each += _COEFFICIENT_BYTES * len(file.getbands())
    return each * file.size[0] * file.size[1]


EXIF_TRANSFORMS = {
    2: Transpose.FLIP_LEFT_RIGHT,
    3: Transpose.ROTATE_180,
    4: Transpose.FLIP_TOP_BOTTOM,
    5: Transpose.TRANSPOSE,
    6: Transpose.ROTATE_270,
    7: Transpose.TRANSVERSE,
    8: Transpose.ROTATE_90,
}
"""Transform to the upright image by EXIF orientation; with any other value the image is used as stored."""
EXIF_INVERSE = EXIF_TRANSFORMS | {6: Transpose.ROTATE_90, 8: Transpose.ROTATE_270}
"""Transform back to the stored image."""
_ROWS_ARE_COLUMNS = {EXIF_TRANSFORMS[orientation] for orientation in (5, 6, 7, 8)}
_ROWS_FROM_END = {EXIF_TRANSFORMS[orientation] for orientation in (3, 4, 7, 8)}


@dataclass(frozen=True)
class StoredImage:
    """A decoded Pillow image of any mode, seen upright by its ``transform`` (None = as stored) and as RGB."""

    stored: PIL.Image.Image
    transform: Transpose | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the upright image."""
        width, height = self.stored.size
        return (height, width) if self.transform in _ROWS_ARE_COLUMNS else (width, height)

    def rows(self, start: int, stop: int) -> PIL.Image.Image:
        """Rows ``start`` to ``stop`` of the upright image in RGB."""
        part = self._stored_part(start, stop)
        rgb = self._eight_bit(part) if self._deep else _rgb(part)
        return rgb if self.transform is None else rgb.transpose(self.transform)

    def stripes(self, height: int = _STRIPE_ROWS) -> Iterator[tuple[int, int]]:
        """(start, stop) of stripes of rows of the upright image."""
        return ((start, min(start + height, self.size[1])) for start in range(0, self.size[1], height))

    def nonblack(self) -> B8:
        """Pixels (H, W) of the upright image whose grey level is not 0, whatever their transparency."""
        grey = self.stored if self._deep else self.stored.convert("L")
        return np.asarray(np.asarray(grey if self.transform is None else grey.transpose(self.transform)) != 0)

    def _stored_part(self, start: int, stop: int) -> PIL.Image.Image:
        width, height = self.stored.size
        if self.transform in _ROWS_FROM_END:
            start, stop = self.size[1] - stop, self.size[1] - start
        columns = self.transform in _ROWS_ARE_COLUMNS
        return self.stored.crop((start, 0, stop, height) if columns else (0, start, width, stop))

    @property
    def _deep(self) -> bool:
        return self.stored.mode.startswith("I") or self.stored.mode == "F"

    @cached_property
    def _range(self) -> tuple[float, float]:
        """Values of black and white: integers by their bit depth, floats by their range."""
        values = (_finite(self._stored_part(*stripe)) for stripe in self.stripes())
        lows, highs = zip(*((part.min(), part.max()) for part in values), strict=True)
        if self.stored.mode == "F":
            return min(lows), max(highs)
        # Otherwise a 12-bit image in a 16-bit file would be nearly black.
        return 0.0, 2.0 ** max(8, int(max(highs)).bit_length()) - 1

    def _eight_bit(self, part: PIL.Image.Image) -> PIL.Image.Image:
        low, high = self._range
        grey = (_finite(part) - low) * (255.0 / max(high - low, 1e-12))
        return PIL.Image.fromarray(np.rint(np.clip(grey, 0, 255)).astype(np.uint8)).convert("RGB")


def _finite(part: PIL.Image.Image) -> F64:
    return np.nan_to_num(np.asarray(part).astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)


def _rgb(part: PIL.Image.Image) -> PIL.Image.Image:
    """Convert to RGB; transparent pixels become mid-grey, since their colours are meaningless."""
    # The A of LAB is a colour.
    if part.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in part.info:
        layered = part.convert("RGBA")
        ground = PIL.Image.new("RGBA", layered.size, (128, 128, 128, 255))
        return PIL.Image.alpha_composite(ground, layered).convert("RGB")
    return part.convert("RGB")


def resized_to(image: StoredImage, max_size_px: int) -> U8:
    """Reduce an image to a long side by one exact scale s along both axes, (x + 0.5) s - 0.5."""
    width, height = image.size
    scale = max_size_px / max(width, height)
    if scale >= 1:
        rgb = np.empty((height, width, 3), dtype=np.uint8)
        for start, stop in image.stripes():
            rgb[start:stop] = np.asarray(image.rows(start, stop))
        return rgb
    long, short = max_size_px, math.floor(min(width, height) * scale)
    size = (long, short) if width >= height else (short, long)
    if min(size) < 1:
        raise UnusableImage(f"has {width} x {height} pixels: too narrow to be reduced to {max_size_px}")
    return _resized(image, size, (min(width, size[0] / scale), min(height, size[1] / scale)))


def _resized(image: StoredImage, size: tuple[int, int], extent: tuple[float, float]) -> U8:
    """Resize the top left ``extent``: block averages, then the filter along rows, then along columns.

    These are the steps of Pillow's ``resize`` with a ``reducing_gap``, all but the last stripe by stripe.
    (Pillow itself may begin with the columns if an image is more than twice as high as wide.)
    """
    by = [max(int(e / s / _REDUCING_GAP), 1) for e, s in zip(extent, size, strict=True)]
    narrow = PIL.Image.new("RGB", (size[0], -(-image.size[1] // by[1])))
    for start, stop in image.stripes(max(_STRIPE_ROWS // by[1], 1) * by[1]):
        part = image.rows(start, stop).reduce((by[0], by[1]))
        box = (0.0, 0.0, extent[0] / by[0], float(part.height))
        narrow.paste(part.resize((size[0], part.height), _LANCZOS, box=box), (0, start // by[1]))
    return np.array(narrow.resize(size, _LANCZOS, box=(0.0, 0.0, float(size[0]), extent[1] / by[1])))

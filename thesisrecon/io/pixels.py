"""A decoded picture as 8-bit RGB at working size, in a room that is known beforehand.

The picture is held once, as its file has it. Turning it upright, converting it and making it smaller go a few
rows at a time: each of these on the whole picture would hold it once more, in four bytes a pixel.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import PIL.Image

from thesisrecon.arrays import F64, U8

STRIPE = 256
"""Rows that are converted at a time."""
REDUCING_GAP = 3.0
"""By how much the costly filter makes a picture smaller; what is above is left to means of whole pixels."""
LANCZOS = PIL.Image.Resampling.LANCZOS

_DECODED, _COEFFICIENTS = 4, 2
_DECODED_BY = {"WEBP": 16, "AVIF": 14, "HEIF": 14, "JPEG2000": 20}
"""Bytes a pixel at the peak of decoding, measured; these decoders hold the picture several times."""


class Refused(Exception):
    """One photograph cannot be used; the text is the reason."""


class Room:
    """Bytes that the threads of the program may hold together; who asks for more than are left waits."""

    def __init__(self, total: int) -> None:
        self._total, self._held, self._change = total, 0, threading.Condition()

    @contextmanager
    def taken(self, amount: int) -> Iterator[None]:
        """Hold ``amount`` bytes in this block; who needs more than there are is let in alone."""
        with self._change:
            self._change.wait_for(lambda: not self._held or self._held + amount <= self._total)
            self._held += amount
        try:
            yield
        finally:
            with self._change:
                self._held -= amount
                self._change.notify_all()


def bytes_to_decode(file: PIL.Image.Image) -> int:
    """What decoding an opened file takes at its peak.

    A JPEG that comes in several scans is held as all its coefficients, two bytes each, beside its pixels.
    """
    each = _DECODED_BY.get(file.format or "", _DECODED)
    if file.info.get("progressive"):
        each += _COEFFICIENTS * len(file.getbands())
    return each * file.size[0] * file.size[1]


class Turn(NamedTuple):
    """How a picture is put upright: by this ``method`` (None: as it is), by which the rows of the upright one
    come from ``columns`` of the stored one or from its rows, ``from_end`` or from the beginning."""

    method: PIL.Image.Transpose | None = None
    columns: bool = False
    from_end: bool = False


AS_STORED = Turn()
TURNS = {
    2: Turn(PIL.Image.Transpose.FLIP_LEFT_RIGHT),
    3: Turn(PIL.Image.Transpose.ROTATE_180, from_end=True),
    4: Turn(PIL.Image.Transpose.FLIP_TOP_BOTTOM, from_end=True),
    5: Turn(PIL.Image.Transpose.TRANSPOSE, columns=True),
    6: Turn(PIL.Image.Transpose.ROTATE_270, columns=True),
    7: Turn(PIL.Image.Transpose.TRANSVERSE, columns=True, from_end=True),
    8: Turn(PIL.Image.Transpose.ROTATE_90, columns=True, from_end=True),
}
"""By the orientation that EXIF tells; with any other the picture stands as it is stored."""


@dataclass(frozen=True)
class Picture:
    """A decoded picture of any mode of Pillow's, seen upright and as 8-bit RGB."""

    stored: PIL.Image.Image
    turn: Turn = AS_STORED

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) when upright."""
        width, height = self.stored.size
        return (height, width) if self.turn.columns else (width, height)

    def rows(self, start: int, stop: int) -> PIL.Image.Image:
        """Some rows of the upright picture, in RGB."""
        part = self._cut(start, stop)
        rgb = self._eight_bit(part) if self._deep else _rgb(part)
        return rgb if self.turn.method is None else rgb.transpose(self.turn.method)

    def stripes(self, height: int = STRIPE) -> Iterator[tuple[int, int]]:
        """(start, stop) of stripes of so many rows that make up the upright picture."""
        return ((start, min(start + height, self.size[1])) for start in range(0, self.size[1], height))

    def _cut(self, start: int, stop: int) -> PIL.Image.Image:
        """What becomes these rows, as it is stored."""
        width, height = self.stored.size
        if self.turn.from_end:
            start, stop = self.size[1] - stop, self.size[1] - start
        return self.stored.crop((start, 0, stop, height) if self.turn.columns else (0, start, width, stop))

    @property
    def _deep(self) -> bool:
        return self.stored.mode.startswith("I") or self.stored.mode == "F"

    @cached_property
    def _range(self) -> tuple[float, float]:
        """What becomes black and white: whole numbers by their bit depth, real numbers by their range."""
        values = (_finite(self._cut(*stripe)) for stripe in self.stripes())
        lows, highs = zip(*((part.min(), part.max()) for part in values), strict=True)
        if self.stored.mode == "F":
            return min(lows), max(highs)
        # A 12-bit sensor in a 16-bit file must not come out nearly black.
        return 0.0, 2.0 ** max(8, int(max(highs)).bit_length()) - 1

    def _eight_bit(self, part: PIL.Image.Image) -> PIL.Image.Image:
        low, high = self._range
        grey = (_finite(part) - low) * (255.0 / max(high - low, 1e-12))
        return PIL.Image.fromarray(np.rint(np.clip(grey, 0, 255)).astype(np.uint8)).convert("RGB")


def _finite(part: PIL.Image.Image) -> F64:
    return np.nan_to_num(np.asarray(part).astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)


def _rgb(part: PIL.Image.Image) -> PIL.Image.Image:
    """RGB; what is transparent becomes mid-grey, since the colours under it mean nothing."""
    # The A of LAB is a colour.
    if part.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in part.info:
        layered = part.convert("RGBA")
        ground = PIL.Image.new("RGBA", layered.size, (128, 128, 128, 255))
        return PIL.Image.alpha_composite(ground, layered).convert("RGB")
    return part.convert("RGB")


def at_working_size(picture: Picture, max_size_px: int) -> U8:
    """(H, W, 3): the picture with its long side at most ``max_size_px``, at one exact scale s along both
    axes: (x + 0.5) s - 0.5.

    Raises :class:`Refused` where nothing of the short side would be left.
    """
    width, height = picture.size
    scale = max_size_px / max(width, height)
    if scale >= 1:
        rgb = np.empty((height, width, 3), dtype=np.uint8)
        for start, stop in picture.stripes():
            rgb[start:stop] = np.asarray(picture.rows(start, stop))
        return rgb
    size = (
        (max_size_px, math.floor(height * scale))
        if width >= height
        else (math.floor(width * scale), max_size_px)
    )
    if min(size) < 1:
        raise Refused(f"is {width} x {height} pixels: too narrow to be reduced to {max_size_px}")
    return _resized(picture, size, (min(width, size[0] / scale), min(height, size[1] / scale)))


def _resized(picture: Picture, size: tuple[int, int], extent: tuple[float, float]) -> U8:
    """The top left ``extent`` of the picture at this ``size``.

    Means of whole pixels, then the filter along the rows, then along the columns: the steps of Pillow's
    ``resize`` with a ``reducing_gap``, of which all but the last go stripe by stripe. (Pillow itself may
    begin with the columns where a picture is more than twice as high as wide.)
    """
    by = [max(int(e / s / REDUCING_GAP), 1) for e, s in zip(extent, size, strict=True)]
    narrow = PIL.Image.new("RGB", (size[0], -(-picture.size[1] // by[1])))
    for start, stop in picture.stripes(max(STRIPE // by[1], 1) * by[1]):
        part = picture.rows(start, stop).reduce((by[0], by[1]))
        box = (0.0, 0.0, extent[0] / by[0], float(part.height))
        narrow.paste(part.resize((size[0], part.height), LANCZOS, box=box), (0, start // by[1]))
    return np.array(narrow.resize(size, LANCZOS, box=(0.0, 0.0, float(size[0]), extent[1] / by[1])))


def picture_from_array(array: Any) -> Picture:
    """The picture of an (H, W) or (H, W, 3) uint8 array; ``ValueError`` for any other."""
    array = np.asarray(array)
    if array.dtype != np.uint8 or array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise ValueError(f"an image array must be (H, W) or (H, W, 3) uint8; got {array.shape} {array.dtype}")
    return Picture(PIL.Image.fromarray(array))

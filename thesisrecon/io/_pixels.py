"""Decoded images as 8-bit RGB at working size, within a known amount of memory, and refused raw files.

The decoded image is held once, in the mode of its file. Rotation, conversion and reduction process a few rows
at a time: on the whole image each of them would need another four bytes per pixel.
"""

import io
import math
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, BinaryIO

import numpy as np
import PIL.Image
import PIL.ImageCms
from PIL.Image import Transpose
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from thesisrecon.arrays import B8, F64, U8
from thesisrecon.errors import Notice

_STRIPE_ROWS = 256  # Rows converted at a time
_LANCZOS = PIL.Image.Resampling.LANCZOS
OPAQUE = 128  # Least alpha of a pixel that is used: at least half of it is covered


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
    # Measured bytes per pixel at the peak; these decoders hold the image several times.
    each = {"WEBP": 16, "AVIF": 14, "HEIF": 14, "JPEG2000": 20}.get(file.format or "", 4)
    if file.info.get("progressive"):
        each += 2 * len(file.getbands())
    return each * file.size[0] * file.size[1]


EXIF_TRANSFORMS = {
    2: Transpose.FLIP_LEFT_RIGHT, 3: Transpose.ROTATE_180, 4: Transpose.FLIP_TOP_BOTTOM,
    5: Transpose.TRANSPOSE, 6: Transpose.ROTATE_270, 7: Transpose.TRANSVERSE, 8: Transpose.ROTATE_90,
}  # fmt: skip
"""Transform to the upright image by EXIF orientation; with any other value the image is used as stored."""
EXIF_INVERSE = EXIF_TRANSFORMS | {6: Transpose.ROTATE_90, 8: Transpose.ROTATE_270}
"""Transform back to the stored image."""
_ROWS_ARE_COLUMNS = {EXIF_TRANSFORMS[orientation] for orientation in (5, 6, 7, 8)}
_ROWS_FROM_END = {EXIF_TRANSFORMS[orientation] for orientation in (3, 4, 7, 8)}


@dataclass(frozen=True)
class StoredImage:
    """A decoded Pillow image in RGB, or RGBA, seen upright by its ``transform`` (None = as stored)."""

    stored: PIL.Image.Image
    transform: Transpose | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the upright image."""
        width, height = self.stored.size
        return (height, width) if self.transform in _ROWS_ARE_COLUMNS else (width, height)

    def rows(self, start: int, stop: int) -> PIL.Image.Image:
        """Rows ``start`` to ``stop`` of the upright image in RGB; in RGBa (premultiplied) if ``layered``."""
        part = self._stored_part(start, stop)
        if self._deep:
            levels = self._eight_bit(part)
        else:
            # Resampling averages colours times alpha, so that those of transparent pixels have no weight.
            levels = part.convert("RGBA").convert("RGBa") if self.layered else self._in_srgb(part)
        return levels if self.transform is None else levels.transpose(self.transform)

    @property
    def layered(self) -> bool:
        """Whether pixels may be transparent. (The A of LAB is a colour.)"""
        return self.stored.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in self.stored.info

    def stripes(self, height: int = _STRIPE_ROWS) -> Iterator[tuple[int, int]]:
        """(start, stop) of stripes of rows of the upright image."""
        return ((start, min(start + height, self.size[1])) for start in range(0, self.size[1], height))

    def unmasked(self) -> B8:
        """Pixels (H, W) that the upright image uses as a mask: neither black nor transparent.

        The transparency alone if no pixel or all are black; the colours alone if nothing else is left.
        """
        grey = self.stored if self._deep else self.stored.convert("L")
        upright = grey if self.transform is None else grey.transpose(self.transform)
        nonblack = np.asarray(np.asarray(upright) != 0)
        if not self.layered:
            return nonblack
        parts = (np.asarray(self.rows(*stripe).getchannel("a")) >= OPAQUE for stripe in self.stripes())
        opaque = np.concatenate(list(parts))
        if nonblack.all() or not nonblack.any():
            return opaque
        both = nonblack & opaque
        return both if both.any() else nonblack

    def _in_srgb(self, part: PIL.Image.Image) -> PIL.Image.Image:
        """Rows in RGB, converted from the colour space of the file to that of displays."""
        if self._to_srgb is None:
            return part.convert("RGB")
        converted = PIL.ImageCms.applyTransform(part, self._to_srgb)
        assert converted is not None
        return converted

    @cached_property
    def _to_srgb(self) -> PIL.ImageCms.ImageCmsTransform | None:
        """Transform by the ICC profile (Display P3, Adobe RGB); None without one that differs from sRGB."""
        stored = self.stored.info.get("icc_profile")
        if not stored or self.stored.mode != "RGB":
            return None
        try:
            profile = PIL.ImageCms.ImageCmsProfile(io.BytesIO(stored))
            if "sRGB" in PIL.ImageCms.getProfileDescription(profile):
                return None
            srgb = PIL.ImageCms.createProfile("sRGB")
            return PIL.ImageCms.buildTransform(profile, srgb, "RGB", "RGB")
        except Exception:
            # Pillow may be built without colour management, and profiles may be damaged.
            return None

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
        levels = PIL.Image.fromarray(np.rint(np.clip(grey, 0, 255)).astype(np.uint8)).convert("RGB")
        if not self.layered:
            return levels
        opaque = np.asarray(part) != self.stored.info["transparency"]
        levels.putalpha(PIL.Image.fromarray(np.where(opaque, 255, 0).astype(np.uint8)))
        return levels.convert("RGBa")


def _finite(part: PIL.Image.Image) -> F64:
    return np.nan_to_num(np.asarray(part).astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)


def resized_to(image: StoredImage, max_size_px: int) -> U8:
    """Reduce an image by one exact scale s, (x + 0.5) s - 0.5, to (H, W, 3), or (H, W, 4) if ``layered``."""
    width, height = image.size
    scale = max_size_px / max(width, height)
    if scale >= 1:
        levels = np.empty((height, width, 4 if image.layered else 3), dtype=np.uint8)
        for start, stop in image.stripes():
            levels[start:stop] = _straight(image.rows(start, stop))
        return levels
    long, short = max_size_px, math.floor(min(width, height) * scale)
    size = (long, short) if width >= height else (short, long)
    if min(size) < 1:
        raise UnusableImage(Notice("too-narrow", width, height, max_size_px))
    return _resized(image, size, (min(width, size[0] / scale), min(height, size[1] / scale)))


def opaque_part(levels: U8) -> tuple[U8, B8 | None]:
    """RGB, grey where it is transparent, and the other pixels as a mask, None if all are opaque."""
    if levels.shape[2] == 3:
        return levels, None
    mask = levels[:, :, 3] >= OPAQUE
    if not mask.any():
        raise UnusableImage(Notice("transparent"))
    rgb = np.ascontiguousarray(levels[:, :, :3])
    rgb[~mask] = 128
    return rgb, None if mask.all() else mask


def _straight(levels: PIL.Image.Image) -> U8:
    """Levels of RGB, or of RGBA from colours times alpha."""
    return np.array(levels.convert("RGBA") if levels.mode == "RGBa" else levels)


def _resized(image: StoredImage, size: tuple[int, int], extent: tuple[float, float]) -> U8:
    """Resize the top left ``extent`` by the steps of Pillow (blocks, rows, columns), stripe by stripe."""
    # The filter reduces by 3; larger reductions average whole pixels first.
    by = [max(int(e / s / 3.0), 1) for e, s in zip(extent, size, strict=True)]
    mode = "RGBa" if image.layered else "RGB"
    narrow = PIL.Image.new(mode, (size[0], -(-image.size[1] // by[1])))
    for start, stop in image.stripes(max(_STRIPE_ROWS // by[1], 1) * by[1]):
        part = image.rows(start, stop).reduce((by[0], by[1]))
        box = (0.0, 0.0, extent[0] / by[0], float(part.height))
        narrow.paste(part.resize((size[0], part.height), _LANCZOS, box=box), (0, start // by[1]))
    return _straight(narrow.resize(size, _LANCZOS, box=(0.0, 0.0, float(size[0]), extent[1] / by[1])))


RAW_SUFFIXES = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".rw2", ".rwl", ".orf", ".raf"),
    *(".pef", ".srw", ".3fr", ".fff", ".iiq", ".erf", ".kdc", ".dcr", ".mrw", ".mos", ".mef", ".x3f", ".gpr"),
)
RAW_FILE = Notice("raw-file")
RAW_SIGNATURE = re.compile(
    rb"FUJIFILMCCD-RAW|IIR[OS]|MMOR|IIU\0|FOVb|\0MRM|II\x1a\0\0\0HEAPCCDR|....ftypcrx |II\*\0....CR\x02\0",
    re.DOTALL,
)
"""First bytes of raw files; only the last kind (CR2) is a TIFF file."""
_Tags = Mapping[int, Any]


def refuse_raw_file(stream: BinaryIO, suffix: str) -> None:
    """Raise ``UnusableImage`` if the image that Pillow would read is not the main one of the file."""
    head = stream.read(32)
    if RAW_SIGNATURE.match(head):
        raise UnusableImage(RAW_FILE)
    if not re.match(rb"II[*+]\0|MM\0[*+]", head):
        return
    if suffix.lower() in RAW_SUFFIXES:
        raise UnusableImage(RAW_FILE)
    at, pages = _directory(stream, head).next, dict[int, ImageFileDirectory_v2]()
    # Until the file ends or repeats.
    while at and at not in pages and len(pages) < 1000:
        pages[at] = _directory(stream, head, at)
        at = pages[at].next
    if not pages:
        return
    first, *others = pages.values()
    size, inner = _size(first), list[_Tags]()
    for page in pages.values():
        # The tags of the images inside a page, which has at most a few.
        places = page.get(330, ())
        places = places if isinstance(places, tuple) else (places,)
        inner += [_directory(stream, head, at) for at in places[:16]]
    # Colour filter array, or linear raw; the version of a DNG.
    sensor = any(tags.get(262) in (32803, 34892) for tags in [*pages.values(), *inner]) or 50706 in first
    if sensor or any(math.prod(_size(tags)) > math.prod(size) for tags in inner):
        raise UnusableImage(RAW_FILE)
    reduced = first.get(254, 0) & 1 or first.get(255, 0) == 2
    # Larger than the first, and of the same ratio of sides within rounding.
    larger = [(w, h) for w, h in map(_size, others) if w > size[0]]
    if (reduced and others) or any(abs(w * size[1] - h * size[0]) <= max(w, h) for w, h in larger):
        raise UnusableImage(Notice("reduced-image", size[0], size[1]))


def _size(tags: _Tags) -> tuple[int, int]:
    return tags.get(256, 0), tags.get(257, 0)


def _directory(stream: BinaryIO, head: bytes, at: int = 0) -> ImageFileDirectory_v2:
    """The tags of an image of a TIFF file, and the place of the next one; at 0 only that of the first."""
    tags = ImageFileDirectory_v2(head[: 16 if b"+" in head[2:4] else 8])
    if at:
        stream.seek(min(at, 2**62))
        tags.load(stream)
    return tags

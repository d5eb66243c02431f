"""Raw files of cameras, and TIFF files that begin with a reduced image: Pillow would read the thumbnail."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from itertools import chain
from typing import Any, BinaryIO

from thesisrecon.errors import Notice
from thesisrecon.io._pixels import UnusableImage

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
_SUBFILE, _OLD_SUBFILE, _WIDTH, _HEIGHT, _PHOTOMETRIC, _SUB_IFDS, _DNG_VERSION = (
    254, 255, 256, 257, 262, 330, 50706,
)  # fmt: skip
_SENSOR_DATA = (32803, 34892)
"""Photometric interpretations: colour filter array and linear raw."""
_FORMATS = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
"""Formats of the whole numbers among the TIFF types."""
_MAX_ENTRIES, _MAX_PAGES, _MAX_SUB_IFDS = 4096, 1000, 16
_Tags = dict[int, tuple[int, ...]]


def refuse_raw_file(stream: BinaryIO, suffix: str) -> None:
    """Raise ``UnusableImage`` if the image that Pillow would read is not the main one of the file."""
    head = stream.read(32)
    if RAW_SIGNATURE.match(head):
        raise UnusableImage(RAW_FILE)
    if not re.match(rb"II[*+]\0|MM\0[*+]", head):
        return
    if suffix.lower() in RAW_SUFFIXES:
        raise UnusableImage(RAW_FILE)
    reader = _TiffTags(stream, head)
    pages = list(reader.pages())
    if not pages:
        return
    first, size = pages[0], _size(pages[0])
    inner = [tags for page in pages for tags in reader.inner(page)]
    sensor = any(tags.get(_PHOTOMETRIC, (0,))[0] in _SENSOR_DATA for tags in chain(pages, inner))
    if sensor or _DNG_VERSION in first or any(_area(tags) > _area(first) for tags in inner):
        raise UnusableImage(RAW_FILE)
    reduced = first.get(_SUBFILE, (0,))[0] & 1 or first.get(_OLD_SUBFILE, (0,))[0] == 2
    if (reduced and len(pages) > 1) or any(_enlarges(_size(page), size) for page in pages[1:]):
        raise UnusableImage(Notice("reduced-image", size[0], size[1]))


def _size(tags: _Tags) -> tuple[int, int]:
    return tags.get(_WIDTH, (0,))[0], tags.get(_HEIGHT, (0,))[0]


def _area(tags: _Tags) -> int:
    return _size(tags)[0] * _size(tags)[1]


def _enlarges(size: tuple[int, int], first: tuple[int, int]) -> bool:
    """Whether an image is larger than the first, and of the same ratio of sides within rounding."""
    return size[0] > first[0] and abs(size[0] * first[1] - size[1] * first[0]) <= max(size)


class _TiffTags:
    """The tags of the pages of a TIFF file that are whole numbers, without their other content."""

    def __init__(self, stream: BinaryIO, head: bytes) -> None:
        self.stream, order = stream, "<" if head[:1] == b"I" else ">"
        big = b"+" in head[2:4]
        kinds = ("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")
        self.count, self.entry, self.offset = (order + kind for kind in kinds)
        self.order, self.start = order, 8 if big else 4

    def pages(self) -> Iterator[_Tags]:
        """The tags of each page, until the file ends or repeats."""
        (at,), seen = self._read(self.start, self.offset), set[int]()
        while at and at not in seen and len(seen) < _MAX_PAGES:
            seen.add(at)
            tags, at = self._directory(at)
            if tags:
                yield tags

    def inner(self, tags: _Tags) -> list[_Tags]:
        """The tags of the images inside a page."""
        return [self._directory(at)[0] for at in tags.get(_SUB_IFDS, ())[:_MAX_SUB_IFDS]]

    def _directory(self, at: int) -> tuple[_Tags, int]:
        (count,) = self._read(at, self.count)
        at, tags, width = at + struct.calcsize(self.count), _Tags(), struct.calcsize(self.entry)
        for n in range(min(count, _MAX_ENTRIES)):
            tag, kind, length, value = self._read(at + n * width, self.entry)
            if kind in _FORMATS and 0 < length <= _MAX_SUB_IFDS:
                wanted = f"{self.order}{length}{_FORMATS[kind]}"
                if struct.calcsize(wanted) <= len(value):
                    tags[tag] = struct.unpack(wanted, value[: struct.calcsize(wanted)])
                else:
                    tags[tag] = self._read(struct.unpack(self.offset, value)[0], wanted)
        return tags, self._read(at + count * width, self.offset)[0]

    def _read(self, at: int, wanted: str) -> tuple[Any, ...]:
        """Values at an offset; zeros behind the end, since damaged files are for the decoder to refuse."""
        size = struct.calcsize(wanted)
        self.stream.seek(min(at, 2**62))
        return struct.unpack(wanted, self.stream.read(size).ljust(size, b"\0"))

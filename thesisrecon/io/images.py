"""Photographs in: every common file as 8-bit RGB at working size, and a reason for each that cannot be read.

Resizing keeps one exact scale s along both axes, (x + 0.5) s - 0.5, so that square pixels stay square: the
last row of a photograph may be cut by less than a working pixel for it.
"""

from __future__ import annotations

import hashlib
import math
import stat
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io.files import NO_FILE, printable
from thesisrecon.io.pixels import (
    AS_STORED,
    TURNS,
    Picture,
    Refused,
    Room,
    Turn,
    at_working_size,
    bytes_to_decode,
    picture_from_array,
)
from thesisrecon.records import Image

ImageSource: TypeAlias = str | Path | Sequence[str | Path | NDArray[Any] | Image]

# What a photograph may be called. Raw and HEIC files are listed so that they are refused by name, not
# overlooked.
SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".bmp", ".webp", ".gif", ".jp2", ".avif"),
    *(".ppm", ".pgm", ".pbm", ".pnm", ".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".rw2"),
)
COMMON_NAMES = ("images", "photographs", "photos", "pictures", "dcim")
LARGEST_FILE = 2**31
"""Bytes; the largest sensors without any compression stay below half of it."""
LARGEST_DECODED = 3 * 2**29
"""Bytes that one photograph may take while it is decoded, and several together that are read at one time: 151
megapixels, the largest sensors, in the costliest kind of JPEG."""
MIN_SIDE = 64
BLANK_RANGE = 8
READ = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "GIF", "JPEG2000", "AVIF", "HEIF", "PPM")
"""What Pillow may take a file for, whatever it is called: some of its other readers start programs."""
_ORIENTATION, _EXIF_IFD, _FOCAL_35MM = 0x0112, 0x8769, 0xA405
_WIDTH_35MM = 36.0
_FOCALS_35MM = (1.0, 1e5)
"""mm; what a header says beyond is a mistake."""
_room = Room(LARGEST_DECODED)


@dataclass(frozen=True)
class Photograph:
    """A photograph that was read: the ``image``, a ``digest`` of its content, what EXIF says of the focal
    length (original px, NaN = nothing), and a ``note`` the user should see (empty: none)."""

    image: Image
    digest: str
    exif_focal_px: float = math.nan
    note: str = ""


@dataclass(frozen=True)
class PhotographSet:
    """The photographs that were read, sorted by name, and the others: name -> why not."""

    photographs: tuple[Photograph, ...]
    refused: dict[str, str]

    @property
    def images(self) -> tuple[Image, ...]:
        """The V views."""
        return tuple(p.image for p in self.photographs)

    @property
    def exif_focal_px(self) -> F64:
        """(V,) original px, NaN = not said."""
        return np.array([p.exif_focal_px for p in self.photographs])


def list_images(folder: Path) -> list[Path]:
    """Photographs of a folder by the ending of their name, sorted by name; hidden files and sub-folders are
    left out.

    Raises :class:`UsageError` where there is no such folder or it cannot be read.
    """
    if not folder.exists():
        raise UsageError(f"there is no folder {folder}")
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder; give the folder that holds the photographs")
    try:
        entries = sorted(folder.iterdir(), key=lambda path: path.name)
    except OSError as error:
        raise UsageError(f"the folder {folder} cannot be read: {error.strerror}") from None
    return [
        p for p in entries if p.suffix.lower() in SUFFIXES and not p.name.startswith(".") and not p.is_dir()
    ]


def scene_name(folder: Path) -> str:
    """What to call the scene of a folder of photographs: its name, or that of the folder above it where its
    own says only what it holds.
    """
    folder = folder.resolve()
    return printable(folder.parent.name if folder.name.lower() in COMMON_NAMES else folder.name)


def read_photograph(source: Any, *, max_size_px: int) -> PhotographSet:
    """One file, array or record as a set of one; arguments as in :func:`read_photographs`.

    Raises :class:`StageFailure` where it cannot be read.
    """
    found = read_photographs([source], max_size_px=max_size_px)
    for name, reason in found.refused.items():
        raise StageFailure(f"{name} {reason}")
    return found


def read_photographs(
    source: ImageSource,
    *,
    max_size_px: int,
    map_all: Callable[[Callable[[Any], Any], list[Any]], Iterable[Any]] = map,
) -> PhotographSet:
    """All photographs of a folder, or of a list of files and arrays, at working size.

    Parameters
    ----------
    source : a folder; or a sequence of files, (H, W) or (H, W, 3) uint8 arrays and :class:`Image` records.
    max_size_px : a longer long side is reduced to this.
    map_all : runs the reading of each, in order; a thread pool's ``map`` reads several at once.

    Returns
    -------
    PhotographSet : what was read, sorted by name; what cannot be decoded, is blank, too small, or has the
        very pixels of an earlier one stands under ``refused``. Files are called what :func:`printable` shows
        of their names, and numbered where two would be called alike.

    Raises
    ------
    UsageError : no such folder. ValueError : an array of another shape or type.
    """
    items = _named_items(source)

    def read(item: tuple[str, Any]) -> Photograph | str:
        try:
            return _read(*item, max_size_px)
        except Refused as refusal:
            return str(refusal)

    read_items = list(map_all(read, items))
    refused = {name: r for (name, _), r in zip(items, read_items, strict=True) if isinstance(r, str)}
    kept: dict[str, Photograph] = {}
    for photograph in (r for r in read_items if not isinstance(r, str)):
        twin = kept.setdefault(photograph.digest, photograph)
        if twin is not photograph:
            refused[photograph.image.name] = f"has the same pixels as {twin.image.name}"
    return PhotographSet(
        tuple(sorted(kept.values(), key=lambda p: p.image.name)), dict(sorted(refused.items()))
    )


def _named_items(source: ImageSource) -> list[tuple[str, Any]]:
    if isinstance(source, str | Path):
        paths = list_images(Path(source))
        return sorted(zip(_names(path.name for path in paths), paths, strict=True), key=lambda pair: pair[0])
    paths = [Path(item) for item in source if isinstance(item, str | Path)]
    # Files of one name from several folders are told apart by their whole path.
    full = len({path.name for path in paths}) < len(paths)
    names = iter(_names(str(path) if full else path.name for path in paths))
    width = len(str(len(source)))
    items: list[tuple[str, Any]] = []
    for n, item in enumerate(source):
        if isinstance(item, str | Path):
            items.append((next(names), Path(item)))
        elif isinstance(item, Image):
            items.append((item.name, item))
        else:
            items.append((f"image-{n:0{width}d}", item))
    return sorted(items, key=lambda pair: pair[0])


def _names(names: Iterable[str]) -> list[str]:
    """What the files are called in print: those that would look alike there are numbered."""
    taken: dict[str, None] = {}
    for name in map(printable, names):
        alike = (f"{name} ({n})" for n in count(2))
        taken[next(one for one in chain([name], alike) if one not in taken)] = None
    return list(taken)


def _read(name: str, item: Any, max_size_px: int) -> Photograph:
    if isinstance(item, Image):
        return _finish(Photograph(item, ""))
    if isinstance(item, Path):
        return _finish(_decode(name, item, max_size_px))
    picture = picture_from_array(item)
    return _finish(Photograph(Image(name, at_working_size(picture, max_size_px), picture.size), ""))


def _finish(photograph: Photograph) -> Photograph:
    """Refuse what shows nothing, and name the content by its hash."""
    rgb = photograph.image.rgb
    if min(rgb.shape[:2]) < MIN_SIDE:
        raise Refused(
            f"is only {rgb.shape[1]} x {rgb.shape[0]} pixels; {MIN_SIDE} x {MIN_SIDE} are the least"
        )
    if np.ptp(rgb.reshape(-1, 3), axis=0).max() < BLANK_RANGE:
        raise Refused("is blank: all its pixels have nearly the same colour")
    content = hashlib.sha256(repr((rgb.shape, photograph.image.original_size)).encode())
    content.update(np.ascontiguousarray(rgb).data)
    return replace(photograph, digest=content.hexdigest()[:32])


def _decode(name: str, path: Path, max_size_px: int) -> Photograph:
    _require_file(path)
    try:
        # Opened here, since Pillow does not close what it cannot read.
        with path.open("rb") as stream, PIL.Image.open(stream, formats=_formats()) as file:
            needed = bytes_to_decode(file)
            if needed > LARGEST_DECODED:
                raise Refused(_too_large(file, needed))
            with _room.taken(needed), closing(file):
                return _photograph(name, file, max_size_px)
    except Refused:
        raise
    except PIL.Image.DecompressionBombError:
        limit = 2 * (PIL.Image.MAX_IMAGE_PIXELS or 0) // 10**6
        raise Refused(f"claims more than {limit} megapixels, which no photograph has") from None
    except PIL.UnidentifiedImageError:
        raise Refused("is not an image of a known format") from None
    except MemoryError:
        raise Refused("does not fit in memory") from None
    except Exception as error:
        # Decoders raise whatever they stumble over in a damaged file; the other photographs go on.
        raise Refused(
            f"cannot be decoded: {printable(getattr(error, 'strerror', None) or str(error))}"
        ) from None


def _photograph(name: str, file: PIL.Image.Image, max_size_px: int) -> Photograph:
    note = "only its first frame is used" if getattr(file, "n_frames", 1) > 1 else ""
    focal_35mm, turn = _exif(file)
    file.load()
    picture = Picture(file, turn)
    said = _FOCALS_35MM[0] <= focal_35mm <= _FOCALS_35MM[1]
    focal = focal_35mm / _WIDTH_35MM * max(picture.size) if said else math.nan
    return Photograph(Image(name, at_working_size(picture, max_size_px), picture.size), "", focal, note)


def _too_large(file: PIL.Image.Image, needed: int) -> str:
    kind = "JPEG in several scans" if file.format == "JPEG" else file.format
    return (
        f"has {file.size[0] * file.size[1] / 1e6:.0f} megapixels, and reading a {kind} of that size takes "
        f"{needed / 2**30:.1f} GiB of memory, where one photograph may have {LARGEST_DECODED / 2**30:.1f}; "
        "save it as PNG or TIFF"
    )


def _require_file(path: Path) -> None:
    """Refuse what is no regular file: reading a pipe waits for ever, a device never ends."""
    try:
        found = path.stat()
    except OSError as error:
        raise Refused(f"cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(found.st_mode):
        raise Refused(f"is {NO_FILE}, not a file")
    if found.st_size > LARGEST_FILE:
        raise Refused(f"is a file of {found.st_size / 2**30:.1f} GiB, which no photograph is")


@cache
def _formats() -> tuple[str, ...]:
    """Those of ``READ`` that this Pillow knows."""
    PIL.Image.init()
    return tuple(name for name in READ if name in PIL.Image.OPEN)


def _exif(file: PIL.Image.Image) -> tuple[float, Turn]:
    """The 35 mm focal length (0 = not said) and what puts the photograph upright."""
    try:
        exif = file.getexif()
        orientation, focal = exif.get(_ORIENTATION), float(exif.get_ifd(_EXIF_IFD).get(_FOCAL_35MM, 0))
    except Exception:
        # A damaged header says nothing; the pixels may still be good.
        return 0.0, AS_STORED
    return focal, TURNS.get(orientation, AS_STORED) if isinstance(orientation, int) else AS_STORED

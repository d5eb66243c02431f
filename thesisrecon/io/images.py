"""Photographs in: every common file as 8-bit RGB at working size, and a reason for each that cannot be read.

Resizing keeps one exact scale s along both axes, (x + 0.5) s - 0.5, so that square pixels stay square: the
last row of a photograph may be cut by less than a working pixel for it.
"""

from __future__ import annotations

import hashlib
import math
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import PIL.Image
import PIL.ImageOps
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io.text import NO_FILE, printable
from thesisrecon.types import F64, Image

U8 = NDArray[np.uint8]
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
MIN_SIDE = 64
STRIPE = 256
"""Rows that are counted in double precision at a time."""
BLANK_RANGE = 8
READ = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "GIF", "JPEG2000", "AVIF", "HEIF", "PPM")
"""What Pillow may take a file for, whatever it is called: some of its other readers start programs."""
_ORIENTATION, _EXIF_IFD, _FOCAL_35MM = 0x0112, 0x8769, 0xA405
_WIDTH_35MM = 36.0
_FOCALS_35MM = (1.0, 1e5)
"""mm; what a header says beyond is a mistake."""


class _Refused(Exception):
    """One photograph cannot be used; the text is the reason."""


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
        except _Refused as refusal:
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
        rgb, photograph = _decode(name, item, max_size_px)
    else:
        rgb = _rgb_from_array(item)
        photograph = Photograph(Image(name, rgb, (rgb.shape[1], rgb.shape[0])), "")
        rgb = _reduced(PIL.Image.fromarray(rgb), max_size_px)
    return _finish(replace(photograph, image=replace(photograph.image, rgb=rgb)))


def _finish(photograph: Photograph) -> Photograph:
    """Refuse what shows nothing, and name the content by its hash."""
    rgb = photograph.image.rgb
    if min(rgb.shape[:2]) < MIN_SIDE:
        raise _Refused(
            f"is only {rgb.shape[1]} x {rgb.shape[0]} pixels; {MIN_SIDE} x {MIN_SIDE} are the least"
        )
    if np.ptp(rgb.reshape(-1, 3), axis=0).max() < BLANK_RANGE:
        raise _Refused("is blank: all its pixels have nearly the same colour")
    content = hashlib.sha256(repr((rgb.shape, photograph.image.original_size)).encode())
    content.update(np.ascontiguousarray(rgb).data)
    return replace(photograph, digest=content.hexdigest()[:32])


def _rgb_from_array(array: Any) -> U8:
    array = np.asarray(array)
    if array.dtype != np.uint8 or array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise ValueError(f"an image array must be (H, W) or (H, W, 3) uint8; got {array.shape} {array.dtype}")
    return np.repeat(array[..., None], 3, axis=2) if array.ndim == 2 else array


def _decode(name: str, path: Path, max_size_px: int) -> tuple[U8, Photograph]:
    """Pixels at working size, and the record that waits for them."""
    _require_file(path)
    try:
        # Opened here, since Pillow does not close what it cannot read.
        with path.open("rb") as stream, PIL.Image.open(stream, formats=_formats()) as file:
            note = "only its first frame is used" if getattr(file, "n_frames", 1) > 1 else ""
            focal_35mm, upright = _exif(file)
            file.load()
            picture = PIL.Image.fromarray(_eight_bit(file)) if _is_deep(file.mode) else _rgb(file)
        picture = upright(picture)
    except PIL.Image.DecompressionBombError:
        limit = 2 * (PIL.Image.MAX_IMAGE_PIXELS or 0) // 10**6
        raise _Refused(f"claims more than {limit} megapixels, which no photograph has") from None
    except PIL.UnidentifiedImageError:
        raise _Refused("is not an image of a known format") from None
    except MemoryError:
        raise _Refused("does not fit in memory") from None
    except Exception as error:
        # Decoders raise whatever they stumble over in a damaged file; the other photographs go on.
        raise _Refused(
            f"cannot be decoded: {printable(getattr(error, 'strerror', None) or str(error))}"
        ) from None
    said = _FOCALS_35MM[0] <= focal_35mm <= _FOCALS_35MM[1]
    focal = focal_35mm / _WIDTH_35MM * max(picture.size) if said else math.nan
    record = Photograph(Image(name, np.zeros((0, 0, 3), np.uint8), picture.size), "", focal, note)
    return _reduced(picture, max_size_px), record


def _require_file(path: Path) -> None:
    """Refuse what is no regular file: reading a pipe waits for ever, a device never ends."""
    try:
        found = path.stat()
    except OSError as error:
        raise _Refused(f"cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(found.st_mode):
        raise _Refused(f"is {NO_FILE}, not a file")
    if found.st_size > LARGEST_FILE:
        raise _Refused(f"is a file of {found.st_size / 2**30:.1f} GiB, which no photograph is")


@cache
def _formats() -> tuple[str, ...]:
    """Those of ``READ`` that this Pillow knows."""
    PIL.Image.init()
    return tuple(name for name in READ if name in PIL.Image.OPEN)


def _exif(file: PIL.Image.Image) -> tuple[float, Callable[[PIL.Image.Image], PIL.Image.Image]]:
    """The 35 mm focal length (0 = not said) and the rotation that puts the photograph upright."""
    turns = PIL.Image.Transpose
    by_orientation = {
        2: turns.FLIP_LEFT_RIGHT,
        3: turns.ROTATE_180,
        4: turns.FLIP_TOP_BOTTOM,
        5: turns.TRANSPOSE,
        6: turns.ROTATE_270,
        7: turns.TRANSVERSE,
        8: turns.ROTATE_90,
    }
    try:
        exif = file.getexif()
        orientation, focal = exif.get(_ORIENTATION), float(exif.get_ifd(_EXIF_IFD).get(_FOCAL_35MM, 0))
    except Exception:
        # A damaged header says nothing; the pixels may still be good.
        orientation, focal = None, 0.0
    turn = by_orientation.get(orientation) if isinstance(orientation, int) else None
    return focal, lambda picture: picture if turn is None else picture.transpose(turn)


def _is_deep(mode: str) -> bool:
    return mode.startswith("I") or mode == "F"


def _eight_bit(file: PIL.Image.Image) -> U8:
    """Grey of more than 8 bits as 8-bit RGB: whole numbers by their bit depth, real numbers by their
    range.
    """
    values = np.asarray(file)
    lows, highs = zip(*((part.min(), part.max()) for _, part in _stripes(values)), strict=True)
    low, high = min(lows), max(highs)
    if file.mode != "F":
        # A 12-bit sensor in a 16-bit file must not come out nearly black.
        low, high = 0.0, 2.0 ** max(8, int(high).bit_length()) - 1
    rgb = np.empty((*values.shape, 3), dtype=np.uint8)
    for rows, part in _stripes(values):
        grey = (part - low) * (255.0 / max(high - low, 1e-12))
        rgb[rows] = np.rint(np.clip(grey, 0, 255))[..., None]
    return rgb


def _stripes(values: NDArray[Any]) -> Iterator[tuple[slice, F64]]:
    """Some rows after others as finite real numbers: all at once take eight times the room of their grey."""
    for start in range(0, len(values), STRIPE):
        rows = slice(start, start + STRIPE)
        part = values[rows].astype(np.float64)
        yield rows, np.nan_to_num(part, nan=0.0, posinf=0.0, neginf=0.0)


def _rgb(file: PIL.Image.Image) -> PIL.Image.Image:
    """RGB; what is transparent becomes mid-grey, since the colours under it mean nothing."""
    if "A" in file.getbands() or "a" in file.getbands() or "transparency" in file.info:
        layered = file.convert("RGBA")
        ground = PIL.Image.new("RGBA", layered.size, (128, 128, 128, 255))
        return PIL.Image.alpha_composite(ground, layered).convert("RGB")
    return file.convert("RGB")


def _reduced(picture: PIL.Image.Image, max_size_px: int) -> U8:
    """The picture with its long side at most ``max_size_px``, at one exact scale."""
    width, height = picture.size
    scale = max_size_px / max(width, height)
    if scale >= 1:
        return np.array(picture)
    size = (
        (max_size_px, math.floor(height * scale))
        if width >= height
        else (math.floor(width * scale), max_size_px)
    )
    if min(size) < 1:
        raise _Refused(f"is {width} x {height} pixels: too narrow to be reduced to {max_size_px}")
    box = (0.0, 0.0, min(width, size[0] / scale), min(height, size[1] / scale))
    resized = picture.resize(size, PIL.Image.Resampling.LANCZOS, box=box, reducing_gap=3.0)
    return np.array(resized)

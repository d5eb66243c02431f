"""Images and their masks: 8-bit RGB at working size from common file formats, or a reason for each file.

Resizing uses one exact scale s along both axes, (x + 0.5) s - 0.5, so that square pixels stay square; the
last row may be cut by less than a working pixel.
"""

import hashlib
import math
import os
import re
import stat
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F32, F64, U8, eight_bit, image_levels
from thesisrecon.errors import Notice, StageFailure, UsageError, require_word
from thesisrecon.imaging.static import static_pixels
from thesisrecon.io import _files, _pixels
from thesisrecon.io._files import as_path, printable
from thesisrecon.io._outputs import LOCK_FILE
from thesisrecon.records import Image

T = TypeVar("T")
MapAll: TypeAlias = Callable[[Callable[[Any], Any], list[Any]], Iterable[Any]]
ImageSource: TypeAlias = str | Path | Sequence[str | Path | NDArray[Any] | Image]

# Raw files, other pictures, and HEIC files without their reader are refused by name, not overlooked.
SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".bmp", ".webp", ".gif", ".jp2", ".avif"),
    *(".ppm", ".pgm", ".pbm", ".pnm", ".heic", ".heif", *_pixels.RAW_SUFFIXES),
    *(".tga", ".psd", ".exr", ".hdr", ".jxl"),
)
"""Suffixes of files that are listed unseen; others are listed if they begin like an image."""
_SIGNATURE = re.compile(
    rb"\xff\xd8\xff|\x89PNG\r\n|II[*+]\0|MM\0[*+]|BM.{4}\0{4}.{4}[\x0c\x28\x34\x38\x40\x6c\x7c]\0\0\0|GIF8[79]a"
    rb"|RIFF.{4}WEBP|\0\0\0\x0cj[PX]|\xff\x4f\xff\x51|.{4}ftyp(?:avi[fs]|mif1|msf1|hei[cmsx]|hev[cmsx])"
    rb"|P[1-6]\s+(?:#[^\n]*\n\s*)*\d+\s+\d+\s|" + _pixels.RAW_SIGNATURE.pattern,
    re.DOTALL,
)
"""First bytes of images and raw files, under any name."""
MAX_FILE_BYTES = 2**31  # Uncompressed images of the largest sensors take less than half of it
MAX_DECODED_BYTES = 3 * 2**29
"""Memory of all images decoded at the same time: enough for 151 megapixels of progressive JPEG."""
MIN_SIDE = 64
FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "GIF", "JPEG2000", "AVIF", "HEIF", "PPM")
"""Formats that Pillow may open: some of its other readers start external programs."""
_ANY_SIZE = int(np.iinfo(np.int32).max)
_budget = _pixels.MemoryBudget(MAX_DECODED_BYTES)


@dataclass(frozen=True)
class DecodedImage:
    """An image at working size, a digest of its content, a warning, and facts of EXIF.

    ``place`` is the latitude, longitude (degrees) and height (m) of the camera.
    """

    image: Image
    digest: str
    exif_focal_px: float = math.nan
    note: str = ""
    place: tuple[float, float, float] = (math.nan,) * 3


@dataclass(frozen=True)
class ImageSet:
    """The usable images of a run, sorted by name, and name -> reason of the other files.

    ``whole`` is the set of which these are a part.
    """

    decoded: tuple[DecodedImage, ...]
    refused: dict[str, str]
    whole: "ImageSet | None" = None

    @property
    def images(self) -> tuple[Image, ...]:
        """The V images."""
        return tuple(d.image for d in self.decoded)

    @property
    def exif_focal_px(self) -> F64:
        """Focal lengths (V,) from EXIF in original pixels, NaN = unknown."""
        return np.array([d.exif_focal_px for d in self.decoded])

    @property
    def places(self) -> F64:
        """Latitudes, longitudes (degrees) and heights (m) of EXIF (V, 3), NaN = unknown."""
        return np.array([d.place for d in self.decoded]).reshape(-1, 3)


def sample(name: str = "courtyard") -> Path:
    """Return the folder of a data set that is installed with the package.

    Parameters
    ----------
    name : {"courtyard", "cube"}
        "courtyard": 14 rendered images of 1024 px in ``images``, their true ``cameras.json`` and ``depth``;
        "cube": ``cube.npz`` with K, R, C, the points X and their exact pixels xy (V, N, 2), NaN = not seen.

    Returns
    -------
    Path

    Examples
    --------
    >>> from thesisrecon import sample
    >>> sorted(path.name for path in sample("courtyard").iterdir())
    ['cameras.json', 'depth', 'images']
    """
    homes = [home / "fixtures" for home in Path(__file__).parents[1:3]]
    require_word("sample", name, ("courtyard", "cube"))
    for home in homes:
        if (home / name).is_dir():
            return home / name
    raise UsageError(Notice("no-demo-images", homes[0]))


def demo_images() -> list[Path]:
    """The images of the demo: enough neighbouring views for self-calibration, few enough for a minute."""
    return sorted((sample() / "images").glob("*.jpg"))[:6]


def image_without_pixels(name: str, size: Sequence[int], original: tuple[int, int]) -> Image:
    """A grey image of (width, height) as a placeholder for one that is not available."""
    return Image(name, np.broadcast_to(np.uint8(128), (size[1], size[0], 3)), original)


def list_images(folder: Path, *others: Path | str | None, deep: bool = False) -> list[Path]:
    """List the image files of a folder by suffix or content, frame9 before frame10, without hidden files.

    ``deep``: those of its subfolders too, but for hidden ones, ``others`` and folders that thesisrecon wrote.
    """
    if not folder.exists():
        raise UsageError(f"there is no folder {folder}")
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder; give the folder of the images")
    # realpath, unlike resolve, has an answer for links in a circle.
    known = {os.path.realpath(other) for other in (folder, *others) if other is not None}
    found, pending = list[Path](), [folder]
    while pending:
        try:
            entries = [path for path in pending.pop().iterdir() if path.name[0] not in ".@"]
        except OSError as error:
            if not found and not pending:
                raise UsageError(f"the folder {folder} cannot be read: {error.strerror}") from None
            continue
        found += [path for path in entries if not path.is_dir() and _is_listed(path)]
        for path in (path for path in entries if deep and path.is_dir()):
            if (real := os.path.realpath(path)) not in known and not os.path.lexists(path / LOCK_FILE):
                known.add(real)
                pending.append(path)
    return sorted(found, key=lambda path: _files.natural_key(path.relative_to(folder).as_posix()))


def _is_listed(path: Path) -> bool:
    suffix = path.suffix.lower()
    # Cameras write thumbnails (.thm) beside their images and videos.
    if suffix in SUFFIXES or suffix == ".thm" or not path.is_file():
        return suffix in SUFFIXES
    try:
        with path.open("rb") as file:
            return _SIGNATURE.match(file.read(256)) is not None
    except OSError:
        return False


def images_folder(source: ImageSource) -> Path | None:
    """Absolute path of the folder below which all images have their names; None if there is none."""
    if isinstance(source, str | Path):
        return Path(source).absolute()
    files = [Path(os.path.normpath(Path(item).absolute())) for item in source if isinstance(item, str | Path)]
    if not files or len(files) < len(source):
        return None
    home, by_path = _common_folder(files)
    return home if by_path or all(file.parent == home for file in files) else None


def _common_folder(files: Sequence[Path]) -> tuple[Path, bool]:
    """The innermost folder of all files, and whether files of one name are distinguished by their paths."""
    folder = os.path.commonpath([os.path.normpath(file.absolute().parent) for file in files])
    return Path(folder), len({file.name for file in files}) < len(files)


def files_by_name(source: ImageSource, *others: Path | str | None) -> dict[str, str]:
    """Absolute paths of the files of images by their names; of a folder without those in ``others``."""
    found = {name: item for name, item in _named_items(source, *others) if isinstance(item, Path)}
    return {name: str(path.absolute()) for name, path in found.items()}


def find_images(source: str | Path | Mapping[str, str], names: Sequence[str]) -> list[Path]:
    """Locate image files by name, with subfolders, in a folder or a list; UsageError if one is missing."""
    folder = Path() if isinstance(source, Mapping) else Path(source)
    listed = source if isinstance(source, Mapping) else dict(_named_items(folder))
    paths = [Path(listed.get(name, folder / name)) for name in names]
    missing = [name for name, path in zip(names, paths, strict=True) if not path.is_file()]
    if missing:
        raise UsageError(Notice("missing-images", len(missing), len(names), folder, missing[0]))
    return paths


def scene_name(folder: Path) -> str:
    """Name a scene after its image folder, or after the parent of a folder called "images" or similar."""
    folder = folder.resolve()
    generic = folder.name.lower() in ("images", "photographs", "photos", "pictures", "dcim")
    return printable(folder.parent.name if generic else folder.name)


def read_image(source: Any, *, max_size_px: int, as_stored: bool = False) -> ImageSet:
    """Read one image; UsageError if the file does not exist, StageFailure if it is unusable."""
    if isinstance(source, str | Path) and not Path(source).is_file():
        raise UsageError(f"there is no image file {source}")
    found = read_images([source], max_size_px=max_size_px, as_stored=as_stored)
    for name, reason in found.refused.items():
        raise StageFailure(f"{name} {reason}")
    return found


def read_images(
    source: ImageSource | Mapping[str, Any], *, max_size_px: int, as_stored: bool = False,
    map_all: MapAll = map,
) -> ImageSet:  # fmt: skip
    """Read all images of a folder, a list or by name, reduced to ``max_size_px``; unusable ones get a reason.

    ``map_all`` is an ordered map, perhaps of a thread pool. Files are rotated upright unless ``as_stored``.
    """
    if isinstance(source, Mapping):
        items = [(name, Path(item) if isinstance(item, str) else item) for name, item in source.items()]
    else:
        items = _named_items(source if isinstance(source, str | Path) else eight_bit_images(*source))

    def read(item: tuple[str, Any]) -> DecodedImage | str:
        if not _files.is_image_name(item[0]):
            return Notice("file-name", _files.IMAGE_NAME_RULE)
        try:
            return _read(*item, max_size_px, as_stored)
        except _pixels.UnusableImage as refusal:
            return str(refusal)

    results = list(map_all(read, items))
    refused = {name: r for (name, _), r in zip(items, results, strict=True) if isinstance(r, str)}
    distinct: dict[str, DecodedImage] = {}
    for decoded in (r for r in results if not isinstance(r, str)):
        first = distinct.setdefault(decoded.digest, decoded)
        if first is not decoded:
            refused[decoded.image.name] = Notice("duplicate", first.image.name)
    # The items are in the order of their names.
    return ImageSet(tuple(distinct.values()), {name: refused[name] for name, _ in items if name in refused})


def _named_items(source: ImageSource, *others: Path | str | None) -> list[tuple[str, Any]]:
    """Names and files or arrays in the order of the names."""
    if isinstance(source, str | Path):
        home, by_path = Path(source), True
        source = list_images(home, *others, deep=True)
    else:
        paths = [Path(item) for item in source if isinstance(item, str | Path)]
        home, by_path = _common_folder(paths) if paths else (Path(), False)
    items: dict[str, Any] = {}
    for n, item in enumerate(source):
        name = f"image-{n:0{len(str(len(source)))}d}"
        if isinstance(item, str | Path):
            name = os.path.relpath(item, home) if by_path else Path(item).name
        elif isinstance(item, Image):
            name = _files.require_image_name(item.name, "an Image record")
        # Equal names are numbered.
        name = printable(name)
        numbered = (f"{name} ({k})" for k in count(2))
        free = next(one for one in chain([name], numbered) if one not in items)
        items[free] = Path(item) if isinstance(item, str) else item
    return sorted(items.items(), key=lambda pair: _files.natural_key(pair[0]))


def _read(name: str, item: Any, max_size_px: int, as_stored: bool) -> DecodedImage:
    """Read an image, refuse small and blank ones, and hash the content."""
    if isinstance(item, Path):
        decoded = decode_file(item, partial(_decoded_image, name, max_size_px, as_stored))
    elif isinstance(item, Image):
        decoded = DecodedImage(replace(item, name=name), "")
    else:
        decoded = DecodedImage(_image(name, _stored(item), max_size_px), "")
    decoded = with_digest(decoded)
    rgb, mask = decoded.image.rgb, decoded.image.mask
    if min(rgb.shape[:2]) < MIN_SIDE:
        raise _pixels.UnusableImage(Notice("too-small", rgb.shape[1], rgb.shape[0], MIN_SIDE, MIN_SIDE))
    used = rgb.reshape(-1, 3) if mask is None else rgb[mask]
    if len(used) and np.ptp(used, axis=0).max() < 8:
        raise _pixels.UnusableImage(Notice("blank"))
    return decoded


def with_digest(decoded: DecodedImage) -> DecodedImage:
    """Set the digest of the content."""
    rgb, mask = decoded.image.rgb, decoded.image.mask
    content = hashlib.sha256(repr((rgb.shape, decoded.image.original_size)).encode())
    content.update(np.ascontiguousarray(rgb).data)
    if mask is not None:
        content.update(np.packbits(mask).data)
    return replace(decoded, digest=content.hexdigest()[:32])


def decode_file(path: Path, use: Callable[[PIL.Image.Image], T]) -> T:
    """Apply ``use`` to an opened image file; UnusableImage with the reason if it cannot be decoded."""
    # Special files are refused: reading a pipe or a device may never end.
    try:
        found = path.stat()
    except OSError as error:
        raise _pixels.UnusableImage(Notice("unreadable", error.strerror)) from None
    if not stat.S_ISREG(found.st_mode):
        raise _pixels.UnusableImage(Notice("not-a-file", _files.SPECIAL_FILE))
    if found.st_size > MAX_FILE_BYTES:
        raise _pixels.UnusableImage(Notice("file-too-large", found.st_size / 2**30, MAX_FILE_BYTES / 2**30))
    try:
        # Opened here, since Pillow does not close files that it cannot read.
        with path.open("rb") as stream:
            _pixels.refuse_raw_file(stream, path.suffix)
            stream.seek(0)
            with PIL.Image.open(stream, formats=_formats()) as file:
                needed = _pixels.decoding_bytes(file)
                if needed > MAX_DECODED_BYTES:
                    kind = "progressive JPEG" if file.format == "JPEG" else file.format
                    megapixels, limit = file.size[0] * file.size[1] / 1e6, MAX_DECODED_BYTES / 2**30
                    raise _pixels.UnusableImage(
                        Notice("decoding-memory", megapixels, kind, needed / 2**30, limit)
                    )
                with _budget.reserve(needed), closing(file):
                    return use(file)
    except _pixels.UnusableImage:
        raise
    except PIL.Image.DecompressionBombError:
        limit = 2 * (PIL.Image.MAX_IMAGE_PIXELS or 0) // 10**6
        raise _pixels.UnusableImage(Notice("too-many-pixels", limit)) from None
    except PIL.UnidentifiedImageError:
        if path.suffix.lower() in _pixels.RAW_SUFFIXES:
            raise _pixels.UnusableImage(_pixels.RAW_FILE) from None
        heic = path.suffix.lower() in (".heic", ".heif") and "HEIF" not in _formats()
        raise _pixels.UnusableImage(Notice("heic") if heic else Notice("unknown-format")) from None
    except MemoryError:
        raise _pixels.UnusableImage(Notice("too-large-for-memory")) from None
    except Exception as error:
        # Decoders raise errors of any kind on damaged files; the other images are still read.
        reason = printable(getattr(error, "strerror", None) or str(error))
        raise _pixels.UnusableImage(Notice("undecodable", reason)) from None


def _image(name: str, stored: _pixels.StoredImage, max_size_px: int) -> Image:
    rgb, mask = _pixels.opaque_part(_pixels.resized_to(stored, max_size_px))
    return Image(name, rgb, stored.size, mask)


def _decoded_image(name: str, max_size_px: int, as_stored: bool, file: PIL.Image.Image) -> DecodedImage:
    # Cameras store a preview as a second frame of a JPEG (MPO).
    several = getattr(file, "n_frames", 1) > 1 and file.format not in ("JPEG", "MPO")
    stored, focal_35mm = load_pixels(file, as_stored=as_stored)
    # The film is 36 mm wide; a focal length outside of 1 to 1e5 mm is a mistake.
    focal = focal_35mm / 36.0 * max(stored.size) if 1.0 <= focal_35mm <= 1e5 else math.nan
    image = _image(name, stored, max_size_px)
    return DecodedImage(image, "", focal, Notice("several-frames") if several else "", _gps(file))


def may_be_transparent(path: Path) -> bool:
    """Whether the header of an image file states transparency."""
    try:
        return decode_file(path, lambda file: _pixels.StoredImage(file).layered)
    except _pixels.UnusableImage:
        return False


@cache
def _formats() -> tuple[str, ...]:
    """Formats of ``FORMATS`` that this Pillow supports, HEIC if pillow-heif is installed."""
    PIL.Image.init()
    with suppress(ImportError):
        import_module("pillow_heif").register_heif_opener()
    return tuple(name for name in FORMATS if name in PIL.Image.OPEN)


def load_pixels(file: PIL.Image.Image, *, as_stored: bool) -> tuple[_pixels.StoredImage, float]:
    """Decode an opened file; return the image, upright or as stored, and the 35 mm focal length or 0."""
    # Pillow turns TIFF images itself when it loads them, and then removes their orientation.
    stated = _exif(file)[0]
    file.load()
    orientation, focal = _exif(file)
    if not as_stored:
        return _pixels.StoredImage(file, _pixels.EXIF_TRANSFORMS.get(orientation)), focal
    return _pixels.StoredImage(
        file, None if orientation == stated else _pixels.EXIF_INVERSE.get(stated)
    ), focal


def rotation_words(as_stored: bool) -> str:
    """Words for the orientation in which the pixels of a file are used."""
    return "without EXIF rotation, as in COLMAP" if as_stored else "after EXIF rotation"


def _exif(file: PIL.Image.Image) -> tuple[int, float]:
    """Orientation and 35 mm focal length of an opened file, 0 if unknown."""
    try:
        exif = file.getexif()
        orientation, focal = exif.get(0x0112), float(exif.get_ifd(0x8769).get(0xA405, 0))
    except Exception:
        # The pixels may be good even if the header is damaged.
        return 0, 0.0
    return orientation if isinstance(orientation, int) else 0, focal


def _gps(file: PIL.Image.Image) -> tuple[float, float, float]:
    """Latitude, longitude (degrees) and height (m) of EXIF, NaN if they are not complete."""
    try:
        tags = file.getexif().get_ifd(0x8825)
        sides = [sum(float(part) / 60.0**k for k, part in enumerate(tags[n])) for n in (2, 4)]
        latitude, longitude = (-a if tags[n] in ("S", "W") else a for a, n in zip(sides, (1, 3), strict=True))
        height = float(tags[6]) * (-1.0 if tags.get(5, b"\0") in (1, b"\1") else 1.0)
    except Exception:
        return math.nan, math.nan, math.nan
    known = abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and math.isfinite(height)
    return (latitude, longitude, height) if known else (math.nan,) * 3


def read_pixels(*sources: Any) -> list[U8]:
    """Files at full size, Pillow images, records or arrays of levels of one scale, as RGB."""
    return [full_image(source).rgb for source in eight_bit_images(*sources)]


def read_levels(*sources: Any, grey: bool = False) -> list[U8 | F32]:
    """As :func:`read_pixels`, NaN where transparent or missing; fractions of levels are not rounded.

    ``grey``: images without colours are (H, W).
    """
    arrays = iter(_arrays_of_levels(sources))
    found = [source if _is_image(source) else next(arrays) for source in sources]
    keep_grey = grey and all(isinstance(one, np.ndarray) and one.ndim == 2 for one in found)
    return [_levels_of(one, keep_grey=keep_grey) for one in found]


def list_of_images(caller: str, images: Any, kinds: str = "a folder, or a sequence of images") -> list[Any]:
    """The items of a sequence of images; UsageError for a single path or anything else."""
    try:
        if not isinstance(images, str | bytes | Path | Mapping | set):
            return list(images)
    except TypeError:
        pass  # an object without items
    raise UsageError(f"{caller} needs {kinds}; got a {type(images).__name__}")


def eight_bit_images(*sources: Any) -> list[Any]:
    """Other sources as they are; arrays, of one scale, as uint8, transparent where a level is missing."""
    arrays = iter(_arrays_of_levels(sources))
    return [source if _is_image(source) else _eight_bit_array(next(arrays)) for source in sources]


def _is_image(source: Any) -> bool:
    return isinstance(source, str | Path | Image | PIL.Image.Image)


def _arrays_of_levels(sources: Sequence[Any]) -> list[U8 | F32]:
    """The arrays among sources as levels of one scale; ValueError unless they have the shape of an image."""
    arrays = image_levels(*(source for source in sources if not _is_image(source)))
    shaped = [array[:, :, 0] if array.ndim == 3 and array.shape[2] == 1 else array for array in arrays]
    for array in shaped:
        if not array.size or array.ndim not in (2, 3) or array.shape[2:] not in ((), (3,), (4,)):
            advice = "; transpose it to (H, W, channels)" if array.shape[:1] in ((1,), (3,), (4,)) else ""
            rule = "an image array of numpy must be (H, W), (H, W, 3) or (H, W, 4)"
            raise ValueError(f"{rule}; got {array.shape}{advice}")
    return shaped


def _eight_bit_array(levels: U8 | F32) -> U8:
    whole, known = eight_bit(levels)
    if known is None:
        return whole
    whole = np.repeat(whole[:, :, None], 3, axis=2) if whole.ndim == 2 else whole
    alpha = whole[:, :, 3] if whole.shape[2] == 4 else np.uint8(255)
    return np.dstack([whole[:, :, :3], np.where(known, alpha, 0).astype(np.uint8)])


def _levels_of(source: Any, *, keep_grey: bool) -> U8 | F32:
    if isinstance(source, np.ndarray) and source.shape[2:] != (4,):
        return source if keep_grey or source.ndim == 3 else np.repeat(source[:, :, None], 3, axis=2)
    image = full_image(_eight_bit_array(source) if isinstance(source, np.ndarray) else source)
    return image.rgb if image.mask is None else image.levels


def _stored(source: U8 | PIL.Image.Image) -> _pixels.StoredImage:
    return _pixels.StoredImage(source if isinstance(source, PIL.Image.Image) else PIL.Image.fromarray(source))


def full_image(source: Any) -> Image:
    """A file, a record or a checked array of 8 bits, at full size."""
    if isinstance(source, str | Path | Image):
        return read_image(source, max_size_px=_ANY_SIZE).images[0]
    try:
        return _image("", _stored(source), _ANY_SIZE)
    except _pixels.UnusableImage as refusal:
        raise StageFailure(Notice("unusable-image", refusal)) from None


_MASK_NAMES = "the mask of IMG.jpg is IMG.jpg.png, or IMG with any suffix"
USELESS_MASKS = Notice("useless-masks")


def check_masks_folder(masks: Any, images: Path | None) -> Path:
    """Absolute path; UsageError if it is none, the folder holds no masks or is the folder of the images."""
    folder: Path = as_path("a run", "masks", masks)
    if not list_images(folder, deep=True):
        raise UsageError(f"there are no masks in {folder}; {_MASK_NAMES}")
    if images is not None and images.is_dir() and folder.samefile(images):
        raise UsageError(f"{folder} is the folder of the images; the masks need a folder of their own")
    return folder.absolute()


def find_masks(folder: Path, names: Sequence[str]) -> tuple[dict[str, Path], list[str]]:
    """The masks of images by name, and warnings of the other files."""
    files: dict[str, list[Path]] = {}
    for path in list_images(folder, deep=True):
        files.setdefault(printable(path.relative_to(folder).with_suffix("").as_posix()), []).append(path)
    owner: dict[Path, str] = {}
    mask_of: dict[str, Path] = {}
    for name in names:
        # The names of files from several folders are paths; their masks may be in one folder.
        path = Path(name)
        places = [name, path.with_suffix("").as_posix(), path.name, path.stem]
        found = next((files[place] for place in places if place in files), [])
        if len(found) > 1:
            raise UsageError(f"{name} has two masks, {found[0]} and {found[1].name}; keep one")
        if found:
            first = owner.setdefault(found[0], name)
            if first != name:
                raise UsageError(f"the mask {found[0]} belongs to {first} and to {name}; {_MASK_NAMES}")
            mask_of[name] = found[0]
    if not mask_of:
        raise UsageError(f"no file in {folder} is named like an image; {_MASK_NAMES}")
    others = [path.name for paths in files.values() for path in paths if path not in owner]
    return mask_of, [Notice("unused-mask", name) for name in others]


def add_masks(
    inputs: ImageSet, folder: Path, *, as_stored: bool = False, map_all: MapAll = map,
) -> tuple[ImageSet, list[str]]:  # fmt: skip
    """Set the masks of images named like files in a folder; return also warnings of the other files."""
    names = [*(decoded.image.name for decoded in inputs.decoded), *inputs.refused]
    mask_of, unused = find_masks(folder, names)

    def masked(decoded: DecodedImage) -> DecodedImage:
        image = decoded.image
        if image.name not in mask_of:
            return decoded
        image = replace(image, mask=read_mask(mask_of[image.name], image, as_stored=as_stored))
        return with_digest(replace(decoded, image=image))

    return replace(inputs, decoded=tuple(map_all(masked, list(inputs.decoded)))), unused


def mask_static(inputs: ImageSet, *, map_all: MapAll = map) -> tuple[ImageSet, list[str]]:
    """Mask the static pixels of images without a mask; return also a warning if there are any."""
    found = static_pixels(inputs.images, map_all=map_all)
    if not found:
        return inputs, []
    decoded = list(inputs.decoded)
    for n, static in found.items():
        image = replace(decoded[n].image, mask=~static)
        decoded[n] = with_digest(replace(decoded[n], image=image))
    share = 100.0 * float(np.median([static.mean() for static in found.values()]))
    return replace(inputs, decoded=tuple(decoded)), [Notice("static-pixels", share, len(found))]


def read_mask(path: Path, image: Image, *, as_stored: bool = False) -> B8 | None:
    """Pixels to use of an image at working size, by nearest neighbour, within its own mask; None: all."""
    try:
        full = decode_file(path, lambda file: load_pixels(file, as_stored=as_stored)[0].unmasked())
    except _pixels.UnusableImage as refusal:
        raise UsageError(f"the mask {path} {refusal}; replace or remove it") from None
    size, (width, height) = full.shape[::-1], image.original_size
    # Each side of a mask of another size may be rounded.
    if abs(size[0] * height - size[1] * width) > max(width, height):
        raise UsageError(Notice("mask-ratio", path, *size, width, height, rotation_words(as_stored)))
    steps = np.divide(size, image.original_size) / image.scale
    places = [
        ((np.arange(n) + 0.5) * step).astype(np.int64) for n, step in zip(image.size, steps, strict=True)
    ]
    x, y = map(np.minimum, places, (size[0] - 1, size[1] - 1))
    mask = np.ascontiguousarray(full[np.ix_(y, x)])
    if image.mask is not None:
        mask &= image.mask
    if not mask.any():
        raise UsageError(Notice("empty-mask", path, image.name))
    return None if mask.all() else mask

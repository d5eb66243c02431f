"""Masks of images: files named like the images whose black or transparent pixels are left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.arrays import B8
from thesisrecon.errors import Notice, UsageError
from thesisrecon.io._files import printable
from thesisrecon.io._images import (
    DecodedImage,
    ImageSet,
    decode_file,
    list_images,
    load_pixels,
    rotation_words,
    with_digest,
)
from thesisrecon.io._pixels import UnusableImage
from thesisrecon.records import Image

_NAMES = "the mask of IMG.jpg is IMG.jpg.png, or IMG with any suffix"

USELESS_MASKS = Notice("useless-masks")


def check_masks_folder(masks: Path, images: Path | None) -> Path:
    """Absolute path; UsageError if the folder holds no masks or is the folder of the images."""
    if not list_images(masks):
        raise UsageError(f"there are no masks in {masks}; {_NAMES}")
    if images is not None and images.is_dir() and masks.samefile(images):
        raise UsageError(f"{masks} is the folder of the images; the masks need a folder of their own")
    return masks.absolute()


def find_masks(folder: Path, names: Sequence[str]) -> tuple[dict[str, Path], list[str]]:
    """The masks of images by name, and warnings of the other files."""
    files: dict[str, list[Path]] = {}
    for path in list_images(folder):
        files.setdefault(printable(path.stem), []).append(path)
    owner: dict[Path, str] = {}
    mask_of: dict[str, Path] = {}
    for name in names:
        # The names of files from several folders are paths.
        found = files.get(Path(name).name) or files.get(Path(name).stem, [])
        if len(found) > 1:
            raise UsageError(f"{name} has two masks, {found[0]} and {found[1].name}; keep one")
        if found:
            first = owner.setdefault(found[0], name)
            if first != name:
                raise UsageError(f"the mask {found[0]} belongs to {first} and to {name}; {_NAMES}")
            mask_of[name] = found[0]
    if not mask_of:
        raise UsageError(f"no file in {folder} is named like an image; {_NAMES}")
    others = [path.name for paths in files.values() for path in paths if path not in owner]
    return mask_of, [Notice("unused-mask", name) for name in others]


def add_masks(
    inputs: ImageSet,
    folder: Path,
    *,
    as_stored: bool = False,
    map_all: Callable[[Callable[[Any], Any], list[Any]], Iterable[Any]] = map,
) -> tuple[ImageSet, list[str]]:
    """Set the masks of images named like files in a folder; return also warnings of the other files.

    Masks are upright, or ``as_stored`` like the images.
    """
    names = [*(decoded.image.name for decoded in inputs.decoded), *inputs.refused]
    mask_of, unused = find_masks(folder, names)

    def masked(decoded: DecodedImage) -> DecodedImage:
        image = decoded.image
        if image.name not in mask_of:
            return decoded
        image = replace(image, mask=read_mask(mask_of[image.name], image, as_stored=as_stored))
        return with_digest(replace(decoded, image=image))

    return replace(inputs, decoded=tuple(map_all(masked, list(inputs.decoded)))), unused


def read_mask(path: Path, image: Image, *, as_stored: bool = False) -> B8 | None:
    """Pixels to use of an image at working size, by nearest neighbour, within its own mask; None: all."""
    try:
        full = decode_file(path, lambda file: load_pixels(file, as_stored=as_stored)[0].unmasked())
    except UnusableImage as refusal:
        raise UsageError(f"the mask {path} {refusal}; replace or remove it") from None
    size, (width, height) = full.shape[::-1], image.original_size
    # Each side of a mask of another size may be rounded.
    if abs(size[0] * height - size[1] * width) > max(width, height):
        raise UsageError(
            f"the mask {path} has {size[0]} x {size[1]} pixels and its image {width} x {height} "
            f"({rotation_words(as_stored)}); a mask may have another size, but not another ratio of width to "
            "height"
        )
    steps = size[0] / width / image.scale, size[1] / height / image.scale
    x, y = (_nearest(image.size[k], steps[k], size[k]) for k in (0, 1))
    mask = np.ascontiguousarray(full[np.ix_(y, x)])
    if image.mask is not None:
        mask &= image.mask
    if not mask.any():
        raise UsageError(
            f"the mask {path} leaves no pixel of {image.name}: black pixels are left out, all others are used"
        )
    return None if mask.all() else mask


def _nearest(count: int, step: float, size: int) -> Any:
    """Nearest of ``size`` pixels for each of ``count`` pixels that are ``step`` of them wide."""
    return np.minimum(((np.arange(count) + 0.5) * step).astype(np.int64), size - 1)

"""Peak memory of a process that reads one large image at working size, by file format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon.io._images import read_images
from validation.runs.processes import call_apart
from validation.runs.study import Part, pick, report_progress
from validation.runs.tables import text_table

LARGEST_SIDE = 13_376  # A square of this side has 178.9 megapixels, the most that are accepted
_ROTATED = PIL.Image.Exif()
_ROTATED[0x0112] = 6
FORMATS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "PNG, RGBA": ("RGBA", "png", {}),
    "PNG, palette with transparency": ("P", "png", {"transparency": 0}),
    "PNG, 16-bit grey": ("I;16", "png", {}),
    "PNG": ("RGB", "png", {}),
    "TIFF, float": ("F", "tif", {}),
    "TIFF, CMYK": ("CMYK", "tif", {}),
    "TIFF": ("RGB", "tif", {}),
    "JPEG": ("RGB", "jpg", {}),
    "JPEG, EXIF rotation": ("RGB", "jpg", {"exif": _ROTATED}),
    "JPEG, progressive": ("RGB", "jpg", {"progressive": True}),
    "WebP": ("RGB", "webp", {}),
    "GIF": ("P", "gif", {}),
}  # Name -> mode of the pixels, suffix of the file, options of Pillow


def write_image(name: str, side: int, path: str) -> None:
    """Write a square image of smooth grey levels."""
    mode, _, options = FORMATS[name]
    row = np.arange(side) % 251
    grey = ((row[:, None] + row) // 2).astype(np.uint8)
    if mode == "I;16":
        image = PIL.Image.fromarray(grey.astype(np.uint16) * 257)
    elif mode == "P":
        image = PIL.Image.fromarray(grey)
        image.putpalette([level for level in range(256) for _ in range(3)])
    else:
        image = PIL.Image.fromarray(grey).convert(mode)
    image.save(path, **options)


def read_one(path: str, max_size_px: int) -> str:
    """Read one image at working size; return why it is refused, or nothing."""
    return next(iter(read_images([path], max_size_px=max_size_px).refused.values()), "")


def large_images_study(
    out: Path, long_side: int = LARGEST_SIDE, max_size: int = 640, formats: Sequence[str] | None = None
) -> Iterator[Part]:
    """Measure the memory that reading the largest accepted images takes."""
    rows = []
    for name in pick(formats, FORMATS):
        report_progress(name)
        path = out / f"large.{FORMATS[name][1]}"
        call_apart(write_image, name, long_side, path)
        refused, process = call_apart(read_one, path, max_size)
        rows.append([name, f"{path.stat().st_size / 1e6:.1f}", f"{process.peak_mb:.0f}", refused])
        path.unlink()
    yield text_table([f"{long_side} x {long_side} px", "file, MB", "peak memory, MB", "refused"], rows)

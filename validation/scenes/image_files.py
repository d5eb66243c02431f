"""Image files of the scenes: read as RGB, written as PNG."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage

from thesisrecon.arrays import U8
from thesisrecon.io._files import write_atomically


def read_rgb(path: Path) -> U8:
    """Read an image (H, W, 3)."""
    with PillowImage.open(path) as image:
        return np.asarray(image.convert("RGB"))


def write_png(path: Path, rgb: U8) -> None:
    """Write an image at once or not at all."""
    sink = io.BytesIO()
    PillowImage.fromarray(rgb).save(sink, "PNG", compress_level=1)
    write_atomically(path, sink.getvalue())

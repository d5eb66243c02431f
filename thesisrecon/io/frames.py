"""Pictures in a row as files: one PNG each, and one animated file of all."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import PIL.features
import PIL.Image
from numpy.typing import NDArray

from thesisrecon.errors import UsageError
from thesisrecon.io.files import write_atomically

WEBP_QUALITY = 85
"""Of animated WebP: lossy (38 dB on frames with much texture), an eighth of the size of APNG and, with all
colours, a quarter of that of GIF."""

WEBP_METHOD = 2
"""Effort of the encoder, 0 to 6; more buys a few percent for twice the time."""

PNG_LEVEL = 3
"""Effort of the compressor, 0 to 9; 6 buys two percent for three times the time."""


def frame_name(number: int) -> str:
    """``frame-0001.png`` is the first, number 1."""
    return f"frame-{number:04d}.png"


def write_frame(folder: Path, number: int, rgb: NDArray[np.uint8]) -> Path:
    """Write picture ``rgb`` (H, W, 3) as frame ``number``, counted from 1, whole or not at all.

    Raises :class:`UsageError` where it cannot be written.
    """
    picture = io.BytesIO()
    PIL.Image.fromarray(rgb).save(picture, "PNG", compress_level=PNG_LEVEL)
    path = folder / frame_name(number)
    write_atomically(path, picture.getvalue())
    return path


def animation_suffix() -> str:
    """``.webp``, or ``.png`` (APNG, lossless and larger) where Pillow was built without WebP."""
    return ".webp" if PIL.features.check("webp") else ".png"


def write_animation(path: Path, frames: Sequence[Path], *, milliseconds: int = 40) -> Path:
    """Write the pictures of the files ``frames``, of equal size, as one that moves, each shown for
    ``milliseconds``, over and over; the same pictures give the same bytes.

    The format is that of the ending of ``path``: .webp or .png. One picture is in memory at a time for the
    former. Raises ``ValueError`` for other endings and without frames, :class:`UsageError` where a frame
    cannot be read or the file not written.
    """
    if path.suffix not in (".webp", ".png"):
        raise ValueError(f"an animation is written as .webp or .png; got {path.name}")
    if not frames:
        raise ValueError("an animation needs at least one frame")
    moving = io.BytesIO()
    film = _Film(frames)
    if path.suffix == ".webp":
        film.save(
            moving,
            "WEBP",
            save_all=True,
            duration=milliseconds,
            loop=0,
            quality=WEBP_QUALITY,
            method=WEBP_METHOD,
        )
    else:
        film.save(moving, "PNG", save_all=True, duration=milliseconds, loop=0)
    write_atomically(path, moving.getvalue())
    return path


class _Film(PIL.Image.Image):
    """The frames as one picture of Pillow's that is read from its files as it is played."""

    def __init__(self, frames: Sequence[Path]) -> None:
        super().__init__()
        self._frames = frames
        self.n_frames = len(frames)
        self.__setstate__(_read(frames[0]).__getstate__())
        self._place = 0

    def tell(self) -> int:
        return self._place

    def seek(self, frame: int) -> None:
        if not 0 <= frame < self.n_frames:
            raise EOFError(f"there is no frame {frame}")
        if frame != self._place:
            self.paste(_read(self._frames[frame]))
            self._place = frame


def _read(path: Path) -> PIL.Image.Image:
    try:
        with PIL.Image.open(path) as picture:
            return picture.convert("RGB")
    except OSError as error:
        raise UsageError(f"the frame {path} cannot be read: {error.strerror or error}") from None

"""Image sequences as files: one PNG per frame, and one animated file."""

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

_WEBP_QUALITY = 85
"""Lossy (38 dB on textured frames): an eighth of the size of APNG, a quarter of GIF with all colours."""
_WEBP_METHOD = 2
"""Encoder effort, 0 to 6; more saves a few percent for twice the time."""
_PNG_LEVEL = 3
"""Compression effort, 0 to 9; 6 saves two percent for three times the time."""


def frame_name(number: int) -> str:
    """Return the file name of a frame.

    Parameters
    ----------
    number : int
        From 1.

    Returns
    -------
    str
        As ``frame-0001.png``.
    """
    return f"frame-{number:04d}.png"


def write_frame(folder: Path, number: int, rgb: NDArray[np.uint8]) -> Path:
    """Write one frame as PNG.

    Parameters
    ----------
    folder : Path
        Output folder.
    number : int
        From 1.
    rgb : ndarray (H, W, 3) uint8
        The pixels.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    encoded = io.BytesIO()
    PIL.Image.fromarray(rgb).save(encoded, "PNG", compress_level=_PNG_LEVEL)
    path = folder / frame_name(number)
    write_atomically(path, encoded.getvalue())
    return path


def animation_suffix() -> str:
    """Return the suffix of animations that this Pillow can write.

    Returns
    -------
    str
        ``.webp``, or ``.png`` (APNG, lossless and larger) if Pillow lacks WebP.
    """
    return ".webp" if PIL.features.check("webp") else ".png"


def write_animation(path: Path, frames: Sequence[Path], *, milliseconds: int = 40) -> Path:
    """Write an endless animation of frames; equal frames give equal bytes.

    Parameters
    ----------
    path : Path
        Ends in ``.webp`` (one frame in memory at a time) or ``.png``.
    frames : sequence of Path
        Image files of one size, at least one.
    milliseconds : int
        Time per frame.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    UsageError
        If a frame cannot be read or the file cannot be written.
    """
    encoded, webp = io.BytesIO(), path.suffix == ".webp"
    lossy = {"quality": _WEBP_QUALITY, "method": _WEBP_METHOD} if webp else {}
    kind = "WEBP" if webp else "PNG"
    _Sequence(frames).save(encoded, kind, save_all=True, duration=milliseconds, loop=0, **lossy)
    write_atomically(path, encoded.getvalue())
    return path


class _Sequence(PIL.Image.Image):
    """A multi-frame Pillow image that reads its frames from files on demand."""

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
        with PIL.Image.open(path) as image:
            return image.convert("RGB")
    except OSError as error:
        raise UsageError(f"the frame {path} cannot be read: {error.strerror or error}") from None

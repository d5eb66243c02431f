"""Point clouds as PLY, ``cameras.json`` with the cameras of a run, frames and animations."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import PIL.features
import PIL.Image

from thesisrecon.arrays import F64, U8
from thesisrecon.camera import Camera
from thesisrecon.errors import UsageError
from thesisrecon.io._files import write_atomically

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_WEBP_QUALITY = 85
"""Lossy (38 dB on textured frames): an eighth of the size of APNG, a quarter of GIF with all colours."""
_WEBP_METHOD = 2
"""Encoder effort, 0 to 6; more saves a few percent for twice the time."""
_PNG_LEVEL = 3
"""Compression effort, 0 to 9; 6 saves two percent for three times the time."""
_JPEG_QUALITY = 95


def write_point_cloud(path: Path, xyz: F64, rgb: U8) -> None:
    """Write coloured points (N, 3) as binary little-endian PLY with float32 coordinates."""
    if not (np.abs(xyz) < np.finfo(np.float32).max).all():
        raise ValueError("write_point_cloud needs finite coordinates")
    vertices = np.empty(len(xyz), dtype=_VERTEX)
    vertices["xyz"], vertices["rgb"] = xyz, rgb
    properties = [f"property float {axis}\n" for axis in "xyz"]
    properties += [f"property uchar {name}\n" for name in ("red", "green", "blue")]
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{''.join(properties)}end_header\n"
    )
    write_atomically(path, header.encode("ascii") + vertices.tobytes())


def cameras_table(cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """Content of ``cameras.json``: cameras by image name."""
    listed = [
        {"name": name, "width": camera.size[0], "height": camera.size[1]}
        | {key: getattr(camera, key) for key in ("K", "distortion", "R", "t", "centre")}
        | ({"std": dict(sorted(camera.std.items()))} if camera.std else {})
        for name, camera in cameras.items()
    ]
    convention = (
        "x ~ K d(R X + t), d(u) = u (1 + k1 |u|^2 + k2 |u|^4 + k3 |u|^6), distortion = (k1, k2, k3); "
        "(0, 0) is the centre of the top-left pixel"
    )
    return {"convention": convention, "cameras": listed}


def write_image(path: Path, rgb: U8) -> None:
    """Write an RGB image as JPEG or, by the suffix, PNG."""
    encoded = io.BytesIO()
    if path.suffix.lower() == ".png":
        PIL.Image.fromarray(rgb).save(encoded, "PNG", compress_level=_PNG_LEVEL)
    else:
        PIL.Image.fromarray(rgb).save(encoded, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    write_atomically(path, encoded.getvalue())


def frame_name(number: int) -> str:
    """File name of a frame, numbered from 1."""
    return f"frame-{number:04d}.png"


def write_frame(folder: Path, number: int, rgb: U8) -> Path:
    """Write one frame as PNG."""
    path = folder / frame_name(number)
    write_image(path, rgb)
    return path


def animation_suffix() -> str:
    """``.webp``, or ``.png`` (APNG, lossless and larger) if Pillow lacks WebP."""
    return ".webp" if PIL.features.check("webp") else ".png"


def write_animation(path: Path, frames: Sequence[Path], *, milliseconds: int = 40) -> Path:
    """Write an endless animation of frame files of the same size; equal frames give equal bytes."""
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

"""Coloured points as a PLY file that every viewer opens.

The cameras of a finished run, read from its ``cameras.json``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.errors import UsageError
from thesisrecon.io.files import read_json, write_atomically

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])


def write_point_cloud(path: Path, xyz: F64, rgb: NDArray[np.uint8]) -> None:
    """Write points ``xyz`` (N, 3) with colours ``rgb`` (N, 3) uint8 as binary little-endian PLY.

    Coordinates are stored as float32, about their own origin, as viewers expect. The file appears whole or
    not at all. Raises ``ValueError`` for other shapes and for coordinates that are not finite in float32,
    :class:`~thesisrecon.errors.OutputError` where it cannot be written.
    """
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise ValueError(
            f"write_point_cloud needs (N, 3) points and (N, 3) uint8 colours; got {xyz.shape}, {rgb.shape}"
        )
    if not (np.abs(xyz) < np.finfo(np.float32).max).all():
        raise ValueError("write_point_cloud needs finite coordinates")
    vertices = np.empty(len(xyz), dtype=_VERTEX)
    vertices["xyz"], vertices["rgb"] = xyz, rgb
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(xyz)}",
        *properties,
        "end_header",
    ]
    write_atomically(path, "".join(f"{line}\n" for line in header).encode("ascii") + vertices.tobytes())


LARGEST_SIDE = 2**24
"""px; far above what any photograph has."""
ROUNDING = 1e-4
"""Of the numbers of a file that somebody has shortened."""


def read_cameras(path: Path) -> dict[str, Camera]:
    """Name -> camera of every registered photograph in the order of the file, in original pixels.

    The lens' distortion is left out: these are the cameras of the photographs after their distortion was
    removed. Raises :class:`UsageError` where the file is absent, damaged or without cameras, and where a K
    has no positive focal lengths or an R is no rotation.
    """
    if not path.is_file():
        raise UsageError(f"there is no {path.name} in {path.parent}; has a run ended there?")
    content = read_json(path)
    try:
        cameras = {str(entry["name"]): _camera(entry) for entry in content["cameras"]}
    except (TypeError, KeyError, ValueError, OverflowError):
        raise UsageError(f"{path} does not hold cameras of this program") from None
    if not cameras:
        raise UsageError(f"{path} holds no camera; no photograph of this run was registered")
    return cameras


def _camera(entry: Any) -> Camera:
    K, R, t = (np.array(entry[name], dtype=np.float64) for name in ("K", "R", "t"))
    camera = Camera(K, R, t, (int(entry["width"]), int(entry["height"])))
    if max(camera.size) > LARGEST_SIDE:
        raise ValueError(f"a photograph is no larger than {LARGEST_SIDE} px")
    if (np.diag(K) <= 0).any() or (np.abs(np.tril(K, -1)) > ROUNDING).any() or abs(K[2, 2] - 1.0) > ROUNDING:
        raise ValueError("K is upper triangular and has positive focal lengths")
    if not np.allclose(R @ R.T, np.eye(3), atol=ROUNDING) or np.linalg.det(R) < 0:
        raise ValueError("R is a rotation")
    return camera

"""Coloured points as a PLY file that every viewer opens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thesisrecon.io.files import write_atomically

F64 = NDArray[np.float64]

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])


def write_point_cloud(path: Path, xyz: F64, rgb: NDArray[np.uint8]) -> None:
    """Write points ``xyz`` (N, 3) with colours ``rgb`` (N, 3) uint8 as binary little-endian PLY.

    Coordinates are stored as float32, about their own origin, as viewers expect. The file appears whole or
    not at all. Raises ``ValueError`` for other shapes and for coordinates that are not finite in float32,
    :class:`~thesisrecon.errors.Unwritable` where it cannot be written.
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

"""Point clouds as PLY, and the cameras of a finished run from its ``cameras.json``."""

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
_MAX_SIDE_PX = 2**24
_ROUNDING = 1e-4
"""Tolerance for numbers that were rounded in the file."""


def write_point_cloud(path: Path, xyz: F64, rgb: NDArray[np.uint8]) -> None:
    """Write coloured points as binary little-endian PLY with float32 coordinates.

    Parameters
    ----------
    path : Path
        The file.
    xyz : ndarray (N, 3)
        Points.
    rgb : ndarray (N, 3) uint8
        Colours.

    Raises
    ------
    ValueError
        For other shapes, or coordinates that are not finite in float32.
    OutputError
        If the file cannot be written.
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


def read_cameras(path: Path) -> dict[str, Camera]:
    """Read the registered cameras of a run, in original pixels and without lens distortion.

    Parameters
    ----------
    path : Path
        A ``cameras.json``.

    Returns
    -------
    dict
        File name -> camera of the undistorted image, in the order of the file.

    Raises
    ------
    UsageError
        If the file is absent, damaged or empty, or a K or R is invalid.
    """
    if not path.is_file():
        raise UsageError(f"there is no {path.name} in {path.parent}; no run has finished in this folder")
    content = read_json(path)
    try:
        cameras = {str(entry["name"]): _camera(entry) for entry in content["cameras"]}
    except (TypeError, KeyError, ValueError, OverflowError):
        raise UsageError(f"{path} does not hold valid cameras written by thesisrecon") from None
    if not cameras:
        raise UsageError(f"{path} holds no camera; no image of this run was registered")
    return cameras


def _camera(entry: Any) -> Camera:
    K, R, t = (np.array(entry[name], dtype=np.float64) for name in ("K", "R", "t"))
    camera = Camera(K, R, t, (int(entry["width"]), int(entry["height"])))
    if max(camera.size) > _MAX_SIDE_PX:
        raise ValueError(f"an image side must be at most {_MAX_SIDE_PX} px")
    if (
        (np.diag(K) <= 0).any()
        or (np.abs(np.tril(K, -1)) > _ROUNDING).any()
        or abs(K[2, 2] - 1.0) > _ROUNDING
    ):
        raise ValueError("K must be upper triangular with positive focal lengths")
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROUNDING) or np.linalg.det(R) < 0:
        raise ValueError("R must be a rotation")
    return camera

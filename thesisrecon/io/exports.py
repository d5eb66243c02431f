"""Point clouds as PLY, and ``cameras.json``: the cameras of a run in original pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.errors import UsageError
from thesisrecon.io.files import read_json, write_atomically
from thesisrecon.records import Image, Reconstruction

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
    xyz, rgb : ndarray (N, 3)
        Points, finite in float32, and uint8 colours.

    Raises
    ------
    ValueError
        For coordinates that are not finite.
    OutputError
        If the file cannot be written.
    """
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


def cameras_table(reconstruction: Reconstruction, images: tuple[Image, ...]) -> dict[str, Any]:
    """Build ``cameras.json``: K, R (world-to-camera), t, centre and distortion of every registered view.

    Parameters
    ----------
    reconstruction : Reconstruction
        Metric, with K and distortion.
    images : tuple of Image
        The V views.

    Returns
    -------
    dict
        Content of the file, in original pixels.
    """
    assert reconstruction.K is not None
    assert reconstruction.distortion is not None
    cameras = []
    for i in np.flatnonzero(reconstruction.registered).tolist():
        K, image = reconstruction.K[i], images[i]
        Rt = np.linalg.solve(K, reconstruction.P[i])
        cameras.append(
            {
                "name": image.name,
                "width": image.original_size[0],
                "height": image.original_size[1],
                "K": _original_from_working(image.scale) @ K,
                "distortion": reconstruction.distortion[i],
                "R": Rt[:, :3],
                "t": Rt[:, 3],
                "centre": -Rt[:, :3].T @ Rt[:, 3],
            }
        )
    convention = (
        "x ~ K d(R X + t), d(u) = u (1 + k1 |u|^2 + k2 |u|^4 + k3 |u|^6), distortion = (k1, k2, k3); "
        "(0, 0) is the centre of the top-left pixel"
    )
    return {"convention": convention, "cameras": cameras}


def _original_from_working(scale: float) -> F64:
    """Return the (3, 3) map from working to original pixels, (x + 0.5) / scale - 0.5."""
    offset = 0.5 / scale - 0.5
    return np.array([[1 / scale, 0.0, offset], [0.0, 1 / scale, offset], [0.0, 0.0, 1.0]])


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
        raise UsageError(f"{path} does not hold cameras written by thesisrecon") from None
    if not cameras:
        raise UsageError(f"{path} holds no camera; no image of this run was registered")
    return cameras


def _camera(entry: Any) -> Camera:
    K, R, t = (np.array(entry[name], dtype=np.float64) for name in ("K", "R", "t"))
    camera = Camera(K, R, t, (int(entry["width"]), int(entry["height"])))
    if max(camera.size) > _MAX_SIDE_PX:
        raise ValueError(f"an image side must be at most {_MAX_SIDE_PX} px")
    lower = np.abs(np.tril(K, -1)).max()
    if (np.diag(K) <= 0).any() or max(lower, abs(K[2, 2] - 1.0)) > _ROUNDING:
        raise ValueError("K must be upper triangular with positive focal lengths")
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROUNDING) or np.linalg.det(R) < 0:
        raise ValueError("R must be a rotation")
    return camera

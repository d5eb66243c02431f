"""The cameras of a finished run, read from its ``cameras.json``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.errors import UsageError
from thesisrecon.geometry.pinhole import PinholeCamera
from thesisrecon.io.files import read_json

LARGEST_SIDE = 2**24
"""px; far above what any photograph has."""
ROUNDING = 1e-4
"""Of the numbers of a file that somebody has shortened."""


def read_cameras(path: Path) -> dict[str, PinholeCamera]:
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


def _camera(entry: Any) -> PinholeCamera:
    K, R, t = (np.array(entry[name], dtype=np.float64) for name in ("K", "R", "t"))
    camera = PinholeCamera(K, R, t, (int(entry["width"]), int(entry["height"])))
    if max(camera.size) > LARGEST_SIDE:
        raise ValueError(f"a photograph is no larger than {LARGEST_SIDE} px")
    if (np.diag(K) <= 0).any() or (np.abs(np.tril(K, -1)) > ROUNDING).any() or abs(K[2, 2] - 1.0) > ROUNDING:
        raise ValueError("K is upper triangular and has positive focal lengths")
    if not np.allclose(R @ R.T, np.eye(3), atol=ROUNDING) or np.linalg.det(R) < 0:
        raise ValueError("R is a rotation")
    return camera

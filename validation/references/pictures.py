"""Images resampled by OpenCV, whose pixels are ours: the centre of the top-left one is (0, 0)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64, U8
from validation.references.libraries import cv2

Size = tuple[int, int]


def warp_affine(rgb: U8, A: F64, size: Size) -> U8:
    """The image (H, W, 3) whose pixel x goes to A x, A (2, 3), by Lanczos' filter; ``size`` is (W, H)."""
    return np.asarray(cv2.warpAffine(rgb, A, size, flags=cv2.INTER_LANCZOS4), np.uint8)


def warp_perspective(picture: NDArray[Any], H: F64, size: Size) -> NDArray[Any]:
    """The image (H, W, C) whose pixel x goes to H x, H (3, 3), by cubic interpolation."""
    return np.asarray(cv2.warpPerspective(picture, H, size, flags=cv2.INTER_CUBIC))


def shrink(rgb: U8, size: Size) -> U8:
    """The image at the smaller ``size`` (W, H), each pixel the mean over its area."""
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)

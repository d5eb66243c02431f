"""PSNR and SSIM of images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.views import _image_similarity as likeness

BORDER_PX = 5
"""Radius of the SSIM windows."""


def psnr_db(picture: NDArray[Any], truth: NDArray[Any], *, where: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio of images (H, W, 3) over the pixels ``where`` (H, W), or all."""
    compared = np.ones(truth.shape[:2], dtype=bool) if where is None else where
    return likeness.psnr_db(truth, picture, compared)


def ssim(picture: NDArray[Any], truth: NDArray[Any]) -> float:
    """Mean structural similarity of images (H, W, 3), 1 for equal ones, where whole windows fit."""
    found = likeness._ssim_map(truth, picture, np.ones(truth.shape[:2], dtype=bool))
    return float(found[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX].mean())

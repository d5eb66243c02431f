"""PSNR and SSIM of images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.views import _image_similarity as similarity

BORDER_PX = 5
"""Radius of the SSIM windows."""


def psnr_db(image: NDArray[Any], truth: NDArray[Any], *, where: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio of images (H, W, 3) over the pixels ``where`` (H, W), or all."""
    compared = np.ones(truth.shape[:2], dtype=bool) if where is None else where
    return similarity.psnr_db(truth, image, compared)


def ssim(image: NDArray[Any], truth: NDArray[Any]) -> float:
    """Mean structural similarity of images (H, W, 3), 1 for equal ones, where whole windows fit."""
    found = similarity._ssim_map(truth, image, np.ones(truth.shape[:2], dtype=bool))
    return float(found[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX].mean())

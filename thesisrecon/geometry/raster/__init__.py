"""Pixels: smoothing and resizing of float32 images in the project's pixel frame.

Resizing by s takes x to (x + 0.5) s - 0.5, so that the corners of the image area stay where they are.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.geometry.raster.kernels import convolve_separable, halve_image, resample_image
from thesisrecon.types import F32

__all__ = ["convolve_separable", "gaussian_taps", "halve", "resample", "smooth"]


def gaussian_taps(sigma_px: float) -> F32:
    """Samples of a Gaussian over three sigma to each side, sum 1; (2 r + 1,)."""
    radius = max(1, int(np.ceil(3.0 * sigma_px)))
    x = np.arange(-radius, radius + 1)
    taps = np.exp(-0.5 * (x / sigma_px) ** 2)
    normalized: F32 = (taps / taps.sum()).astype(np.float32)
    return normalized


def smooth(image: F32, sigma_px: float) -> F32:
    """Gaussian smoothing of (H, W), sigma in pixels, the border pixel repeated."""
    return convolve_separable(image, gaussian_taps(sigma_px))


def halve(image: F32) -> F32:
    """Half the size (rounded down), low-passed by (1, 3, 3, 1) / 8: x goes to (x + 0.5) / 2 - 0.5 exactly.

    Raises ``ValueError`` for an image narrower or lower than two pixels.
    """
    if min(image.shape) < 2:
        raise ValueError(f"halve needs at least 2 x 2 pixels; got shape {image.shape}")
    return halve_image(image)


def resample(image: F32, width: int, height: int) -> F32:
    """(H, W) -> (height, width), bilinear; the caller smooths first where the image shrinks."""
    if width < 1 or height < 1:
        raise ValueError(f"resample needs a size of at least 1 x 1; got {width} x {height}")
    return resample_image(image, width, height)

"""Smoothing, resizing and cubic interpolation of float32 images in the project's pixel frame.

Resizing by s maps x to (x + 0.5) s - 0.5, so that the corners of the image area stay fixed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon._numba import FAST, empty, kernel, zeros
from thesisrecon.arrays import F32, F64, I64


@kernel(fastmath=FAST)
def _convolve_separable(image: F32, taps: F32) -> F32:
    """Convolve (H, W) with symmetric taps (2 r + 1,) along both axes, the border repeated."""
    height, width = image.shape
    radius = taps.size // 2
    out = zeros(image.shape, np.float32)
    row = empty(width + 2 * radius, np.float32)
    for y in range(height):
        row[:] = np.float32(0.0)
        for k in range(taps.size):
            source = image[min(max(y + k - radius, 0), height - 1)]
            weight = taps[k]
            for x in range(width):
                row[radius + x] += weight * source[x]
        row[:radius] = row[radius]
        row[radius + width :] = row[radius + width - 1]
        target = out[y]
        for k in range(taps.size):
            weight = taps[k]
            for x in range(width):
                target[x] += weight * row[x + k]
    return out


@kernel(fastmath=FAST)
def _halve_image(image: F32) -> F32:
    """Downsample to (H // 2, W // 2) with the taps (1, 3, 3, 1) / 8, centred between the merged pixels."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    out = empty((height, width), np.float32)
    row = empty(image.shape[1], np.float32)
    one, three = np.float32(1.0 / 8.0), np.float32(3.0 / 8.0)
    for y in range(height):
        above, below = max(2 * y - 1, 0), min(2 * y + 2, image.shape[0] - 1)
        for x in range(image.shape[1]):
            row[x] = one * (image[above, x] + image[below, x]) + three * (
                image[2 * y, x] + image[2 * y + 1, x]
            )
        for x in range(width):
            left, right = row[max(2 * x - 1, 0)], row[min(2 * x + 2, image.shape[1] - 1)]
            out[y, x] = one * (left + right) + three * (row[2 * x] + row[2 * x + 1])
    return out


@kernel(fastmath=FAST)
def resample(image: F32, width: int, height: int) -> F32:
    """Resize an image (H, W) by bilinear interpolation; smooth it before if it shrinks."""
    scale_x, scale_y = image.shape[1] / width, image.shape[0] / height
    out = empty((height, width), np.float32)
    left = empty(width, np.int64)
    fraction = empty(width, np.float32)
    for x in range(width):
        u = min(max((x + 0.5) * scale_x - 0.5, 0.0), image.shape[1] - 1.0)
        left[x] = min(int(u), max(image.shape[1] - 2, 0))
        fraction[x] = np.float32(u - left[x])
    step = 1 if image.shape[1] > 1 else 0
    for y in range(height):
        v = min(max((y + 0.5) * scale_y - 0.5, 0.0), image.shape[0] - 1.0)
        top = min(int(v), max(image.shape[0] - 2, 0))
        below = min(top + 1, image.shape[0] - 1)
        b = np.float32(v - top)
        a = np.float32(1.0) - b
        for x in range(width):
            u0, u1, s = left[x], left[x] + step, fraction[x]
            near = a * image[top, u0] + b * image[below, u0]
            far = a * image[top, u1] + b * image[below, u1]
            out[y, x] = near + s * (far - near)
    return out


def gaussian_taps(sigma_px: float) -> F32:
    """Samples (2 r + 1,) of a Gaussian of sum 1 over three sigma to each side."""
    radius = max(1, int(np.ceil(3.0 * sigma_px)))
    x = np.arange(-radius, radius + 1)
    taps = np.exp(-0.5 * (x / sigma_px) ** 2)
    return np.asarray(taps / taps.sum(), dtype=np.float32)


def smooth(image: F32, sigma_px: float) -> F32:
    """Smooth an image (H, W) with a Gaussian, the border pixels repeated."""
    return _convolve_separable(image, gaussian_taps(sigma_px))


def halve(image: F32) -> F32:
    """Reduce an image to half its size (rounded down), low-passed by (1, 3, 3, 1) / 8."""
    if min(image.shape) < 2:
        raise ValueError(f"halve needs at least 2 x 2 pixels; got shape {image.shape}")
    return _halve_image(image)


@kernel
def cubic_weights(fraction: float, weights: NDArray[Any]) -> None:
    """Fill in four weights of cubic convolution with a = -1/2 (Keys, IEEE Trans. ASSP 29, 1981)."""
    weights[0] = ((-0.5 * fraction + 1.0) * fraction - 0.5) * fraction
    weights[1] = (1.5 * fraction - 2.5) * fraction * fraction + 1.0
    weights[2] = ((-1.5 * fraction + 2.0) * fraction + 0.5) * fraction
    weights[3] = (0.5 * fraction - 0.5) * fraction * fraction


@kernel
def weighted_median(values: F32, weights: F64, order: I64, half: float) -> float:
    """The smallest value, in ascending ``order``, up to which the weights sum to ``half``."""
    total = 0.0
    for k in order:
        total += weights[k]
        if total >= half:
            return float(values[k])
    return float(values[order[-1]])

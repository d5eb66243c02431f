"""Compiled loops over pixels; every one has a NumPy twin in the tests."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32

# Sums may be reordered; assuming that no NaN exists would undo the bounds checks.
FAST = {"contract", "reassoc", "nsz", "arcp"}


@njit(cache=True, nogil=True, fastmath=FAST)
def convolve_separable(image: F32, taps: F32) -> F32:
    """Convolve (H, W) with the symmetric ``taps`` (2 r + 1,) along both axes, the border repeated."""
    height, width = image.shape
    radius = taps.size // 2
    out = np.zeros_like(image)
    row = np.empty(width + 2 * radius, np.float32)
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


@njit(cache=True, nogil=True, fastmath=FAST)
def halve_image(image: F32) -> F32:
    """(H, W) -> (H // 2, W // 2) with the taps (1, 3, 3, 1) / 8, centred between the pixels they merge."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    out = np.empty((height, width), np.float32)
    row = np.empty(image.shape[1], np.float32)
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


@njit(cache=True, nogil=True, fastmath=FAST)
def resample_image(image: F32, width: int, height: int) -> F32:
    """Bilinear samples of (H, W) at the pixel centres of a ``height`` x ``width`` grid over the same area."""
    scale_x, scale_y = image.shape[1] / width, image.shape[0] / height
    out = np.empty((height, width), np.float32)
    left = np.empty(width, np.int64)
    share = np.empty(width, np.float32)
    for x in range(width):
        u = min(max((x + 0.5) * scale_x - 0.5, 0.0), image.shape[1] - 1.0)
        left[x] = min(int(u), max(image.shape[1] - 2, 0))
        share[x] = np.float32(u - left[x])
    step = 1 if image.shape[1] > 1 else 0
    for y in range(height):
        v = min(max((y + 0.5) * scale_y - 0.5, 0.0), image.shape[0] - 1.0)
        top = min(int(v), max(image.shape[0] - 2, 0))
        below = min(top + 1, image.shape[0] - 1)
        b = np.float32(v - top)
        a = np.float32(1.0) - b
        for x in range(width):
            u0, u1, s = left[x], left[x] + step, share[x]
            near = a * image[top, u0] + b * image[below, u0]
            far = a * image[top, u1] + b * image[below, u1]
            out[y, x] = near + s * (far - near)
    return out

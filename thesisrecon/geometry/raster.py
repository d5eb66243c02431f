"""Compiled loops over pixels; every one has a NumPy twin in the tests.

Pixels: smoothing and resizing of float32 images in the project's pixel frame.

Resizing by s takes x to (x + 0.5) s - 0.5, so that the corners of the image area stay where they are.

The weights of an interpolation, for the loops that read images between their pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thesisrecon.arrays import F32

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


@njit(cache=True, nogil=True)
def cubic_weights(share: float, weights: NDArray[Any]) -> None:
    """Weights of four pixels at ``share`` in [0, 1] between the second and third: Keys 1981, a = -1/2.

    Keys, "Cubic convolution interpolation for digital image processing", IEEE Transactions on Acoustics,
    Speech, and Signal Processing 29, 1981. ``weights`` is overwritten; it may have more places.
    """
    weights[0] = ((-0.5 * share + 1.0) * share - 0.5) * share
    weights[1] = (1.5 * share - 2.5) * share * share + 1.0
    weights[2] = ((-1.5 * share + 2.0) * share + 0.5) * share
    weights[3] = (0.5 * share - 0.5) * share * share

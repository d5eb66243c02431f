"""Smoothing, resizing and cubic resampling of images, also into rectified or undistorted frames.

Resizing by s maps x to (x + 0.5) s - 0.5, so that the corners of the image area stay fixed.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon._numba import FAST, empty, kernel, zeros
from thesisrecon.arrays import B8, F32, F64, I64, U8, Record
from thesisrecon.camera import pixels_of_rays, widest_angle
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.lens import distort

MAX_TAPS = 24  #: limit of the filter width: reductions by more than 6 alias
NOT_SHRUNK = 1.1  #: reduction up to which the filter is not widened
STRIP_ROWS = 64  #: rows whose positions are held in memory at a time


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
def halve(image: F32) -> F32:
    """Reduce to (H // 2, W // 2) >= 1 with the taps (1, 3, 3, 1) / 8, centred between the merged pixels."""
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


@kernel
def _cubic(x: float) -> float:
    """Cubic convolution kernel of Keys with a = -1/2, third-order accurate."""
    x = abs(x)
    if x < 1.0:
        return (1.5 * x - 2.5) * x * x + 1.0
    if x < 2.0:
        return ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0
    return 0.0


@kernel
def _taps(at: float, spread: float, weights: F64) -> tuple[int, int]:
    """Weights of the pixels around ``at`` with the kernel ``spread`` times as wide; first pixel and count."""
    reach = min(2.0 * spread, 0.5 * MAX_TAPS - 1.0)
    first = int(np.ceil(at - reach))
    count = int(np.floor(at + reach)) - first + 1
    total = 0.0
    for k in range(count):
        weights[k] = _cubic((first + k - at) / spread)
        total += weights[k]
    for k in range(count):
        weights[k] /= total
    return first, count


@kernel
def _spread(xy: F64, i: int, j: int, axis: int) -> float:
    """Distance of the neighbours of ``xy[i, j]`` along an axis of the image, at least 1."""
    i1 = i + 1 if i + 1 < xy.shape[0] else i - 1
    j1 = j + 1 if j + 1 < xy.shape[1] else j - 1
    across = xy[i, j1, axis] - xy[i, j, axis] if j1 >= 0 else 0.0
    down = xy[i1, j, axis] - xy[i, j, axis] if i1 >= 0 else 0.0
    squared = across * across + down * down
    # The comparison is also false for NaN.
    return np.sqrt(squared) if squared > NOT_SHRUNK * NOT_SHRUNK else 1.0


@kernel
def sample_cubic(image: F32, xy: F64, widen: bool, out: F32) -> None:
    """Cubic samples of ``image`` (H, W, C) at ``xy`` (>= n, m, 2) px into ``out`` (n, m, C)."""
    # With ``widen`` the kernel is wider along each axis of the image where adjacent positions are more than a
    # pixel apart. NaN outside the pixel centres, or beside a NaN pixel; other NaN pixels are left out.
    height, width, channels = image.shape
    wx, wy = empty(MAX_TAPS), empty(MAX_TAPS)
    total = empty(channels)
    for i in range(out.shape[0]):
        for j in range(xy.shape[1]):
            out[i, j] = np.nan
            x, y = xy[i, j, 0], xy[i, j, 1]
            # Rounding of the positions must not remove border pixels.
            if not (x > -1e-6 and y > -1e-6 and x < width - 1 + 1e-6 and y < height - 1 + 1e-6):
                continue
            x0, y0 = min(max(int(x), 0), width - 1), min(max(int(y), 0), height - 1)
            x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
            if np.isnan(image[y0, x0, 0] + image[y0, x1, 0] + image[y1, x0, 0] + image[y1, x1, 0]):
                continue
            spread_x = _spread(xy, i, j, 0) if widen else 1.0
            spread_y = _spread(xy, i, j, 1) if widen else 1.0
            inner = x0 >= 1 and x0 + 2 < width and y0 >= 1 and y0 + 2 < height
            if inner and spread_x == 1.0 and spread_y == 1.0:
                cubic_weights(x - x0, wx)
                cubic_weights(y - y0, wy)
                for c in range(channels):
                    value = 0.0
                    for k in range(4):
                        row = image[y0 - 1 + k]
                        left_part = wx[0] * row[x0 - 1, c] + wx[1] * row[x0, c]
                        value += wy[k] * (left_part + wx[2] * row[x0 + 1, c] + wx[3] * row[x0 + 2, c])
                    total[c] = value
                if not np.isnan(total[0]):
                    for c in range(channels):
                        out[i, j, c] = total[c]
                    continue
            left, n_x = _taps(x, spread_x, wx)
            top, n_y = _taps(y, spread_y, wy)
            weight = 0.0
            total[:] = 0.0
            for k in range(n_y):
                v = min(max(top + k, 0), height - 1)
                for l in range(n_x):
                    u = min(max(left + l, 0), width - 1)
                    if np.isnan(image[v, u, 0]):
                        continue
                    w = wy[k] * wx[l]
                    weight += w
                    for c in range(channels):
                        total[c] += w * image[v, u, c]
            for c in range(channels):
                out[i, j, c] = total[c] / weight


def warp_image(image: F32, lookup: Callable[[range], F64], size: tuple[int, int]) -> F32:
    """Resample an image into a frame of (width, height) by cubic convolution, NaN outside the image."""
    pixels = np.ascontiguousarray(image, dtype=np.float32)
    pixels = pixels[:, :, None] if pixels.ndim == 2 else pixels
    width, height = size
    out = np.empty((height, width, pixels.shape[2]), np.float32)
    for rows in np.array_split(np.arange(height), -(-height // STRIP_ROWS)):
        first, last = int(rows[0]), int(rows[-1]) + 1
        # One row more, if there is one: neighbour distances determine the filter width.
        sample_cubic(pixels, lookup(range(first, min(last + 1, height))), True, out[first:last])
    return out[:, :, 0] if image.ndim == 2 else out


def undistort_image(
    rgb: U8, K: F64, distortion: F64, pinhole_K: F64, size: tuple[int, int], *, mask: B8 | None = None,
    turn: F64 | None = None,
) -> tuple[U8, B8]:  # fmt: skip
    """Resample an image with distortion into a pinhole camera; return it and which pixels are inside."""
    # The pinhole camera is rotated by `turn` (3, 3), from the axes of the image to its own.
    inverse = np.linalg.inv(pinhole_K)
    most = np.inf if turn is None else widest_angle(K, rgb.shape[1::-1], distortion)

    def lookup(rows: range) -> F64:
        x, y = np.meshgrid(np.arange(float(size[0])), np.arange(float(rows.start), float(rows.stop)))
        rays = homogenize(np.stack([x, y], axis=-1).reshape(-1, 2)) @ inverse.T
        if turn is not None:
            return pixels_of_rays(rays @ turn, K, distortion, most).reshape(*x.shape, 2)
        xy = distort(dehomogenize(rays), distortion) @ K[:2, :2].T + K[:2, 2]
        return np.asarray(xy.reshape(*x.shape, 2))

    given = rgb.astype(np.float32)
    if mask is not None:
        given[~mask] = np.nan
    return resampled(given, lookup, size)


def resampled(levels: F32, lookup: Callable[[range], F64], size: tuple[int, int]) -> tuple[U8, B8]:
    """Resample levels (H, W, 3), NaN where there are none; return an image and which pixels are inside."""
    pixels = warp_image(levels, lookup, size)
    seen = np.asarray(np.isfinite(pixels).all(axis=2))
    pixels[~seen] = 0.0
    np.clip(np.rint(pixels, out=pixels), 0.0, 255.0, out=pixels)
    return pixels.astype(np.uint8), seen


def bilinear_samples(values: F32 | F64, x: F32 | F64, y: F32 | F64) -> tuple[F64, F64]:
    """Bilinear samples (..., C) of ``values`` (H, W, C), and the range (..., C) of the four pixels around."""
    height, width = values.shape[:2]
    x0 = np.clip(np.floor(x).astype(np.int64), 0, max(width - 2, 0))
    y0 = np.clip(np.floor(y).astype(np.int64), 0, max(height - 2, 0))
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    a, b, c, d = (values[v, u] for v, u in ((y0, x0), (y0, x1), (y1, x0), (y1, x1)))
    top, bottom = a + fx * (b - a), c + fx * (d - c)
    spread = np.maximum.reduce([a, b, c, d]) - np.minimum.reduce([a, b, c, d])
    return top + fy * (bottom - top), spread


class Rectification(Record, ABC):
    """Maps between two images (side 0 is the left one) and a frame whose rows are epipolar lines."""

    size: tuple[int, int]

    @abstractmethod
    def _original(self, side: int, xy: F64) -> F64: ...

    @abstractmethod
    def _rectified(self, side: int, xy: F64) -> F64: ...

    @abstractmethod
    def _lookup(self, side: int, rows: range) -> F64:
        """Positions (len(rows), width, 2) of rows of the frame in an image."""

    def original_from_rectified(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Map positions (N, 2) of the frame to pixels, NaN if there is none, or ``within`` the frame only."""
        return self._original(side, self._within(xy) if within else xy)

    def rectified_from_original(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Map pixels (N, 2) to the frame, NaN beyond the line sent to infinity, and outside if ``within``."""
        moved = self._rectified(side, xy)
        return self._within(moved) if within else moved

    def _within(self, xy: F64) -> F64:
        inside = np.all((xy >= -0.5) & (xy <= np.array(self.size) - 0.5), axis=1)
        return np.where(inside[:, None], xy, np.nan)

    def reduced(self, scale: float) -> "Rectification":  # noqa: ARG002
        """The frame with ``scale`` times as many pixels per side, or itself where its size is bounded."""
        return self

    def warp(self, image: F32, side: int) -> F32:
        """Resample an image (H, W) or (H, W, C) into the frame, NaN outside."""
        return warp_image(image, partial(self._lookup, side), self.size)

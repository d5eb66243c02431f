"""Windows of a photograph, sampled from its pyramid and normalised.

A pyramid travels as ``pixels``, all its levels one after the other, and ``levels`` (L, 3): offset, height and
width of each; level k spans ``base * 2^k`` pixels of the photograph per pixel.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32, F64, I64

# Sums may be reordered; assuming that no NaN exists would undo the bounds checks.
FAST = {"contract", "reassoc", "nsz", "arcp"}
SIDE = 15
SAMPLES = SIDE * SIDE


@njit(cache=True, nogil=True)
def level_of(scale: float, base: float, count: int) -> int:
    """The pyramid level whose pixels are nearest to ``scale``, on a logarithmic measure."""
    k = int(np.floor(np.log2(scale / base) + 0.5))
    return min(max(k, 0), count - 1)


@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def sample_window(pixels: F32, level: I64, to_level: float, xy: F64, step: F64, side: int, out: F32) -> bool:
    """Bilinear samples of a ``side`` x ``side`` window around ``xy`` px into ``out`` (side^2,), False where
    it leaves.

    Sample (column a, row b), counted from the centre, is at ``xy + step @ (a, b)``; ``level`` is (offset,
    height, width) and ``to_level`` its pixels per pixel of the photograph.
    """
    offset, height, width = level[0], level[1], level[2]
    x0 = (xy[0] + 0.5) * to_level - 0.5
    y0 = (xy[1] + 0.5) * to_level - 0.5
    a, b = step[0, 0] * to_level, step[0, 1] * to_level
    c, d = step[1, 0] * to_level, step[1, 1] * to_level
    half = side // 2
    reach_x, reach_y = half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
    if not (x0 - reach_x >= 0.0 and x0 + reach_x < width - 1.001):
        return False
    if not (y0 - reach_y >= 0.0 and y0 + reach_y < height - 1.001):
        return False
    n = 0
    for row in range(-half, half + 1):
        u_row, v_row = x0 + b * row, y0 + d * row
        for column in range(-half, half + 1):
            u, v = u_row + a * column, v_row + c * column
            iu, iv = int(u), int(v)
            p, q = np.float32(u - iu), np.float32(v - iv)
            at = offset + iv * width + iu
            top = pixels[at] + p * (pixels[at + 1] - pixels[at])
            low = pixels[at + width] + p * (pixels[at + width + 1] - pixels[at + width])
            out[n] = top + q * (low - top)
            n += 1
    return True


@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def normalize_window(window: F32) -> float:
    """Subtract the mean and divide by the norm, in place; returns the norm before (0: no structure, left
    zero)."""
    total = np.float32(0.0)
    for n in range(len(window)):
        total += window[n]
    mean = total / np.float32(len(window))
    square = np.float32(0.0)
    for n in range(len(window)):
        window[n] -= mean
        square += window[n] * window[n]
    norm = np.sqrt(square)
    # Less contrast than half a grey level per pixel is noise.
    if norm < 0.5 * np.sqrt(float(len(window))):
        window[:] = np.float32(0.0)
        return 0.0
    factor = np.float32(1.0) / norm
    for n in range(len(window)):
        window[n] *= factor
    return float(norm)


@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def dot(a: F32, b: F32) -> float:
    """Inner product of two float32 vectors."""
    total = np.float32(0.0)
    for n in range(len(a)):
        total += a[n] * b[n]
    return float(total)


@njit(cache=True, nogil=True)
def corner_patches(pixels: F32, levels: I64, base: float, xy: F64, scale: F32, side: int = SIDE) -> F32:
    """(N, side^2) normalised upright windows of the corners at their scale; zero where they leave the
    image."""
    out = np.zeros((len(xy), side * side), np.float32)
    step = np.zeros((2, 2))
    for n in range(len(xy)):
        k = level_of(scale[n], base, len(levels))
        step[0, 0] = step[1, 1] = scale[n]
        if sample_window(pixels, levels[k], 1.0 / (base * 2.0**k), xy[n], step, side, out[n]):
            normalize_window(out[n])
        else:
            out[n] = np.float32(0.0)
    return out


@njit(cache=True, nogil=True)
def map_determinant(a: F64) -> float:
    """Determinant of a local map (2, 2); 0 for one that no two photographs of a surface have (mirrored, or
    five times larger or smaller)."""
    determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    return determinant if determinant > 0.04 and determinant < 25.0 else 0.0

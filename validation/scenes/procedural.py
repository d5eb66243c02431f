"""Procedural noise and patterns on a plane: band-limited, seeded by integers, the same on every machine.

Everything is integer hashing and elementwise arithmetic, so no library's random stream or summation order
enters. Coordinates are metres; a map of shape (H, W) has its sample (row, column) at (column, row) * texel_m.
"""

from __future__ import annotations

from collections.abc import Callable
from math import floor, sqrt
from typing import TypeVar, cast

import numpy as np
from numba import njit

from thesisrecon.arrays import F32, F64

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """numba's njit with a static type, without fast-math: bytes must not depend on it."""
    return cast(Kernel, njit(cache=True, nogil=True)(function))


@compiled
def _hash01(ix: int, iy: int, seed: int) -> float:
    h = (ix * 374761393 + iy * 668265263 + seed * 1442695041) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 1103515245) & 0xFFFFFFFF
    return float((h ^ (h >> 16)) & 0xFFFFFF) / 16777216.0


@compiled
def _value_noise(x: float, y: float, seed: int, period: int) -> float:
    """Value noise in [-1, 1] on the unit lattice; ``period`` > 0 wraps it along x."""
    ix, iy = floor(x), floor(y)
    fx, fy = x - ix, y - iy
    sx = fx * fx * fx * (fx * (fx * 6.0 - 15.0) + 10.0)
    sy = fy * fy * fy * (fy * (fy * 6.0 - 15.0) + 10.0)
    x0, x1 = ix, ix + 1
    if period > 0:
        x0, x1 = x0 % period, x1 % period
    a = _hash01(x0, iy, seed) * (1.0 - sx) + _hash01(x1, iy, seed) * sx
    b = _hash01(x0, iy + 1, seed) * (1.0 - sx) + _hash01(x1, iy + 1, seed) * sx
    return 2.0 * (a * (1.0 - sy) + b * sy) - 1.0


@compiled
def _fill_fractal(out: F32, steps: F64, seed: int, wrap_width: float) -> None:
    """``steps``: texel, longest wavelength, shortest wavelength, amplitude ratio of the next octave."""
    texel, longest, shortest, ratio = steps
    for row in range(out.shape[0]):
        for col in range(out.shape[1]):
            total, weight, norm, wavelength, octave = 0.0, 1.0, 0.0, longest, 0
            while wavelength >= shortest:
                period = 0
                scale = 1.0 / wavelength
                if wrap_width > 0.0:
                    period = max(1, int(wrap_width / wavelength + 0.5))
                    scale = period / wrap_width
                total += weight * _value_noise(
                    col * texel * scale, row * texel / wavelength, seed + 31 * octave, period
                )
                norm += weight * weight
                weight *= ratio
                wavelength *= 0.5
                octave += 1
            out[row, col] = total / sqrt(norm)


def fractal(
    shape: tuple[int, int],
    texel_m: float,
    seed: int,
    *,
    wavelengths_m: tuple[float, float],
    ratio: float = 0.6,
    wrap: bool = False,
) -> F32:
    """Multi-octave noise (H, W), zero mean, about 0.5 RMS, between two wavelengths, the shortest at least two
    texels; ``wrap`` closes it along x.
    """
    out = np.empty(shape, np.float32)
    steps = np.array([texel_m, *wavelengths_m, ratio])
    _fill_fractal(out, steps, seed, shape[1] * texel_m if wrap else 0.0)
    return out


@compiled
def _fill_cells(edge: F32, label: F32, warp: F32, texel: float, cell: float, seed: int, period: int) -> None:
    for row in range(edge.shape[0]):
        for col in range(edge.shape[1]):
            x = (col * texel + warp[row, col]) / cell
            y = (row * texel + 0.7 * warp[row, col]) / cell
            ix, iy = floor(x), floor(y)
            first, second, best = 1e9, 1e9, 0.0
            for jy in range(iy - 2, iy + 3):
                for jx in range(ix - 2, ix + 3):
                    kx = jx % period if period > 0 else jx
                    px = jx + 0.15 + 0.7 * _hash01(kx, jy, seed)
                    py = jy + 0.15 + 0.7 * _hash01(kx, jy, seed + 1)
                    d = sqrt((x - px) * (x - px) + (y - py) * (y - py))
                    if d < first:
                        second, first, best = first, d, _hash01(kx, jy, seed + 2)
                    elif d < second:
                        second = d
            edge[row, col] = (second - first) * cell
            label[row, col] = best


def cells(
    shape: tuple[int, int], texel_m: float, seed: int, *, cell_m: float, wrap: bool = False
) -> tuple[F32, F32]:
    """Irregular stones (Worley's cells): distance to the joint (m) and a label in [0, 1) of each stone."""
    edge, label = np.empty(shape, np.float32), np.empty(shape, np.float32)
    period = round(shape[1] * texel_m / cell_m) if wrap else 0
    cell = shape[1] * texel_m / period if wrap else cell_m
    warp = fractal(
        shape, texel_m, seed + 7, wavelengths_m=(0.5 * cell, max(0.12 * cell, 2.5 * texel_m)), wrap=wrap
    )
    _fill_cells(edge, label, (0.09 * cell * warp).astype(np.float32), texel_m, cell, seed, period)
    return edge, label


@compiled
def _fill_courses(edge: F32, label: F32, warp: F32, steps: F64, seed: int) -> None:
    texel, length, rise = steps
    for row in range(edge.shape[0]):
        for col in range(edge.shape[1]):
            y = row * texel + warp[row, col]
            course = floor(y / rise)
            shift = (0.5 * (course % 2) + 0.16 * _hash01(course, 3, seed)) * length
            x = col * texel + warp[row, col] + shift
            block = floor(x / length)
            left = (block + 0.12 * (_hash01(block, course, seed) - 0.5)) * length
            right = (block + 1 + 0.12 * (_hash01(block + 1, course, seed) - 0.5)) * length
            if x < left:
                block, right, left = block - 1, left, left - length
            elif x > right:
                block, left, right = block + 1, right, right + length
            along = min(x - left, right - x)
            across = min(y - course * rise, (course + 1) * rise - y)
            edge[row, col] = min(along, across)
            label[row, col] = _hash01(block, course, seed + 5)


def courses(
    shape: tuple[int, int],
    texel_m: float,
    seed: int,
    *,
    block_m: tuple[float, float],
    wobble_m: float = 0.003,
) -> tuple[F32, F32]:
    """Blocks (length, rise) in running bond: distance to the joint (m) and a label of each block."""
    edge, label = np.empty(shape, np.float32), np.empty(shape, np.float32)
    warp = fractal(shape, texel_m, seed + 11, wavelengths_m=(0.5 * block_m[0], 4.0 * texel_m))
    steps = np.array([texel_m, *block_m])
    _fill_courses(edge, label, (wobble_m * warp).astype(np.float32), steps, seed)
    return edge, label


@compiled
def _stamp_leaves(height: F32, tint: F32, leaves: F64, texel: float) -> None:
    for k in range(leaves.shape[0]):
        cx, cy, size, cos, sin, base, shade = leaves[k]
        reach = int(1.1 * size / texel) + 1
        col0, row0 = int(cx / texel), int(cy / texel)
        for row in range(max(0, row0 - reach), min(height.shape[0], row0 + reach + 1)):
            for col in range(max(0, col0 - reach), min(height.shape[1], col0 + reach + 1)):
                dx, dy = (col * texel - cx) / size, (row * texel - cy) / size
                a, b = cos * dx + sin * dy, cos * dy - sin * dx
                if abs(a) >= 1.0:
                    continue
                half_width = 0.62 * (1.0 - a * a) * (1.0 - 0.45 * a)
                rest = 1.0 - abs(b) / half_width
                if rest <= 0.0:
                    continue
                level = base + 0.25 * size * min(1.0, 4.0 * rest) * (1.0 - 0.5 * a * a)
                if level > height[row, col]:
                    height[row, col] = level
                    vein = 0.25 if abs(b) < 0.07 else 0.0
                    tint[row, col] = shade + vein + 0.12 * a + (0.1 if b > 0.0 else -0.1)


def ivy(
    shape: tuple[int, int], texel_m: float, seed: int, *, density: F32, depth_m: float = 0.05
) -> tuple[F32, F32]:
    """Overlapping leaves where ``density`` (H, W) allows: height (m, 0 = none) and tint about 0.5."""
    rng = np.random.Generator(np.random.PCG64(seed))
    n = int(shape[0] * shape[1] * texel_m**2 * 900)
    raw = rng.random((n, 7))
    rows = (raw[:, 1] * shape[0]).astype(np.int64)
    cols = (raw[:, 0] * shape[1]).astype(np.int64)
    grown = raw[raw[:, 6] < density[rows, cols]]
    # Rational parametrisation of the circle: no library sine, so the same bytes on every machine.
    s = 2.4 * grown[:, 3] - 1.2
    leaves = np.column_stack(
        [
            grown[:, 0] * shape[1] * texel_m,
            grown[:, 1] * shape[0] * texel_m,
            0.035 + 0.04 * grown[:, 2],
            2.0 * s / (1.0 + s * s),
            -(1.0 - s * s) / (1.0 + s * s),
            depth_m * (0.15 + 0.85 * grown[:, 4]),
            0.15 + 0.7 * grown[:, 5],
        ]
    )
    height, tint = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    _stamp_leaves(height, tint, leaves, texel_m)
    return height, tint

"""Compiled search for the plane of every pixel that makes the photographs agree."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

UNKNOWN = 4.0
"""Cost of a pixel without a plane; that of the worst plane is 2."""
HIDDEN = 0.5
"""By how much a neighbour's cost may exceed the least one and still count."""
TEXTURE = 4.0
"""Variance in squared grey levels that counts as noise: below it a window says nothing."""


@njit(cache=True, nogil=True, error_model="numpy")
def fit_planes(rho: F32, radius: int, alike: float, gx: F32, gy: F32) -> None:
    """Gradient (H, W) of the inverse depth about every known pixel, from the known ones within ``radius``
    that differ from it by at most the share ``alike``; 0 where they are too few, NaN where unknown."""
    height, width = rho.shape
    for v in range(height):
        for u in range(width):
            gx[v, u], gy[v, u] = np.nan, np.nan
            here = np.float64(rho[v, u])
            if not np.isfinite(here):
                continue
            sxx, sxy, syy, sxd, syd, sx, sy, sd, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
            for b in range(max(v - radius, 0), min(v + radius + 1, height)):
                for a in range(max(u - radius, 0), min(u + radius + 1, width)):
                    d = np.float64(rho[b, a]) - here
                    if abs(d) <= alike * here:
                        x, y = a - u, b - v
                        sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
                        sxd, syd = sxd + x * d, syd + y * d
                        sx, sy, sd, n = sx + x, sy + y, sd + d, n + 1
            gx[v, u], gy[v, u] = 0.0, 0.0
            if n >= 6:
                sxx, sxy, syy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
                sxd, syd = sxd - sx * sd / n, syd - sy * sd / n
                det = sxx * syy - sxy * sxy
                if det > 1e-3 * sxx * syy:
                    gx[v, u] = (syy * sxd - sxy * syd) / det
                    gy[v, u] = (sxx * syd - sxy * sxd) / det


@njit(cache=True, nogil=True, error_model="numpy")
def _weights(gray: F32, u: int, v: int, offsets: I64, likeness: F32, weights: F64, values: F64) -> None:
    """Of the samples of a window: the more alike the centre, the more they count; 0 outside."""
    height, width = gray.shape
    centre = gray[v, u]
    for k in range(len(offsets)):
        a, b = u + offsets[k, 0], v + offsets[k, 1]
        weights[k], values[k] = 0.0, 0.0
        if 0 <= a < width and 0 <= b < height:
            apart = abs(gray[b, a] - centre)
            if apart < 256.0:
                weights[k], values[k] = likeness[int(apart)], gray[b, a]


@njit(cache=True, nogil=True, error_model="numpy")
def _one_cost(
    other: F32, size: I64, H: F64, e: F64, u: int, v: int, plane: F64, offsets: I64, weights: F64, values: F64
) -> float:
    """1 - weighted NCC of the window with its image in another view by the plane, -1 where that is not held.

    (x, y, 1) of inverse depth rho is at H (x, y, 1) + rho e.
    """
    x0, x1, x2 = H[0, 0] * u + H[0, 1] * v + H[0, 2], H[0, 0] + plane[1] * e[0], H[0, 1] + plane[2] * e[0]
    y0, y1, y2 = H[1, 0] * u + H[1, 1] * v + H[1, 2], H[1, 0] + plane[1] * e[1], H[1, 1] + plane[2] * e[1]
    z0, z1, z2 = H[2, 0] * u + H[2, 1] * v + H[2, 2], H[2, 0] + plane[1] * e[2], H[2, 1] + plane[2] * e[2]
    x0, y0, z0 = x0 + plane[0] * e[0], y0 + plane[0] * e[1], z0 + plane[0] * e[2]
    width, height = size[0], size[1]
    total, held, sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(offsets)):
        w = weights[k]
        total += w
        dx, dy = offsets[k, 0], offsets[k, 1]
        z = z0 + dx * z1 + dy * z2
        if not z > 0.0:
            return -1.0
        x, y = (x0 + dx * x1 + dy * x2) / z, (y0 + dx * y1 + dy * y2) / z
        if not (0.0 <= x < width - 1 and 0.0 <= y < height - 1):
            continue
        i, j = int(x), int(y)
        fx, fy = x - i, y - j
        top = other[j, i] + fx * (other[j, i + 1] - other[j, i])
        bottom = other[j + 1, i] + fx * (other[j + 1, i + 1] - other[j + 1, i])
        b = top + fy * (bottom - top)
        a = values[k]
        held += w
        sa, sb = sa + w * a, sb + w * b
        saa, sbb, sab = saa + w * a * a, sbb + w * b * b, sab + w * a * b
    if held < 0.7 * total:
        return -1.0
    sa, sb = sa / held, sb / held
    va, vb = max(saa / held - sa * sa, 0.0) + TEXTURE, max(sbb / held - sb * sb, 0.0) + TEXTURE
    cost = 1.0 - (sab / held - sa * sb) / np.sqrt(va * vb)
    return cost if cost >= 0.0 else -1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _cost(
    others: F32,
    sizes: I64,
    H: F64,
    e: F64,
    u: int,
    v: int,
    plane: F64,
    offsets: I64,
    weights: F64,
    values: F64,
) -> float:
    """Mean of the least two costs, the second at most ``HIDDEN`` above the first: a neighbour from which the
    pixel is hidden has no say."""
    if not plane[0] > 0.0:
        return UNKNOWN
    least, second = UNKNOWN, UNKNOWN
    for k in range(len(others)):
        cost = _one_cost(others[k], sizes[k], H[k], e[k], u, v, plane, offsets, weights, values)
        if cost >= 0.0:
            if cost < least:
                least, second = cost, least
            elif cost < second:
                second = cost
    # A single neighbour, or one beside those that are hidden: the worse for it, whatever the others show.
    return least + 0.5 * min(second - least, HIDDEN) if least < UNKNOWN else UNKNOWN


@njit(cache=True, nogil=True, error_model="numpy")
def _motion(H: F64, e: F64, u: int, v: int, rho: float) -> float:
    """Greatest number of pixels that the place in another view moves per unit of inverse depth."""
    most = 0.0
    for k in range(len(H)):
        z = H[k, 2, 0] * u + H[k, 2, 1] * v + H[k, 2, 2] + rho * e[k, 2]
        x = (H[k, 0, 0] * u + H[k, 0, 1] * v + H[k, 0, 2] + rho * e[k, 0]) / z
        y = (H[k, 1, 0] * u + H[k, 1, 1] * v + H[k, 1, 2] + rho * e[k, 1]) / z
        most = max(most, np.hypot(e[k, 0] - x * e[k, 2], e[k, 1] - y * e[k, 2]) / abs(z))
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def sweep_planes(
    gray: F32,
    others: F32,
    sizes: I64,
    H: F64,
    e: F64,
    offsets: I64,
    likeness: F32,
    step_px: float,
    settled: float,
    backward: bool,
    planes: F32,
    cost: F32,
) -> None:
    """One pass over ``planes`` (H, W, 3), inverse depth and its gradient, and their ``cost``, in place.

    Every pixel tries the planes of the two neighbours that the pass has been at, continued to it, and its own
    moved by ``step_px`` in the image (as a whole, and tilted by as much at the rim of the window), unless
    its cost is at most ``settled``.
    ``offsets`` (S, 2) are the samples of the window, ``likeness`` (256,) their weight by grey difference;
    ``others`` (K, H', W') the neighbours, of ``sizes`` (K, 2) (width, height).
    """
    height, width = gray.shape
    weights, values = np.empty(len(offsets)), np.empty(len(offsets))
    plane, trial = np.empty(3), np.empty(3)
    reach = max(np.abs(offsets).max(), 1)
    way = -1 if backward else 1
    for row in range(height):
        v = height - 1 - row if backward else row
        for column in range(width):
            u = width - 1 - column if backward else column
            if not np.isfinite(gray[v, u]) or cost[v, u] <= settled:
                continue
            _weights(gray, u, v, offsets, likeness, weights, values)
            plane[:] = planes[v, u]
            least = float(cost[v, u])
            for k in range(2):
                a, b = (u - way, v) if k == 0 else (u, v - way)
                if not (0 <= a < width and 0 <= b < height) or not np.isfinite(planes[b, a, 0]):
                    continue
                trial[:] = planes[b, a]
                trial[0] += (u - a) * trial[1] + (v - b) * trial[2]
                tried = _cost(others, sizes, H, e, u, v, trial, offsets, weights, values)
                if tried < least:
                    least = tried
                    plane[:] = trial
            if least < UNKNOWN:
                move = step_px / _motion(H, e, u, v, plane[0])
                for k in range(6):
                    trial[:] = plane
                    by = move if k % 2 == 0 else -move
                    trial[k // 2] += by if k < 2 else by / reach
                    tried = _cost(others, sizes, H, e, u, v, trial, offsets, weights, values)
                    if tried < least:
                        least = tried
                        plane[:] = trial
            planes[v, u] = plane
            cost[v, u] = least


@njit(cache=True, nogil=True, error_model="numpy")
def rate_planes(
    gray: F32,
    others: F32,
    sizes: I64,
    H: F64,
    e: F64,
    offsets: I64,
    likeness: F32,
    planes: F32,
    accepted: float,
    least: F32,
    support: U8,
    slope: F32,
) -> None:
    """``least`` cost (H, W) of planes in a neighbour, in how many it is at most ``accepted`` (``support``),
    and ``slope``, the root of the sum of the squared pixels per unit of inverse depth over these."""
    height, width = gray.shape
    weights, values = np.empty(len(offsets)), np.empty(len(offsets))
    plane = np.empty(3)
    for v in range(height):
        for u in range(width):
            least[v, u], support[v, u], slope[v, u] = UNKNOWN, 0, 0.0
            if not (np.isfinite(gray[v, u]) and planes[v, u, 0] > 0.0):
                continue
            _weights(gray, u, v, offsets, likeness, weights, values)
            plane[:] = planes[v, u]
            total = 0.0
            for k in range(len(others)):
                one = _one_cost(others[k], sizes[k], H[k], e[k], u, v, plane, offsets, weights, values)
                if 0.0 <= one < least[v, u]:
                    least[v, u] = one
                if 0.0 <= one <= accepted:
                    support[v, u] += 1
                    total += _motion(H[k : k + 1], e[k : k + 1], u, v, plane[0]) ** 2
            slope[v, u] = np.sqrt(total)


@njit(cache=True, nogil=True, error_model="numpy")
def begin_planes(
    gray: F32, others: F32, sizes: I64, H: F64, e: F64, offsets: I64, likeness: F32, planes: F32, cost: F32
) -> None:
    """``cost`` (H, W) of the planes that a search begins with, ``UNKNOWN`` where there is none."""
    height, width = gray.shape
    weights, values = np.empty(len(offsets)), np.empty(len(offsets))
    plane = np.empty(3)
    for v in range(height):
        for u in range(width):
            cost[v, u] = UNKNOWN
            if np.isfinite(gray[v, u]) and planes[v, u, 0] > 0.0:
                _weights(gray, u, v, offsets, likeness, weights, values)
                plane[:] = planes[v, u]
                cost[v, u] = _cost(others, sizes, H, e, u, v, plane, offsets, weights, values)

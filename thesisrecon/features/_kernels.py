"""Kernels of the corner detector; each has a NumPy twin in the tests."""

from __future__ import annotations

import numpy as np

from thesisrecon._numba import FAST, empty, full, kernel, zeros
from thesisrecon.arrays import F32, F64, I64


@kernel(fastmath=FAST)
def corner_response(channels: F32, derivative: F32, taps: F32, trace_weight: float) -> F32:
    """Compute the corner response R (H, W) of section 4.2.1, zero where windows leave the image.

    M holds the products of the gradients of ``channels`` (C, H, W), summed over them and smoothed by
    ``taps``; the gradient at x is sum_k derivative[k] I(x + k), k from the middle. ``trace_weight`` is 0 for
    det M / trace M, else k of det M - k (trace M)^2. One sweep down the image keeps only the last 2 r + 1
    rows of products, which stay in the cache.
    """
    count, height, width = channels.shape
    reach, size = derivative.size // 2, taps.size
    out = zeros((height, width), np.float32)
    ring = zeros((size, 3, width), np.float32)
    slope = empty((2, width), np.float32)
    column = empty((3, width), np.float32)
    moment = empty((3, width), np.float32)
    border = size // 2 + reach
    for y in range(reach, height - reach):
        products = ring[y % size]
        products[:] = np.float32(0.0)
        for c in range(count):
            _slopes(channels[c], derivative, y, slope)
            _add_products(slope, reach, products)
        if y < size + reach - 1:
            continue
        column[:] = np.float32(0.0)
        for k in range(size):
            earlier = ring[(y - size + 1 + k) % size]
            weight = taps[k]
            for m in range(3):
                source, target = earlier[m], column[m]
                for x in range(width):
                    target[x] += weight * source[x]
        moment[:] = np.float32(0.0)
        for m in range(3):
            target = moment[m, border:]
            for k in range(size):
                weight = taps[k]
                # Slices that start at the first read avoid checks for negative indices in the loops.
                source = column[m, k + reach :]
                for x in range(width - 2 * border):
                    target[x] += weight * source[x]
        _measure(moment[:, border:], width - 2 * border, trace_weight, out[y - size // 2, border:])
    return out


@kernel(fastmath=FAST, forceinline=True)
def _slopes(image: F32, derivative: F32, y: int, out: F32) -> None:
    """Row y of the derivatives of ``image`` along x and y, from column ``len(derivative) // 2`` on."""
    reach, width = derivative.size // 2, image.shape[1]
    out[:] = np.float32(0.0)
    along, across = out[0, reach:], out[1, reach:]
    for k in range(derivative.size):
        weight = derivative[k]
        if weight == 0.0:
            continue
        beside, below = image[y, k:], image[y + k - reach, reach:]
        for x in range(width - 2 * reach):
            along[x] += weight * beside[x]
            across[x] += weight * below[x]


@kernel(fastmath=FAST, forceinline=True)
def _add_products(slope: F32, reach: int, out: F32) -> None:
    gx, gy = slope[0, reach:], slope[1, reach:]
    xx, xy, yy = out[0, reach:], out[1, reach:], out[2, reach:]
    for x in range(slope.shape[1] - 2 * reach):
        xx[x] += gx[x] * gx[x]
        xy[x] += gx[x] * gy[x]
        yy[x] += gy[x] * gy[x]


@kernel(fastmath=FAST, forceinline=True)
def _measure(moment: F32, count: int, trace_weight: float, out: F32) -> None:
    a, b, c = moment[0], moment[1], moment[2]
    if trace_weight == 0.0:
        for x in range(count):
            out[x] = (a[x] * c[x] - b[x] * b[x]) / (a[x] + c[x] + np.float32(1e-6))
    else:
        for x in range(count):
            trace = a[x] + c[x]
            out[x] = a[x] * c[x] - b[x] * b[x] - trace_weight * trace * trace


@kernel
def fit_maxima(response: F32, threshold: float, subpixel: bool = True) -> tuple[F64, F32]:
    """Local maxima of R: positions (N, 2) refined by least-squares quadratic surfaces, and responses (N,)."""
    height, width = response.shape
    # Maxima do not touch: at most one in four pixels.
    most = (height // 2 + 1) * (width // 2 + 1)
    xy = empty((most, 2), np.float64)
    value = empty(most, np.float32)
    limit = np.float32(threshold)
    n = 0
    for y in range(1, height - 1):
        row = response[y]
        for x in range(1, width - 1):
            v = row[x]
            if v > limit and v > row[x - 1] and v >= row[x + 1] and _is_maximum(response, x, y):
                dx, dy = _surface_maximum(response, x, y) if subpixel else (0.0, 0.0)
                xy[n, 0], xy[n, 1] = x + dx, y + dy
                value[n] = v
                n += 1
    return xy[:n].copy(), value[:n].copy()


@kernel
def _is_maximum(response: F32, x: int, y: int) -> bool:
    # > on one side and >= on the other: a plateau of two pixels gives one corner.
    v = response[y, x]
    return bool(
        v > response[y - 1, x - 1]
        and v > response[y - 1, x]
        and v > response[y - 1, x + 1]
        and v > response[y, x - 1]
        and v >= response[y, x + 1]
        and v >= response[y + 1, x - 1]
        and v >= response[y + 1, x]
        and v >= response[y + 1, x + 1]
    )


@kernel
def _surface_maximum(response: F32, x: int, y: int) -> tuple[float, float]:
    gx = gy = gxx = gyy = gxy = 0.0
    for k in range(-1, 2):
        left, centre, right = response[y + k, x - 1], response[y + k, x], response[y + k, x + 1]
        above, middle, below = response[y - 1, x + k], response[y, x + k], response[y + 1, x + k]
        gx += (right - left) / 6.0
        gy += (below - above) / 6.0
        gxx += (left - 2.0 * centre + right) / 3.0
        gyy += (above - 2.0 * middle + below) / 3.0
    gxy = (
        response[y + 1, x + 1] + response[y - 1, x - 1] - response[y - 1, x + 1] - response[y + 1, x - 1]
    ) / 4.0
    determinant = gxx * gyy - gxy * gxy
    if not (gxx < 0.0 and determinant > 1e-12 * gxx * gxx):
        return 0.0, 0.0
    dx = -(gyy * gx - gxy * gy) / determinant
    dy = -(gxx * gy - gxy * gx) / determinant
    if abs(dx) > 1.0 or abs(dy) > 1.0:
        return 0.0, 0.0
    return dx, dy


@kernel(fastmath=FAST)
def squared_suppression_radii(xy: F32, response: F32, robustness: float) -> F32:
    """Squared distances (N,) to the nearest corner whose response times robustness is larger."""
    n = len(xy)
    x, y = xy[:, 0].copy(), xy[:, 1].copy()
    out = full(n, np.inf, np.float32)
    stronger = 0
    for i in range(n):
        while stronger < i and robustness * response[stronger] > response[i]:
            stronger += 1
        best = np.float32(3.4e38)
        for j in range(stronger):
            dx, dy = x[j] - x[i], y[j] - y[i]
            best = min(best, dx * dx + dy * dy)
        if stronger > 0:
            out[i] = best
    return out


@kernel(fastmath=FAST)
def sample_patches(image: F32, xy: F64, angle: F32, side: int, spacing: float) -> F32:
    """Square patches (N, side^2) of an image, clamped, rotated by ``angle`` (N,) rad, sampled bilinearly."""
    height, width = image.shape
    out = empty((len(xy), side * side), np.float32)
    centre = 0.5 * (side - 1)
    for n in range(len(xy)):
        c, s = np.cos(angle[n]) * spacing, np.sin(angle[n]) * spacing
        for row in range(side):
            for column in range(side):
                a, b = column - centre, row - centre
                u = min(max(xy[n, 0] + c * a - s * b, 0.0), width - 1.001)
                v = min(max(xy[n, 1] + s * a + c * b, 0.0), height - 1.001)
                x0, y0 = int(u), int(v)
                p, q = np.float32(u - x0), np.float32(v - y0)
                top = image[y0, x0] + p * (image[y0, x0 + 1] - image[y0, x0])
                low = image[y0 + 1, x0] + p * (image[y0 + 1, x0 + 1] - image[y0 + 1, x0])
                out[n, row * side + column] = top + q * (low - top)
    return out


@kernel
def enforce_spacing(xy: F64, order: I64, distance: float) -> I64:
    """Select indices in the sequence of ``order``, each at least ``distance`` from all selected before."""
    kept = empty(len(order), np.int64)
    n = 0
    for i in order:
        free = True
        for k in range(n):
            dx, dy = xy[i, 0] - xy[kept[k], 0], xy[i, 1] - xy[kept[k], 1]
            if dx * dx + dy * dy < distance * distance:
                free = False
                break
        if free:
            kept[n] = i
            n += 1
    return kept[:n]


@kernel(fastmath=FAST)
def sample_affinely(image: F32, to_image: F64, offset: F64, shape: tuple[int, int]) -> F32:
    """Image (h, w) whose pixel x shows ``image`` at ``to_image`` x + ``offset``, clamped, bilinearly."""
    height, width = image.shape
    out = empty(shape, np.float32)
    for row in range(shape[0]):
        for column in range(shape[1]):
            u = to_image[0, 0] * column + to_image[0, 1] * row + offset[0]
            v = to_image[1, 0] * column + to_image[1, 1] * row + offset[1]
            u, v = min(max(u, 0.0), width - 1.001), min(max(v, 0.0), height - 1.001)
            x0, y0 = int(u), int(v)
            p, q = np.float32(u - x0), np.float32(v - y0)
            top = image[y0, x0] + p * (image[y0, x0 + 1] - image[y0, x0])
            low = image[y0 + 1, x0] + p * (image[y0 + 1, x0 + 1] - image[y0 + 1, x0])
            out[row, column] = top + q * (low - top)
    return out

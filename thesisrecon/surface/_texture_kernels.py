"""Compiled loops of texturing; the tests contain NumPy versions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thesisrecon._numba import empty, kernel, zeros
from thesisrecon.arrays import B8, F32, F64, I64, U8
from thesisrecon.imaging.filters import weighted_median


class ViewSurface(NamedTuple):
    """A surface seen by one view.

    With (u, v, 1) z = M X + p, the pixels per area are ``scale`` = det M times the distance of ``centre`` to
    the tangent plane over z^3.
    ``depth`` (H, W): nearest depth, inf without a surface; ``trust`` (H, W): weight of each pixel in 0 .. 1;
    ``tolerance``: relative depth by which visible points may lie behind ``depth``; ``gain`` (3,): of the
    brightness.
    """

    P: F64
    centre: F64
    scale: float
    depth: F32
    trust: F32
    tolerance: float
    rgb: U8
    gain: F32


@kernel
def diffuse(share: F32, neighbours: I64, keep: float, spread: F32, out: F32) -> None:
    """Diffuse ``spread`` (M, V) over neighbouring faces by one step, among the views with a ``share``.

    ``keep``: weight of the initial share against the mean of the neighbours.
    """
    for m in range(share.shape[0]):
        count = 0
        for k in range(3):
            count += neighbours[m, k] >= 0
        part = np.float32((1.0 - keep) / max(count, 1))
        for v in range(share.shape[1]):
            out[m, v] = 0.0
            if share[m, v] > 0.0:
                total = np.float32(0.0)
                for k in range(3):
                    if neighbours[m, k] >= 0:
                        total += spread[neighbours[m, k], v]
                out[m, v] = np.float32(keep) * share[m, v] + part * total


@kernel
def observe_points(points: F64, normals: F64, view: ViewSurface, weight: F32, color: F32) -> None:
    """Observe points in one view: weights (pixels per area times trust) and colours times the gain.

    A point is visible if it is at most ``view.tolerance`` of its depth behind the farthest of the four pixels
    around.
    """
    P, centre, scale, depth, trust, tolerance, rgb, gain = view
    height, width = depth.shape
    for n in range(points.shape[0]):
        weight[n] = 0.0
        X, Y, Z = points[n]
        towards = (
            normals[n, 0] * (centre[0] - X)
            + normals[n, 1] * (centre[1] - Y)
            + normals[n, 2] * (centre[2] - Z)
        )
        z = P[2, 0] * X + P[2, 1] * Y + P[2, 2] * Z + P[2, 3]
        if not (z > 0.0 and towards > 0.0):
            continue
        u = (P[0, 0] * X + P[0, 1] * Y + P[0, 2] * Z + P[0, 3]) / z
        v = (P[1, 0] * X + P[1, 1] * Y + P[1, 2] * Z + P[1, 3]) / z
        if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
            continue
        x, y = int(u), int(v)
        right, below = min(x + 1, width - 1), min(y + 1, height - 1)
        farthest = max(max(depth[y, x], depth[y, right]), max(depth[below, x], depth[below, right]))
        if z * (1.0 - tolerance) > farthest:
            continue
        s, t = u - x, v - y
        upper = trust[y, x] + s * (trust[y, right] - trust[y, x])
        lower = trust[below, x] + s * (trust[below, right] - trust[below, x])
        weight[n] = np.float32((upper + t * (lower - upper)) * scale * towards / (z * z * z))
        for k in range(3):
            a, b = np.float32(rgb[y, x, k]), np.float32(rgb[y, right, k])
            c, d = np.float32(rgb[below, x, k]), np.float32(rgb[below, right, k])
            top, bottom = a + s * (b - a), c + s * (d - c)
            color[n, k] = np.float32((top + t * (bottom - top)) * gain[k])


@kernel
def _sort_weighted(values: F32, weights: F64, order: I64) -> tuple[int, float]:
    """Sort the values (V,) of positive weight by index into ``order``; return their number and weight."""
    count, total = 0, 0.0
    for v in range(len(values)):
        if weights[v] > 0.0:
            k = count
            while k > 0 and values[order[k - 1]] > values[v]:
                order[k] = order[k - 1]
                k -= 1
            order[k] = v
            count += 1
            total += weights[v]
    return count, total


MAX_BLENDED = 32
"""Views that are blended at a point, those of the largest weights."""


@kernel
def keep_largest(one: F32, its_color: F32, weight: F32, color: F32) -> None:
    """Let the observations (N,) of one more view replace the smallest kept ones (V, N) that are smaller.

    Those of larger ``weight`` stay, of equal ones the first, in the order of the views.
    """
    views = weight.shape[0]
    for n in range(len(one)):
        if one[n] <= 0.0:
            continue
        least = 0
        for v in range(1, views):
            if weight[v, n] <= weight[least, n]:
                least = v
        if one[n] <= weight[least, n]:
            continue
        for v in range(least, views - 1):
            weight[v, n] = weight[v + 1, n]
            for k in range(3):
                color[v, n, k] = color[v + 1, n, k]
        weight[views - 1, n] = one[n]
        for k in range(3):
            color[views - 1, n, k] = its_color[n, k]


@kernel
def combine_colors(weight: F32, color: F32, power: float, scatter: float, out: F32) -> None:
    """Blend the colours (V, N, 3) of points; those without positive ``weight`` (V, N) stay in ``out``.

    Relative weights are raised to ``power`` and multiplied by 1 / (1 + (d / scatter)^2)^2 with the RMS
    distance d from the weighted median colour.
    """
    views = weight.shape[0]
    relative = empty(views)
    order = empty(views, np.int64)
    middle = empty(3)
    for n in range(weight.shape[1]):
        best = np.float32(0.0)
        for v in range(views):
            best = max(best, weight[v, n])
        if best <= 0.0:
            continue
        for v in range(views):
            relative[v] = weight[v, n] / best
        for k in range(3):
            count, sum_of_weights = _sort_weighted(color[:, n, k], relative, order)
            middle[k] = weighted_median(color[:, n, k], relative, order[:count], 0.5 * sum_of_weights)
        total = 0.0
        mean = zeros(3)
        for v in range(views):
            if relative[v] <= 0.0:
                continue
            apart = 0.0
            for k in range(3):
                apart += (color[v, n, k] - middle[k]) ** 2
            trust = 1.0 / (1.0 + apart / (3.0 * scatter * scatter))
            w = relative[v] ** power * trust * trust
            total += w
            for k in range(3):
                mean[k] += w * color[v, n, k]
        for k in range(3):
            out[n, k] = np.float32(mean[k] / total)


@kernel
def grow_colors(texture: U8, drawn: B8) -> None:
    """Extend the drawn texels by the mean of their neighbours."""
    height, width = drawn.shape
    before = drawn.copy()
    total = zeros(3)
    for y in range(height):
        for x in range(width):
            if before[y, x]:
                continue
            total[:] = 0.0
            count = 0
            for j in range(max(y - 1, 0), min(y + 2, height)):
                for i in range(max(x - 1, 0), min(x + 2, width)):
                    if before[j, i]:
                        count += 1
                        for k in range(3):
                            total[k] += texture[j, i, k]
            if count:
                drawn[y, x] = True
                for k in range(3):
                    texture[y, x, k] = int(total[k] / count + 0.5)


@kernel
def continue_faces(corners: F64, farthest: float, face: I64, weights: F32) -> None:
    """Extrapolate faces to adjacent empty texels, up to barycentric coordinates of ``farthest``.

    ``corners`` (M, 3, 3): in homogeneous texels; ``face`` (H, W), -1 for none, and ``weights`` (H, W, 2) of
    corners 1 and 2 are updated from the left, right, upper or lower neighbour.
    """
    height, width = face.shape
    before = face.copy()
    for y in range(height):
        for x in range(width):
            if before[y, x] >= 0:
                continue
            for side in range(4):
                j = y + (side == 3) - (side == 2)
                i = x + (side == 1) - (side == 0)
                if not (0 <= j < height and 0 <= i < width) or before[j, i] < 0:
                    continue
                c = corners[before[j, i]]
                ax, ay = c[1, 0] - c[0, 0], c[1, 1] - c[0, 1]
                bx, by = c[2, 0] - c[0, 0], c[2, 1] - c[0, 1]
                area = ax * by - ay * bx
                dx, dy = x - c[0, 0], y - c[0, 1]
                p, q = dx * by - dy * bx, ax * dy - ay * dx
                if max(abs(p), abs(q)) <= farthest * abs(area) and area != 0.0:
                    face[y, x] = before[j, i]
                    weights[y, x, 0] = np.float32(p / area)
                    weights[y, x, 1] = np.float32(q / area)
                    break

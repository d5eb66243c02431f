"""Triangulation from any number of views, compiled: linear, iterated linear, mid-point, least reprojection.

Observations are sorted by point; ``start`` (N + 1,) says where each point's begin. Points with fewer than two
observations come out as zeros, all others with unit norm (mid-points with X4 = 1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

PASSES = 10
"""Of the iterated linear method; Hartley and Sturm found that those that converge have done so by then."""


class Sightings(NamedTuple):
    """Observations sorted by point: the number of the ``view`` (K,), the pixels ``xy`` (K, 2), and the
    ``weight`` (K,) of the two equations of each."""

    view: I64
    xy: F64
    weight: F64


@njit(cache=True, nogil=True)
def list_seen(xy: F64, start: I64, view: I64, seen: F64) -> int:
    """The observations of xy (V, N, 2) that are not NaN, point by point; -> how many."""
    count = 0
    for j in range(xy.shape[1]):
        start[j] = count
        for v in range(xy.shape[0]):
            x, y = xy[v, j, 0], xy[v, j, 1]
            if math.isnan(x) or math.isnan(y):
                continue
            view[count], seen[count, 0], seen[count, 1] = v, x, y
            count += 1
    start[xy.shape[1]] = count
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def insert_row(R: F64, row: F64) -> None:
    """Givens rotations that take one more row (4,) into the triangle R (4, 4); R'R grows by row row'."""
    for c in range(4):
        if row[c] == 0.0:
            continue
        length = math.sqrt(R[c, c] * R[c, c] + row[c] * row[c])
        cosine, sine = R[c, c] / length, row[c] / length
        R[c, c] = length
        for k in range(c + 1, 4):
            above = R[c, k]
            R[c, k] = cosine * above + sine * row[k]
            row[k] = cosine * row[k] - sine * above


@njit(cache=True, nogil=True, error_model="numpy")
def least_singular_vector(R: F64, x: F64) -> None:
    """Fill x (4,) with the unit vector that makes |R x| least, R (4, 4) upper triangular.

    Inverse iteration; where the two least singular values are near each other, Jacobi's rotations.
    """
    largest = max(abs(R[0, 0]), abs(R[1, 1]), abs(R[2, 2]), abs(R[3, 3]))
    floor = max(1e-16 * largest, 1e-300)
    d0, d1 = 1.0 / max(R[0, 0], floor), 1.0 / max(R[1, 1], floor)
    d2, d3 = 1.0 / max(R[2, 2], floor), 1.0 / max(R[3, 3], floor)
    y0, y1, y2, y3 = 0.0, 0.0, 0.0, 1.0
    x0 = x1 = x2 = x3 = 0.0
    for k in range(9):
        if k > 0:
            y0 = x0 * d0
            y1 = (x1 - R[0, 1] * y0) * d1
            y2 = (x2 - R[0, 2] * y0 - R[1, 2] * y1) * d2
            y3 = (x3 - R[0, 3] * y0 - R[1, 3] * y1 - R[2, 3] * y2) * d3
        z3 = y3 * d3
        z2 = (y2 - R[2, 3] * z3) * d2
        z1 = (y1 - R[1, 2] * z2 - R[1, 3] * z3) * d1
        z0 = (y0 - R[0, 1] * z1 - R[0, 2] * z2 - R[0, 3] * z3) * d0
        size = 1.0 / math.sqrt(z0 * z0 + z1 * z1 + z2 * z2 + z3 * z3)
        z0, z1, z2, z3 = z0 * size, z1 * size, z2 * size, z3 * size
        change = abs(z0 - x0) + abs(z1 - x1) + abs(z2 - x2) + abs(z3 - x3)
        x0, x1, x2, x3 = z0, z1, z2, z3
        if change < 1e-13:
            x[0], x[1], x[2], x[3] = x0, x1, x2, x3
            return
    jacobi_least(R, x)


@njit(cache=True, nogil=True, error_model="numpy")
def jacobi_least(R: F64, x: F64) -> None:
    """As :func:`least_singular_vector` by one-sided Jacobi rotations (Hestenes): slow and sure."""
    A, V = R.copy(), np.eye(4)
    for i in range(1, 4):
        A[i, :i] = 0.0
    for _ in range(30):
        turned = False
        for p in range(3):
            for q in range(p + 1, 4):
                a = b = c = 0.0
                for i in range(4):
                    a, b, c = a + A[i, p] * A[i, p], b + A[i, q] * A[i, q], c + A[i, p] * A[i, q]
                if abs(c) <= 1e-15 * math.sqrt(a * b):
                    continue
                turned = True
                zeta = (b - a) / (2.0 * c)
                t = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                cosine = 1.0 / math.sqrt(1.0 + t * t)
                sine = cosine * t
                for i in range(4):
                    A[i, p], A[i, q] = cosine * A[i, p] - sine * A[i, q], sine * A[i, p] + cosine * A[i, q]
                    V[i, p], V[i, q] = cosine * V[i, p] - sine * V[i, q], sine * V[i, p] + cosine * V[i, q]
        if not turned:
            break
    best, least = 0, math.inf
    for p in range(4):
        length = A[0, p] ** 2 + A[1, p] ** 2 + A[2, p] ** 2 + A[3, p] ** 2
        if length < least:
            best, least = p, length
    x[:] = V[:, best]


@njit(cache=True, nogil=True, error_model="numpy")
def least_algebraic(P: F64, sightings: Sightings, first: int, last: int, R: F64, row: F64, x: F64) -> None:
    """x (4,) of least sum of (weight (u p3'x - p1'x))^2 + (weight (v p3'x - p2'x))^2 over k = first..last; R
    (4, 4) and row (4,) are scratch."""
    view, xy, weight = sightings
    R[:] = 0.0
    for k in range(first, last):
        p, w = P[view[k]], weight[k]
        for i in range(2):
            for c in range(4):
                row[c] = w * (xy[k, i] * p[2, c] - p[i, c])
            insert_row(R, row)
    least_singular_vector(R, x)


@njit(cache=True, nogil=True, error_model="numpy")
def reprojection_cost(P: F64, x: F64, first: int, last: int, view: I64, xy: F64) -> float:
    """Sum of squared distances of one point's images, infinite or NaN in a focal plane."""
    cost = 0.0
    for k in range(first, last):
        p = P[view[k]]
        w = 1.0 / (p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3])
        du = w * (p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]) - xy[k, 0]
        dv = w * (p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]) - xy[k, 1]
        cost += du * du + dv * dv
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_linearly(
    P: F64, scale: F64, start: I64, view: I64, xy: F64, passes: int, tolerance: float, X: F64
) -> None:
    """Fill X (N, 4) by the linear method, a view's rows times its ``scale`` (V,).

    ``passes`` > 0: then anew with each row over the depth p3'X of the pass before, until no depth changes by
    more than ``tolerance`` of itself. Where they do not come to rest, the last and the linear answer are
    compared by reprojection.
    """
    R, row, x, y = np.zeros((4, 4)), np.empty(4), np.empty(4), np.empty(4)
    weight = np.empty(len(xy))
    sightings = Sightings(view, xy, weight)
    for j in range(len(start) - 1):
        first, last = start[j], start[j + 1]
        X[j] = 0.0
        if last - first < 2:
            continue
        for k in range(first, last):
            weight[k] = scale[view[k]]
        least_algebraic(P, sightings, first, last, R, row, x)
        X[j] = x
        y[:] = x
        rest = False
        for n in range(passes):
            change = 0.0
            for k in range(first, last):
                p = P[view[k], 2]
                depth = abs(p[0] * y[0] + p[1] * y[1] + p[2] * y[2] + p[3] * y[3])
                change = max(change, abs(depth * weight[k] - 1.0))
                weight[k] = 1.0 / depth if depth > 0.0 else math.inf
            rest = n > 0 and change < tolerance
            if rest or not math.isfinite(weight[first:last].sum()):
                break
            least_algebraic(P, sightings, first, last, R, row, y)
        if passes > 0 and (
            rest
            or reprojection_cost(P, y, first, last, view, xy) < reprojection_cost(P, x, first, last, view, xy)
        ):
            X[j] = y


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_midpoints(
    inverses: F64, centres: F64, start: I64, view: I64, xy: F64, least_det: float, X: F64
) -> None:
    """Fill X (N, 4) with the points nearest to all rays; ``inverses`` (V, 3, 3) of M, ``centres`` (V, 3).

    Zeros where the determinant of the sum of I - d d' is not above ``least_det``: parallel rays.
    """
    A, b, d, r = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for j in range(len(start) - 1):
        first, last = start[j], start[j + 1]
        X[j] = 0.0
        if last - first < 2:
            continue
        A[:] = 0.0
        b[:] = 0.0
        origin = centres[view[first]]
        for k in range(first, last):
            M = inverses[view[k]]
            for i in range(3):
                d[i] = M[i, 0] * xy[k, 0] + M[i, 1] * xy[k, 1] + M[i, 2]
                r[i] = centres[view[k], i] - origin[i]
            size = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
            along = (d[0] * r[0] + d[1] * r[1] + d[2] * r[2]) * size
            for i in range(3):
                b[i] += r[i] - along * d[i]
                A[i, i] += 1.0
                for m in range(3):
                    A[i, m] -= d[i] * d[m] * size
        c0 = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
        c1 = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
        c2 = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
        det = A[0, 0] * c0 + A[0, 1] * c1 + A[0, 2] * c2
        if not det > least_det:
            continue
        X[j, 0] = c0 * b[0] + c1 * b[1] + c2 * b[2]
        X[j, 1] = c1 * b[0] + (A[0, 0] * A[2, 2] - A[0, 2] ** 2) * b[1]
        X[j, 1] += (A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]) * b[2]
        X[j, 2] = c2 * b[0] + (A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]) * b[1]
        X[j, 2] += (A[0, 0] * A[1, 1] - A[0, 1] ** 2) * b[2]
        for i in range(3):
            X[j, i] = X[j, i] / det + origin[i]
        X[j, 3] = 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def reprojection_normal(P: F64, x: F64, first: int, last: int, view: I64, xy: F64, H: F64, g: F64) -> None:
    """Fill H (4, 4) = J'J, lower part, and g (4,) = J'r of one point; both have no part along x."""
    H[:] = 0.0
    g[:] = 0.0
    J = np.empty((2, 4))
    for k in range(first, last):
        p = P[view[k]]
        w = 1.0 / (p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3])
        u = w * (p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3])
        v = w * (p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3])
        du, dv = u - xy[k, 0], v - xy[k, 1]
        for c in range(4):
            J[0, c], J[1, c] = w * (p[0, c] - u * p[2, c]), w * (p[1, c] - v * p[2, c])
            g[c] += J[0, c] * du + J[1, c] * dv
        for c in range(4):
            for m in range(c + 1):
                H[c, m] += J[0, c] * J[0, m] + J[1, c] * J[1, m]


@njit(cache=True, nogil=True, error_model="numpy")
def solve_damped(H: F64, x: F64, damping: float, g: F64, L: F64, step: F64) -> bool:
    """Fill step (4,) = -(H + damping diag(H) + t x x')^-1 g by Cholesky; False where it is not positive.

    x, a unit vector, spans the kernel of H; t, the trace of H, gives it the size of the rest.
    """
    trace = H[0, 0] + H[1, 1] + H[2, 2] + H[3, 3]
    for c in range(4):
        for m in range(c + 1):
            value = H[c, m] + trace * x[c] * x[m]
            if m == c:
                value += damping * H[c, c]
            for n in range(m):
                value -= L[c, n] * L[m, n]
            if m < c:
                L[c, m] = value / L[m, m]
            elif value > 0.0:
                L[c, c] = math.sqrt(value)
            else:
                return False
    for c in range(4):
        value = -g[c]
        for n in range(c):
            value -= L[c, n] * step[n]
        step[c] = value / L[c, c]
    for c in range(3, -1, -1):
        value = step[c]
        for n in range(c + 1, 4):
            value -= L[n, c] * step[n]
        step[c] = value / L[c, c]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def reduce_reprojection(P: F64, start: I64, view: I64, xy: F64, iterations: int, X: F64) -> None:
    """Levenberg-Marquardt on every unit point of X (N, 4), in place, until no step lowers its cost."""
    H, L, g = np.empty((4, 4)), np.zeros((4, 4)), np.empty(4)
    step, moved = np.empty(4), np.empty(4)
    for j in range(len(start) - 1):
        first, last = start[j], start[j + 1]
        x = X[j]
        if last - first < 2 or (x[0] == 0.0 and x[1] == 0.0 and x[2] == 0.0 and x[3] == 0.0):
            continue
        cost = reprojection_cost(P, x, first, last, view, xy)
        damping, still, fresh = 1e-4, 0, True
        for _ in range(iterations):
            if fresh:
                reprojection_normal(P, x, first, last, view, xy, H, g)
            if solve_damped(H, x, damping, g, L, step):
                for c in range(4):
                    moved[c] = x[c] + step[c]
                size = 1.0 / math.sqrt(moved @ moved)
                for c in range(4):
                    moved[c] *= size
                candidate = reprojection_cost(P, moved, first, last, view, xy)
            else:
                candidate = math.inf
            fresh = candidate < cost
            if fresh:
                # Twice without a gain above rounding: the first may have been a lucky step.
                still = still + 1 if cost - candidate <= 1e-14 * cost else 0
                cost = candidate
                x[:] = moved
                damping = max(0.1 * damping, 1e-12)
            else:
                damping *= 10.0
            if still == 2 or damping > 1e12 or cost == 0.0:
                break

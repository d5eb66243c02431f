"""Triangulation from any number of views, compiled: linear, iterated linear, mid-point, least reprojection.

Observations are sorted by point; ``start`` (N + 1,) says where each point's begin. Points with fewer than two
observations come out as zeros, all others with unit norm (mid-points with X4 = 1).

Section 6.3: space points from their images, by five methods behind one door.

============== ===== ================================== ==================================================
method         views what it makes least                use
============== ===== ================================== ==================================================
``linear``     any   an algebraic residual              starts; fast, good enough where noise is small
``iterated``   any   nearly the reprojection error      as linear, no longer depending on cameras' scales
``midpoint``   any   distances of rays in space         metric frames only
``polynomial`` two   the reprojection error, globally   the best for two views, in any frame
``optimal``    any   the reprojection error, locally    the best for more views, in any frame
============== ===== ================================== ==================================================

Hartley and Sturm, "Triangulation", CVIU 68(2), 1997. docs/triangulation.md compares them.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numba import njit

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.homogeneous import require_finite
from thesisrecon.geometry.optimal_triangulation import triangulate_polynomial

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


Method = Literal["polynomial", "linear", "midpoint", "iterated", "optimal"]
Listed = tuple[I64, I64, F64]
"""Observations sorted by point: where each point's begin (N + 1,), their views (K,) and pixels (K, 2)."""

_AT_REST = 1e-6
"""Relative change of all depths at which the iterated linear method has come to rest."""
_PARALLEL = 1e-14
"""Determinant of the mid-point system below which rays are parallel: about 2 sin^2 of the angle of two."""
_ITERATIONS = 200
"""Most steps of the n-view method; the median point takes three or four."""


def triangulate_observations(P: F64, view: I64, point: I64, xy: F64, n_points: int) -> F64:
    """Linear triangulation of all points of an observation list; -> (n_points, 4) with unit norm.

    P (V, 3, 4); view, point (K,), xy (K, 2) px, in any order, fastest where sorted by point. The criterion is
    that of :func:`triangulate_linear`. Points with fewer than two observations come out as zeros.
    """
    if not (point[1:] >= point[:-1]).all():
        order = np.argsort(point, kind="stable")
        view, point, xy = view[order], point[order], xy[order]
    start = np.searchsorted(point, np.arange(n_points + 1)).astype(np.int64)
    listed = (start, np.ascontiguousarray(view, dtype=np.int64), np.ascontiguousarray(xy, dtype=np.float64))
    return _linear(P, listed, 0)


def triangulate_linear(P: F64, xy: F64) -> F64:
    """Linear triangulation (6.3.1), P (V, 3, 4), xy (V, N, 2) px, NaN = not seen; -> X (N, 4) unit norm.

    Least sum of squares of u p3'X - p1'X and v p3'X - p2'X over unit X. Of Hartley's normalisation the shift
    changes nothing here, for these rows do not see it, and the scale is the weight of a view: each view's
    rows are divided by the norm of M's first two, the pixels' origin in the middle of its points. In a metric
    frame that is the focal length, so that rows are depths times angles. The answer changes with the
    projective frame. Points seen in fewer than two views come out as zeros. Raises ``ValueError`` as
    :func:`triangulate` does.
    """
    P, xy = _checked(P, xy)
    return _linear(P, _listed(xy), 0)


def triangulate_iterated(P: F64, xy: F64) -> F64:
    """Iterated linear triangulation (Hartley and Sturm's Iterative-LS); arguments as in
    :func:`triangulate_linear`.

    The rows are divided by the depth p3'X of the pass before, which makes them the reprojection residuals at
    rest, and solved again, ten times at most; where the depths do not come to rest, the last or the linear
    answer stands, whichever reprojects better. The limit is near the least reprojection error, not at it: the
    depths count as constants.
    """
    P, xy = _checked(P, xy)
    return _linear(P, _listed(xy), PASSES)


def triangulate_midpoint(P: F64, xy: F64) -> F64:
    """Point nearest to all rays (6.3.2); P (V, 3, 4), xy (V, N, 2) px, NaN = not seen; -> X (N, 4), X4 = 1.

    Sum of squared distances in space. Meaningful in a metric frame only: distances do not exist in a
    projective one, and the answer changes with it, for the worse. Parallel rays and points seen once come out
    as zeros. Raises ``ValueError`` for a camera whose centre is at infinity, which has no rays in this sense.
    """
    P, xy = _checked(P, xy)
    M = P[:, :, :3]
    if not (np.abs(np.linalg.det(M)) > 1e-14 * np.linalg.norm(M, axis=(1, 2)) ** 3).all():
        raise ValueError("the mid-point method needs finite cameras; the left 3x3 part of one is singular")
    inverses = np.linalg.inv(M)
    centres = np.ascontiguousarray(-np.einsum("vab,vb->va", inverses, P[:, :, 3]))
    X = np.empty((xy.shape[1], 4))
    triangulate_midpoints(np.ascontiguousarray(inverses), centres, *_listed(xy), _PARALLEL, X)
    return X


def triangulate_optimal(P: F64, xy: F64) -> F64:
    """Least reprojection error from any number of views; P (V, 3, 4), xy (V, N, 2) px, NaN = not seen; -> X
    (N, 4) unit norm.

    Levenberg-Marquardt from the linear answer until no step lowers the sum of squared distances any more, in
    a frame in which the cameras' rows are orthonormal; the same point in every projective frame. The minimum
    is a local one: with two views beside an epipole :func:`triangulate_polynomial` may know a lower. No
    robust loss: wrong observations count in full. Points seen in fewer than two views come out as zeros.
    """
    P, xy = _checked(P, xy)
    listed = start, view, seen = _listed(xy)
    X = _linear(P, listed, 0)
    if len(view) == 0:
        return X
    low, high = seen.min(axis=0), seen.max(axis=0)
    centre, scale = 0.5 * (low + high), 2.0 / max(float((high - low).max()), 1e-12)
    moved = np.concatenate([scale * (P[:, :2] - centre[:, None] * P[:, 2:]), P[:, 2:]], axis=1)
    moved /= np.linalg.norm(moved, axis=(1, 2), keepdims=True)
    Q, R = np.linalg.qr(moved.reshape(-1, 4))
    if not np.abs(np.diag(R)).min() > 1e-13 * np.abs(R).max():
        Q, R = moved.reshape(-1, 4), np.eye(4)
    Y = np.ascontiguousarray(X @ R.T)
    sizes = np.linalg.norm(Y, axis=1, keepdims=True)
    Y /= np.where(sizes > 0.0, sizes, 1.0)
    cameras = np.ascontiguousarray(Q).reshape(-1, 3, 4)
    reduce_reprojection(cameras, start, view, scale * (seen - centre), _ITERATIONS, Y)
    X = np.linalg.solve(R, Y.T).T
    sizes = np.linalg.norm(X, axis=1, keepdims=True)
    return np.asarray(X / np.where(sizes > 0.0, sizes, 1.0))


def triangulate(P: F64, xy: F64, *, method: Method = "polynomial") -> F64:
    """Space points from their images by one of the methods of section 6.3.

    Parameters
    ----------
    P : (V, 3, 4) cameras of any scale, V >= 2.
    xy : (V, N, 2) px, NaN = not seen.
    method : "polynomial" (optimal, exactly two views), "linear", "midpoint" (metric frames only), "iterated"
        (linear) or "optimal" (least reprojection error from any number of views).

    Returns
    -------
    X (N, 4) homogeneous, in the frame of the cameras; zeros where a point is seen in fewer than two views or
    its rays do not fix it.

    Raises ``ValueError`` for an unknown method, wrong shapes, infinite pixels, and cameras that are zero, not
    finite, fewer than two or not for the method.
    """
    methods = {
        "polynomial": triangulate_polynomial,
        "linear": triangulate_linear,
        "midpoint": triangulate_midpoint,
        "iterated": triangulate_iterated,
        "optimal": triangulate_optimal,
    }
    if method not in methods:
        raise ValueError(f"triangulate knows {', '.join(methods)}; got method={method!r}")
    return methods[method](*_checked(P, xy))


def triangulation_angles(centres: F64, view: I64, point: I64, X: F64, n_points: int) -> F64:
    """Largest angle (rad) between a point's rays, against the ray of its first observation; -> (n_points,).

    centres (V, 3), X (n_points, 3); a point without observations gets 0.
    """
    rays = X[point] - centres[view]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    first = np.zeros((n_points, 3))
    first[point[::-1]] = rays[::-1]
    cosine = np.clip(np.einsum("ka,ka->k", rays, first[point]), -1.0, 1.0)
    angles = np.zeros(n_points)
    np.maximum.at(angles, point, np.arccos(cosine))
    return angles


def _checked(P: F64, xy: F64) -> tuple[F64, F64]:
    """Cameras and pixels as contiguous float64 arrays, or ``ValueError``."""
    if np.iscomplexobj(P) or np.iscomplexobj(xy):
        raise ValueError("triangulate needs real numbers; got complex ones")
    P, xy = np.ascontiguousarray(P, dtype=np.float64), np.ascontiguousarray(xy, dtype=np.float64)
    if P.ndim != 3 or P.shape[1:] != (3, 4) or xy.ndim != 3 or xy.shape[0] != len(P) or xy.shape[2] != 2:
        raise ValueError(f"triangulate needs P (V, 3, 4) and xy (V, N, 2); got {P.shape} and {xy.shape}")
    if len(P) < 2:
        raise ValueError(f"triangulate needs at least two cameras; got {len(P)}")
    require_finite("triangulate, for its cameras,", P)
    if not np.abs(P).max(axis=(1, 2)).all():
        raise ValueError("triangulate needs cameras that are not all zero")
    if np.isinf(xy).any():
        raise ValueError("triangulate needs finite pixels, or NaN for not seen; some are infinite")
    return P, xy


def _listed(xy: F64) -> Listed:
    views, points = xy.shape[:2]
    start, view = np.empty(points + 1, dtype=np.int64), np.empty(views * points, dtype=np.int64)
    seen = np.empty((views * points, 2))
    count = list_seen(xy, start, view, seen)
    return start, view[:count], seen[:count]


def _linear(P: F64, listed: Listed, passes: int) -> F64:
    """The linear answer, and with ``passes`` the iterated one."""
    start, view, xy = listed
    P = np.ascontiguousarray(P, dtype=np.float64)
    counts = np.maximum(np.bincount(view, minlength=len(P)), 1)
    middle = np.stack([np.bincount(view, xy[:, i], minlength=len(P)) / counts for i in range(2)], axis=1)
    # The fourth column would bring in where the origin of space lies.
    size = np.linalg.norm(P[:, :2, :3] - middle[:, :, None] * P[:, 2:, :3], axis=(1, 2))
    X = np.empty((len(start) - 1, 4))
    triangulate_linearly(P, 1.0 / np.where(size > 0.0, size, 1.0), start, view, xy, passes, _AT_REST, X)
    return X

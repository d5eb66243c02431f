"""Section 6.3.3: the polynomial method, optimal triangulation from two views (Hartley and Sturm 1997).

The pair of points nearest to the measured one that satisfies the epipolar constraint is the best of at most
six stationary points of a one-parameter cost over the epipolar planes, the roots of a polynomial of degree 6.

All epipolar planes are q0 A + q1 B; their lines in the two images are L1 q and L2 q, L (3, 2). The distance
of x = (x, y, 1) from a line is the root of n^2 / (q'Bq) with n = (x'L) q linear in q and B = L[:2]'L[:2] of
the pair alone, so that a point enters by four numbers. The line through the point and its B-orthogonal
companion replace the rotated images of the paper, so that epipoles may be at infinity. Forms B are stored as
(B00, B01, B11).
"""

import math

import numpy as np

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import F64, checked, require_finite, require_shapes
from thesisrecon.geometry.homogeneous import checked_unit, cross_matrix
from thesisrecon.geometry.triangulation import sort_by_point, triangulate_linear
from thesisrecon.geometry.two_view import fundamental_from_cameras

_Two = tuple[float, float]
_Four = tuple[float, float, float, float]
_PencilCost = tuple[float, float, float, float, float, float, float]
"""Cost G x^2 / (1 + kappa x^2) + (n0 + n1 x)^2 / (E0 + 2 E1 x + E2 x^2) of a member x of a pencil, in n0, n1,
E0, E1, E2, G, kappa."""

_DEGREE = 6
_RANK = 1e-13  # singular values below this fraction of the largest are zero


@kernel(inline="always")
def _form(B: F64, p0: float, p1: float, q0: float, q1: float) -> float:
    """Return p'Bq."""
    value: float = p0 * (B[0] * q0 + B[1] * q1) + p1 * (B[1] * q0 + B[2] * q1)
    return value


@kernel
def _stationary_polynomial(cost: _PencilCost, c: F64) -> None:
    """Fill c (7,) with half the numerator of the derivative of the cost."""
    n0, n1, E0, E1, E2, G, kappa = cost
    m0, m1 = n1 * E0 - n0 * E1, n1 * E1 - n0 * E2
    s0, s1, s2 = n0 * m0, n0 * m1 + n1 * m0, n1 * m1
    c[0] = s0
    c[1] = s1 + G * E0 * E0
    c[2] = s2 + 2.0 * kappa * s0 + 4.0 * G * E0 * E1
    c[3] = 2.0 * kappa * s1 + G * (4.0 * E1 * E1 + 2.0 * E0 * E2)
    c[4] = 2.0 * kappa * s2 + kappa * kappa * s0 + 4.0 * G * E1 * E2
    c[5] = kappa * kappa * s1 + G * E2 * E2
    c[6] = kappa * kappa * s2


@kernel
def _least_stationary(pencil: _PencilCost, c: F64, whole: bool) -> float:
    """Return the root of c of least cost in [-1, 1], or on the ``whole`` line with infinity; or NaN."""
    n0, n1, E0, E1, E2, G, kappa = pencil
    roots, backward = empty(_DEGREE + 2), empty(_DEGREE + 1)
    best, least = math.nan, math.inf
    for k in range(roots_in_unit_interval(c, roots)):
        x = roots[k]
        cost = G * x * x / (1.0 + kappa * x * x) + (n0 + n1 * x) ** 2 / (E0 + 2.0 * E1 * x + E2 * x * x)
        if cost < least:
            best, least = x, cost
    if whole:
        for k in range(_DEGREE + 1):
            backward[k] = c[_DEGREE - k]
        # The reversed polynomial may vanish at 0 without a sign change: infinity is always tried.
        count = roots_in_unit_interval(backward, roots)
        roots[count] = 0.0
        for k in range(count + 1):
            y = roots[k]
            cost = G / (y * y + kappa) + (n0 * y + n1) ** 2 / (E0 * y * y + 2.0 * E1 * y + E2)
            if cost < least:
                best, least = 1.0 / y, cost
    return best


@kernel
def _best_in_sector(own: _Two, B: F64, Q: float, D: float, other: _Two, E: F64, most: float, c: F64) -> _Four:
    """Return the best member q of the pencil and n of both images."""
    # q is counted from the line through one image's point. That image has x'L = `own`, the form B, Q = q'Bq
    # of the line through its point and D = det B; the second `other` and E. `most`, a bound on the cost,
    # restricts the search to the sector of lines within its root of the point.
    a, b = own
    q0, q1 = b, -a
    p0, p1 = B[1] * b - B[2] * a, B[1] * a - B[0] * b
    n0, n1 = other[0] * q0 + other[1] * q1, other[0] * p0 + other[1] * p1
    proper = Q - most * D > 0.5 * Q
    h = math.sqrt(most / (Q - most * D)) if proper else 1.0 / math.sqrt(D)
    n1 *= h
    E0, E1, E2 = _form(E, q0, q1, q0, q1), h * _form(E, q0, q1, p0, p1), h * h * _form(E, p0, p1, p0, p1)
    G, kappa = Q * h * h, D * h * h
    cost = (n0, n1, E0, E1, E2, G, kappa)
    _stationary_polynomial(cost, c)
    x = _least_stationary(cost, c, not proper)
    if math.isinf(x):
        return p0, p1, -Q, n1 / h
    return q0 + h * x * p0, q1 + h * x * p1, -h * x * Q, n0 + n1 * x


@kernel
def _best_of_pencil(a1: float, b1: float, a2: float, b2: float, B1: F64, B2: F64, c: F64) -> _Four:
    """Return q0, q1, n1, n2 of least n1^2 / (q'B1q) + n2^2 / (q'B2q), n = a q0 + b q1; c (7,) is scratch."""
    cross = a2 * b1 - b2 * a1
    Q1, Q2 = _form(B1, b1, -a1, b1, -a1), _form(B2, b2, -a2, b2, -a2)
    if cross == 0.0:
        # The match is exact, or a point is its epipole, through which every line goes.
        if a1 == 0.0 and b1 == 0.0:
            return (b2, -a2, 0.0, 0.0) if Q2 > 0.0 else (1.0, 0.0, 0.0, 0.0)
        return b1, -a1, 0.0, 0.0
    through1 = cross * cross / _form(B2, b1, -a1, b1, -a1)
    through2 = cross * cross / _form(B1, b2, -a2, b2, -a2)
    most = min(through1, through2)
    D1, D2 = max(B1[0] * B1[2] - B1[1] ** 2, 0.0), max(B2[0] * B2[2] - B2[1] ** 2, 0.0)
    # Q / D is the squared distance of a point from its epipole: the farther one gives the narrower sector.
    if Q1 * D2 > Q2 * D1 or (D1 == 0.0 and D2 == 0.0):
        q0, q1, n1, n2 = _best_in_sector((a1, b1), B1, Q1, D1, (a2, b2), B2, most, c)
    else:
        q0, q1, n2, n1 = _best_in_sector((a2, b2), B2, Q2, D2, (a1, b1), B1, most, c)
    cost = n1 * n1 / _form(B1, q0, q1, q0, q1) + n2 * n2 / _form(B2, q0, q1, q0, q1)
    if not cost <= most:
        return (b1, -a1, 0.0, cross) if through1 <= through2 else (b2, -a2, -cross, 0.0)
    return q0, q1, n1, n2


@kernel
def _correct_each_match(L1: F64, L2: F64, B1: F64, B2: F64, xy1: F64, xy2: F64) -> None:
    """Move every match (N, 2), (N, 2) to its nearest exact one, in place."""
    c = empty(_DEGREE + 1)
    for k in range(len(xy1)):
        x1, y1, x2, y2 = xy1[k, 0], xy1[k, 1], xy2[k, 0], xy2[k, 1]
        a1, b1 = L1[0, 0] * x1 + L1[1, 0] * y1 + L1[2, 0], L1[0, 1] * x1 + L1[1, 1] * y1 + L1[2, 1]
        a2, b2 = L2[0, 0] * x2 + L2[1, 0] * y2 + L2[2, 0], L2[0, 1] * x2 + L2[1, 1] * y2 + L2[2, 1]
        q0, q1, n1, n2 = _best_of_pencil(a1, b1, a2, b2, B1, B2, c)
        size = 1.0 / math.sqrt(q0 * q0 + q1 * q1)
        q0, q1, n1, n2 = q0 * size, q1 * size, n1 * size, n2 * size
        u, v = L1[0, 0] * q0 + L1[0, 1] * q1, L1[1, 0] * q0 + L1[1, 1] * q1
        n1 = n1 / (u * u + v * v) if n1 != 0.0 else 0.0
        xy1[k, 0], xy1[k, 1] = x1 - n1 * u, y1 - n1 * v
        u, v = L2[0, 0] * q0 + L2[0, 1] * q1, L2[1, 0] * q0 + L2[1, 1] * q1
        n2 = n2 / (u * u + v * v) if n2 != 0.0 else 0.0
        xy2[k, 0], xy2[k, 1] = x2 - n2 * u, y2 - n2 * v


def _conditioning(xy: F64) -> tuple[float, F64, F64]:
    """Scale (one for both views), centre (2, 2) and the transforms (2, 3, 3) to ``scale (x - centre)``."""
    scale, centre, T = 1.0, np.zeros((2, 2)), np.zeros((2, 3, 3))
    if xy.size:
        centre = xy.mean(axis=1)
        spread = float(np.abs(xy - centre[:, None]).max())
        scale = 1.0 / spread if spread > 0.0 else 1.0
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = -scale * centre
    T[:, 2, 2] = 1.0
    return scale, centre, T


def _balanced(L: F64) -> tuple[F64, F64]:
    """Lines L (2, 3, 2) of a pencil in a balanced basis, and the forms (2, 3)."""
    B = np.einsum("vka,vkb->vab", L[:, :2], L[:, :2])
    traces = np.maximum(np.trace(B, axis1=1, axis2=2), 1e-300)
    values, basis = np.linalg.eigh((B / traces[:, None, None]).sum(axis=0))
    L = np.ascontiguousarray(L @ (basis / np.sqrt(np.maximum(values, _RANK * values[1]))))
    u, v = L[:, :2, 0], L[:, :2, 1]
    return L, np.stack([np.sum(u * u, axis=1), np.sum(u * v, axis=1), np.sum(v * v, axis=1)], axis=1)


def correct_matches(F: F64, xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Move matches to the nearest pairs with x2' F x1 = 0: least sum of squared distances.

    The minimum is global. A match with a point on its epipole is exact with every partner and is not moved.
    """
    F, xy1, xy2 = checked("correct_matches", F=(F, (3, 3)), xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    F = checked_unit(F, "correct_matches")
    xy = np.stack([xy1, xy2])
    scale, centre, T = _conditioning(xy)
    back = np.linalg.inv(T)
    U, s, Vt = np.linalg.svd(back[1].T @ F @ back[0])
    if not s[1] > _RANK * s[0]:
        raise ValueError("correct_matches needs an F of rank 2; got one of rank 1")
    lines1 = Vt[:2].T
    lines2 = (U[:, :2] * s[:2]) @ Vt[:2] @ cross_matrix(Vt[2]) @ lines1
    L, B = _balanced(np.stack([lines1, lines2]))
    moved = np.ascontiguousarray((xy - centre[:, None]) * scale)
    _correct_each_match(L[0], L[1], B[0], B[1], moved[0], moved[1])
    moved = moved / scale + centre[:, None]
    return moved[0], moved[1]


def triangulate_polynomial(P: F64, xy: F64) -> F64:
    """Triangulate xy (2, N, 2) optimally from two views (6.3.3): unit points (N, 4); zeros where xy is NaN.

    The sum of squared reprojection errors is the global minimum in any frame. A match whose nearest exact
    pair has one point on an epipole gives the centre of the other camera; both, some point of the baseline.
    """
    if P.shape != (2, 3, 4):
        raise ValueError(f'the polynomial method needs exactly two cameras, not {len(P)}; use "optimal"')
    require_shapes("triangulate_polynomial", xy=(xy, (2, "N", 2)))
    require_finite("triangulate_polynomial", P)
    seen = np.isfinite(xy).all(axis=(0, 2))
    T = _conditioning(xy[:, seen])[2]
    conditioned = T @ P
    size = np.linalg.norm(conditioned, axis=(1, 2), keepdims=True)
    stacked = (conditioned / np.where(size > 0.0, size, 1.0)).reshape(6, 4)
    columns = np.linalg.norm(stacked, axis=0)
    U, s, _ = np.linalg.svd(stacked / np.where(columns > 0.0, columns, 1.0), full_matrices=False)
    if not s[3] > _RANK * s[0]:
        raise ValueError("the polynomial method needs two cameras with different centres")
    # In a frame of space with Q1'Q1 + Q2'Q2 = I, the eigenvalues of Q2'Q2 of the centres are 0 and 1.
    Q = U.reshape(2, 3, 4)
    values = np.linalg.eigvalsh(Q[1].T @ Q[1])
    if not (values[1] > _RANK and 1.0 - values[2] > _RANK):
        raise ValueError("the polynomial method needs cameras of rank 3")
    moved = np.full_like(xy, np.nan)
    moved[:, seen] = correct_matches(T[1].T @ fundamental_from_cameras(*Q) @ T[0], *xy[:, seen])
    return triangulate_linear(P, sort_by_point(moved), 0)


@kernel
def horner(c: F64, x: float) -> tuple[float, float]:
    """Return value and derivative of the polynomial c, lowest power first."""
    value, slope = c[len(c) - 1], 0.0
    for k in range(len(c) - 2, -1, -1):
        slope = slope * x + value
        value = value * x + c[k]
    return value, slope


@kernel
def _root_between(c: F64, low: float, high: float, rising: bool) -> float:
    """Return the root of c in [low, high] by Newton's method, or bisection outside the bracket."""
    x = 0.5 * (low + high)
    for _ in range(100):
        value, slope = horner(c, x)
        if value == 0.0:
            break
        if (value > 0.0) == rising:
            high = x
        else:
            low = x
        moved = x - value / slope
        if not low < moved < high:
            moved = 0.5 * (low + high)
        # The bracket has no number between its ends.
        if abs(moved - x) <= 1e-16 + 2e-16 * abs(x):
            break
        x = moved
    return x


@kernel
def roots_in_unit_interval(c: F64, roots: F64) -> int:
    """Fill roots (D + 1,) with those of c (D + 1,) in [-1, 1] by those of its derivatives; their number."""
    degree = len(c) - 1
    derivative, cuts = empty(degree + 1), empty(degree + 2)
    found = 0
    for order in range(degree - 1, -1, -1):
        d = derivative[: degree - order + 1]
        for k in range(order, degree + 1):
            factor = 1.0
            for m in range(k - order + 1, k + 1):
                factor *= m
            d[k - order] = factor * c[k]
        cuts[0] = -1.0
        for k in range(found):
            cuts[k + 1] = roots[k]
        cuts[found + 1] = 1.0
        pieces, found = found + 1, 0
        left, _ = horner(d, -1.0)
        for k in range(pieces):
            right, _ = horner(d, cuts[k + 1])
            if (left < 0.0 < right) or (right < 0.0 < left):
                roots[found] = _root_between(d, cuts[k], cuts[k + 1], left < 0.0)
                found += 1
            elif right == 0.0 and k + 1 < pieces:
                roots[found] = cuts[k + 1]
                found += 1
            left = right
    return found

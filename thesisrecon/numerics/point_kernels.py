"""Refinement of every point on its own, and the guard that keeps points before their cameras."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from thesisrecon.arrays import F64, I64
from thesisrecon.numerics.projective_cameras import tangent_reflectors, tangent_step
from thesisrecon.numerics.small_solvers import away_from_zero, invert_positive_3x3, loss_value, loss_weight

Loss = tuple[int, float]
"""Number of a robust loss, and where it turns."""


class Sightings(NamedTuple):
    """Observations ``first`` to ``last`` of one point, among all sorted by point: ``view_index`` (K,), ``xy``
    (K, 2)."""

    first: int
    last: int
    view_index: I64
    xy: F64


@njit(cache=True, nogil=True)
def revert_cheirality_violations(
    start: I64, view_index: I64, row_before: F64, row_after: F64, X_before: F64, X_after: F64
) -> None:
    """Put back the points whose step takes them through the focal plane of a view that sees them.

    ``row`` (V, 4) third rows of the cameras; X (N, 4), or (N, 3) with a fourth coordinate 1.
    """
    d = X_before.shape[1]
    for j in range(len(start) - 1):
        for k in range(start[j], start[j + 1]):
            v = view_index[k]
            before = row_before[v, 3] if d == 3 else 0.0
            after = row_after[v, 3] if d == 3 else 0.0
            for c in range(d):
                before += row_before[v, c] * X_before[j, c]
                after += row_after[v, c] * X_after[j, c]
            if before * after < 0.0:
                X_after[j] = X_before[j]
                break


@njit(cache=True, nogil=True)
def point_cost(P: F64, x: F64, sightings: Sightings, loss: Loss) -> tuple[float, int]:
    """1/2 sum rho of one point's observations, and how many of them lie behind their camera."""
    first, last, view_index, xy = sightings
    code, delta = loss
    cost, behind = 0.0, 0
    for k in range(first, last):
        p = P[view_index[k]]
        u0 = p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]
        u1 = p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]
        u2 = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3]
        w = away_from_zero(u2)
        if u2 < 0.0:
            behind += 1
        r0, r1 = u0 / w - xy[k, 0], u1 / w - xy[k, 1]
        cost += loss_value(code, r0 * r0 + r1 * r1, delta)
    return 0.5 * cost, behind


@njit(cache=True, nogil=True)
def linearize_point(
    P: F64, x: F64, tangent: tuple[F64, float], sightings: Sightings, loss: Loss, H: F64, g: F64
) -> None:
    """Fill J'J (3, 3) and J'r (3,) of one unit point in its ``tangent`` space (Householder vector v, factor
    beta)."""
    v, beta = tangent
    first, last, view_index, xy = sightings
    code, delta = loss
    H[:] = 0.0
    g[:] = 0.0
    J = np.empty((2, 4))
    r = np.empty(2)
    for k in range(first, last):
        p = P[view_index[k]]
        u0 = p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]
        u1 = p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]
        w = away_from_zero(p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3])
        a, b = u0 / w, u1 / w
        r[0], r[1] = a - xy[k, 0], b - xy[k, 1]
        weight = loss_weight(code, r[0] * r[0] + r[1] * r[1], delta)
        d0 = d1 = 0.0
        for c in range(4):
            J[0, c] = (p[0, c] - a * p[2, c]) / w
            J[1, c] = (p[1, c] - b * p[2, c]) / w
            d0 += J[0, c] * v[c]
            d1 += J[1, c] * v[c]
        for c in range(4):
            J[0, c] -= beta * d0 * v[c]
            J[1, c] -= beta * d1 * v[c]
        for m in range(3):
            g[m] += weight * (J[0, m + 1] * r[0] + J[1, m + 1] * r[1])
            for n in range(3):
                H[m, n] += weight * (J[0, m + 1] * J[0, n + 1] + J[1, m + 1] * J[1, n + 1])


@njit(cache=True, nogil=True)
def refine_each_point(
    P: F64, X: F64, start: I64, view_index: I64, xy: F64, code: int, delta: float, iterations: int
) -> None:
    """Damped Gauss-Newton on every unit point of X (N, 4), in place; steps that cross a focal plane are
    refused."""
    H, M, Mi = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    g, step = np.empty(3), np.empty((1, 3))
    v, beta, moved = np.empty((1, 4)), np.empty(1), np.empty((1, 4))
    for j in range(len(start) - 1):
        first, last = start[j], start[j + 1]
        if last - first < 2:
            continue
        x = X[j : j + 1]
        if x[0, 0] == 0.0 and x[0, 1] == 0.0 and x[0, 2] == 0.0 and x[0, 3] == 0.0:
            continue
        sightings, loss = Sightings(first, last, view_index, xy), (code, delta)
        cost, behind = point_cost(P, x[0], sightings, loss)
        damping = 1e-4
        fresh = True
        for _ in range(iterations):
            if fresh:
                tangent_reflectors(x, v, beta)
                linearize_point(P, x[0], (v[0], beta[0]), sightings, loss, H, g)
            for m in range(3):
                for n in range(3):
                    M[m, n] = H[m, n]
                M[m, m] *= 1.0 + damping
            if not invert_positive_3x3(M, Mi):
                break
            for m in range(3):
                step[0, m] = -(Mi[m, 0] * g[0] + Mi[m, 1] * g[1] + Mi[m, 2] * g[2])
            tangent_step(x, v, beta, step, moved)
            candidate, flipped = point_cost(P, moved[0], sightings, loss)
            fresh = candidate < cost and flipped == behind
            if fresh:
                x[0] = moved[0]
                gain = cost - candidate
                cost = candidate
                damping = max(damping * 0.2, 1e-9)
                if gain <= 1e-9 * cost:
                    break
            else:
                damping *= 10.0

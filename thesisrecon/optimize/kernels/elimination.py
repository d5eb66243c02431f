"""Elimination of the points from the normal equations, and their steps once the cameras' are known.

A residual's Jacobian has three parts: ``A`` (K, 2, C), columns of its view's own block; ``E`` (K, 2, F),
columns that views have in common, F may be 0; and ``B`` (K, 2, 3) of its point. The reduced system is kept in
three parts accordingly: C x C blocks for pairs of views that see a point together, a border between views and
common columns, and a corner. Residuals and Jacobians come multiplied by sqrt(rho').

With V = sum B'B + damping = L L' of one point, B~ = B L^-T and Q_kl = delta_kl I - B~_k B~_l' (2 x 2), the
reduced system is S_kl = A_k' Q_kl A_l: rank-two updates instead of the rank-three ones of W V^-1 W'.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thesisrecon.optimize.kernels.records import Jacobians

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Places(NamedTuple):
    """Where observations, sorted by point, go.

    ``start`` (N + 1,) the first of each point; ``view_index`` (K,); ``block`` (V,) number of the view's
    block, -1 for one held fixed; ``pair`` (b, b) number of the block of two views, upper triangle;
    ``common`` (V, F) columns of the border, -1 for one that does not move."""

    start: I64
    view_index: I64
    block: I64
    pair: I64
    common: I64


class Sums(NamedTuple):
    """The reduced system: ``blocks`` (n, C, C), ``border`` (b, C, e), ``corner`` (e, e), ``rhs`` (D,) with
    D = b C + e; and, before elimination, ``diagonal`` (D,) of J'J and ``gradient`` (D,)."""

    blocks: F64
    border: F64
    corner: F64
    rhs: F64
    diagonal: F64
    gradient: F64


class PointSums(NamedTuple):
    """Of each point: ``inverse`` (N, 3, 3) of its damped J'J, zeros where the data do not hold it;
    ``gradient`` (N, 3) and ``diagonal`` (N, 3) of J'J."""

    inverse: F64
    gradient: F64
    diagonal: F64


class _Scratch(NamedTuple):
    """Room for one point: ``Bt`` (m, 2, 3), ``rt`` (m, 2), ``E`` and ``T`` (m, 2, e), ``root`` (3, 3) = L^-1,
    ``slot`` (columns of the border,) and ``column`` (e,), places of the common columns it is seen with."""

    Bt: F64
    rt: F64
    E: F64
    T: F64
    root: F64
    slot: I64
    column: I64


@njit(cache=True, nogil=True)
def eliminate_points(
    first: int, last: int, damping: float, J: Jacobians, places: Places, sums: Sums, points: PointSums
) -> None:
    """Add the points first..last, eliminated, to ``sums``; fill their ``points``.

    The diagonal of a point's J'J is multiplied by 1 + damping; a point whose block is not positive stays
    where it is.
    """
    most, border = 1, len(sums.corner)
    for j in range(first, last):
        most = max(most, places.start[j + 1] - places.start[j])
    wide = min(border, most * places.common.shape[1])
    room = _Scratch(
        np.empty((most, 2, 3)), np.empty((most, 2)), np.empty((most, 2, wide)), np.empty((most, 2, wide)),
        np.empty((3, 3)), np.full(border, -1), np.empty(wide, np.int64),
    )  # fmt: skip
    for j in range(first, last):
        s, e = places.start[j], places.start[j + 1]
        if s == e:
            continue
        sum_point(s, e, j, damping, J, points, room)
        add_views(s, e, J, places, sums, room)
        if border > 0:
            add_common(s, e, J, places, sums, room)


@njit(cache=True, nogil=True)
def sum_point(
    s: int, e: int, j: int, damping: float, J: Jacobians, points: PointSums, room: _Scratch
) -> None:
    """J'J and J'r of one point, its inverse, B~ and the residuals that its own step leaves."""
    v00 = v01 = v02 = v11 = v12 = v22 = h0 = h1 = h2 = 0.0
    for k in range(s, e):
        for i in range(2):
            b0, b1, b2, r = J.B[k, i, 0], J.B[k, i, 1], J.B[k, i, 2], J.residual[k, i]
            v00 += b0 * b0
            v01 += b0 * b1
            v02 += b0 * b2
            v11 += b1 * b1
            v12 += b1 * b2
            v22 += b2 * b2
            h0 += b0 * r
            h1 += b1 * r
            h2 += b2 * r
    h, d = points.gradient[j], points.diagonal[j]
    h[0], h[1], h[2] = h0, h1, h2
    d[0], d[1], d[2] = v00, v11, v22
    M = room.root
    more = 1.0 + damping
    inverse_root(v00 * more, v01, v02, v11 * more, v12, v22 * more, M)
    for a in range(3):
        for b in range(3):
            points.inverse[j, a, b] = M[0, a] * M[0, b] + M[1, a] * M[1, b] + M[2, a] * M[2, b]
    g0, g1, g2 = M[0, 0] * h0, M[1, 0] * h0 + M[1, 1] * h1, M[2, 0] * h0 + M[2, 1] * h1 + M[2, 2] * h2
    for k in range(s, e):
        for i in range(2):
            b0, b1, b2 = J.B[k, i, 0], J.B[k, i, 1], J.B[k, i, 2]
            t0, t1, t2 = M[0, 0] * b0, M[1, 0] * b0 + M[1, 1] * b1, M[2, 0] * b0 + M[2, 1] * b1 + M[2, 2] * b2
            t = room.Bt[k - s, i]
            t[0], t[1], t[2] = t0, t1, t2
            room.rt[k - s, i] = J.residual[k, i] - t0 * g0 - t1 * g1 - t2 * g2


@njit(cache=True, nogil=True)
def inverse_root(v00: float, v01: float, v02: float, v11: float, v12: float, v22: float, M: F64) -> bool:
    """M = L^-1 of a symmetric 3 x 3 matrix L L'; zeros (and False) where a pivot is not positive."""
    M[:] = 0.0
    if not v00 > 0.0:
        return False
    l00 = np.sqrt(v00)
    l10, l20 = v01 / l00, v02 / l00
    p1 = v11 - l10 * l10
    if not p1 > 0.0:
        return False
    l11 = np.sqrt(p1)
    l21 = (v12 - l20 * l10) / l11
    p2 = v22 - l20 * l20 - l21 * l21
    if not p2 > 0.0:
        return False
    M[0, 0], M[1, 1], M[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / np.sqrt(p2)
    M[1, 0] = -l10 * M[0, 0] * M[1, 1]
    M[2, 1] = -l21 * M[1, 1] * M[2, 2]
    M[2, 0] = -(l20 * M[0, 0] + l21 * M[1, 0]) * M[2, 2]
    return True


@njit(cache=True, nogil=True)
def add_views(s: int, e: int, J: Jacobians, places: Places, sums: Sums, room: _Scratch) -> None:
    """The blocks of all pairs of views that see one point, and the views' part of the right-hand side."""
    C = J.A.shape[2]
    for k in range(s, e):
        v = places.block[places.view_index[k]]
        if v < 0:
            continue
        r0, r1 = J.residual[k, 0], J.residual[k, 1]
        t0, t1 = room.rt[k - s, 0], room.rt[k - s, 1]
        for a in range(C):
            a0, a1 = J.A[k, 0, a], J.A[k, 1, a]
            sums.gradient[v * C + a] += a0 * r0 + a1 * r1
            sums.rhs[v * C + a] -= a0 * t0 + a1 * t1
            sums.diagonal[v * C + a] += a0 * a0 + a1 * a1
        b = room.Bt[k - s]
        for m in range(k, e):
            w = places.block[places.view_index[m]]
            if w < 0:
                continue
            c = room.Bt[m - s]
            same = 1.0 if m == k else 0.0
            q00 = same - b[0, 0] * c[0, 0] - b[0, 1] * c[0, 1] - b[0, 2] * c[0, 2]
            q01 = -b[0, 0] * c[1, 0] - b[0, 1] * c[1, 1] - b[0, 2] * c[1, 2]
            q10 = -b[1, 0] * c[0, 0] - b[1, 1] * c[0, 1] - b[1, 2] * c[0, 2]
            q11 = same - b[1, 0] * c[1, 0] - b[1, 1] * c[1, 1] - b[1, 2] * c[1, 2]
            add_block(sums.blocks[places.pair[v, w]], J.A[k], J.A[m], q00, q01, q10, q11)
            if v == w and m > k:
                add_block(sums.blocks[places.pair[v, w]], J.A[m], J.A[k], q00, q10, q01, q11)


@njit(cache=True, nogil=True, inline="always")
def add_block(S: F64, left: F64, right: F64, q00: float, q01: float, q10: float, q11: float) -> None:
    """S (C, C) += left' Q right for left, right (2, C)."""
    C = S.shape[0]
    for a in range(C):
        p0 = left[0, a] * q00 + left[1, a] * q10
        p1 = left[0, a] * q01 + left[1, a] * q11
        for b in range(C):
            S[a, b] += p0 * right[0, b] + p1 * right[1, b]


@njit(cache=True, nogil=True)
def add_common(s: int, e: int, J: Jacobians, places: Places, sums: Sums, room: _Scratch) -> None:
    """Border, corner and right-hand side of the common columns that one point is seen with.

    Gathered side by side they are E (2m, n); T = (I - B~ B~') E is what the point's own step leaves of them.
    """
    C, E, T = J.A.shape[2], room.E, room.T
    n = gather_common(s, e, J, places, room)
    first = sums.border.shape[0] * C
    for c in range(n):
        p0 = p1 = p2 = 0.0
        for i in range(e - s):
            for x in range(2):
                p0 += room.Bt[i, x, 0] * E[i, x, c]
                p1 += room.Bt[i, x, 1] * E[i, x, c]
                p2 += room.Bt[i, x, 2] * E[i, x, c]
        for i in range(e - s):
            for x in range(2):
                b = room.Bt[i, x]
                T[i, x, c] = E[i, x, c] - b[0] * p0 - b[1] * p1 - b[2] * p2
    for i in range(e - s):
        k, v = s + i, places.block[places.view_index[s + i]]
        for c in range(n):
            column, t0, t1 = room.column[c], T[i, 0, c], T[i, 1, c]
            if v >= 0:
                for a in range(C):
                    sums.border[v, a, column] += J.A[k, 0, a] * t0 + J.A[k, 1, a] * t1
            e0, e1 = E[i, 0, c], E[i, 1, c]
            if e0 == 0.0 and e1 == 0.0:
                continue
            sums.gradient[first + column] += e0 * J.residual[k, 0] + e1 * J.residual[k, 1]
            sums.rhs[first + column] -= e0 * room.rt[i, 0] + e1 * room.rt[i, 1]
            sums.diagonal[first + column] += e0 * e0 + e1 * e1
            for d in range(n):
                sums.corner[column, room.column[d]] += e0 * T[i, 0, d] + e1 * T[i, 1, d]
    for c in range(n):
        room.slot[room.column[c]] = -1


@njit(cache=True, nogil=True)
def gather_common(s: int, e: int, J: Jacobians, places: Places, room: _Scratch) -> int:
    """The common columns of one point's observations side by side in ``room.E``; returns how many."""
    F, n = places.common.shape[1], 0
    for k in range(s, e):
        for f in range(F):
            column = places.common[places.view_index[k], f]
            if column >= 0 and room.slot[column] < 0:
                room.slot[column] = n
                room.column[n] = column
                n += 1
    for k in range(s, e):
        for c in range(n):
            room.E[k - s, 0, c] = room.E[k - s, 1, c] = 0.0
        for f in range(F):
            column = places.common[places.view_index[k], f]
            if column >= 0:
                room.E[k - s, 0, room.slot[column]] += J.E[k, 0, f]
                room.E[k - s, 1, room.slot[column]] += J.E[k, 1, f]
    return n


@njit(cache=True, nogil=True)
def substitute_points(
    first: int, last: int, camera_step: F64, J: Jacobians, places: Places, points: PointSums, step: F64
) -> None:
    """Steps of the points first..last (N, 3) for a step of the cameras (D,): -V^-1 (h + B' J step)."""
    C, F = J.A.shape[2], places.common.shape[1]
    border = len(places.pair) * C
    for j in range(first, last):
        h = points.gradient[j]
        t0, t1, t2 = h[0], h[1], h[2]
        for k in range(places.start[j], places.start[j + 1]):
            e0 = e1 = 0.0
            view = places.view_index[k]
            v = places.block[view] * C
            if v >= 0:
                for c in range(C):
                    e0 += J.A[k, 0, c] * camera_step[v + c]
                    e1 += J.A[k, 1, c] * camera_step[v + c]
            for f in range(F):
                column = places.common[view, f]
                if column >= 0:
                    e0 += J.E[k, 0, f] * camera_step[border + column]
                    e1 += J.E[k, 1, f] * camera_step[border + column]
            t0 += J.B[k, 0, 0] * e0 + J.B[k, 1, 0] * e1
            t1 += J.B[k, 0, 1] * e0 + J.B[k, 1, 1] * e1
            t2 += J.B[k, 0, 2] * e0 + J.B[k, 1, 2] * e1
        V = points.inverse[j]
        for a in range(3):
            step[j, a] = -(V[a, 0] * t0 + V[a, 1] * t1 + V[a, 2] * t2)


@njit(cache=True, nogil=True)
def mark_pairs(start: I64, view: I64, block: I64, seen: NDArray[np.bool_]) -> None:
    """Mark in ``seen`` (b, b), upper triangle, the blocks of views that see a point together."""
    for j in range(len(start) - 1):
        for k in range(start[j], start[j + 1]):
            v = block[view[k]]
            if v >= 0:
                for m in range(k, start[j + 1]):
                    if block[view[m]] >= 0:
                        seen[v, block[view[m]]] = True

"""Elimination of the points from the normal equations [[U, W], [W', V]], and their steps (HZ A6.3).

A Jacobian has columns A of its view, E that views have in common, and B of its point. The reduced system has
blocks for pairs of views with a common point, a border between views and common columns, and a corner. With
V = sum B'B + damping = L L' of one point, B~ = B L^-T, Q_kl = delta_kl I - B~_k B~_l' (2 x 2) and Z = B~' A =
L^-1 W' (3 x C), two observations add S_kl = A_k' Q_kl A_l = delta_kl A_k' A_k - Z_k' Z_l to U - W V^-1 W'.
"""

from typing import NamedTuple

import numpy as np

from thesisrecon._numba import copy_to, empty, full, kernel
from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.small_matrices import invert_cholesky_3x3, multiply_transposed_3x3
from thesisrecon.optimize.bundle.projection import Jacobians


class BlockIndex(NamedTuple):
    """``start`` (N + 1,) of each point, ``block`` (V,) and border columns ``common`` (V, F) of each view.

    Both are -1 if fixed. Row v of the reduced matrix has blocks ``row[v]`` to ``row[v + 1]``, of the views
    ``column`` (n,); others are not summed.
    """

    start: I64
    view_index: I64
    block: I64
    row: I64
    column: I64
    common: I64


class ReducedSums(NamedTuple):
    """The reduced system: ``blocks`` (n, C, C), ``border`` (b, C, e), ``corner`` (e, e), ``rhs`` (D,).

    D = b C + e; ``diagonal`` (D,) of J'J and ``gradient`` (D,) are those before elimination.
    """

    blocks: F64
    border: F64
    corner: F64
    rhs: F64
    diagonal: F64
    gradient: F64


class PointSums(NamedTuple):
    """Inverse (N, 3, 3) of each point's damped J'J, zeros if undetermined; gradient and diagonal (N, 3)."""

    inverse: F64
    gradient: F64
    diagonal: F64


class _Elimination(NamedTuple):
    """B~ (k, 2, 3), Z (k, 3, 6) and residuals (k, 2) after the points' own steps, from ``first`` on.

    g = L^-1 h (n, 3). Z is empty unless a view has six columns.
    """

    first: int
    Bt: F64
    Z: F64
    residual: F64
    g: F64


class ByView(NamedTuple):
    """Observations ``order`` of free views by view; block of the view and end of the point of each (k,)."""

    order: I64
    block: I64
    end: I64


def sort_by_view(first: int, last: int, index: BlockIndex) -> ByView:
    """Sort the observations of a range of points; those of one view stay in their order."""
    bounds = index.start[first : last + 1]
    block = index.block[index.view_index[bounds[0] : bounds[-1]]]
    order = np.argsort(block, kind="stable")[np.count_nonzero(block < 0) :]
    return ByView(bounds[0] + order, block, np.repeat(bounds[1:], np.diff(bounds)))


@kernel
def eliminate_points(
    first: int, last: int, damping: float, J: Jacobians, index: BlockIndex, by_view: ByView,
    sums: ReducedSums, points: PointSums,
) -> None:  # fmt: skip
    """Add the eliminated points to the sums; a point whose block is not positive does not move."""
    k = index.start[first]
    n = index.start[last] - k
    Z = empty((n if J.A.shape[2] == 6 else 0, 3, 6))
    left = _Elimination(k, empty((n, 2, 3)), Z, empty((n, 2)), empty((last - first, 3)))
    _sum_points(first, last, damping, J, index, points, left)
    _add_views(J, index, by_view, sums, left)
    if len(sums.corner) > 0:
        _add_common(first, last, J, index, sums, left)


# A call with these arrays costs more than a point, so the loops over points are inside.


@kernel
def _sum_points(
    first: int, last: int, damping: float, J: Jacobians, index: BlockIndex, points: PointSums,
    left: _Elimination,
) -> None:  # fmt: skip
    """Compute J'J and J'r of each point, its inverse, B~ and the residuals after its own step."""
    M, more = empty((3, 3)), 1.0 + damping
    for j in range(first, last):
        v00 = v01 = v02 = v11 = v12 = v22 = h0 = h1 = h2 = 0.0
        s, e = index.start[j], index.start[j + 1]
        for k in range(s, e):
            for i in range(2):
                b0, b1, b2, r = J.B[k, i, 0], J.B[k, i, 1], J.B[k, i, 2], J.residual[k, i]
                v00, v01, v02 = v00 + b0 * b0, v01 + b0 * b1, v02 + b0 * b2
                v11, v12, v22 = v11 + b1 * b1, v12 + b1 * b2, v22 + b2 * b2
                h0, h1, h2 = h0 + b0 * r, h1 + b1 * r, h2 + b2 * r
        h, d, g = points.gradient[j], points.diagonal[j], left.g[j - first]
        h[0], h[1], h[2] = h0, h1, h2
        d[0], d[1], d[2] = v00, v11, v22
        invert_cholesky_3x3(v00 * more, v01, v02, v11 * more, v12, v22 * more, M)
        multiply_transposed_3x3(M, points.inverse[j])
        m00, m10, m11, m20, m21, m22 = M[0, 0], M[1, 0], M[1, 1], M[2, 0], M[2, 1], M[2, 2]
        g0, g1, g2 = m00 * h0, m10 * h0 + m11 * h1, m20 * h0 + m21 * h1 + m22 * h2
        g[0], g[1], g[2] = g0, g1, g2
        for k in range(s, e):
            for i in range(2):
                b0, b1, b2 = J.B[k, i, 0], J.B[k, i, 1], J.B[k, i, 2]
                t0, t1, t2 = m00 * b0, m10 * b0 + m11 * b1, m20 * b0 + m21 * b1 + m22 * b2
                t = left.Bt[k - left.first, i]
                t[0], t[1], t[2] = t0, t1, t2
                left.residual[k - left.first, i] = J.residual[k, i] - t0 * g0 - t1 * g1 - t2 * g2
            if J.A.shape[2] == 6:
                o = k - left.first
                for i in range(3):
                    t0, t1 = left.Bt[o, 0, i], left.Bt[o, 1, i]
                    for c in range(6):
                        left.Z[o, i, c] = t0 * J.A[k, 0, c] + t1 * J.A[k, 1, c]


@kernel(forceinline=True)
def _add_views(
    J: Jacobians, index: BlockIndex, by_view: ByView, sums: ReducedSums, left: _Elimination
) -> None:
    """Add the blocks of all pairs of views that observe a point, and right sides, view by view (cache)."""
    C = J.A.shape[2]
    for k in by_view.order:
        o = k - left.first
        v = by_view.block[o]
        r0, r1 = J.residual[k, 0], J.residual[k, 1]
        t0, t1 = left.residual[o, 0], left.residual[o, 1]
        for a in range(C):
            a0, a1 = J.A[k, 0, a], J.A[k, 1, a]
            sums.gradient[v * C + a] += a0 * r0 + a1 * r1
            sums.rhs[v * C + a] -= a0 * t0 + a1 * t1
            sums.diagonal[v * C + a] += a0 * a0 + a1 * a1
    if C == 6:
        _add_blocks_of_six(left.first, by_view, index, J.A, left.Z, sums.blocks)
    else:
        _add_blocks(left.first, by_view, index, J.A, left.Bt, sums.blocks)


@kernel(inline="always")
def _select_row(index: BlockIndex, before: int, v: int, slot: I64) -> None:
    """Set ``slot`` (b,) to the blocks of row v, -1 for none, from those of the row before."""
    if before >= 0:
        slot[index.column[index.row[before] : index.row[before + 1]]] = -1
    for n in range(index.row[v], index.row[v + 1]):
        slot[index.column[n]] = n


@kernel(fastmath={"contract"}, forceinline=True)
def _add_blocks(first: int, by_view: ByView, index: BlockIndex, A: F64, Bt: F64, blocks: F64) -> None:
    """Add A_k' Q_km A_m of observations k <= m of a point to their blocks, within one view transposed too."""
    order, block, end = by_view
    slot, before = full(len(index.row) - 1, -1, np.int64), -1
    for i in range(len(order)):
        k = order[i] - first
        v = block[k]
        if v != before:
            _select_row(index, before, v, slot)
            before = v
        for m in range(k, end[k] - first):
            w = block[m]
            if w < 0 or slot[w] < 0:
                continue
            same = 1.0 if m == k else 0.0
            q00 = same - Bt[k, 0, 0] * Bt[m, 0, 0] - Bt[k, 0, 1] * Bt[m, 0, 1] - Bt[k, 0, 2] * Bt[m, 0, 2]
            q01 = -Bt[k, 0, 0] * Bt[m, 1, 0] - Bt[k, 0, 1] * Bt[m, 1, 1] - Bt[k, 0, 2] * Bt[m, 1, 2]
            q10 = -Bt[k, 1, 0] * Bt[m, 0, 0] - Bt[k, 1, 1] * Bt[m, 0, 1] - Bt[k, 1, 2] * Bt[m, 0, 2]
            q11 = same - Bt[k, 1, 0] * Bt[m, 1, 0] - Bt[k, 1, 1] * Bt[m, 1, 1] - Bt[k, 1, 2] * Bt[m, 1, 2]
            n = slot[w]
            _add_block(blocks, n, A, first + k, first + m, (q00, q01, q10, q11))
            if v == w and m > k:
                _add_block(blocks, n, A, first + m, first + k, (q00, q10, q01, q11))


@kernel(inline="always", fastmath={"contract"}, forceinline=True)
def _add_block(blocks: F64, n: int, A: F64, k: int, m: int, Q: tuple[float, float, float, float]) -> None:
    """Add A_k' Q A_m to block n."""
    q00, q01, q10, q11 = Q
    for a in range(blocks.shape[1]):
        p0 = A[k, 0, a] * q00 + A[k, 1, a] * q10
        p1 = A[k, 0, a] * q01 + A[k, 1, a] * q11
        for b in range(blocks.shape[2]):
            blocks[n, a, b] += p0 * A[m, 0, b] + p1 * A[m, 1, b]


@kernel(fastmath={"contract"}, forceinline=True)
def _add_blocks_of_six(first: int, by_view: ByView, index: BlockIndex, A: F64, Z: F64, blocks: F64) -> None:
    """As :func:`_add_blocks` for C = 6: A_k' A_k - Z_k' Z_m, three times as fast (vectors)."""
    order, block, end = by_view
    slot, before = full(len(index.row) - 1, -1, np.int64), -1
    for i in range(len(order)):
        k = order[i] - first
        v = block[k]
        if v != before:
            _select_row(index, before, v, slot)
            before = v
        _add_gram_of_six(blocks, slot[v], A, order[i])
        for m in range(k, end[k] - first):
            w = block[m]
            if w < 0 or slot[w] < 0:
                continue
            _subtract_product_of_six(blocks, slot[w], Z, k, m)
            if m > k and v == w:
                _subtract_product_of_six(blocks, slot[w], Z, m, k)


@kernel(inline="always", fastmath={"contract"}, forceinline=True)
def _subtract_product_of_six(blocks: F64, n: int, Z: F64, k: int, m: int) -> None:
    """Subtract Z_k' Z_m from block n."""
    x0, x1, x2, x3, x4, x5 = Z[m, 0, 0], Z[m, 0, 1], Z[m, 0, 2], Z[m, 0, 3], Z[m, 0, 4], Z[m, 0, 5]
    y0, y1, y2, y3, y4, y5 = Z[m, 1, 0], Z[m, 1, 1], Z[m, 1, 2], Z[m, 1, 3], Z[m, 1, 4], Z[m, 1, 5]
    z0, z1, z2, z3, z4, z5 = Z[m, 2, 0], Z[m, 2, 1], Z[m, 2, 2], Z[m, 2, 3], Z[m, 2, 4], Z[m, 2, 5]
    for a in range(6):
        p, q, r = Z[k, 0, a], Z[k, 1, a], Z[k, 2, a]
        s0 = blocks[n, a, 0] - p * x0 - q * y0 - r * z0
        s1 = blocks[n, a, 1] - p * x1 - q * y1 - r * z1
        s2 = blocks[n, a, 2] - p * x2 - q * y2 - r * z2
        s3 = blocks[n, a, 3] - p * x3 - q * y3 - r * z3
        s4 = blocks[n, a, 4] - p * x4 - q * y4 - r * z4
        s5 = blocks[n, a, 5] - p * x5 - q * y5 - r * z5
        blocks[n, a, 0], blocks[n, a, 1], blocks[n, a, 2] = s0, s1, s2
        blocks[n, a, 3], blocks[n, a, 4], blocks[n, a, 5] = s3, s4, s5


@kernel(inline="always", fastmath={"contract"}, forceinline=True)
def _add_gram_of_six(blocks: F64, n: int, A: F64, k: int) -> None:
    """Add A_k' A_k to block n."""
    x0, x1, x2, x3, x4, x5 = A[k, 0, 0], A[k, 0, 1], A[k, 0, 2], A[k, 0, 3], A[k, 0, 4], A[k, 0, 5]
    y0, y1, y2, y3, y4, y5 = A[k, 1, 0], A[k, 1, 1], A[k, 1, 2], A[k, 1, 3], A[k, 1, 4], A[k, 1, 5]
    for a in range(6):
        p, q = A[k, 0, a], A[k, 1, a]
        s0, s1 = blocks[n, a, 0] + p * x0 + q * y0, blocks[n, a, 1] + p * x1 + q * y1
        s2, s3 = blocks[n, a, 2] + p * x2 + q * y2, blocks[n, a, 3] + p * x3 + q * y3
        s4, s5 = blocks[n, a, 4] + p * x4 + q * y4, blocks[n, a, 5] + p * x5 + q * y5
        blocks[n, a, 0], blocks[n, a, 1], blocks[n, a, 2] = s0, s1, s2
        blocks[n, a, 3], blocks[n, a, 4], blocks[n, a, 5] = s3, s4, s5


@kernel
def _add_common(
    first: int, last: int, J: Jacobians, index: BlockIndex, sums: ReducedSums, left: _Elimination
) -> None:
    """Add border, corner and right-hand side of the common columns."""
    # Those of one point side by side are E (2m, n). With p = B~' E the point's own step leaves T = E - B~ p
    # of them, and E' T = E'E - p'p.
    most, C = 1, J.A.shape[2]
    for j in range(first, last):
        most = max(most, index.start[j + 1] - index.start[j])
    wide = min(len(sums.corner), most * index.common.shape[1])
    E, T, p = empty((most, 2, wide)), empty((2, wide)), empty((3, wide))
    column, slot = empty(wide, np.int64), full(len(sums.corner), -1, np.int64)
    edge = C * sums.border.shape[0]
    ends = (sums.corner, sums.rhs[edge:], sums.diagonal[edge:], sums.gradient[edge:])
    for j in range(first, last):
        s, e = index.start[j], index.start[j + 1]
        n = _gather_common(s, e, J.E, index.view_index, index.common, E, column, slot)
        p[:, :n] = 0.0
        for i in range(e - s):
            for x in range(2):
                b = left.Bt[s + i - left.first, x]
                for c in range(n):
                    p[0, c] += b[0] * E[i, x, c]
                    p[1, c] += b[1] * E[i, x, c]
                    p[2, c] += b[2] * E[i, x, c]
        for i in range(e - s):
            v = index.block[index.view_index[s + i]]
            if v < 0:
                continue
            for x in range(2):
                b = left.Bt[s + i - left.first, x]
                for c in range(n):
                    T[x, c] = E[i, x, c] - b[0] * p[0, c] - b[1] * p[1, c] - b[2] * p[2, c]
            for a in range(C):
                a0, a1 = J.A[s + i, 0, a], J.A[s + i, 1, a]
                for c in range(n):
                    sums.border[v, a, column[c]] += a0 * T[0, c] + a1 * T[1, c]
        _add_corner(column[:n], E[: e - s], p, left.g[j - first], J.residual[s:e], ends)


@kernel
def _gather_common(
    s: int, e: int, J_E: F64, view_index: I64, common: I64, E: F64, column: I64, slot: I64
) -> int:
    """Collect the common columns of observations s..e in E (m, 2, n) and their border ``column``; return n.

    ``slot`` (border columns,) is -1 before and after.
    """
    F, n = common.shape[1], 0
    for k in range(s, e):
        for f in range(F):
            c = common[view_index[k], f]
            if c >= 0 and slot[c] < 0:
                slot[c] = n
                column[n] = c
                n += 1
    for k in range(s, e):
        for c in range(n):
            E[k - s, 0, c] = E[k - s, 1, c] = 0.0
        for f in range(F):
            c = common[view_index[k], f]
            if c >= 0:
                E[k - s, 0, slot[c]] += J_E[k, 0, f]
                E[k - s, 1, slot[c]] += J_E[k, 1, f]
    for c in range(n):
        slot[column[c]] = -1
    return n


@kernel
def _add_corner(column: I64, E: F64, p: F64, g: F64, residual: F64, ends: tuple[F64, F64, F64, F64]) -> None:
    """Add the common columns of one point to (corner, rhs, diagonal, gradient) of the border."""
    corner, rhs, diagonal, gradient = ends
    n = len(column)
    for c in range(n):
        r = squared = 0.0
        for i in range(len(E)):
            r += E[i, 0, c] * residual[i, 0] + E[i, 1, c] * residual[i, 1]
            squared += E[i, 0, c] * E[i, 0, c] + E[i, 1, c] * E[i, 1, c]
        gradient[column[c]] += r
        rhs[column[c]] -= r - p[0, c] * g[0] - p[1, c] * g[1] - p[2, c] * g[2]
        diagonal[column[c]] += squared
        for d in range(c, n):
            total = -p[0, c] * p[0, d] - p[1, c] * p[1, d] - p[2, c] * p[2, d]
            for i in range(len(E)):
                total += E[i, 0, c] * E[i, 0, d] + E[i, 1, c] * E[i, 1, d]
            corner[column[c], column[d]] += total
            if d > c:
                corner[column[d], column[c]] += total


@kernel
def substitute_points(
    first: int, last: int, camera_step: F64, J: Jacobians, index: BlockIndex, points: PointSums, step: F64,
    product: F64,
) -> None:  # fmt: skip
    """Compute the steps -V^-1 (h + B' J step) of points for a camera step.

    If h = 0, ``product`` (D,) grows by that of the camera step with the reduced matrix, unless it is empty.
    """
    C, F = J.A.shape[2], index.common.shape[1]
    border = (len(index.row) - 1) * C
    most = 1
    for j in range(first, last):
        most = max(most, index.start[j + 1] - index.start[j])
    moved = empty((most, 2))
    for j in range(first, last):
        h, s = points.gradient[j], index.start[j]
        t0, t1, t2 = h[0], h[1], h[2]
        for k in range(s, index.start[j + 1]):
            e0 = e1 = 0.0
            view = index.view_index[k]
            v = index.block[view] * C
            if v >= 0:
                for c in range(C):
                    e0 += J.A[k, 0, c] * camera_step[v + c]
                    e1 += J.A[k, 1, c] * camera_step[v + c]
            for f in range(F):
                column = index.common[view, f]
                if column >= 0:
                    e0 += J.E[k, 0, f] * camera_step[border + column]
                    e1 += J.E[k, 1, f] * camera_step[border + column]
            moved[k - s, 0], moved[k - s, 1] = e0, e1
            t0 += J.B[k, 0, 0] * e0 + J.B[k, 1, 0] * e1
            t1 += J.B[k, 0, 1] * e0 + J.B[k, 1, 1] * e1
            t2 += J.B[k, 0, 2] * e0 + J.B[k, 1, 2] * e1
        V = points.inverse[j]
        for a in range(3):
            step[j, a] = -(V[a, 0] * t0 + V[a, 1] * t1 + V[a, 2] * t2)
        if len(product) == 0:
            continue
        p0, p1, p2 = step[j, 0], step[j, 1], step[j, 2]
        for k in range(s, index.start[j + 1]):
            e0 = moved[k - s, 0] + J.B[k, 0, 0] * p0 + J.B[k, 0, 1] * p1 + J.B[k, 0, 2] * p2
            e1 = moved[k - s, 1] + J.B[k, 1, 0] * p0 + J.B[k, 1, 1] * p1 + J.B[k, 1, 2] * p2
            view = index.view_index[k]
            v = index.block[view] * C
            if v >= 0:
                for c in range(C):
                    product[v + c] += J.A[k, 0, c] * e0 + J.A[k, 1, c] * e1
            for f in range(F):
                column = index.common[view, f]
                if column >= 0:
                    product[border + column] += J.E[k, 0, f] * e0 + J.E[k, 1, f] * e1


@kernel
def revert_crossing_points(
    start: I64, view_index: I64, row_before: F64, row_after: F64, X_before: F64, X_after: F64
) -> None:
    """Undo the steps of points (N, 3) or (N, 4) that cross the focal plane of a view that observes them."""
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
                copy_to(X_after[j], X_before[j])
                break

"""Compiled kernels of bundle adjustment: linearisation, elimination of the points, back substitution.

Observations are sorted by point; ``start`` (N + 1,) says where each point's begin. A residual's Jacobian has
three parts: columns of its view (``A``, (K, 2, C)), columns that a group of views shares (``G``, (K, 2, F), F
may be 0) and three of its point (``B``, (K, 2, 3)). ``view_column`` and ``group_column`` (K,) are the first
columns of these blocks in the reduced system, -1 for a view held fixed. Residuals and Jacobians leave the
linearisation multiplied by sqrt(rho').
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

TINY = 1e-12


@njit(cache=True, nogil=True, inline="always")
def loss_value(code: int, s: float, delta: float) -> float:
    """rho(s) of the losses of losses.py, numbered in its order."""
    d2 = delta * delta
    if code == 1:
        return s if s <= d2 else 2.0 * delta * math.sqrt(s) - d2
    if code == 2:
        return 2.0 * d2 * (math.sqrt(1.0 + s / d2) - 1.0)
    if code == 3:
        return d2 * math.log1p(s / d2)
    if code == 4:
        return min(s, d2)
    return s


@njit(cache=True, nogil=True, inline="always")
def loss_weight(code: int, s: float, delta: float) -> float:
    """rho'(s)."""
    d2 = delta * delta
    if code == 1:
        return 1.0 if s <= d2 else delta / math.sqrt(s)
    if code == 2:
        return 1.0 / math.sqrt(1.0 + s / d2)
    if code == 3:
        return 1.0 / (1.0 + s / d2)
    if code == 4:
        return 1.0 if s <= d2 else 0.0
    return 1.0


@njit(cache=True, nogil=True, inline="always")
def away_from_zero(w: float) -> float:
    """w, moved off 0: a point in the focal plane gets a huge residual instead of a division by zero."""
    if w >= 0.0:
        return max(w, TINY)
    return min(w, -TINY)


@njit(cache=True, nogil=True)
def project_projective(
    P: F64, X: F64, view_index: I64, point_index: I64, xy: F64, residual: F64, depth: F64
) -> None:
    """Fill residual (K, 2) = projection - xy and depth (K,) = third row of P X; P (V, 3, 4), X (N, 4)."""
    for k in range(len(xy)):
        p, x = P[view_index[k]], X[point_index[k]]
        z0 = p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]
        z1 = p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]
        z2 = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3]
        w = away_from_zero(z2)
        depth[k] = z2
        residual[k, 0] = z0 / w - xy[k, 0]
        residual[k, 1] = z1 / w - xy[k, 1]


@njit(cache=True, nogil=True)
def project_metric(
    R: F64,
    t: F64,
    intrinsics: F64,
    group: I64,
    X: F64,
    view_index: I64,
    point_index: I64,
    xy: F64,
    residual: F64,
    depth: F64,
) -> None:
    """Fill residual (K, 2) px and depth (K,); R (V, 3, 3), t (V, 3), intrinsics (G, 6) or (G, 8), group (V,),
    X (N, 3)."""
    lens = intrinsics.shape[1] > 6
    for k in range(len(xy)):
        v, x = view_index[k], X[point_index[k]]
        r, q = R[v], intrinsics[group[v]]
        x0 = r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 2] * x[2] + t[v, 0]
        x1 = r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + t[v, 1]
        x2 = r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + t[v, 2]
        w = away_from_zero(x2)
        a, b = x0 / w, x1 / w
        r2 = a * a + b * b
        d = 1.0 + q[5] * r2
        if lens:
            d += (q[6] + q[7] * r2) * r2 * r2
        depth[k] = x2
        residual[k, 0] = q[0] * a * d + q[2] * b * d + q[3] - xy[k, 0]
        residual[k, 1] = q[0] * q[1] * b * d + q[4] - xy[k, 1]


@njit(cache=True, nogil=True)
def robust_cost(residual: F64, code: int, delta: float) -> float:
    """1/2 sum rho(|r_k|^2)."""
    total = 0.0
    for k in range(len(residual)):
        s = residual[k, 0] * residual[k, 0] + residual[k, 1] * residual[k, 1]
        total += loss_value(code, s, delta)
    return 0.5 * total


@njit(cache=True, nogil=True)
def tangent_reflectors(p: F64, v: F64, beta: F64) -> None:
    """Householder vectors (n, d) and factors (n,) that take unit rows p to -+e0: columns 1.. span p's tangent
    space."""
    for i in range(p.shape[0]):
        for c in range(p.shape[1]):
            v[i, c] = p[i, c]
        v[i, 0] += 1.0 if p[i, 0] >= 0.0 else -1.0
        norm = 0.0
        for c in range(p.shape[1]):
            norm += v[i, c] * v[i, c]
        beta[i] = 2.0 / norm if norm > 0.0 else 0.0


@njit(cache=True, nogil=True)
def tangent_step(p: F64, v: F64, beta: F64, step: F64, out: F64) -> None:
    """Unit rows moved along their tangent space: normalise(p + H[:, 1:] step); signs are kept."""
    d = p.shape[1]
    for i in range(p.shape[0]):
        along = 0.0
        for c in range(1, d):
            along += v[i, c] * step[i, c - 1]
        norm = 0.0
        for c in range(d):
            moved = p[i, c] - beta[i] * along * v[i, c]
            if c > 0:
                moved += step[i, c - 1]
            out[i, c] = moved
            norm += moved * moved
        norm = np.sqrt(norm)
        for c in range(d):
            out[i, c] /= norm if norm > 0.0 else 1.0


@njit(cache=True, nogil=True)
def linearize_projective(
    P: F64,
    vP: F64,
    bP: F64,
    X: F64,
    vX: F64,
    bX: F64,
    view_index: I64,
    point_index: I64,
    xy: F64,
    code: int,
    delta: float,
    residual: F64,
    A: F64,
    B: F64,
) -> float:
    """Weighted residuals (K, 2), A (K, 2, 11), B (K, 2, 3) in the tangent spaces of unit P (V, 12) and X (N,
    4).

    With u = P X: d pi = (1 / u2) [[1, 0, -x], [0, 1, -y]] du (methods 6.7). Returns the cost.
    """
    cost = 0.0
    for k in range(len(xy)):
        i, j = view_index[k], point_index[k]
        p, x, v, y = P[i], X[j], vP[i], vX[j]
        u0 = p[0] * x[0] + p[1] * x[1] + p[2] * x[2] + p[3] * x[3]
        u1 = p[4] * x[0] + p[5] * x[1] + p[6] * x[2] + p[7] * x[3]
        w = away_from_zero(p[8] * x[0] + p[9] * x[1] + p[10] * x[2] + p[11] * x[3])
        a, b = u0 / w, u1 / w
        r0, r1 = a - xy[k, 0], b - xy[k, 1]
        s = r0 * r0 + r1 * r1
        cost += loss_value(code, s, delta)
        root = np.sqrt(loss_weight(code, s, delta))
        residual[k, 0], residual[k, 1] = root * r0, root * r1
        f = root / w
        e0 = x[0] * v[0] + x[1] * v[1] + x[2] * v[2] + x[3] * v[3]
        e1 = x[0] * v[4] + x[1] * v[5] + x[2] * v[6] + x[3] * v[7]
        e2 = x[0] * v[8] + x[1] * v[9] + x[2] * v[10] + x[3] * v[11]
        c0, c1 = bP[i] * f * (e0 - a * e2), bP[i] * f * (e1 - b * e2)
        for c in range(1, 12):
            A[k, 0, c - 1] = -c0 * v[c]
            A[k, 1, c - 1] = -c1 * v[c]
        for c in range(4):
            fx = f * x[c]
            if c > 0:
                A[k, 0, c - 1] += fx
            A[k, 1, 3 + c] += fx
            A[k, 0, 7 + c] -= a * fx
            A[k, 1, 7 + c] -= b * fx
        d0 = d1 = 0.0
        for c in range(4):
            d0 += f * (p[c] - a * p[8 + c]) * y[c]
            d1 += f * (p[4 + c] - b * p[8 + c]) * y[c]
        for c in range(1, 4):
            B[k, 0, c - 1] = f * (p[c] - a * p[8 + c]) - bX[j] * d0 * y[c]
            B[k, 1, c - 1] = f * (p[4 + c] - b * p[8 + c]) - bX[j] * d1 * y[c]
    return 0.5 * cost


@njit(cache=True, nogil=True)
def linearize_metric(
    R: F64,
    t: F64,
    intrinsics: F64,
    group: I64,
    X: F64,
    view_index: I64,
    point_index: I64,
    xy: F64,
    free: I64,
    sigma: float,
    code: int,
    delta: float,
    residual: F64,
    A: F64,
    G: F64,
    B: F64,
) -> float:
    """Weighted residuals (K, 2) in units of sigma, A (K, 2, 6), G (K, 2, F), B (K, 2, 3) of calibrated
    cameras.

    A pose moves by x -> exp(w) x + d in the camera's frame, columns (w, d); the focal column is that of log
    f; ``free`` lists the F free columns of (log f, aspect, skew, cx, cy, k1, k2, k3), of which intrinsics may
    lack the last two. Returns the cost.
    """
    cost = 0.0
    lens = intrinsics.shape[1] > 6
    D = np.empty((2, 8))
    for k in range(len(xy)):
        v, x = view_index[k], X[point_index[k]]
        r, q = R[v], intrinsics[group[v]]
        x0 = r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 2] * x[2] + t[v, 0]
        x1 = r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + t[v, 1]
        w = away_from_zero(r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + t[v, 2])
        a, b = x0 / w, x1 / w
        f, g, skew, k1 = q[0], q[0] * q[1], q[2], q[5]
        r2 = a * a + b * b
        # The slope of d over r^2, which is k1 where there is no more than k1.
        d, slope = 1.0 + k1 * r2, k1
        if lens:
            d += (q[6] + q[7] * r2) * r2 * r2
            slope += (2.0 * q[6] + 3.0 * q[7] * r2) * r2
        e0 = (f * a * d + skew * b * d + q[3] - xy[k, 0]) / sigma
        e1 = (g * b * d + q[4] - xy[k, 1]) / sigma
        s = e0 * e0 + e1 * e1
        cost += loss_value(code, s, delta)
        root = np.sqrt(loss_weight(code, s, delta))
        residual[k, 0], residual[k, 1] = root * e0, root * e1
        root /= sigma
        D[0, 0], D[1, 0] = f * a * d, g * b * d
        D[0, 1], D[1, 1] = 0.0, f * b * d
        D[0, 2], D[1, 2] = b * d, 0.0
        D[0, 3], D[1, 3] = 1.0, 0.0
        D[0, 4], D[1, 4] = 0.0, 1.0
        D[0, 5], D[1, 5] = (f * a + skew * b) * r2, g * b * r2
        D[0, 6], D[1, 6] = D[0, 5] * r2, D[1, 5] * r2
        D[0, 7], D[1, 7] = D[0, 6] * r2, D[1, 6] * r2
        for c in range(len(free)):
            G[k, 0, c] = root * D[0, free[c]]
            G[k, 1, c] = root * D[1, free[c]]
        # d(a d, b d) / d(a, b), then d(pixel) / d(a, b), then the chain through the division by depth.
        m00, m01, m11 = d + 2.0 * slope * a * a, 2.0 * slope * a * b, d + 2.0 * slope * b * b
        n00, n01 = f * m00 + skew * m01, f * m01 + skew * m11
        n10, n11 = g * m01, g * m11
        h = root / w
        j00, j01, j02 = h * n00, h * n01, -h * (n00 * a + n01 * b)
        j10, j11, j12 = h * n10, h * n11, -h * (n10 * a + n11 * b)
        A[k, 0, 0], A[k, 0, 1], A[k, 0, 2] = j02 * x1 - j01 * w, j00 * w - j02 * x0, j01 * x0 - j00 * x1
        A[k, 1, 0], A[k, 1, 1], A[k, 1, 2] = j12 * x1 - j11 * w, j10 * w - j12 * x0, j11 * x0 - j10 * x1
        A[k, 0, 3], A[k, 0, 4], A[k, 0, 5] = j00, j01, j02
        A[k, 1, 3], A[k, 1, 4], A[k, 1, 5] = j10, j11, j12
        for c in range(3):
            B[k, 0, c] = j00 * r[0, c] + j01 * r[1, c] + j02 * r[2, c]
            B[k, 1, c] = j10 * r[0, c] + j11 * r[1, c] + j12 * r[2, c]
    return 0.5 * cost


@njit(cache=True, nogil=True)
def add_normal_blocks(
    start: I64,
    view_column: I64,
    group_column: I64,
    A: F64,
    G: F64,
    B: F64,
    residual: F64,
    H: F64,
    g: F64,
    V: F64,
    h: F64,
) -> None:
    """Add J'J and J'r: H (D, D) upper triangle and g (D,) of the cameras, V (N, 3, 3) and h (N, 3) of the
    points."""
    C, F = A.shape[2], G.shape[2]
    for j in range(len(start) - 1):
        for k in range(start[j], start[j + 1]):
            r0, r1 = residual[k, 0], residual[k, 1]
            for a in range(3):
                h[j, a] += B[k, 0, a] * r0 + B[k, 1, a] * r1
                for b in range(3):
                    V[j, a, b] += B[k, 0, a] * B[k, 0, b] + B[k, 1, a] * B[k, 1, b]
            v, q = view_column[k], group_column[k]
            if v >= 0:
                for a in range(C):
                    a0, a1 = A[k, 0, a], A[k, 1, a]
                    g[v + a] += a0 * r0 + a1 * r1
                    row = H[v + a]
                    for b in range(C):
                        row[v + b] += a0 * A[k, 0, b] + a1 * A[k, 1, b]
                    for b in range(F):
                        row[q + b] += a0 * G[k, 0, b] + a1 * G[k, 1, b]
            for a in range(F):
                a0, a1 = G[k, 0, a], G[k, 1, a]
                g[q + a] += a0 * r0 + a1 * r1
                for b in range(F):
                    H[q + a, q + b] += a0 * G[k, 0, b] + a1 * G[k, 1, b]


@njit(cache=True, nogil=True)
def invert_positive_3x3(M: F64, out: F64) -> bool:
    """Inverse of a symmetric (3, 3) by Cholesky; zeros (and False) where a pivot is not positive."""
    out[:] = 0.0
    if not M[0, 0] > 0.0:
        return False
    l00 = np.sqrt(M[0, 0])
    l10, l20 = M[1, 0] / l00, M[2, 0] / l00
    p1 = M[1, 1] - l10 * l10
    if not p1 > 0.0:
        return False
    l11 = np.sqrt(p1)
    l21 = (M[2, 1] - l20 * l10) / l11
    p2 = M[2, 2] - l20 * l20 - l21 * l21
    if not p2 > 0.0:
        return False
    l22 = np.sqrt(p2)
    i00, i11, i22 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    i20 = -(l20 * i00 + l21 * i10) * i22
    out[0, 0] = i00 * i00 + i10 * i10 + i20 * i20
    out[1, 1] = i11 * i11 + i21 * i21
    out[2, 2] = i22 * i22
    out[0, 1] = out[1, 0] = i10 * i11 + i20 * i21
    out[0, 2] = out[2, 0] = i20 * i22
    out[1, 2] = out[2, 1] = i21 * i22
    return True


@njit(cache=True, nogil=True)
def gather_coupling(
    first: int,
    last: int,
    view_column: I64,
    group_column: I64,
    A: F64,
    G: F64,
    B: F64,
    column: I64,
    width: I64,
    W: F64,
) -> int:
    """One point's W' (3, total width) and its blocks (column, width): one per view and one per group it is
    seen by.

    Returns the number of blocks. Views that see the point twice and groups of several views are merged.
    """
    blocks, place = 0, 0
    for part in range(2):
        J = A if part == 0 else G
        columns = view_column if part == 0 else group_column
        size = J.shape[2]
        if size == 0:
            continue
        opened, opened_place = blocks, place
        for k in range(first, last):
            if columns[k] < 0:
                continue
            n, at = opened, opened_place
            while n < blocks and column[n] != columns[k]:
                n += 1
                at += size
            if n == blocks:
                column[n], width[n] = columns[k], size
                blocks += 1
                place += size
                for a in range(3):
                    for c in range(size):
                        W[a, at + c] = 0.0
            for a in range(3):
                b0, b1 = B[k, 0, a], B[k, 1, a]
                for c in range(size):
                    W[a, at + c] += b0 * J[k, 0, c] + b1 * J[k, 1, c]
    return blocks


@njit(cache=True, nogil=True)
def eliminate_points(
    start: I64,
    view_column: I64,
    group_column: I64,
    A: F64,
    G: F64,
    B: F64,
    V: F64,
    h: F64,
    damping: float,
    S: F64,
    rhs: F64,
    Vi: F64,
) -> None:
    """Subtract the points from the damped camera system: S -= W V^-1 W' (upper triangle), rhs += W V^-1 h.

    The diagonal of V (N, 3, 3) is multiplied by 1 + damping; Vi (N, 3, 3) gets the inverses, zeros for points
    that the data do not hold (they stay where they are).
    """
    most = 1
    for j in range(len(start) - 1):
        most = max(most, start[j + 1] - start[j])
    W = np.empty((3, most * (A.shape[2] + G.shape[2])))
    Y = np.empty_like(W)
    column, width = np.empty(2 * most, np.int64), np.empty(2 * most, np.int64)
    M = np.empty((3, 3))
    for j in range(len(start) - 1):
        if start[j + 1] == start[j]:
            continue
        for a in range(3):
            for b in range(3):
                M[a, b] = V[j, a, b]
            M[a, a] *= 1.0 + damping
        if not invert_positive_3x3(M, Vi[j]):
            continue
        blocks = gather_coupling(start[j], start[j + 1], view_column, group_column, A, G, B, column, width, W)
        total = 0
        for n in range(blocks):
            total += width[n]
        for a in range(3):
            m0, m1, m2 = Vi[j, a, 0], Vi[j, a, 1], Vi[j, a, 2]
            for c in range(total):
                Y[a, c] = m0 * W[0, c] + m1 * W[1, c] + m2 * W[2, c]
        h0, h1, h2 = h[j, 0], h[j, 1], h[j, 2]
        at = 0
        for n in range(blocks):
            other = at
            for c in range(width[n]):
                rhs[column[n] + c] += Y[0, at + c] * h0 + Y[1, at + c] * h1 + Y[2, at + c] * h2
            for m in range(n, blocks):
                subtract_block(S, W, Y, at, other, column[n], column[m], width[n], width[m])
                other += width[m]
            at += width[n]


@njit(cache=True, nogil=True, inline="always")
def subtract_block(
    S: F64, W: F64, Y: F64, at: int, other: int, row: int, col: int, rows: int, cols: int
) -> None:
    """S[row.., col..] -= W[:, at..]' Y[:, other..], in the upper triangle."""
    if row > col:
        row, col, rows, cols, at, other = col, row, cols, rows, other, at
    for a in range(rows):
        w0, w1, w2 = W[0, at + a], W[1, at + a], W[2, at + a]
        target = S[row + a]
        for b in range(cols):
            target[col + b] -= w0 * Y[0, other + b] + w1 * Y[1, other + b] + w2 * Y[2, other + b]


@njit(cache=True, nogil=True)
def substitute_points(
    start: I64,
    view_column: I64,
    group_column: I64,
    A: F64,
    G: F64,
    B: F64,
    Vi: F64,
    h: F64,
    camera_step: F64,
    point_step: F64,
) -> None:
    """Steps of the points (N, 3) for a step of the cameras (D,): -V^-1 (h + W' step)."""
    C, F = A.shape[2], G.shape[2]
    for j in range(len(start) - 1):
        t0, t1, t2 = h[j, 0], h[j, 1], h[j, 2]
        for k in range(start[j], start[j + 1]):
            e0 = e1 = 0.0
            v, q = view_column[k], group_column[k]
            if v >= 0:
                for c in range(C):
                    e0 += A[k, 0, c] * camera_step[v + c]
                    e1 += A[k, 1, c] * camera_step[v + c]
            for c in range(F):
                e0 += G[k, 0, c] * camera_step[q + c]
                e1 += G[k, 1, c] * camera_step[q + c]
            t0 += B[k, 0, 0] * e0 + B[k, 1, 0] * e1
            t1 += B[k, 0, 1] * e0 + B[k, 1, 1] * e1
            t2 += B[k, 0, 2] * e0 + B[k, 1, 2] * e1
        for a in range(3):
            point_step[j, a] = -(Vi[j, a, 0] * t0 + Vi[j, a, 1] * t1 + Vi[j, a, 2] * t2)


@njit(cache=True, nogil=True)
def hold_flipping_points(
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
def point_cost(
    P: F64, x: F64, first: int, last: int, view_index: I64, xy: F64, code: int, delta: float
) -> tuple[float, int]:
    """1/2 sum rho of one point's observations first..last, and how many of them lie behind their camera."""
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
    P: F64,
    x: F64,
    v: F64,
    beta: float,
    first: int,
    last: int,
    view_index: I64,
    xy: F64,
    code: int,
    delta: float,
    H: F64,
    g: F64,
) -> None:
    """Fill J'J (3, 3) and J'r (3,) of one unit point in its tangent space (Householder vector v, factor
    beta)."""
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
        cost, behind = point_cost(P, x[0], first, last, view_index, xy, code, delta)
        damping = 1e-4
        fresh = True
        for _ in range(iterations):
            if fresh:
                tangent_reflectors(x, v, beta)
                linearize_point(P, x[0], v[0], beta[0], first, last, view_index, xy, code, delta, H, g)
            for m in range(3):
                for n in range(3):
                    M[m, n] = H[m, n]
                M[m, m] *= 1.0 + damping
            if not invert_positive_3x3(M, Mi):
                break
            for m in range(3):
                step[0, m] = -(Mi[m, 0] * g[0] + Mi[m, 1] * g[1] + Mi[m, 2] * g[2])
            tangent_step(x, v, beta, step, moved)
            candidate, flipped = point_cost(P, moved[0], first, last, view_index, xy, code, delta)
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

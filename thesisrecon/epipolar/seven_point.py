"""Seven-point samples by the dozen, in the projective basis of four of the seven matches.

With points 1-4 of each image at (1, 0, 0), (0, 1, 0), (0, 0, 1) and (1, 1, 1), F has a zero diagonal and
entries that sum to zero: six unknowns, of which the other three matches leave a pencil of two, by minors. Its
determinant, F12 F23 F31 + F13 F21 F32, is a cubic whose coefficients are products. Nothing needs pivots, so
one loop without branches treats the samples side by side (one a lane) in vector instructions, four times
faster than one after the other. Made for the thousands of samples of a search, which may lose a sample that
is nearly degenerate; :func:`thesisrecon.epipolar.search.seven_point` stays exact there.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64

Nine = tuple[float, float, float, float, float, float, float, float, float]
Three = tuple[float, float, float]

LANES = 32
TO_BASIS_1, TO_BASIS_2, FIRST, SECOND, ROWS = 0, 9, 39, 45, 54
"""Rows of a solved batch: from 0 and 9 the two transforms (9 each), from 18 the orientation of the first
three matches, from 21 and 30 the last three points of either image (9 each), from 39 and 45 the two members
(6 each) that span the pencil, from 51 the three coefficients of the monic cubic."""


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def basis_transform(
    xa: float, ya: float, xb: float, yb: float, xc: float, yc: float, xd: float, yd: float
) -> Nine:
    """Rows of the T (3, 3) that takes four points to the projective basis; not finite for three on a line."""
    a0, a1, a2 = yb - yc, xc - xb, xb * yc - yb * xc
    b0, b1, b2 = yc - ya, xa - xc, xc * ya - yc * xa
    c0, c1, c2 = ya - yb, xb - xa, xa * yb - ya * xb
    a = 1.0 / (a0 * xd + a1 * yd + a2)
    b = 1.0 / (b0 * xd + b1 * yd + b2)
    c = 1.0 / (c0 * xd + c1 * yd + c2)
    return a * a0, a * a1, a * a2, b * b0, b * b1, b * b2, c * c0, c * c1, c * c2


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def apply_transform(T: Nine, x: float, y: float) -> Three:
    """T (x, y, 1)'."""
    return T[0] * x + T[1] * y + T[2], T[3] * x + T[4] * y + T[5], T[6] * x + T[7] * y + T[8]


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def basis_equation(u: Three, v: Three) -> tuple[float, float, float, float, float]:
    """Coefficients of F13, F21, F23, F31, F32 in v' F u = 0, F12 being minus their sum."""
    first = v[0] * u[1]
    return (
        v[0] * u[2] - first,
        v[1] * u[0] - first,
        v[1] * u[2] - first,
        v[2] * u[0] - first,
        v[2] * u[1] - first,
    )


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def triple(a: Three, b: Three, c: Three) -> float:
    """The determinant with columns a, b, c."""
    value: float = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    return value


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def solve_batch(X: F64, Y: F64) -> None:
    """Pencils and cubics of LANES samples: ``X`` (28, LANES) holds x1, y1, x2, y2 of seven matches.

    ``Y`` (ROWS, LANES) is laid out as said above. Lanes of degenerate samples get numbers that are not finite
    or a cubic of no meaning.
    """
    for k in range(LANES):
        S = basis_transform(X[0, k], X[1, k], X[4, k], X[5, k], X[8, k], X[9, k], X[12, k], X[13, k])
        T = basis_transform(X[2, k], X[3, k], X[6, k], X[7, k], X[10, k], X[11, k], X[14, k], X[15, k])
        # T x_i is a positive or negative multiple of the basis vector e_i: the products over both images.
        side0 = (S[0] * X[0, k] + S[1] * X[1, k] + S[2]) * (T[0] * X[2, k] + T[1] * X[3, k] + T[2])
        side1 = (S[3] * X[4, k] + S[4] * X[5, k] + S[5]) * (T[3] * X[6, k] + T[4] * X[7, k] + T[5])
        side2 = (S[6] * X[8, k] + S[7] * X[9, k] + S[8]) * (T[6] * X[10, k] + T[7] * X[11, k] + T[8])
        u, v = apply_transform(S, X[16, k], X[17, k]), apply_transform(T, X[18, k], X[19, k])
        r, s = apply_transform(S, X[20, k], X[21, k]), apply_transform(T, X[22, k], X[23, k])
        w, z = apply_transform(S, X[24, k], X[25, k]), apply_transform(T, X[26, k], X[27, k])
        A, B, C = basis_equation(u, v), basis_equation(r, s), basis_equation(w, z)
        c0, c1, c2 = (A[0], B[0], C[0]), (A[1], B[1], C[1]), (A[2], B[2], C[2])
        c3, c4 = (A[3], B[3], C[3]), (A[4], B[4], C[4])
        lead = triple(c0, c1, c2)
        p1, p2, p3, p4 = -triple(c3, c1, c2), -triple(c0, c3, c2), -triple(c0, c1, c3), lead
        q1, q2, q3, q5 = -triple(c4, c1, c2), -triple(c0, c4, c2), -triple(c0, c1, c4), lead
        p0, q0 = -(p1 + p2 + p3 + p4), -(q1 + q2 + q3 + q5)
        # det(t p + q), with p5 = q4 = 0.
        m3 = p0 * p3 * p4
        m2 = q0 * p3 * p4 + p0 * q3 * p4 + p1 * p2 * q5
        m1 = q0 * q3 * p4 + q1 * p2 * q5 + p1 * q2 * q5
        m0 = q1 * q2 * q5
        inverse = 1.0 / m3
        for m in range(9):
            Y[TO_BASIS_1 + m, k] = S[m]
            Y[TO_BASIS_2 + m, k] = T[m]
        Y[18, k], Y[19, k], Y[20, k] = side0, side1, side2
        Y[21, k], Y[22, k], Y[23, k], Y[24, k], Y[25, k], Y[26, k] = u[0], u[1], u[2], r[0], r[1], r[2]
        Y[27, k], Y[28, k], Y[29, k], Y[30, k], Y[31, k], Y[32, k] = w[0], w[1], w[2], v[0], v[1], v[2]
        Y[33, k], Y[34, k], Y[35, k], Y[36, k], Y[37, k], Y[38, k] = s[0], s[1], s[2], z[0], z[1], z[2]
        Y[39, k], Y[40, k], Y[41, k], Y[42, k], Y[43, k], Y[44, k] = p0, p1, p2, p3, p4, 0.0
        Y[45, k], Y[46, k], Y[47, k], Y[48, k], Y[49, k], Y[50, k] = q0, q1, q2, q3, 0.0, q5
        Y[51, k], Y[52, k], Y[53, k] = m2 * inverse, m1 * inverse, m0 * inverse


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def newton_cubic_roots(a: float, b: float, c: float, roots: F64) -> int:
    """Real roots of x^3 + a x^2 + b x + c: one by Newton from outside, the others of the quadratic left.

    From beyond the turning point on the side of the root the iteration is monotone. A double root may be
    missed, or found as two that are near; 0 roots where a coefficient is not finite.
    """
    centre = -a / 3.0
    Q = (a * a - 3.0 * b) / 9.0
    value = ((centre + a) * centre + b) * centre + c
    if not abs(value) < np.inf:
        return 0
    reach = 2.0 * np.sqrt(Q) if Q > 0.0 else np.cbrt(abs(value))
    x = centre - reach if value > 0.0 else centre + reach
    for _ in range(40):
        slope = (3.0 * x + 2.0 * a) * x + b
        change = (((x + a) * x + b) * x + c) / slope if slope != 0.0 else 0.0
        x -= change
        if not abs(change) > 1e-13 * (1.0 + abs(x)):
            break
    roots[0] = x
    p = a + x
    q = b + p * x
    gap = p * p - 4.0 * q
    if not gap > 0.0:
        return 1
    large = -0.5 * (p + np.sqrt(gap)) if p > 0.0 else -0.5 * (p - np.sqrt(gap))
    roots[1] = large
    roots[2] = q / large if large != 0.0 else 0.0
    return 3


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def oriented_in_basis(g: F64, Y: F64, lane: int) -> bool:
    """Whether all seven matches of a lane can be in front of both cameras of the member ``g`` (6,).

    The oriented epipolar constraint (Chum, Werner and Matas, ICPR 2004): e2 x x2 and F x1, parallel for an
    exact match, agree in direction for all or for none.
    """
    g01, g02, g10, g12, g20, g21 = g
    # e2 is at right angles to the columns (0, g10, g20), (g01, 0, g21) and (g02, g12, 0).
    e0, e1, e2 = g10 * g21, g20 * g01, -g10 * g01
    first = Y[18, lane] * (e2 * g10 - e1 * g20)
    if first * Y[19, lane] * (e0 * g21 - e2 * g01) < 0.0:
        return False
    if first * Y[20, lane] * (e1 * g02 - e0 * g12) < 0.0:
        return False
    fourth = (e1 - e2) * (g01 + g02) + (e2 - e0) * (g10 + g12) + (e0 - e1) * (g20 + g21)
    if first * fourth < 0.0:
        return False
    for m in range(3):
        u0, u1, u2 = Y[21 + 3 * m, lane], Y[22 + 3 * m, lane], Y[23 + 3 * m, lane]
        v0, v1, v2 = Y[30 + 3 * m, lane], Y[31 + 3 * m, lane], Y[32 + 3 * m, lane]
        dot = (e1 * v2 - e2 * v1) * (g01 * u1 + g02 * u2)
        dot += (e2 * v0 - e0 * v2) * (g10 * u0 + g12 * u2) + (e0 * v1 - e1 * v0) * (g20 * u0 + g21 * u1)
        if first * dot < 0.0:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def leave_basis(g: F64, Y: F64, lane: int, f: F64) -> bool:
    """F = T2' G T1 as a unit vector ``f`` (9,), G of the entries ``g`` (6,); False where it is not finite."""
    norm = 0.0
    for j in range(3):
        s0, s1, s2 = Y[j, lane], Y[3 + j, lane], Y[6 + j, lane]
        r0, r1, r2 = g[0] * s1 + g[1] * s2, g[2] * s0 + g[3] * s2, g[4] * s0 + g[5] * s1
        for i in range(3):
            f[3 * i + j] = Y[9 + i, lane] * r0 + Y[12 + i, lane] * r1 + Y[15 + i, lane] * r2
            norm += f[3 * i + j] * f[3 * i + j]
    if not 0.0 < norm < np.inf:
        return False
    norm = 1.0 / np.sqrt(norm)
    for m in range(9):
        f[m] *= norm
    return True


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def lane_solutions(Y: F64, lane: int, work: F64, F: F64) -> int:
    """Fundamental matrices (``F`` (3, 9), unit norm) of one sample that keep its orientation; how many.

    ``work`` (9,) is overwritten.
    """
    roots, g, found = work[:3], work[3:], 0
    for k in range(newton_cubic_roots(Y[51, lane], Y[52, lane], Y[53, lane], roots)):
        for m in range(6):
            g[m] = roots[k] * Y[FIRST + m, lane] + Y[SECOND + m, lane]
        if oriented_in_basis(g, Y, lane) and leave_basis(g, Y, lane, F[found]):
            found += 1
    return found

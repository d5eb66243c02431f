"""module"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64, I64
from thesisrecon.epipolar.frame import SMALLEST_PX, PairFrame, as_matches, check_matches
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform
from thesisrecon.geometry.two_view import enforce_rank_two, unit_norm

UNDETERMINED_REL = 1e-12
"""Ratio of the eighth to the first singular value below which the matches leave F free."""


def estimate_eight_point(xy1: F64, xy2: F64, *, normalized: bool = True, rank_two: bool = True) -> F64:
    """F (3, 3), unit norm, that minimises the algebraic residuals (5.2) over matches (N >= 8, 2) px.

    ``normalized`` conditions the pixels first (Hartley, "In defence of the eight-point algorithm", PAMI
    1997); raw pixels, as the thesis has it, weight the entries of F unequally and are the worse the larger
    the image. ``rank_two`` moves to the nearest singular matrix (in the frame it was solved in), which the
    thesis' linear method does not.

    Raises ``ValueError`` for fewer than 8 matches, wrong shapes or coordinates that are not finite, and
    ``StageFailure`` where the matches leave F free (all on a line, or on a plane without noise).
    """
    xy1, xy2 = as_matches(xy1, xy2)
    if len(xy1) < 8:
        raise ValueError(f"the eight-point algorithm needs at least 8 matches; got {len(xy1)}")
    xy1, xy2 = check_matches(xy1, xy2, needed=8)
    T1 = normalizing_transform(xy1) if normalized else np.eye(3)
    T2 = normalizing_transform(xy2) if normalized else np.eye(3)
    x1, x2 = homogenize(xy1) @ T1.T, homogenize(xy2) @ T2.T
    A = (x2[:, :, None] * x1[:, None, :]).reshape(len(x1), 9)
    # The triangular factor has the singular values and right vectors of all rows, and nine rows.
    _, s, Vt = np.linalg.svd(np.linalg.qr(A, mode="r"))
    if not s[7] > UNDETERMINED_REL * s[0] * (1.0 if normalized else 1e-4):
        raise StageFailure(
            "the matches leave the fundamental matrix free",
            f"the equations of {len(xy1)} matches have rank below 8",
            "matches on one plane do that; some off the plane are needed",
        )
    F = Vt[8].reshape(3, 3)
    return unit_norm(T2.T @ (enforce_rank_two(F) if rank_two else F) @ T1)


def estimate_seven_point(xy1: F64, xy2: F64) -> F64:
    """The fundamental matrices through exactly seven matches (7, 2) px; (k, 3, 3), k = 0 to 3, unit norm.

    The pencil f1, f2 of solutions of (5.1) is searched for its singular members; all directions count, also
    F1 - F2, which alpha f1 + (1 - alpha) f2 of the thesis reaches only at infinity. Empty where the seven
    matches are degenerate (their equations dependent, or every member singular). Raises ``ValueError`` for
    other shapes or coordinates that are not finite.
    """
    xy1, xy2 = as_matches(xy1, xy2)
    if xy1.shape != (7, 2):
        raise ValueError(f"the seven-point algorithm needs two (7, 2) arrays; got {xy1.shape}, {xy2.shape}")
    if not min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) > SMALLEST_PX:
        return np.empty((0, 3, 3))
    frame = PairFrame.of(xy1, xy2)
    solutions = np.empty((3, 9))
    count = seven_point(frame.points(xy1, xy2), np.arange(7), solutions)
    return np.array([frame.matrix_in_pixels(f) for f in solutions[:count]]).reshape(count, 3, 3)


DIAGONAL = np.sqrt(0.5)


@njit(
    cache=True,
    nogil=True,
    inline="always",
    error_model="numpy",
    fastmath={"reassoc", "contract"},
    forceinline=True,
)
def reflect(v: F64, start: int, scale: float, x: F64) -> None:
    """x <- (I - scale v v') x, v zero before ``start``."""
    dot = 0.0
    for r in range(start, 9):
        dot += v[r] * x[r]
    dot *= scale
    for r in range(start, 9):
        x[r] -= dot * v[r]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def null_pencil(points: F64, sample: I64, pencil: F64) -> bool:
    """Two orthonormal vectors (``pencil`` (2, 9)) that span the null space of the seven equations (5.1).

    Householder QR of A' (9, 7): the last two columns of Q. False where the equations are dependent.
    """
    A = np.empty((7, 9))
    for k in range(7):
        x1, y1, x2, y2 = points[sample[k]]
        A[k, 0], A[k, 1], A[k, 2] = x2 * x1, x2 * y1, x2
        A[k, 3], A[k, 4], A[k, 5] = y2 * x1, y2 * y1, y2
        A[k, 6], A[k, 7], A[k, 8] = x1, y1, 1.0
    pencil[:] = 0.0
    pencil[0, 7] = pencil[1, 8] = 1.0
    scales = np.empty(7)
    for k in range(7):
        norm = 0.0
        for r in range(k, 9):
            norm += A[k, r] * A[k, r]
        norm = np.sqrt(norm)
        if norm < 1e-9:
            return False
        A[k, k] += norm if A[k, k] >= 0.0 else -norm
        scales[k] = 1.0 / (norm * abs(A[k, k]))
        for c in range(k + 1, 7):
            reflect(A[k], k, scales[k], A[c])
    for k in range(6, -1, -1):
        reflect(A[k], k, scales[k], pencil[0])
        reflect(A[k], k, scales[k], pencil[1])
    return True


@njit(cache=True, nogil=True)
def det3(f: F64) -> float:
    """Determinant of a 3x3 matrix given as a vector of 9."""
    value: float = (
        f[0] * (f[4] * f[8] - f[5] * f[7])
        - f[1] * (f[3] * f[8] - f[5] * f[6])
        + f[2] * (f[3] * f[7] - f[4] * f[6])
    )
    return value


@njit(cache=True, nogil=True)
def mixed_det3(f: F64, g: F64) -> float:
    """trace(adj(f) g): the coefficient of a in det(f + a g)."""
    value: float = (
        (f[4] * f[8] - f[5] * f[7]) * g[0]
        + (f[5] * f[6] - f[3] * f[8]) * g[1]
        + (f[3] * f[7] - f[4] * f[6]) * g[2]
        + (f[2] * f[7] - f[1] * f[8]) * g[3]
        + (f[0] * f[8] - f[2] * f[6]) * g[4]
        + (f[1] * f[6] - f[0] * f[7]) * g[5]
        + (f[1] * f[5] - f[2] * f[4]) * g[6]
        + (f[2] * f[3] - f[0] * f[5]) * g[7]
        + (f[0] * f[4] - f[1] * f[3]) * g[8]
    )
    return value


@njit(cache=True, nogil=True)
def monic_cubic_roots(a: float, b: float, c: float, roots: F64) -> int:
    """Real roots of x^3 + a x^2 + b x + c, a double root once; polished by Newton."""
    Q = (a * a - 3.0 * b) / 9.0
    R = (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0
    gap = R * R - Q * Q * Q
    # What the rounding of a, b and c leaves of R^2 - Q^3: within it a double root is a double root.
    small = 1e-12 * (R * R + abs(Q * Q * Q))
    small += 4e-15 * (Q * Q * (a * a + abs(b)) + abs(R) * (abs(a * a * a) + abs(a * b) + abs(c)))
    count = 1
    if gap < -small:
        theta = np.arccos(min(1.0, max(-1.0, R / np.sqrt(Q * Q * Q))))
        for k in range(3):
            roots[k] = -2.0 * np.sqrt(Q) * np.cos((theta + 2.0 * np.pi * (k - 1)) / 3.0) - a / 3.0
        count = 3
    else:
        A = -np.sign(R) * np.cbrt(abs(R) + np.sqrt(max(gap, 0.0)))
        B = Q / A if A != 0.0 else 0.0
        roots[0] = A + B - a / 3.0
        if gap <= small and A != 0.0:
            roots[1] = -0.5 * (A + B) - a / 3.0
            count = 2
    for k in range(count):
        for _ in range(2):
            x = roots[k]
            slope = (3.0 * x + 2.0 * a) * x + b
            value = ((x + a) * x + b) * x + c
            if abs(slope) > 1e-8 * (1.0 + x * x):
                roots[k] = x - value / slope
    return count


@njit(cache=True, nogil=True)
def singular_members(pencil: F64, F: F64) -> int:
    """Members of the pencil with determinant 0, unit norm, into ``F`` (3, 9); how many (0 to 3).

    det is a homogeneous cubic of the pencil's coordinates. It cannot vanish in four directions unless it
    vanishes everywhere, so the direction of the largest |det| of four is made the first basis vector: the
    leading coefficient is then never small and no solution is lost at infinity, as (5.2)'s affine combination
    loses one.
    """
    best, c, s = -1.0, 1.0, 0.0
    trial = np.empty(9)
    for k in range(4):
        ck = (1.0, 0.0, DIAGONAL, DIAGONAL)[k]
        sk = (0.0, 1.0, DIAGONAL, -DIAGONAL)[k]
        for m in range(9):
            trial[m] = ck * pencil[0, m] + sk * pencil[1, m]
        size = abs(det3(trial))
        if size > best:
            best, c, s = size, ck, sk
    if best < 1e-14:
        return 0
    first = c * pencil[0] + s * pencil[1]
    second = c * pencil[1] - s * pencil[0]
    lead = det3(first)
    roots = np.empty(3)
    count = monic_cubic_roots(
        mixed_det3(first, second) / lead, mixed_det3(second, first) / lead, det3(second) / lead, roots
    )
    for k in range(count):
        norm = np.sqrt(1.0 + roots[k] * roots[k])
        for m in range(9):
            F[k, m] = (roots[k] * first[m] + second[m]) / norm
    return count


@njit(cache=True, nogil=True)
def seven_point(points: F64, sample: I64, F: F64) -> int:
    """Fundamental matrices (``F`` (3, 9)) through seven matches; how many (0 where they are degenerate)."""
    pencil = np.empty((2, 9))
    if not null_pencil(points, sample, pencil):
        return 0
    return singular_members(pencil, F)


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

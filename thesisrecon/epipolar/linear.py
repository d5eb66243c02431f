"""Section 5.2: F from linear equations: the eight-point and the seven-point algorithm.

The seven-point algorithm exists twice. :func:`seven_point` solves one sample by a QR decomposition and is
also exact for nearly degenerate samples. :func:`solve_seven_point_batch` solves LANES samples at once in the
projective basis of four of the seven matches: there F has a zero diagonal and entries that sum to zero, and
three equations leave a pencil by minors without pivoting. Its loop has no branches, so it vectorises and is
four times faster; it may miss a double root, which random sampling tolerates.

Points are rows (x1, y1, x2, y2) in a common frame; F is a row-major vector of 9 in the kernels.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64, I64
from thesisrecon.epipolar.frame import MIN_PX, PairFrame, as_matches, check_matches
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform
from thesisrecon.geometry.two_view import enforce_rank_two, unit_norm

# Ratio of the eighth to the first singular value below which F is undetermined.
UNDETERMINED_REL = 1e-12
DIAGONAL = np.sqrt(0.5)
LANES = 32
# Rows of a solved batch: 0 and 9 the transforms to the bases (9 each), 18 the orientation of the first three
# matches, 21 and 30 the last three points of either image (9 each), 39 and 45 the two members (6 each) of
# the pencil basis, 51 the three coefficients of the monic cubic.
TO_BASIS_1, TO_BASIS_2, FIRST, SECOND, ROWS = 0, 9, 39, 45, 54


def estimate_eight_point(xy1: F64, xy2: F64, *, normalized: bool = True, rank_two: bool = True) -> F64:
    """Estimate F from at least eight matches by the eight-point algorithm (5.2).

    Minimises the algebraic residuals x2' F x1 over unit vectors.

    Parameters
    ----------
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 8, px.
    normalized : bool
        Normalise the coordinates first [1]_. The thesis uses raw pixels, which weight the entries of F
        unequally.
    rank_two : bool
        Replace F by the nearest singular matrix in the frame of the solution. The thesis' linear method does
        not.

    Returns
    -------
    ndarray (3, 3)
        F with x2' F x1 = 0, unit norm.

    Raises
    ------
    ValueError
        If there are fewer than 8 matches, or as :func:`~thesisrecon.epipolar.frame.as_matches`.
    StageFailure
        If the matches do not determine F (all collinear, or coplanar without noise).

    References
    ----------
    .. [1] R. Hartley, "In defense of the eight-point algorithm", PAMI 19, 1997.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.geometry.two_view import sampson_residuals
    >>> xy1 = np.array([[0, 0], [9, 1], [2, 8], [7, 7], [4, 3], [1, 5], [8, 4], [5, 9]], dtype=float)
    >>> depth = np.array([1, 2, 4, 2, 1, 4, 1, 2])
    >>> xy2 = xy1 + np.array([[4.0, 2.0]]) / depth[:, None]
    >>> F = estimate_eight_point(xy1, xy2)
    >>> bool(np.abs(sampson_residuals(F, xy1, xy2)).max() < 1e-9)
    True
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
            "the matches do not determine the fundamental matrix",
            f"the equations of {len(xy1)} matches have rank below 8",
            "add matches off the dominant plane",
        )
    F = Vt[8].reshape(3, 3)
    return unit_norm(T2.T @ (enforce_rank_two(F) if rank_two else F) @ T1)


def estimate_seven_point(xy1: F64, xy2: F64) -> F64:
    """Return all fundamental matrices through exactly seven matches.

    Searches the pencil spanned by two solutions of (5.1) for singular members in all directions, also F1 -
    F2, which alpha F1 + (1 - alpha) F2 of the thesis reaches only at infinity.

    Parameters
    ----------
    xy1, xy2 : array_like (7, 2)
        Matched points, px.

    Returns
    -------
    ndarray (k, 3, 3)
        The k = 0 to 3 solutions, unit norm; none for degenerate matches.

    Raises
    ------
    ValueError
        If the shapes are not (7, 2), or as :func:`~thesisrecon.epipolar.frame.as_matches`.

    References
    ----------
    Hartley and Zisserman, Multiple View Geometry, section 11.1.2.

    Examples
    --------
    >>> import numpy as np
    >>> xy1 = np.array([[0, 0], [9, 1], [2, 8], [7, 7], [4, 3], [1, 5], [8, 4]], dtype=float)
    >>> xy2 = xy1 + np.array([[4.0, 2.0]]) / np.array([1, 2, 4, 2, 1, 4, 1])[:, None]
    >>> F = estimate_seven_point(xy1, xy2)
    >>> 1 <= len(F) <= 3 and bool(np.abs(np.linalg.det(F)).max() < 1e-9)
    True
    """
    xy1, xy2 = as_matches(xy1, xy2)
    if xy1.shape != (7, 2):
        raise ValueError(f"the seven-point algorithm needs two (7, 2) arrays; got {xy1.shape}, {xy2.shape}")
    if not min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) > MIN_PX:
        return np.empty((0, 3, 3))
    frame = PairFrame.of(xy1, xy2)
    solutions = np.empty((3, 9))
    count = seven_point(frame.points(xy1, xy2), np.arange(7), solutions)
    return np.array([frame.matrix_in_pixels(f) for f in solutions[:count]]).reshape(count, 3, 3)


@njit(
    cache=True,
    nogil=True,
    inline="always",
    error_model="numpy",
    fastmath={"reassoc", "contract"},
    forceinline=True,
)
def _reflect(v: F64, start: int, scale: float, x: F64) -> None:
    """Apply x <- (I - scale v v') x with v zero before ``start``."""
    dot = 0.0
    for r in range(start, 9):
        dot += v[r] * x[r]
    dot *= scale
    for r in range(start, 9):
        x[r] -= dot * v[r]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def _null_pencil(points: F64, sample: I64, pencil: F64) -> bool:
    """Compute an orthonormal basis ``pencil`` (2, 9) of the null space of the seven equations (5.1).

    Householder QR of A' (9, 7): the last two columns of Q. False if the equations are dependent.
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
            _reflect(A[k], k, scales[k], A[c])
    for k in range(6, -1, -1):
        _reflect(A[k], k, scales[k], pencil[0])
        _reflect(A[k], k, scales[k], pencil[1])
    return True


@njit(cache=True, nogil=True)
def _det3(f: F64) -> float:
    """Determinant of a 3 x 3 matrix given as a vector of 9."""
    value: float = (
        f[0] * (f[4] * f[8] - f[5] * f[7])
        - f[1] * (f[3] * f[8] - f[5] * f[6])
        + f[2] * (f[3] * f[7] - f[4] * f[6])
    )
    return value


@njit(cache=True, nogil=True)
def _mixed_det3(f: F64, g: F64) -> float:
    """trace(adj(f) g), the coefficient of a in det(f + a g)."""
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
def _cubic_roots(a: float, b: float, c: float, roots: F64) -> int:
    """Real roots of x^3 + a x^2 + b x + c in closed form, double roots once, polished by Newton steps."""
    Q = (a * a - 3.0 * b) / 9.0
    R = (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0
    gap = R * R - Q * Q * Q
    # Rounding error of R^2 - Q^3: a smaller value counts as a double root.
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
    """Compute the members with determinant 0 of a pencil of 3 x 3 matrices.

    The determinant is a homogeneous cubic of the pencil coordinates. It cannot vanish in four directions
    unless it vanishes everywhere, so the direction with the largest determinant of four becomes the first
    basis vector: the leading coefficient is never small and no solution is lost at infinity.

    Parameters
    ----------
    pencil : ndarray (2, 9)
        Orthonormal basis of the pencil.
    F : ndarray (3, 9)
        Output: the members, unit norm.

    Returns
    -------
    int
        Number of members, 0 to 3.
    """
    best, c, s = -1.0, 1.0, 0.0
    trial = np.empty(9)
    for k in range(4):
        ck = (1.0, 0.0, DIAGONAL, DIAGONAL)[k]
        sk = (0.0, 1.0, DIAGONAL, -DIAGONAL)[k]
        for m in range(9):
            trial[m] = ck * pencil[0, m] + sk * pencil[1, m]
        size = abs(_det3(trial))
        if size > best:
            best, c, s = size, ck, sk
    if best < 1e-14:
        return 0
    first = c * pencil[0] + s * pencil[1]
    second = c * pencil[1] - s * pencil[0]
    lead = _det3(first)
    roots = np.empty(3)
    count = _cubic_roots(
        _mixed_det3(first, second) / lead, _mixed_det3(second, first) / lead, _det3(second) / lead, roots
    )
    for k in range(count):
        norm = np.sqrt(1.0 + roots[k] * roots[k])
        for m in range(9):
            F[k, m] = (roots[k] * first[m] + second[m]) / norm
    return count


@njit(cache=True, nogil=True)
def seven_point(points: F64, sample: I64, F: F64) -> int:
    """Compute the fundamental matrices through seven matches.

    Parameters
    ----------
    points : ndarray (N, 4)
        Matches as rows (x1, y1, x2, y2) in a common frame.
    sample : ndarray (7,)
        Indices of the seven matches.
    F : ndarray (3, 9)
        Output: the solutions, unit norm.

    Returns
    -------
    int
        Number of solutions, 0 for degenerate matches.
    """
    pencil = np.empty((2, 9))
    if not _null_pencil(points, sample, pencil):
        return 0
    return singular_members(pencil, F)


Nine = tuple[float, float, float, float, float, float, float, float, float]


Three = tuple[float, float, float]


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _basis_transform(
    xa: float, ya: float, xb: float, yb: float, xc: float, yc: float, xd: float, yd: float
) -> Nine:
    """Rows of T (3, 3) from pixels to the basis of four points; not finite if three are collinear."""
    a0, a1, a2 = yb - yc, xc - xb, xb * yc - yb * xc
    b0, b1, b2 = yc - ya, xa - xc, xc * ya - yc * xa
    c0, c1, c2 = ya - yb, xb - xa, xa * yb - ya * xb
    a = 1.0 / (a0 * xd + a1 * yd + a2)
    b = 1.0 / (b0 * xd + b1 * yd + b2)
    c = 1.0 / (c0 * xd + c1 * yd + c2)
    return a * a0, a * a1, a * a2, b * b0, b * b1, b * b2, c * c0, c * c1, c * c2


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _apply_transform(T: Nine, x: float, y: float) -> Three:
    """T (x, y, 1)'."""
    return T[0] * x + T[1] * y + T[2], T[3] * x + T[4] * y + T[5], T[6] * x + T[7] * y + T[8]


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _basis_equation(u: Three, v: Three) -> tuple[float, float, float, float, float]:
    """Coefficients of F13, F21, F23, F31, F32 in v' F u = 0, with F12 minus their sum."""
    first = v[0] * u[1]
    return (
        v[0] * u[2] - first,
        v[1] * u[0] - first,
        v[1] * u[2] - first,
        v[2] * u[0] - first,
        v[2] * u[1] - first,
    )


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _determinant(a: Three, b: Three, c: Three) -> float:
    """Determinant of the matrix with columns a, b, c."""
    value: float = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    return value


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def solve_seven_point_batch(X: F64, Y: F64) -> None:
    """Compute the pencils and cubics of LANES samples side by side.

    With t p + q a member of a pencil, det(t p + q) = t^3 + ... has products of entries as coefficients, since
    F12 F23 F31 + F13 F21 F32 is the determinant of a matrix with zero diagonal.

    Parameters
    ----------
    X : ndarray (28, LANES)
        x1, y1, x2, y2 of the seven matches of each sample.
    Y : ndarray (ROWS, LANES)
        Output, laid out as documented at ROWS; not finite or meaningless for degenerate samples.
    """
    for k in range(LANES):
        S = _basis_transform(X[0, k], X[1, k], X[4, k], X[5, k], X[8, k], X[9, k], X[12, k], X[13, k])
        T = _basis_transform(X[2, k], X[3, k], X[6, k], X[7, k], X[10, k], X[11, k], X[14, k], X[15, k])
        # T x_i is a positive or negative multiple of the basis vector e_i: the products over both images.
        side0 = (S[0] * X[0, k] + S[1] * X[1, k] + S[2]) * (T[0] * X[2, k] + T[1] * X[3, k] + T[2])
        side1 = (S[3] * X[4, k] + S[4] * X[5, k] + S[5]) * (T[3] * X[6, k] + T[4] * X[7, k] + T[5])
        side2 = (S[6] * X[8, k] + S[7] * X[9, k] + S[8]) * (T[6] * X[10, k] + T[7] * X[11, k] + T[8])
        u, v = _apply_transform(S, X[16, k], X[17, k]), _apply_transform(T, X[18, k], X[19, k])
        r, s = _apply_transform(S, X[20, k], X[21, k]), _apply_transform(T, X[22, k], X[23, k])
        w, z = _apply_transform(S, X[24, k], X[25, k]), _apply_transform(T, X[26, k], X[27, k])
        A, B, C = _basis_equation(u, v), _basis_equation(r, s), _basis_equation(w, z)
        c0, c1, c2 = (A[0], B[0], C[0]), (A[1], B[1], C[1]), (A[2], B[2], C[2])
        c3, c4 = (A[3], B[3], C[3]), (A[4], B[4], C[4])
        lead = _determinant(c0, c1, c2)
        p1, p2, p3, p4 = -_determinant(c3, c1, c2), -_determinant(c0, c3, c2), -_determinant(c0, c1, c3), lead
        q1, q2, q3, q5 = -_determinant(c4, c1, c2), -_determinant(c0, c4, c2), -_determinant(c0, c1, c4), lead
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
def _newton_cubic_roots(a: float, b: float, c: float, roots: F64) -> int:
    """Real roots of x^3 + a x^2 + b x + c: one by Newton, the others from the remaining quadratic.

    The iteration starts beyond the turning point on the side of the root, where it is monotone. It may miss a
    double root or find it as two close ones; no root if a coefficient is not finite.
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
def _oriented_in_basis(g: F64, Y: F64, lane: int) -> bool:
    """Return whether the seven matches of a lane can be in front of both cameras of the member ``g`` (6,).

    Oriented epipolar constraint (Chum, Werner and Matas, ICPR 2004): e2 x x2 and F x1 are parallel for an
    exact match and must agree in direction for all matches or for none.
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
def _leave_basis(g: F64, Y: F64, lane: int, f: F64) -> bool:
    """Write F = T2' G T1 as a unit vector ``f`` (9,), G from the entries ``g`` (6,); False if not finite."""
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
def seven_point_batch_solutions(Y: F64, lane: int, work: F64, F: F64) -> int:
    """Compute the fundamental matrices of one sample of a solved batch that satisfy the oriented constraint.

    Parameters
    ----------
    Y : ndarray (ROWS, LANES)
        Batch solved by :func:`solve_seven_point_batch`.
    lane : int
        Column of the sample.
    work : ndarray (9,)
        Scratch memory.
    F : ndarray (3, 9)
        Output: the solutions, unit norm.

    Returns
    -------
    int
        Number of solutions, 0 to 3.
    """
    roots, g, found = work[:3], work[3:], 0
    for k in range(_newton_cubic_roots(Y[51, lane], Y[52, lane], Y[53, lane], roots)):
        for m in range(6):
            g[m] = roots[k] * Y[FIRST + m, lane] + Y[SECOND + m, lane]
        if _oriented_in_basis(g, Y, lane) and _leave_basis(g, Y, lane, F[found]):
            found += 1
    return found

"""Section 5.2: F from linear equations: the eight-point and the seven-point algorithm."""

from __future__ import annotations

import numpy as np

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import F64, I64
from thesisrecon.epipolar._frame import MIN_PX, PairFrame, as_matches, check_matches
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import normalizing_transform, unit_norm
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import enforce_rank_two

# Ratio of the eighth to the first singular value below which F is undetermined.
UNDETERMINED_REL = 1e-12
DIAGONAL = np.sqrt(0.5)


def estimate_eight_point(xy1: F64, xy2: F64, *, normalized: bool = True, rank_two: bool = True) -> F64:
    """F of unit norm from at least eight matches (N, 2) by the eight-point algorithm (5.2).

    Minimises the algebraic residuals x2' F x1 over unit vectors. ``normalized``: with Hartley's normalisation
    (PAMI 19, 1997); the thesis uses raw pixels, which weight the entries of F unequally. ``rank_two``: the
    nearest singular matrix in the frame of the solution; the thesis does not enforce it.
    """
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
    """Return all fundamental matrices through exactly seven matches (HZ, section 11.1.2).

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
        If the matches are not finite (7, 2) arrays.

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


@kernel(inline="always", fastmath={"reassoc", "contract"}, forceinline=True)
def _reflect(v: F64, start: int, scale: float, x: F64) -> None:
    """Apply x <- (I - scale v v') x with v zero before ``start``."""
    dot = 0.0
    for r in range(start, 9):
        dot += v[r] * x[r]
    dot *= scale
    for r in range(start, 9):
        x[r] -= dot * v[r]


@kernel(fastmath={"reassoc", "contract"}, forceinline=True)
def _null_pencil(points: F64, sample: I64, pencil: F64) -> bool:
    """Orthonormal basis ``pencil`` (2, 9) of the null space of the seven equations (5.1); False if dependent.

    Householder QR of A' (9, 7): the last two columns of Q.
    """
    A = empty((7, 9))
    for k in range(7):
        x1, y1, x2, y2 = points[sample[k]]
        A[k, 0], A[k, 1], A[k, 2] = x2 * x1, x2 * y1, x2
        A[k, 3], A[k, 4], A[k, 5] = y2 * x1, y2 * y1, y2
        A[k, 6], A[k, 7], A[k, 8] = x1, y1, 1.0
    pencil[:] = 0.0
    pencil[0, 7] = pencil[1, 8] = 1.0
    scales = empty(7)
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


@kernel
def _det3(f: F64) -> float:
    """Determinant of a 3 x 3 matrix given as a vector of 9."""
    value: float = (
        f[0] * (f[4] * f[8] - f[5] * f[7])
        - f[1] * (f[3] * f[8] - f[5] * f[6])
        + f[2] * (f[3] * f[7] - f[4] * f[6])
    )
    return value


@kernel
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


@kernel
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


@kernel
def _singular_members(pencil: F64, F: F64) -> int:
    """Write the members ``F`` (3, 9) with determinant 0 of a pencil (2, 9); returns their number, 0 to 3.

    The determinant is a homogeneous cubic of the pencil coordinates. It cannot vanish in four directions
    unless it vanishes everywhere, so the direction with the largest determinant of four becomes the first
    basis vector: the leading coefficient is never small and no solution is lost at infinity.
    """
    best, c, s = -1.0, 1.0, 0.0
    trial = empty(9)
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
    roots = empty(3)
    count = _cubic_roots(
        _mixed_det3(first, second) / lead, _mixed_det3(second, first) / lead, _det3(second) / lead, roots
    )
    for k in range(count):
        norm = np.sqrt(1.0 + roots[k] * roots[k])
        for m in range(9):
            F[k, m] = (roots[k] * first[m] + second[m]) / norm
    return count


@kernel
def seven_point(points: F64, sample: I64, F: F64) -> int:
    """Compute the fundamental matrices through seven matches, also of nearly degenerate samples.

    Parameters
    ----------
    points : ndarray (N, 4)
        Matches as rows (x1, y1, x2, y2) in a common frame.
    sample : ndarray (7,)
        Indices of the seven matches.
    F : ndarray (3, 9)
        Output: the solutions, unit norm, row-major.

    Returns
    -------
    int
        Number of solutions, 0 for degenerate matches.
    """
    pencil = empty((2, 9))
    if not _null_pencil(points, sample, pencil):
        return 0
    return _singular_members(pencil, F)

"""Small matrices: kernels that compile in a fraction of the time of LAPACK's wrappers."""

import math

import numpy as np
import scipy

from thesisrecon._numba import kernel, zeros
from thesisrecon.arrays import F64


@kernel
def invert_cholesky_3x3(
    m00: float, m10: float, m20: float, m11: float, m21: float, m22: float, out: F64
) -> bool:
    """Fill ``out`` with L^-1 of a symmetric matrix L L' given by its lower triangle."""
    out[:] = 0.0
    if not m00 > 0.0:
        return False
    l00 = np.sqrt(m00)
    l10, l20 = m10 / l00, m20 / l00
    p1 = m11 - l10 * l10
    if not p1 > 0.0:
        return False
    l11 = np.sqrt(p1)
    l21 = (m21 - l20 * l10) / l11
    p2 = m22 - l20 * l20 - l21 * l21
    if not p2 > 0.0:
        return False
    out[0, 0], out[1, 1], out[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / np.sqrt(p2)
    out[1, 0] = -l10 * out[0, 0] * out[1, 1]
    out[2, 1] = -l21 * out[1, 1] * out[2, 2]
    out[2, 0] = -(l20 * out[0, 0] + l21 * out[1, 0]) * out[2, 2]
    return True


@kernel(inline="always")
def multiply_transposed_3x3(L: F64, out: F64) -> None:
    """Fill ``out`` with L' L."""
    for a in range(3):
        for b in range(3):
            out[a, b] = L[0, a] * L[0, b] + L[1, a] * L[1, b] + L[2, a] * L[2, b]


def floored_diagonal(diagonal: F64) -> F64:
    """Floor the diagonal (D,) of J'J away from 0, so that the damped matrix is positive."""
    largest = float(diagonal.max(initial=0.0))
    return np.maximum(diagonal, 1e-12 * largest if largest > 0.0 else 1.0)


def solve_positive(A: F64, b: F64) -> F64 | None:
    """Solve A x = b, b (D,) or (D, M), by Cholesky factorisation; None if A is not positive."""
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        return None
    if len(b) == 0:
        return np.zeros_like(b)
    _, x, info = scipy.linalg.lapack.dposv(A, b, lower=1)
    return None if info != 0 or not np.isfinite(x).all() else np.asarray(x).reshape(b.shape)


@kernel
def solve_damped(H: F64, g: F64, damping: float, step: F64) -> bool:
    """Solve (H + damping diag H) step = -g by Cholesky factorisation in kernels; False if not positive."""
    n = len(g)
    L = zeros((n, n))
    floor = 0.0
    for i in range(n):
        floor = max(floor, H[i, i])
    floor = 1e-14 * floor + 1e-300
    for i in range(n):
        for j in range(i + 1):
            total = H[i, j]
            if i == j:
                total += damping * max(H[i, i], floor)
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 1e-3 * damping * floor:
                    return False
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    for i in range(n):
        total = -g[i]
        for k in range(i):
            total -= L[i, k] * step[k]
        step[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= L[k, i] * step[k]
        step[i] = total / L[i, i]
    return True


@kernel
def orthogonalize_columns(A: F64, V: F64) -> None:
    """Make A (m, n) in place A V with orthogonal columns, V (n, n), by Jacobi rotations (Hestenes 1958)."""
    m, n = A.shape
    V[:] = 0.0
    for p in range(n):
        V[p, p] = 1.0
    for _ in range(30):
        turned = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                a = b = c = 0.0
                for i in range(m):
                    a, b, c = a + A[i, p] * A[i, p], b + A[i, q] * A[i, q], c + A[i, p] * A[i, q]
                if abs(c) <= 1e-15 * math.sqrt(a * b):
                    continue
                turned = True
                zeta = (b - a) / (2.0 * c)
                t = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                cosine = 1.0 / math.sqrt(1.0 + t * t)
                sine = cosine * t
                for i in range(m):
                    A[i, p], A[i, q] = cosine * A[i, p] - sine * A[i, q], sine * A[i, p] + cosine * A[i, q]
                for i in range(n):
                    V[i, p], V[i, q] = cosine * V[i, p] - sine * V[i, q], sine * V[i, p] + cosine * V[i, q]
        if not turned:
            break

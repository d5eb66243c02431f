"""Linear algebra of small matrices in kernels; it compiles in a fraction of the time of LAPACK's wrappers."""

from __future__ import annotations

import math

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.kernels import kernel, zeros


@kernel
def solve_damped(H: F64, g: F64, damping: float, step: F64) -> bool:
    """Solve (H + damping diag H) step = -g by Cholesky factorisation, inside kernels.

    Parameters
    ----------
    H, g, damping : ndarray (n, n), ndarray (n,), float
        J'J, J'r and Levenberg-Marquardt damping.
    step : ndarray (n,)
        Output.

    Returns
    -------
    bool
        False if the damped matrix is not positive definite.
    """
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


@kernel(error_model="numpy")
def orthogonalize_columns(A: F64, V: F64) -> None:
    """Make the columns of A orthogonal in place by one-sided Jacobi rotations (Hestenes 1958).

    The lengths of the columns become the singular values, not sorted.

    Parameters
    ----------
    A : ndarray (m, n)
        Matrix; becomes A V.
    V : ndarray (n, n)
        Output: the right singular vectors, in columns.
    """
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


@kernel(error_model="numpy")
def shortest_column(A: F64) -> int:
    """Index of the column of least length.

    Parameters
    ----------
    A : ndarray (m, n)
        Matrix.

    Returns
    -------
    int
        The first of the shortest columns.
    """
    best, least = 0, math.inf
    for p in range(A.shape[1]):
        length = 0.0
        for i in range(A.shape[0]):
            length += A[i, p] ** 2
        if length < least:
            best, least = p, length
    return best

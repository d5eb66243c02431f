"""Compiled solvers of small dense systems and guards, for loops over points or samples."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64

TINY = 1e-12


@njit(cache=True, nogil=True, inline="always")
def away_from_zero(w: float) -> float:
    """Move a projective depth off 0, so that a point in the focal plane gets a huge residual.

    Parameters
    ----------
    w : float, depth

    Returns
    -------
    float, w, or +-TINY with its sign
    """
    if w >= 0.0:
        return max(w, TINY)
    return min(w, -TINY)


@njit(cache=True, nogil=True)
def invert_cholesky_3x3(
    m00: float, m10: float, m20: float, m11: float, m21: float, m22: float, out: F64
) -> bool:
    """Fill ``out`` with L^-1 of a symmetric matrix L L' given by its lower triangle.

    Parameters
    ----------
    m00, m10, m20, m11, m21, m22 : float, matrix entries
    out : ndarray (3, 3), output; zeros if a pivot is not positive

    Returns
    -------
    bool, whether the matrix is positive definite
    """
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


@njit(cache=True, nogil=True)
def invert_positive_3x3(M: F64, root: F64, out: F64) -> bool:
    """Invert a symmetric positive matrix by Cholesky factorisation.

    Parameters
    ----------
    M : ndarray (3, 3), matrix, lower triangle used
    root : ndarray (3, 3), output L^-1 with M = L L'
    out : ndarray (3, 3), output M^-1; zeros if a pivot is not positive

    Returns
    -------
    bool, whether the matrix is positive definite
    """
    positive = invert_cholesky_3x3(M[0, 0], M[1, 0], M[2, 0], M[1, 1], M[2, 1], M[2, 2], root)
    multiply_transposed_3x3(root, out)
    return positive


@njit(cache=True, nogil=True, inline="always")
def multiply_transposed_3x3(L: F64, out: F64) -> None:
    """Fill ``out`` with L' L.

    Parameters
    ----------
    L : ndarray (3, 3), matrix
    out : ndarray (3, 3), output
    """
    for a in range(3):
        for b in range(3):
            out[a, b] = L[0, a] * L[0, b] + L[1, a] * L[1, b] + L[2, a] * L[2, b]


@njit(cache=True, nogil=True)
def solve_damped(H: F64, g: F64, damping: float, step: F64) -> bool:
    """Solve (H + damping diag H) step = -g by Cholesky factorisation.

    Parameters
    ----------
    H : ndarray (n, n), symmetric matrix J'J
    g : ndarray (n,), gradient J'r
    damping : float, Levenberg-Marquardt damping
    step : ndarray (n,), output

    Returns
    -------
    bool, false if the damped matrix is not positive definite
    """
    n = len(g)
    L = np.zeros((n, n))
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

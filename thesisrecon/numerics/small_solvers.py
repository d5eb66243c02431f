"""Losses and guards of a single residual or matrix, inlined into the loops of the other modules."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64

TINY = 1e-12


@njit(cache=True, nogil=True, inline="always")
def away_from_zero(w: float) -> float:
    """w, moved off 0: a point in the focal plane gets a huge residual instead of a division by zero."""
    if w >= 0.0:
        return max(w, TINY)
    return min(w, -TINY)


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

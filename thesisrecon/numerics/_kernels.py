"""Compiled robust losses (``code`` is a number of ``LOSS_CODES``), guards and solvers of 3 x 3 systems."""

from __future__ import annotations

import math

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.kernels import kernel

TINY = 1e-12


@kernel(inline="always")
def loss_value(code: int, s: float, delta: float) -> float:
    """Evaluate rho(s)."""
    d2 = delta * delta
    if code == 1:
        return s if s <= d2 else 2.0 * delta * math.sqrt(s) - d2
    if code == 2:
        return 2.0 * d2 * (math.sqrt(1.0 + s / d2) - 1.0)
    if code == 3:
        return d2 * math.log1p(s / d2)
    return s


@kernel(inline="always")
def loss_weight(code: int, s: float, delta: float) -> float:
    """Evaluate rho'(s)."""
    d2 = delta * delta
    if code == 1:
        return 1.0 if s <= d2 else delta / math.sqrt(s)
    if code == 2:
        return 1.0 / math.sqrt(1.0 + s / d2)
    if code == 3:
        return 1.0 / (1.0 + s / d2)
    return 1.0


@kernel(inline="always")
def loss_curvature(code: int, s: float, delta: float) -> float:
    """Evaluate 1 + 2 s rho'' / rho', the fraction of the curvature along a residual that its loss leaves."""
    u = s / (delta * delta)
    if code == 1:
        return 1.0 if u <= 1.0 else 0.0
    if code == 2:
        return 1.0 / (1.0 + u)
    if code == 3:
        return (1.0 - u) / (1.0 + u)
    return 1.0


@kernel(inline="always")
def away_from_zero(w: float) -> float:
    """Move a projective depth off 0, so that a point in the focal plane gets a huge residual."""
    if w >= 0.0:
        return max(w, TINY)
    return min(w, -TINY)


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


@kernel
def invert_positive_3x3(M: F64, root: F64, out: F64) -> bool:
    """Invert a symmetric positive matrix by Cholesky factorisation."""
    positive = invert_cholesky_3x3(M[0, 0], M[1, 0], M[2, 0], M[1, 1], M[2, 1], M[2, 2], root)
    multiply_transposed_3x3(root, out)
    return positive


@kernel(inline="always")
def multiply_transposed_3x3(L: F64, out: F64) -> None:
    """Fill ``out`` with L' L."""
    for a in range(3):
        for b in range(3):
            out[a, b] = L[0, a] * L[0, b] + L[1, a] * L[1, b] + L[2, a] * L[2, b]

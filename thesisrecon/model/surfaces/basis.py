"""Uniform cubic B-splines between two knots: values, derivatives and bending energy."""

from __future__ import annotations

import numpy as np

from thesisrecon.types import F64

_POLYNOMIALS = (
    np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]])
    / 6.0
)
"""Row i: the coefficients of 1, u, u^2, u^3 of the i-th of the four that are not zero, u in [0, 1]."""


def basis(u: F64, derivative: int = 0) -> F64:
    """(N, 4) values of the four B-splines, or of a derivative, at u (N,) between two knots."""
    row = _POLYNOMIALS
    for _ in range(derivative):
        row = row[:, 1:] * np.arange(1.0, row.shape[1])
    return np.asarray(np.power(u[:, None], np.arange(row.shape[1])) @ row.T)


def energies() -> tuple[F64, F64]:
    """(16, 16) of the bending energy, the integral of f_xx^2 + 2 f_xy^2 + f_yy^2 over a cell of side 1, and
    of that of the squared gradient, in the coefficients of the cell's nodes (i, j) in place 4 i + j."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    values = [basis(0.5 * (nodes + 1.0), d) for d in (0, 1, 2)]
    M0, M1, M2 = (np.einsum("n,ni,nj->ij", 0.5 * weights, v, v) for v in values)
    bending = np.kron(M2, M0) + 2.0 * np.kron(M1, M1) + np.kron(M0, M2)
    return bending, np.kron(M1, M0) + np.kron(M0, M1)

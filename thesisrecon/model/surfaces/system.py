"""The normal equations of a spline in pieces: assembled, and solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.model.surfaces.basis import basis, energies
from thesisrecon.model.surfaces.kernels import evaluate_pixels, sum_squares
from thesisrecon.model.surfaces.pieces import Pieces
from thesisrecon.types import F64

TILT = 1e-7
"""Weight of squared gradients beside that of bending: what decides where depths leave a tilt open."""


@dataclass(frozen=True)
class NormalEquations:
    """Least squares of a spline in ``pieces`` with ``cell`` px between knots.

    ``rows, starts`` are the places of the sparse matrix and ``place`` (N, 256) where the entries of each
    piece go.
    """

    pieces: Pieces
    cell: int
    pixel_basis: F64
    energy: F64
    rows: NDArray[np.int32]
    starts: NDArray[np.int32]
    place: NDArray[np.int32]

    @classmethod
    def of(cls, pieces: Pieces, cell: int) -> NormalEquations:
        """The equations' pattern, without numbers."""
        own, count = pieces.coefficient, pieces.count
        code = (own[:, None, :] * count + own[:, :, None]).reshape(-1)
        places, place = np.unique(code, return_inverse=True)
        starts = np.searchsorted(places, np.arange(count + 1) * count).astype(np.int32)
        bending, gradient = energies()
        along = basis((np.arange(cell) + 0.5) / cell)
        rows = (places % count).astype(np.int32)
        return cls(
            pieces,
            cell,
            along,
            bending + TILT * gradient,
            rows,
            starts,
            place.astype(np.int32).reshape(-1, 256),
        )

    def sums(self, value: F64, weight: F64) -> tuple[F64, F64]:
        """What the depths (H, W) and their weights give each piece: (N, 16, 16) and (N, 16)."""
        n = len(self.pieces.coefficient)
        matrix, right = np.zeros((n, 16, 16)), np.zeros((n, 16))
        sum_squares(self.pieces.piece, value, weight, self.pixel_basis, self.cell, matrix, right)
        upper = np.triu_indices(16, 1)
        matrix[:, upper[1], upper[0]] = matrix[:, upper[0], upper[1]]
        return matrix, right

    def solve(self, matrix: F64, right: F64, stiffness: F64) -> F64:
        """Coefficients where pieces (N,) resist bending by ``stiffness``."""
        entries = matrix + stiffness[:, None, None] * self.energy
        data = np.bincount(self.place.ravel(), entries.ravel(), len(self.rows))
        count = self.pieces.count
        A = scipy.sparse.csc_array((data, self.rows, self.starts), shape=(count, count))
        b = np.bincount(self.pieces.coefficient.ravel(), right.ravel(), count)
        factor = scipy.sparse.linalg.splu(
            A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return np.asarray(factor.solve(b))

    def values(self, c: F64) -> F64:
        """(H, W) of the spline at the pixels."""
        value = np.empty(self.pieces.piece.shape)
        evaluate_pixels(self.pieces.piece, self.pieces.coefficient, c, self.pixel_basis, self.cell, value)
        return value

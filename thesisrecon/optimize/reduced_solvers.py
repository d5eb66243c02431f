"""Solvers of the reduced camera system, and the choice between them by size and sparsity.

Dense Cholesky serves up to some hundred views. Beyond, views see points with their neighbours only: where an
order of the views keeps these near the diagonal (corridors, loops, streets) a banded Cholesky factor is exact
at a cost linear in the views; where none does, conjugate gradients work on the blocks as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from thesisrecon.optimize import kernels
from thesisrecon.optimize.kernels import Sums
from thesisrecon.optimize.levenberg_marquardt import solve_positive

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# What an operation costs beside one of a dense Cholesky factorisation: narrow bands keep the processor less
# busy, and the blocks of a product with a vector come from memory.
BAND_COST, PRODUCT_COST = 2.0, 8.0
TYPICAL_PRODUCTS = 150
SMALL = 600


@dataclass(frozen=True)
class ReducedSystem:
    """A symmetric positive system in blocks: ``row`` <= ``column`` (n,) the views of each of ``sums.blocks``;
    ``sums.border`` and ``sums.corner`` what they have in common; ``sums.rhs`` the right-hand side."""

    row: I64
    column: I64
    sums: Sums

    def dense(self) -> F64:
        """The matrix (D, D), upper triangle."""
        edge, D = self.sums.border.shape[0] * self.sums.border.shape[1], len(self.sums.rhs)
        S = np.zeros((D, D))
        kernels.fill_dense(self.sums.blocks, self.row, self.column, S)
        S[:edge, edge:] = self.sums.border.reshape(edge, D - edge)
        S[edge:, edge:] = self.sums.corner
        return S


class ReducedSolver(Protocol):
    """Solves a reduced system; None where it is not positive."""

    def solve(self, system: ReducedSystem) -> F64 | None:
        """x (D,)."""


@dataclass(frozen=True)
class DenseCholesky:
    """The whole matrix by LAPACK: D^3 / 3 operations."""

    def solve(self, system: ReducedSystem) -> F64 | None:
        """x (D,) or None."""
        # Row-major upper is column-major lower: LAPACK reads the transpose without a copy.
        return solve_positive(system.dense().T, system.sums.rhs)


@dataclass(frozen=True)
class BandedCholesky:
    """The views in the order ``place`` (b,), neighbours at most ``reach`` places apart, by LAPACK's banded
    factorisation; the border by its Schur complement."""

    place: I64
    reach: int

    def solve(self, system: ReducedSystem) -> F64 | None:
        """x (D,) or None."""
        b, C, e = system.sums.border.shape
        factor = self.factor(system)
        if factor is None:
            return None
        order = np.argsort(self.place)
        right = np.empty((b, C, e + 1))
        right[..., 0] = system.sums.rhs[: b * C].reshape(b, C)
        right[..., 1:] = system.sums.border
        solved, info = lapack.dpbtrs(factor, right[order].reshape(b * C, e + 1), lower=1)
        if info != 0 or not np.isfinite(solved).all():
            return None
        back = solved.reshape(b, C, e + 1)[self.place].reshape(b * C, e + 1)
        tail = np.zeros(0)
        if e:
            border = system.sums.border.reshape(b * C, e)
            corner = system.sums.corner - border.T @ back[:, 1:]
            found = solve_positive(corner, system.sums.rhs[b * C :] - border.T @ back[:, 0])
            if found is None:
                return None
            tail = found
        return np.concatenate([back[:, 0] - back[:, 1:] @ tail, tail])

    def factor(self, system: ReducedSystem) -> F64 | None:
        """LAPACK's lower banded Cholesky factor (width, b C) of the views' part; None if not positive."""
        b, C, _ = system.sums.border.shape
        band = np.zeros((b * C, (self.reach + 1) * C))
        kernels.fill_band(system.sums.blocks, system.row, system.column, self.place, band)
        if not np.isfinite(band).all():
            return None
        factor, info = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        return factor if info == 0 else None


@dataclass(frozen=True)
class ConjugateGradients:
    """Preconditioned by the inverses of the views' blocks and of the corner (block Jacobi), from zero, until
    the residual in that norm has fallen by ``tolerance``."""

    tolerance: float = 1e-3
    max_products: int = 1000

    def solve(self, system: ReducedSystem) -> F64 | None:
        """x (D,) or None."""
        s, (b, C, _) = system.sums, system.sums.border.shape
        try:
            inverse = np.linalg.inv(s.blocks[system.row == system.column])
            corner = np.linalg.inv(s.corner)
        except np.linalg.LinAlgError:
            return None

        def precondition(r: F64) -> F64:
            views = np.einsum("bij,bj->bi", inverse, r[: b * C].reshape(b, C))
            return np.concatenate([views.ravel(), corner @ r[b * C :]])

        x, r = np.zeros_like(s.rhs), s.rhs.copy()
        z = precondition(r)
        p, energy = z, float(r @ z)
        enough = self.tolerance**2 * energy
        for _ in range(self.max_products):
            if not energy > enough:
                break
            product = multiply(system, p)
            curvature = float(p @ product)
            if not curvature > 0.0:
                return None
            x, r = x + energy / curvature * p, r - energy / curvature * product
            z = precondition(r)
            before, energy = energy, float(r @ z)
            p = z + energy / before * p
        return x if np.isfinite(x).all() else None


def multiply(system: ReducedSystem, x: F64) -> F64:
    """S x (D,)."""
    s, (b, C, e) = system.sums, system.sums.border.shape
    border, y = s.border.reshape(b * C, e), np.empty((b, C))
    kernels.multiply_blocks(s.blocks, system.row, system.column, x[: b * C].reshape(b, C), y)
    return np.concatenate([y.ravel() + border @ x[b * C :], border.T @ x[: b * C] + s.corner @ x[b * C :]])


def choose_solver(row: I64, column: I64, n_views: int, width: int, border: int) -> ReducedSolver:
    """The solver with the least work for this pattern of blocks; dense for all small systems."""
    D = float(n_views * width + border)
    if D <= SMALL:
        return DenseCholesky()
    graph = coo_array((np.ones(len(row)), (row, column)), shape=(n_views, n_views)).tocsr()
    order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    place = np.empty(n_views, dtype=np.int64)
    place[order] = np.arange(n_views)
    reach = int(np.abs(place[row] - place[column]).max(initial=0))
    band, products = float((reach + 1) * width), 4.0 * (len(row) * width**2 + D * border)
    work: list[tuple[float, ReducedSolver]] = [
        (D**3 / 3.0, DenseCholesky()),
        (BAND_COST * D * band * (band + 4.0 * (border + 1)), BandedCholesky(place, reach)),
        (PRODUCT_COST * TYPICAL_PRODUCTS * products, ConjugateGradients()),
    ]
    return min(work, key=lambda choice: choice[0])[1]

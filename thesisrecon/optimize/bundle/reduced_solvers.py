"""Solvers of the reduced camera system, and the choice between them by size and sparsity.

A banded Cholesky factor is linear in the views if an order keeps neighbours together (corridors, streets).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon._numba import kernel
from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.small_matrices import solve_positive
from thesisrecon.optimize.bundle.elimination import ReducedSums

# Cost of an operation relative to dense Cholesky: narrow bands compute slower.
BAND_COST = 2.0
SMALL = 600


@kernel
def _fill_dense(blocks: F64, row: I64, column: I64, S: F64) -> None:
    """Copy blocks (n, C, C) of views row[i] <= column[i] to the upper triangle of S (D, D)."""
    C = blocks.shape[1]
    for i in range(len(blocks)):
        r, c = row[i] * C, column[i] * C
        for a in range(C):
            for b in range(C):
                S[r + a, c + b] = blocks[i, a, b]


@kernel
def add_diagonal(blocks: F64, pair: I64, corner: F64, values: F64) -> None:
    """Add values (D,) to the diagonal of the reduced matrix; ``pair`` (b, b) is the block of two views."""
    C, b = blocks.shape[1], len(pair)
    for v in range(b):
        for a in range(C):
            blocks[pair[v, v], a, a] += values[v * C + a]
    for c in range(len(corner)):
        corner[c, c] += values[b * C + c]


@kernel
def fill_band(blocks: F64, row: I64, column: I64, place: I64, band: F64) -> None:
    """Copy blocks to band[j, i - j] = S[i, j] (D, width + 1), views in the order ``place`` (b,)."""
    C = blocks.shape[1]
    for i in range(len(blocks)):
        r, c = place[row[i]] * C, place[column[i]] * C
        for a in range(C):
            for b in range(C):
                high, low = max(r + a, c + b), min(r + a, c + b)
                band[low, high - low] = blocks[i, a, b]


@kernel
def invert_band(L: F64, Z: F64) -> None:
    """Fill the entries inside the band of (L L')^-1 by the recursion of Takahashi (1973); L[j, i - j]."""
    D, width = L.shape
    for j in range(D - 1, -1, -1):
        last = min(D - 1, j + width - 1)
        pivot = 1.0 / L[j, 0]
        for i in range(last, j, -1):
            total = 0.0
            for k in range(j + 1, i + 1):
                total += L[j, k - j] * Z[k, i - k]
            for k in range(i + 1, last + 1):
                total += L[j, k - j] * Z[i, k - i]
            Z[j, i - j] = -pivot * total
        total = 0.0
        for k in range(j + 1, last + 1):
            total += L[j, k - j] * Z[j, k - j]
        Z[j, 0] = pivot * (pivot - total)


@dataclass(frozen=True)
class ReducedSystem:
    """Symmetric positive system in blocks of views ``row`` <= ``column`` (n,)."""

    row: I64
    column: I64
    sums: ReducedSums

    def dense(self) -> F64:
        """Return the upper triangle of the matrix; (D, D)."""
        edge, D = self.sums.border.shape[0] * self.sums.border.shape[1], len(self.sums.rhs)
        S = np.zeros((D, D))
        _fill_dense(self.sums.blocks, self.row, self.column, S)
        S[:edge, edge:] = self.sums.border.reshape(edge, D - edge)
        S[edge:, edge:] = self.sums.corner
        return S


def solve_dense(system: ReducedSystem) -> F64 | None:
    """Return x (D,) by Cholesky, D^3 / 3 operations, or None if the system is not positive."""
    # Row-major upper is column-major lower: LAPACK reads the transpose without a copy.
    return solve_positive(system.dense().T, system.sums.rhs)


@dataclass(frozen=True)
class _BandedFactor:
    """LAPACK's lower banded ``factor`` (width, b C) of the views, in the order ``place`` (b,).

    ``border`` (b, C, e), ``moved`` (b C, e) = views^-1 border, ``complement`` = corner - border' moved.
    """

    place: I64
    factor: F64
    border: F64
    moved: F64
    complement: F64

    def solve_views(self, right: F64) -> F64:
        """Return views^-1 right for right (b C, m)."""
        b, C, _ = self.border.shape
        ordered = right.reshape(b, C, -1)[np.argsort(self.place)].reshape(b * C, -1)
        solved, _ = scipy.linalg.lapack.dpbtrs(self.factor, ordered, lower=1)
        return np.asarray(solved.reshape(b, C, -1)[self.place].reshape(b * C, -1))

    def solve(self, right: F64) -> F64 | None:
        """Return S^-1 right for right (D, m); None if the complement is not positive."""
        edge, flat = len(self.moved), self.border.reshape(len(self.moved), -1)
        views = self.solve_views(right[:edge])
        tail = solve_positive(self.complement, right[edge:] - flat.T @ views)
        if tail is None or not np.isfinite(views).all():
            return None
        return np.concatenate([views - self.moved @ tail, tail])

    def inverse_blocks(self, row: I64, column: I64) -> F64:
        """Return S^-1 of pairs of views inside the band, each with the border; (n, C + e, C + e)."""
        b, C, e = self.border.shape
        band = np.zeros(self.factor.T.shape)
        invert_band(np.ascontiguousarray(self.factor.T), band)
        corner, moved = np.linalg.inv(self.complement), self.moved.reshape(b, C, e)
        blocks = np.zeros((len(row), C + e, C + e))
        place = self.place * C
        for a in range(C):
            for c in range(C):
                first, second = place[row] + a, place[column] + c
                low = np.minimum(first, second)
                blocks[:, a, c] = band[low, np.maximum(first, second) - low]
        blocks[:, :C, :C] += np.einsum("bae,ef,bcf->bac", moved[row], corner, moved[column])
        cross = -moved @ corner
        blocks[:, :C, C:] = cross[row]
        blocks[:, C:, :C] = np.swapaxes(cross[column], 1, 2)
        blocks[:, C:, C:] = corner
        return blocks


@dataclass(frozen=True)
class BandedCholesky:
    """Banded factorisation by LAPACK, the border by its Schur complement."""

    place: I64
    reach: int

    def solve(self, system: ReducedSystem) -> F64 | None:
        """Return x (D,), or None if the system is not positive."""
        factored = self.factor(system)
        found = None if factored is None else factored.solve(system.sums.rhs[:, None])
        return None if found is None else found[:, 0]

    def factor(self, system: ReducedSystem) -> _BandedFactor | None:
        """Return the factors, or None if the system is not positive."""
        s, (b, C, e) = system.sums, system.sums.border.shape
        band = np.zeros((b * C, (self.reach + 1) * C))
        fill_band(s.blocks, system.row, system.column, self.place, band)
        if not np.isfinite(band).all():
            return None
        factor, info = scipy.linalg.lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        if info != 0:
            return None
        flat = s.border.reshape(b * C, e)
        views = _BandedFactor(self.place, factor, s.border, flat, s.corner)
        moved = views.solve_views(flat) if e else flat
        return _BandedFactor(self.place, factor, s.border, moved, s.corner - flat.T @ moved)


def choose_solver(row: I64, column: I64, n_views: int, width: int, border: int) -> BandedCholesky | None:
    """Return the banded solver for blocks of ``width`` and a border, None if dense Cholesky is less work."""
    D = float(n_views * width + border)
    if D <= SMALL:
        return None
    banded = order_views(row, column, n_views)
    band = float((banded.reach + 1) * width)
    return banded if BAND_COST * D * band * (band + 4.0 * (border + 1)) < D**3 / 3.0 else None


def order_views(row: I64, column: I64, n_views: int) -> BandedCholesky:
    """Order the views such that neighbours stand close (reverse Cuthill-McKee)."""
    graph = scipy.sparse.coo_array((np.ones(len(row)), (row, column)), shape=(n_views, n_views)).tocsr()
    order = scipy.sparse.csgraph.reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    place = np.empty(n_views, dtype=np.int64)
    place[order] = np.arange(n_views)
    return BandedCholesky(place, int(np.abs(place[row] - place[column]).max(initial=0)))

"""The reduced system in the forms that its solvers want: dense, banded, and as a product with a vector."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@njit(cache=True, nogil=True)
def fill_dense(blocks: F64, row: I64, column: I64, S: F64) -> None:
    """Blocks (n, C, C) of views row[i] <= column[i] into the upper triangle of S (D, D)."""
    C = blocks.shape[1]
    for i in range(len(blocks)):
        r, c = row[i] * C, column[i] * C
        for a in range(C):
            for b in range(C):
                S[r + a, c + b] = blocks[i, a, b]


@njit(cache=True, nogil=True)
def add_diagonal(blocks: F64, pair: I64, corner: F64, values: F64) -> None:
    """Add values (D,) to the diagonal of the reduced matrix; ``pair`` (b, b) numbers the blocks of views."""
    C, b = blocks.shape[1], len(pair)
    for v in range(b):
        for a in range(C):
            blocks[pair[v, v], a, a] += values[v * C + a]
    for c in range(len(corner)):
        corner[c, c] += values[b * C + c]


@njit(cache=True, nogil=True)
def fill_band(blocks: F64, row: I64, column: I64, place: I64, band: F64) -> None:
    """Blocks into the lower band of LAPACK, band[j, i - j] = S[i, j], views in the order ``place`` (b,).

    ``band`` (D, width + 1) is row-major, hence the column-major array that LAPACK wants, transposed.
    """
    C = blocks.shape[1]
    for i in range(len(blocks)):
        r, c = place[row[i]] * C, place[column[i]] * C
        for a in range(C):
            for b in range(C):
                high, low = max(r + a, c + b), min(r + a, c + b)
                band[low, high - low] = blocks[i, a, b]


@njit(cache=True, nogil=True)
def multiply_blocks(blocks: F64, row: I64, column: I64, x: F64, y: F64) -> None:
    """y (b, C) = S x for the symmetric S of which ``blocks`` are the upper triangle; x (b, C)."""
    C = blocks.shape[1]
    y[:] = 0.0
    for i in range(len(blocks)):
        r, c, S = row[i], column[i], blocks[i]
        for a in range(C):
            total = 0.0
            for b in range(C):
                total += S[a, b] * x[c, b]
            y[r, a] += total
        if r != c:
            for a in range(C):
                left = x[r, a]
                for b in range(C):
                    y[c, b] += S[a, b] * left


@njit(cache=True, nogil=True)
def invert_band(L: F64, Z: F64) -> None:
    """The entries inside the band of (L L')^-1, by the recursion of Takahashi (1973) from the last column on.

    L and Z (D, width) hold column j from the diagonal down: L[j, i - j].
    """
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

"""Compiled parts of the fit of B-splines: pieces of surface, their coefficients, sums and values.

A piece is what hangs together of the pixels of one cell between knots. Cells are numbered row by row, pieces
cell by cell. Node (a, b) is the a-th row and b-th column of coefficients; cell (p, q) has the nodes (p + i,
q + j), i, j = 0 .. 3.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]


@njit(cache=True, nogil=True)
def root_of(parent: I64, k: int) -> int:
    """The root of k in a forest, whose paths it halves."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@njit(cache=True, nogil=True)
def join(parent: I64, a: int, b: int) -> None:
    """Make one tree of those of a and b, under the smaller root."""
    a, b = root_of(parent, a), root_of(parent, b)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b


@njit(cache=True, nogil=True)
def label_pieces(known: B8, right: B8, down: B8, cell: int, piece: I64, first: I64) -> int:
    """Number the pieces: ``piece`` (H, W), -1 where not ``known``; ``first`` (cells + 1,) that of each cell.

    ``right`` (H, W - 1) and ``down`` (H - 1, W) say which neighbours are of one surface. Returns how many.
    """
    height, width = known.shape
    rows, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    parent = np.empty(cell * cell, dtype=np.int64)
    number = np.empty(cell * cell, dtype=np.int64)
    count = 0
    for p in range(rows):
        for q in range(columns):
            first[p * columns + q] = count
            y1, x1 = min((p + 1) * cell, height), min((q + 1) * cell, width)
            for k in range(cell * cell):
                parent[k] = k
                number[k] = -1
            for y in range(p * cell, y1):
                for x in range(q * cell, x1):
                    k = (y - p * cell) * cell + x - q * cell
                    if x + 1 < x1 and right[y, x]:
                        join(parent, k, k + 1)
                    if y + 1 < y1 and down[y, x]:
                        join(parent, k, k + cell)
            for y in range(p * cell, y1):
                for x in range(q * cell, x1):
                    piece[y, x] = -1
                    if not known[y, x]:
                        continue
                    root = root_of(parent, (y - p * cell) * cell + x - q * cell)
                    if number[root] < 0:
                        number[root] = count
                        count += 1
                    piece[y, x] = number[root]
    first[rows * columns] = count
    return count


@njit(cache=True, nogil=True)
def number_coefficients(first: I64, columns: int, start: I64, linked: I64, coefficient: I64) -> int:
    """A coefficient for every node and every set of pieces that hang together within its sixteen cells.

    ``linked[start[k]:start[k + 1]]`` are the pieces that go on from piece k in other cells. ``coefficient``
    (pieces, 16) gets the numbers at node (i, j) of its cell in place 4 i + j. Returns how many there are.
    """
    rows = (len(first) - 1) // columns
    parent = np.arange(len(coefficient))
    own = np.full(len(coefficient), -1, dtype=np.int64)
    count = 0
    for a in range(rows + 3):
        for b in range(columns + 3):
            p0, p1 = max(a - 3, 0), min(a, rows - 1)
            q0, q1 = max(b - 3, 0), min(b, columns - 1)
            for p in range(p0, p1 + 1):
                begin, end = first[p * columns + q0], first[p * columns + q1 + 1]
                for k in range(begin, end):
                    parent[k] = k
                    own[k] = -1
            for p in range(p0, p1 + 1):
                for k in range(first[p * columns + q0], first[p * columns + q1 + 1]):
                    for n in range(start[k], start[k + 1]):
                        other = linked[n]
                        if other > k and _within(first, columns, other, p0, p1, q0, q1):
                            join(parent, k, other)
            for p in range(p0, p1 + 1):
                for q in range(q0, q1 + 1):
                    for k in range(first[p * columns + q], first[p * columns + q + 1]):
                        root = root_of(parent, k)
                        if own[root] < 0:
                            own[root] = count
                            count += 1
                        coefficient[k, 4 * (a - p) + b - q] = own[root]
    return count


@njit(cache=True, nogil=True)
def _within(first: I64, columns: int, k: int, p0: int, p1: int, q0: int, q1: int) -> bool:
    """Whether piece k lies in a cell of rows p0 .. p1 and columns q0 .. q1."""
    found = False
    for p in range(p0, p1 + 1):
        found = found or first[p * columns + q0] <= k < first[p * columns + q1 + 1]
    return found


@njit(cache=True, nogil=True)
def sum_squares(
    piece: I64, value: F64, weight: F64, basis: F64, cell: int, matrix: F64, right_side: F64
) -> None:
    """Add the normal equations of all pixels to those of their pieces.

    ``value``, ``weight`` (H, W); ``basis`` (cell, 4) of the pixels of a cell along either axis; ``matrix``
    (pieces, 16, 16) gets its upper half, ``right_side`` (pieces, 16).
    """
    height, width = piece.shape
    b = np.empty(16)
    for y in range(height):
        for x in range(width):
            k = piece[y, x]
            w = weight[y, x]
            if k < 0 or w <= 0.0:
                continue
            for i in range(4):
                for j in range(4):
                    b[4 * i + j] = basis[y % cell, i] * basis[x % cell, j]
            for m in range(16):
                wb = w * b[m]
                right_side[k, m] += wb * value[y, x]
                for n in range(m, 16):
                    matrix[k, m, n] += wb * b[n]


@njit(cache=True, nogil=True)
def evaluate_pixels(piece: I64, coefficient: I64, c: F64, basis: F64, cell: int, value: F64) -> None:
    """``value`` (H, W) of the surface at the pixels, NaN where they are of no piece."""
    height, width = piece.shape
    for y in range(height):
        for x in range(width):
            k = piece[y, x]
            total = np.nan
            if k >= 0:
                total = 0.0
                for i in range(4):
                    for j in range(4):
                        total += basis[y % cell, i] * basis[x % cell, j] * c[coefficient[k, 4 * i + j]]
            value[y, x] = total

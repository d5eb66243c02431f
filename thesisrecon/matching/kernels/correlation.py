"""Best and second best of correlations between patches."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32, I64


@njit(cache=True, nogil=True)
def scan_correlations(correlation: F32, xy2: F32, apart2: F32) -> tuple[I64, F32, F32]:
    """Best column of each row, its value, and the best value of a rival that lies elsewhere.

    ``correlation`` (B, N); ``xy2`` (N, 2) px; ``apart2`` (N,) squared distance within which a rival of column
    n counts as the same place. Returns index (B,), value (B,), rival (B,); -1 where there is no rival.
    """
    rows, columns = correlation.shape
    index = np.zeros(rows, np.int64)
    value = np.full(rows, -1.0, np.float32)
    rival = np.full(rows, -1.0, np.float32)
    for b in range(rows):
        row = correlation[b]
        best, top = 0, np.float32(-2.0)
        for n in range(columns):
            if row[n] > top:
                best, top = n, row[n]
        second = np.float32(-1.0)
        x, y, limit = xy2[best, 0], xy2[best, 1], apart2[best]
        for n in range(columns):
            if row[n] > second:
                dx, dy = xy2[n, 0] - x, xy2[n, 1] - y
                if dx * dx + dy * dy > limit:
                    second = row[n]
        index[b], value[b], rival[b] = best, top, second
    return index, value, rival


@njit(cache=True, nogil=True)
def update_column_best(correlation: F32, first_row: int, value: F32, index: I64) -> None:
    """Keep in ``value`` and ``index`` (N,) the best row of each column seen so far."""
    for b in range(correlation.shape[0]):
        row = correlation[b]
        for n in range(len(value)):
            if row[n] > value[n]:
                value[n] = row[n]
                index[n] = first_row + b

"""Nearest neighbours of points of an image by a grid of cells, faster than a tree for this many queries."""

from __future__ import annotations

import numpy as np

from thesisrecon._numba import empty, kernel, zeros
from thesisrecon.arrays import F64, I64


@kernel
def nearest_neighbours(xy: F64, of: F64, count: int) -> I64:
    """Numbers (N, count) of the points ``xy`` (M, 2) nearest to each position ``of`` (N, 2).

    The nearest is first, of equally distant ones that with the smaller number.
    """
    low, cell, shape = _grid(xy)
    start, order = _fill_cells(xy, low, cell, shape)
    found, near = empty((len(of), count), np.int64), empty(count)
    for n in range(len(of)):
        x, y = of[n, 0] - low[0], of[n, 1] - low[1]
        column = min(max(int(np.floor(x / cell)), 0), shape[0] - 1)
        row = min(max(int(np.floor(y / cell)), 0), shape[1] - 1)
        held, best = 0, found[n]
        for ring in range(max(shape[0], shape[1])):
            for r in range(max(row - ring, 0), min(row + ring, shape[1] - 1) + 1):
                inside = abs(r - row) < ring
                for c in range(column - ring, column + ring + 1, 2 * ring if inside else 1):
                    if c < 0 or c >= shape[0]:
                        continue
                    first = r * shape[0] + c
                    for at in range(start[first], start[first + 1]):
                        m = order[at]
                        dx, dy = xy[m, 0] - of[n, 0], xy[m, 1] - of[n, 1]
                        held = _insert(m, dx * dx + dy * dy, best, near, held)
            if held < count:
                continue
            # Every point within this distance is in the cells seen so far.
            safe = np.inf
            if column - ring > 0:
                safe = min(safe, x - (column - ring) * cell)
            if column + ring < shape[0] - 1:
                safe = min(safe, (column + ring + 1) * cell - x)
            if row - ring > 0:
                safe = min(safe, y - (row - ring) * cell)
            if row + ring < shape[1] - 1:
                safe = min(safe, (row + ring + 1) * cell - y)
            if near[count - 1] < safe * abs(safe):
                break
    return found


@kernel(forceinline=True)
def _insert(m: int, distance2: float, found: I64, near: F64, held: int) -> int:
    """Insert a point into the sorted list of ``held`` numbers and squared distances; return its length."""
    at = held
    if held == len(near):
        at = held - 1
        if distance2 > near[at] or (distance2 == near[at] and m > found[at]):
            return held
    while at > 0 and (near[at - 1] > distance2 or (near[at - 1] == distance2 and found[at - 1] > m)):
        near[at], found[at] = near[at - 1], found[at - 1]
        at -= 1
    near[at], found[at] = distance2, m
    return min(held + 1, len(near))


@kernel
def _grid(xy: F64) -> tuple[F64, float, I64]:
    """Lower corner (2,), side and numbers (2,) of square cells of about two points each."""
    low, high, shape = empty(2), empty(2), empty(2, np.int64)
    for a in range(2):
        low[a] = high[a] = xy[0, a]
        for n in range(len(xy)):
            low[a], high[a] = min(low[a], xy[n, a]), max(high[a], xy[n, a])
    width, height = high[0] - low[0], high[1] - low[1]
    cell = max(np.sqrt(2.0 * width * height / len(xy)), 2.0 * max(width, height) / len(xy), 1e-9)
    shape[0], shape[1] = int(width / cell) + 1, int(height / cell) + 1
    return low, cell, shape


@kernel
def _fill_cells(xy: F64, low: F64, cell: float, shape: I64) -> tuple[I64, I64]:
    """The points of cell c, row by row, are ``order[start[c]:start[c + 1]]``."""
    place, start = empty(len(xy), np.int64), zeros(shape[0] * shape[1] + 1, np.int64)
    for n in range(len(xy)):
        column = min(int((xy[n, 0] - low[0]) / cell), shape[0] - 1)
        place[n] = min(int((xy[n, 1] - low[1]) / cell), shape[1] - 1) * shape[0] + column
        start[place[n] + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    order, fill = empty(len(xy), np.int64), start.copy()
    for n in range(len(xy)):
        order[fill[place[n]]] = n
        fill[place[n]] += 1
    return start, order

"""Compiled semi-global passes: least costs along paths, each row of pixels by vector instructions."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]
I16 = NDArray[np.int16]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

UNREACHABLE = np.int16(16000)
"""Cost of a disparity beyond the range: more than any path, and no overflow with a penalty on top."""
BLOCK = 192
"""Rows that go through the horizontal passes together, at most."""
TILE = 32
"""Columns that are transposed together."""


@njit(cache=True, nogil=True)
def _jumps_between(
    a: I16, b: I16, largest: np.float32, least: np.float32, scale: np.float32, out: I16
) -> None:
    for x in range(len(out)):
        apart = np.float32(a[x]) - np.float32(b[x])
        apart = -apart if apart < 0 else apart
        jump = largest * scale / (scale + apart)
        out[x] = np.int16(least if jump < least else jump)


@njit(cache=True, nogil=True, error_model="numpy")
def jump_penalties(grey: I16, largest: np.float32, least: np.float32, scale: np.float32, out: I16) -> None:
    """The penalty of a large change of disparity between neighbours, ``out`` (4, H, W): of (y, x) and its
    neighbour at the left, above, above left and above right.

    It falls with the step of grey between them, ``largest`` / (1 + step / scale), but not below ``least``
    (Hirschmüller 2008, section 2.2).
    """
    height, width = grey.shape
    out[:] = np.int16(largest)
    for y in range(height):
        _jumps_between(grey[y, 1:], grey[y, : width - 1], largest, least, scale, out[0, y, 1:])
        if y > 0:
            above = grey[y - 1]
            _jumps_between(grey[y], above, largest, least, scale, out[1, y])
            _jumps_between(grey[y, 1:], above[: width - 1], largest, least, scale, out[2, y, 1:])
            _jumps_between(grey[y, : width - 1], above[1:], largest, least, scale, out[3, y, : width - 1])


@njit(cache=True, nogil=True)
def _extend(
    cost: U8,
    previous: tuple[I16, I16, I16],
    least: I16,
    jump: I16,
    step: np.int16,
    path: I16,
    path_least: I16,
    total: U16,
) -> None:
    """One disparity of a row of pixels: L = C + min(L'(d), L'(d +- 1) + P1, min L' + P2) - min L'.

    ``previous`` are the rows L'(d - 1), L'(d), L'(d + 1) of the pixels before on the path; ``path_least``
    takes the minimum and ``total`` the sum.
    """
    below, same, above = previous
    for x in range(len(cost)):
        beside = below[x]
        other = above[x]
        beside = np.int16((other if other < beside else beside) + step)
        value = same[x]
        value = beside if beside < value else value
        base = least[x]
        far = np.int16(base + jump[x])
        value = far if far < value else value
        value = np.int16(np.int16(value - base) + np.int16(cost[x]))
        path[x] = value
        so_far = path_least[x]
        path_least[x] = value if value < so_far else so_far
        total[x] = np.uint16(total[x] + np.uint16(value))


@njit(cache=True, nogil=True)
def _sweep_rows(costs: U8, jumps: I16, step: np.int16, shift: int, down: bool, total: U16) -> None:
    """Paths that come from the row above (or below, not ``down``), ``shift`` columns aside, through
    ``costs`` (N, D, W), added to ``total``; ``jumps`` (N, W) of each pixel and the one above."""
    rows, n, width = costs.shape
    paths = np.zeros((2, n + 2, width + 2), np.int16)
    paths[:, 0], paths[:, n + 1] = UNREACHABLE, UNREACHABLE
    least = np.zeros((2, width + 2), np.int16)
    lo, hi = 1 + shift, 1 + shift + width
    for i in range(rows):
        y = i if down else rows - 1 - i
        new, old = i & 1, 1 - (i & 1)
        least[new, 1 : width + 1] = UNREACHABLE
        # The penalty between two pixels is kept with the lower of them.
        of = y if down else min(y + 1, rows - 1)
        jump = np.empty(width, np.int16)
        jump[:] = jumps[of]
        if not down and shift != 0:
            jump[:] = UNREACHABLE
            # A path from the lower right is the upper-left penalty of the pixel it comes from.
            if shift > 0:
                jump[: width - 1] = jumps[of, 1:]
            else:
                jump[1:] = jumps[of, : width - 1]
        for q in range(n):
            _extend(
                costs[y, q],
                (paths[old, q, lo:hi], paths[old, q + 1, lo:hi], paths[old, q + 2, lo:hi]),
                least[old, lo:hi],
                jump,
                step,
                paths[new, q + 1, 1 : width + 1],
                least[new, 1 : width + 1],
                total[y, q],
            )


@njit(cache=True, nogil=True)
def _copy(source: U8 | U16, out: U8 | U16) -> None:
    for x in range(len(out)):
        out[x] = source[x]


@njit(cache=True, nogil=True)
def _transpose_bytes(source: U8, out: U8) -> None:
    """(N, D, W) to (W, D, N), N <= BLOCK, tile by tile: read column by column from where it lies, a row
    length that is a multiple of a large power of two would use a few places of the cache only."""
    rows, n, width = source.shape
    tile = np.empty((BLOCK, TILE + 16), np.uint8)
    for q in range(n):
        for start in range(0, width, TILE):
            size = min(TILE, width - start)
            for y in range(rows):
                _copy(source[y, q, start : start + size], tile[y, :size])
            for x in range(size):
                line = out[start + x, q]
                for y in range(rows):
                    line[y] = tile[y, x]


@njit(cache=True, nogil=True)
def _set_transposed(source: U16, out: U16) -> None:
    """(W, D, N) to (N, D, W), N <= BLOCK, tile by tile."""
    width, n, rows = source.shape
    tile = np.empty((BLOCK, TILE + 16), np.uint16)
    for q in range(n):
        for start in range(0, width, TILE):
            size = min(TILE, width - start)
            for x in range(size):
                line = source[start + x, q]
                for y in range(rows):
                    tile[y, x] = line[y]
            for y in range(rows):
                _copy(tile[y, :size], out[y, q, start : start + size])


@njit(cache=True, nogil=True)
def sum_paths(costs: U8, jumps: I16, step: np.int16, diagonals: bool, total: U16) -> None:
    """Sum over the paths that end in a pixel of their least costs, ``total`` (H, D, W), from ``costs``
    (H, D, W) (Hirschmüller 2008): along its row and column from both sides, and along the diagonals.

    ``jumps`` (4, H, W) from :func:`jump_penalties`, ``step`` the penalty of a change by one.
    """
    height, n, width = costs.shape
    # Along a row every pixel waits for the one before: many rows together, transposed, fill the vectors.
    for start in range(0, height, BLOCK):
        rows = min(BLOCK, height - start)
        part, added = np.empty((width, n, rows), np.uint8), np.zeros((width, n, rows), np.uint16)
        _transpose_bytes(costs[start : start + rows], part)
        turned = np.ascontiguousarray(jumps[0, start : start + rows].T)
        _sweep_rows(part, turned, step, 0, True, added)
        _sweep_rows(part, turned, step, 0, False, added)
        _set_transposed(added, total[start : start + rows])
    for down in (True, False):
        _sweep_rows(costs, jumps[1], step, 0, down, total)
        if diagonals:
            sign = -1 if down else 1
            _sweep_rows(costs, jumps[2], step, sign, down, total)
            _sweep_rows(costs, jumps[3], step, -sign, down, total)

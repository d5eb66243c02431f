"""Loops of the overlap estimate; the tests compare each with a NumPy twin."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32, F64, I64


@njit(cache=True, nogil=True)
def mutual_best(correlation: F32, xy2: F32, apart2: F32) -> tuple[I64, F32]:
    """Of each row of (N, M) correlations its column, -1 where they are not each other's best, and its rival.

    The rival (N,) is the largest correlation of a row elsewhere: with a column whose place ``xy2`` (M, 2) is
    farther from that of the best than the square root of the best's ``apart2`` (M,); -1 without any, and
    where the column is -1. The first of equal values counts.
    """
    rows, columns = correlation.shape
    column_value = np.full(columns, -2.0, np.float32)
    column_row = np.full(columns, -1, np.int64)
    index = np.full(rows, -1, np.int64)
    for r in range(rows):
        best, place = np.float32(-2.0), -1
        for c in range(columns):
            value = correlation[r, c]
            if value > best:
                best, place = value, c
            if value > column_value[c]:
                column_value[c] = value
                column_row[c] = r
        index[r] = place
    rival = np.full(rows, -1.0, np.float32)
    for r in range(rows):
        place = index[r]
        if place < 0 or column_row[place] != r:
            index[r] = -1
            continue
        for c in range(columns):
            if correlation[r, c] > rival[r]:
                dx, dy = xy2[c, 0] - xy2[place, 0], xy2[c, 1] - xy2[place, 1]
                if dx * dx + dy * dy > apart2[place]:
                    rival[r] = correlation[r, c]
    return index, rival


@njit(cache=True, nogil=True)
def most_agreeing(xy1: F64, xy2: F64, scale: F64, angle: F64, limits: F64) -> int:
    """The largest number of matches that the similarity of one of them predicts, that one not counted.

    Match m has places ``xy1[m]``, ``xy2[m]`` and a similarity: ``scale[m]`` (pixels of image 2 per pixel of
    image 1) and ``angle[m]`` (rad). It predicts another whose place in image 2 it foretells within
    ``limits[0]`` px, and whose scale differs by at most ``limits[1]`` in its logarithm, its angle by at most
    ``limits[2]`` rad.
    """
    most, radius2 = 0, limits[0] * limits[0]
    for h in range(len(xy1)):
        c, s = scale[h] * np.cos(angle[h]), scale[h] * np.sin(angle[h])
        count = 0
        for m in range(len(xy1)):
            x, y = xy1[m, 0] - xy1[h, 0], xy1[m, 1] - xy1[h, 1]
            dx = xy2[h, 0] + c * x - s * y - xy2[m, 0]
            dy = xy2[h, 1] + s * x + c * y - xy2[m, 1]
            turn = np.cos(angle[m] - angle[h])
            alike = abs(np.log(scale[m] / scale[h])) <= limits[1] and turn >= np.cos(limits[2])
            if m != h and alike and dx * dx + dy * dy <= radius2:
                count += 1
        most = max(most, count)
    return most

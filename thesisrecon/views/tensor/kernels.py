"""The transfer of every pixel of a photograph by a tensor."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thesisrecon.types import F32, F64

I16 = NDArray[np.int16]
I32 = NDArray[np.int32]


@njit(cache=True, nogil=True)
def transfer_rows(T: F64, P2: F64, places: F32, first: int, xy: F64, nearness: F32) -> None:
    """Where the third view sees the pixels (x, y), y from ``first`` on, with matches ``places`` (H, W, 2).

    Written are ``xy`` (H, W, 2) and ``nearness`` (H, W), as ``VirtualTensor.transfer`` has them; NaN where a
    match is.
    """
    height, width = nearness.shape
    for row in range(height):
        y = float(first + row)
        for column in range(width):
            x = float(column)
            x2, y2 = float(places[row, column, 0]), float(places[row, column, 1])
            xy[row, column, 0] = xy[row, column, 1] = nearness[row, column] = np.nan
            if not (np.isfinite(x2) and np.isfinite(y2)):
                continue
            a0 = P2[0, 0] * x + P2[0, 1] * y + P2[0, 2]
            a1 = P2[1, 0] * x + P2[1, 1] * y + P2[1, 2]
            a2 = P2[2, 0] * x + P2[2, 1] * y + P2[2, 2]
            # The direction of the epipolar line a_4 x a; its length cancels.
            l0 = P2[2, 3] * a0 - P2[0, 3] * a2
            l1 = P2[2, 3] * a1 - P2[1, 3] * a2
            l2 = -(l0 * x2 + l1 * y2)
            u = v = w = 0.0
            for i, xi in enumerate((x, y, 1.0)):
                for j, lj in enumerate((l0, l1, l2)):
                    weight = xi * lj
                    u += weight * T[i, j, 0]
                    v += weight * T[i, j, 1]
                    w += weight * T[i, j, 2]
            if not -w * (l0 * P2[0, 3] + l1 * P2[1, 3] + l2 * P2[2, 3]) > 0.0:
                continue
            xy[row, column, 0] = u / w
            xy[row, column, 1] = v / w
            nearness[row, column] = (l0 * a0 + l1 * a1 + l2 * a2) / w


@njit(cache=True, nogil=True)
def guess_rows(nearness: tuple[F32, F32], P2: F64, steps: I32, distance: I16, step: float, out: F32) -> None:
    """Nearness of all pixels of a photograph, into ``out`` (H, W): the known one, or that of a pixel around.

    ``nearness`` of this photograph (H, W) and of the other (h, w), each in its own view, NaN = unknown;
    ``P2`` (3, 4) the other camera; ``distance`` (K, H, W) how many of the ``steps`` (K, 2) (down, right) lead
    to the next known pixel. Of these pixels the nearest is taken, unless its surface would stand in front of
    what the other photograph sees by more than ``step``: such a one only where all do. NaN where there is
    none.
    """
    own, other = nearness
    for y in range(own.shape[0]):
        for x in range(own.shape[1]):
            out[y, x] = own[y, x]
            if not np.isnan(own[y, x]):
                continue
            least, before = np.inf, True
            for k in range(steps.shape[0]):
                n = distance[k, y, x]
                if n < 1:
                    continue
                reach = n * n * (steps[k, 0] ** 2 + steps[k, 1] ** 2)
                rho = own[y + n * steps[k, 0], x + n * steps[k, 1]]
                stands = _stands_before(other, P2, x, y, rho, step)
                if (before and not stands) or (before == stands and reach < least):
                    least, before = reach, stands
                    out[y, x] = rho


@njit(cache=True, nogil=True)
def _stands_before(other: F32, P2: F64, x: int, y: int, rho: float, step: float) -> bool:
    """Whether the point of a pixel at a nearness is in front of what the other photograph sees there."""
    u = P2[0, 0] * x + P2[0, 1] * y + P2[0, 2] + rho * P2[0, 3]
    v = P2[1, 0] * x + P2[1, 1] * y + P2[1, 2] + rho * P2[1, 3]
    w = P2[2, 0] * x + P2[2, 1] * y + P2[2, 2] + rho * P2[2, 3]
    if not w > 0.0:
        return True
    column, row = np.rint(u / w), np.rint(v / w)
    if not (0 <= row < other.shape[0] and 0 <= column < other.shape[1]):
        return False
    # A comparison with NaN is false.
    return bool(rho / w > other[int(row), int(column)] + step)

"""The transfer of every pixel of a photograph by a tensor."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32, F64


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

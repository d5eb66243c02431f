"""What is asked of all observations after every camera."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import B8, F64, I64


@njit(cache=True, nogil=True)
def project_observations(P: F64, X: F64, view: I64, point: I64, xy: F64, chosen: B8) -> tuple[F64, F64]:
    """Of the ``chosen`` (K,) observations the depth w and the distance px of (u, v) / w from ``xy`` (K, 2).

    (u, v, w) = P (V, 3, 4) of the view times X (N, 4) of the point. Of others, and in the focal plane, the
    depth is 0 and the distance infinite.
    """
    depth, distance = np.zeros(len(xy)), np.full(len(xy), np.inf)
    for k in range(len(xy)):
        if not chosen[k]:
            continue
        p, x = P[view[k]], X[point[k]]
        w = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3]
        if w == 0.0:
            continue
        u = (p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]) / w - xy[k, 0]
        v = (p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]) / w - xy[k, 1]
        depth[k] = w
        if np.isfinite(u) and np.isfinite(v):
            distance[k] = np.sqrt(u * u + v * v)
    return depth, distance

"""Section 6.3: space points from their images.

Linear (DLT, Hartley and Sturm, "Triangulation", CVIU 68(2), 1997) for any number of views at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def triangulate_observations(P: F64, view: I64, point: I64, xy: F64, n_points: int) -> F64:
    """Linear triangulation of all points of an observation list; -> (n_points, 4) with unit norm.

    P (V, 3, 4); view, point (K,), xy (K, 2) px. Minimises the algebraic residual u p3'X - p1'X, v p3'X -
    p2'X with each row pair scaled by the norm of its camera's first two rows. Points with fewer than two
    observations come out as zeros.
    """
    scale = np.linalg.norm(P[:, :2], axis=(1, 2))
    Q = (P / np.where(scale > 0, scale, 1.0)[:, None, None])[view]
    rows = xy[:, :, None] * Q[:, 2:3] - Q[:, :2]
    outer = np.einsum("kra,krb->kab", rows, rows).reshape(len(view), 16)
    normal = np.stack([np.bincount(point, outer[:, c], minlength=n_points) for c in range(16)], axis=1)
    counts = np.bincount(point, minlength=n_points)
    X = np.zeros((n_points, 4))
    enough = counts >= 2
    X[enough] = np.linalg.eigh(normal[enough].reshape(-1, 4, 4))[1][:, :, 0]
    return X


def triangulate_linear(P: F64, xy: F64) -> F64:
    """Linear triangulation, P (V, 3, 4), xy (V, N, 2) px with NaN where not seen; -> X (N, 4) unit norm.

    Points seen in fewer than two views come out as zeros.
    """
    if P.ndim != 3 or P.shape[1:] != (3, 4) or xy.ndim != 3 or xy.shape[0] != len(P) or xy.shape[2] != 2:
        raise ValueError(f"triangulate needs P (V, 3, 4) and xy (V, N, 2); got {P.shape} and {xy.shape}")
    view, point = np.nonzero(np.isfinite(xy).all(axis=2))
    return triangulate_observations(P, view, point, xy[view, point], xy.shape[1])


def triangulation_angles(centres: F64, view: I64, point: I64, X: F64, n_points: int) -> F64:
    """Largest angle (rad) between a point's rays, against the ray of its first observation; -> (n_points,).

    centres (V, 3), X (n_points, 3); observations sorted by point.
    """
    rays = X[point] - centres[view]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    first = np.searchsorted(point, np.arange(n_points))
    reference = rays[np.minimum(first, len(point) - 1)][point]
    cosine = np.clip(np.einsum("ka,ka->k", rays, reference), -1.0, 1.0)
    angles = np.zeros(n_points)
    np.maximum.at(angles, point, np.arccos(cosine))
    return angles

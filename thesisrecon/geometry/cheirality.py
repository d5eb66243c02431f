"""Section 3.5.2: which side of a camera a point is on, and signs that put every point in front.

Hartley, "Chirality", IJCV 26(1), 1998. The thesis' (3.27) is his chi; its magnitude is an inverse depth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def cheirality(X: F64, P: F64) -> F64:
    """chi(X, P) = det(M)^(1/3) W / t (3.27): positive in front of the camera, 0 on the plane at infinity.

    X (N, 4), P (3, 4) -> (N,); does not change when X or P is scaled, by a negative number either. Only its
    sign is that of the depth: its magnitude is an inverse depth, which for a camera not normalised has no
    unit; :func:`depth` measures.
    """
    t = X @ P[2]
    return np.asarray(np.cbrt(np.linalg.det(P[:, :3])) * X[:, 3] / t)


def depth(X: F64, P: F64) -> F64:
    """Signed distance of X (N, 4) from the principal plane of P (3, 4), in units of space (HZ 6.15)."""
    M = P[:, :3]
    return np.asarray(np.sign(np.linalg.det(M)) * (X @ P[2]) / (X[:, 3] * np.linalg.norm(M[2])))


def orient_signs(P: F64, X: F64, view: I64, point: I64, *, sweeps: int = 20) -> tuple[F64, F64, float]:
    """Signs of cameras and points that make the projective depths w of P_i X_j = w (u, v, 1) positive.

    P (V, 3, 4), X (N, 4), observations (view, point) (K,). Returns signs (V,), (N,) of +-1 and the share of
    observations they satisfy. For a reconstruction of real points the share is 1 up to wrong matches
    (Hartley 1998, theorem 17); votes of the neighbours decide, so a few wrong ones do not spread.
    """
    w = np.sign(np.einsum("kj,kj->k", P[view, 2], X[point]))
    views = np.zeros(len(P))
    points = np.zeros(len(X))
    if len(view) == 0:
        return np.ones(len(P)), np.ones(len(X)), 1.0
    views[np.bincount(view, minlength=len(P)).argmax()] = 1.0
    for _ in range(sweeps):
        points = np.sign(np.bincount(point, w * views[view], minlength=len(X)))
        votes = np.sign(np.bincount(view, w * points[point], minlength=len(P)))
        if np.array_equal(votes, views):
            break
        views = votes
    views[views == 0] = 1.0
    points[points == 0] = 1.0
    return views, points, float(np.mean(w * views[view] * points[point] > 0))

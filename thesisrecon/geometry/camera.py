"""Section 3.5: the projective camera P = K [R t], its parts and its centre.

The thesis writes R for camera-to-world (3.21); here R is world-to-camera, its transpose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import dehomogenize, homogenize

F64 = NDArray[np.float64]


def compose_camera(K: F64, R: F64, t: F64) -> F64:
    """P = K [R t]; K, R (..., 3, 3), t (..., 3) -> (..., 3, 4)."""
    return np.asarray(K @ np.concatenate([R, t[..., None]], axis=-1))


def decompose_camera(P: F64) -> tuple[F64, F64, F64]:
    """K, R, t of P (3.21), with K33 = 1, positive focals and det R = 1.

    P (3, 4) may have any scale and sign. Raises ``ValueError`` where the left 3x3 part is singular (a camera
    at infinity has no K).
    """
    M = P[:, :3]
    det = np.linalg.det(M)
    if not np.isfinite(P).all() or abs(det) < 1e-14 * np.linalg.norm(M) ** 3:
        raise ValueError("decompose_camera needs a finite camera; the left 3x3 part of P is singular")
    P = P * np.sign(det)
    K, R = rq(P[:, :3])
    t = np.linalg.solve(K, P[:, 3])
    return K / K[2, 2], R, np.asarray(t, dtype=np.float64)


def rq(M: F64) -> tuple[F64, F64]:
    """M = K R, K upper triangular with positive diagonal, R orthogonal (a rotation where det M > 0)."""
    Q, U = np.linalg.qr(M[::-1].T)
    K = U.T[::-1, ::-1]
    R = Q.T[::-1]
    signs = np.sign(np.diag(K))
    signs[signs == 0] = 1.0
    return K * signs, signs[:, None] * R


def camera_centre(P: F64) -> F64:
    """Centre by minors (3.24): the signed homogeneous 4-vector C with P C = 0; (..., 3, 4) -> (..., 4)."""
    columns = [0, 1, 2, 3]
    minors = [np.linalg.det(P[..., [c for c in columns if c != k]]) for k in columns]
    return np.stack([-minors[0], minors[1], -minors[2], minors[3]], axis=-1)


def project(P: F64, X: F64) -> F64:
    """Pixels of space points: P (3, 4), X (N, 3) or homogeneous (N, 4) -> (N, 2)."""
    Xh = homogenize(X) if X.shape[-1] == 3 else X
    return dehomogenize(Xh @ P.T)


def distort(xy_normalized: F64, k1: float) -> F64:
    """(x, y) (1 + k1 r^2): the one-parameter radial model on normalised image points (N, 2)."""
    r2 = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    return np.asarray(xy_normalized * (1.0 + k1 * r2))


def undistort(xy_normalized: F64, k1: float, *, iterations: int = 30) -> F64:
    """Inverse of :func:`distort` by fixed-point iteration; exact to rounding for |k1| r^2 < 0.3."""
    undistorted = xy_normalized
    for _ in range(iterations):
        undistorted = xy_normalized / (1.0 + k1 * np.sum(undistorted**2, axis=-1, keepdims=True))
    return undistorted


def project_camera(K: F64, R: F64, t: F64, X: F64, *, k1: float = 0.0) -> F64:
    """Pixels of X (N, 3) seen by a metric camera with radial distortion k1; -> (N, 2)."""
    normalized = dehomogenize(X @ R.T + t)
    return distort(normalized, k1) @ K[:2, :2].T + K[:2, 2]

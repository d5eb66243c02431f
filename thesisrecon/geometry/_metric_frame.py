"""Cameras and points in a metric frame, given the transform to it and the calibration matrices."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import B8, F64


def nearest_rotation(A: F64) -> F64:
    """The rotation nearest to A (3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(A)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def upgrade_cameras(P: F64, K: F64, metric_from_projective: F64) -> tuple[F64, F64, F64]:
    """Rotations (V, 3, 3) and translations (V, 3) nearest to C = K^-1 P H^-1 = s [R t], and singular values.

    The values (V, 3) are those of s R, equal for exact cameras.
    """
    Q = np.linalg.inv(K) @ (P @ np.linalg.inv(metric_from_projective))
    Q *= np.where(np.linalg.det(Q[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    U, S, Vt = np.linalg.svd(Q[:, :, :3])
    return U @ Vt, Q[:, :, 3] / S.mean(axis=1)[:, None], S


def upgrade_points(X: F64, valid: B8, metric_from_projective: F64) -> tuple[F64, B8, float]:
    """Points (N, 3), zeros where not finite; which are finite; and the scale of their frame, which is free:
    the median of their distances from their median.
    """
    Xm = X @ metric_from_projective.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        X = Xm[:, :3] / Xm[:, 3:]
    finite = valid & np.isfinite(X).all(axis=1)
    X = np.where(finite[:, None], X, 0.0)
    return X, finite, float(np.median(np.linalg.norm(X[finite] - np.median(X[finite], axis=0), axis=1)))

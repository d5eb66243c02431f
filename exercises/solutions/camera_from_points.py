"""DLT of a camera and its decomposition."""

import numpy as np
from scipy.linalg import rq

from solutions.homography import normalise


def dlt(X, xy):
    """Return P (3, 4), of any scale, from points (N, 3) and pixels (N, 2)."""
    x, T = normalise(xy)
    mean, s = X.mean(axis=0), np.sqrt(3) / X.std(axis=0).mean()
    U = np.vstack([np.column_stack([s * np.eye(3), -s * mean]), [0, 0, 0, 1]])
    Xn = np.column_stack([X, np.ones(len(X))]) @ U.T
    zero = np.zeros_like(Xn)
    A = np.vstack([np.hstack([Xn, zero, -x[:, :1] * Xn]), np.hstack([zero, Xn, -x[:, 1:2] * Xn])])
    return np.linalg.inv(T) @ np.linalg.svd(A)[2][-1].reshape(3, 4) @ U


def camera_from_points(X, xy):
    """Return K, R, t from points (N, 3) and pixels (N, 2)."""
    P = dlt(X, xy)
    P = P * np.sign(np.linalg.det(P[:, :3]))
    K, R = rq(P[:, :3])
    S = np.diag(np.sign(np.diag(K)))
    K, R = K @ S, S @ R
    t = np.linalg.inv(K) @ P[:, 3]
    return K / K[2, 2], R, t

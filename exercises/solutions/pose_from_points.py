"""Linear resection with known K."""

import numpy as np

from solutions.camera_from_points import dlt


def pose_from_points(X, xy, K):
    """Return R and t from points (N, 3), pixels (N, 2) and K."""
    P = np.linalg.inv(K) @ dlt(X, xy)
    P = P * np.sign(np.linalg.det(P[:, :3]))
    U, s, Vt = np.linalg.svd(P[:, :3])
    return U @ Vt, P[:, 3] / s.mean()

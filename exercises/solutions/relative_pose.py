"""The pose of an essential matrix."""

import numpy as np

from solutions.triangulation import triangulation


def relative_pose(E, x1, x2):
    """Return R and t of E for matches (N, 2)."""
    U, _, Vt = np.linalg.svd(E)
    W = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    best = -1
    for A in (U @ W @ Vt, U @ W.T @ Vt):
        for t in (U[:, 2], -U[:, 2]):
            R = A * np.sign(np.linalg.det(A))
            X = triangulation(np.eye(3, 4), np.column_stack([R, t]), x1, x2)
            front = np.sum((X[:, 2] > 0) & ((X @ R.T + t)[:, 2] > 0))
            if front > best:
                best, pose = front, (R, t)
    return pose

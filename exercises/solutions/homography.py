"""Normalised DLT."""

import numpy as np


def normalise(xy):
    """Homogeneous points (N, 3) with mean 0 and mean distance sqrt 2, and T (3, 3)."""
    mean = xy.mean(axis=0)
    s = np.sqrt(2) / np.linalg.norm(xy - mean, axis=1).mean()
    T = np.array([[s, 0, -s * mean[0]], [0, s, -s * mean[1]], [0, 0, 1]])
    return np.column_stack([xy, np.ones(len(xy))]) @ T.T, T


def homography(xy1, xy2):
    """Return H (3, 3) from pixels (N, 2)."""
    x1, T1 = normalise(xy1)
    x2, T2 = normalise(xy2)
    zero = np.zeros_like(x1)
    rows1 = np.hstack([zero, -x1, x2[:, 1:2] * x1])
    rows2 = np.hstack([x1, zero, -x2[:, :1] * x1])
    H = np.linalg.svd(np.vstack([rows1, rows2]))[2][-1].reshape(3, 3)
    return np.linalg.inv(T2) @ H @ T1

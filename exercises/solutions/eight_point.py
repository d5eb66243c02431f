"""Normalised eight-point algorithm."""

import numpy as np

from solutions.homography import normalise


def eight_point(xy1, xy2):
    """Return F (3, 3) from pixels (N, 2)."""
    x1, T1 = normalise(xy1)
    x2, T2 = normalise(xy2)
    A = (x2[:, :, None] * x1[:, None, :]).reshape(-1, 9)
    F = np.linalg.svd(A)[2][-1].reshape(3, 3)
    U, s, Vt = np.linalg.svd(F)
    s[2] = 0
    F = U @ np.diag(s) @ Vt
    return T2.T @ F @ T1

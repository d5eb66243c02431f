"""Seven-point algorithm."""

import numpy as np

from solutions.homography import normalise


def seven_point(xy1, xy2):
    """Return all F (S, 3, 3) from pixels (7, 2)."""
    x1, T1 = normalise(xy1)
    x2, T2 = normalise(xy2)
    A = (x2[:, :, None] * x1[:, None, :]).reshape(-1, 9)
    F1, F2 = np.linalg.svd(A)[2][-2:].reshape(2, 3, 3)
    a = np.arange(4)
    values = [np.linalg.det(k * F1 + (1 - k) * F2) for k in a]
    roots = np.roots(np.polyfit(a, values, 3))
    real = roots.real[np.abs(roots.imag) < 1e-6]
    return np.array([T2.T @ (k * F1 + (1 - k) * F2) @ T1 for k in real])

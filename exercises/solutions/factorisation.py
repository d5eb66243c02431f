"""Factorisation of Tomasi and Kanade."""

import numpy as np


def factorisation(xy):
    """Return M, t, X from pixels (V, N, 2)."""
    t = xy.mean(axis=1)
    W = (xy - t[:, None]).transpose(0, 2, 1).reshape(-1, xy.shape[1])
    U, s, Vt = np.linalg.svd(W, full_matrices=False)
    return (U[:, :3] * s[:3]).reshape(-1, 2, 3), t, Vt[:3].T

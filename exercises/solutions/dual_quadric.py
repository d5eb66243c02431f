"""Linear self-calibration."""

import numpy as np


def dual_quadric(P):
    """Return the focal lengths (V,) of projective cameras (V, 3, 4)."""
    i, j = np.triu_indices(4)
    basis = np.zeros((10, 4, 4))
    basis[range(10), i, j] = basis[range(10), j, i] = 1
    P = P / np.linalg.norm(P, axis=(1, 2), keepdims=True)
    w = np.einsum("vab,kbc,vdc->vkad", P, basis, P)
    rows = [w[..., 0, 1], w[..., 0, 2], w[..., 1, 2], w[..., 0, 0] - w[..., 1, 1]]
    q = np.linalg.svd(np.concatenate(rows))[2][-1]
    w = np.einsum("vkad,k->vad", w, q)
    return np.sqrt(w[:, 0, 0] / w[:, 2, 2])

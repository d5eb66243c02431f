"""Similarity transforms between point sets: how two metric models are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import require_finite, require_shapes


@dataclass(frozen=True)
class Similarity:
    """The similarity y = scale R x + t, R (3, 3) a rotation, t (3,)."""

    scale: float
    R: F64
    t: F64

    def apply(self, X: F64) -> F64:
        """Transform points (N, 3)."""
        return self.scale * X @ self.R.T + self.t

    @property
    def matrix(self) -> F64:
        """Transform of homogeneous points; ndarray (4, 4)."""
        G = np.eye(4)
        G[:3, :3] = self.scale * self.R
        G[:3, 3] = self.t
        return G


def estimate_similarity(source: F64, target: F64) -> Similarity:
    """Estimate the least-squares similarity that takes ``source`` (N, 3) to ``target`` (N, 3).

    Raises ValueError for fewer than 3 points, or collinear ones (the rotation about the line is free).
    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI, 1991.
    """
    require_shapes("estimate_similarity", source=(source, ("N", 3)), target=(target, ("N", 3)))
    if len(source) < 3:
        raise ValueError(f"estimate_similarity needs at least 3 points; got {len(source)}")
    require_finite("estimate_similarity", source, target)
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s, t = source - mean_s, target - mean_t
    U, D, Vt = np.linalg.svd(t.T @ s / len(s))
    if D[1] <= 1e-12 * max(D[0], 1e-300):
        raise ValueError("estimate_similarity needs points that do not all lie on one line")
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ S @ Vt
    scale = float(np.trace(np.diag(D) @ S) / np.mean(np.sum(s**2, axis=1)))
    return Similarity(scale, R, mean_t - scale * R @ mean_s)

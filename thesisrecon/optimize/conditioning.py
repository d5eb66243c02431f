"""Frames in which projective problems are well conditioned: scaled pixels and whitened space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def pixel_conditioning(xy: F64) -> F64:
    """T (3, 3) that moves the middle of xy (K, 2) to 0 and its half-diagonal to 1; isotropic, so residuals
    scale.

    The identity's scale stands in where all pixels are equal.
    """
    if len(xy) == 0:
        return np.eye(3)
    low, high = xy.min(axis=0), xy.max(axis=0)
    half = 0.5 * float(np.hypot(*(high - low)))
    s = 1.0 / half if half > 0.0 else 1.0
    cx, cy = 0.5 * (low + high)
    return np.array([[s, 0.0, -s * cx], [0.0, s, -s * cy], [0.0, 0.0, 1.0]])


def scene_frame(X: F64) -> tuple[F64, float]:
    """Middle (3,) and inverse size of points X (N, 3) by medians, so that far points do not matter.

    (0, 1) without points; the scale is 1 where all points are equal.
    """
    if len(X) == 0:
        return np.zeros(3), 1.0
    origin = np.median(X, axis=0)
    size = float(np.median(np.linalg.norm(X - origin, axis=1)))
    return origin, 1.0 / size if size > 0.0 else 1.0


def whitening_transform(X: F64, *, rounds: int = 4) -> F64:
    """M (4, 4) for which the unit vectors x = M X / |M X| have sum x x' proportional to I; X (N, 4)
    homogeneous.

    Fixed-point iteration of Tyler (Annals of Statistics 1987): every point counts as a direction, so neither
    the homogeneous scales nor a few far points matter. Directions without extent (all points on a plane) are
    stretched by at most 1e6. det M > 0, hence orientations are kept; points of norm 0 are left out.
    """
    M = np.eye(4)
    norms = np.linalg.norm(X, axis=1)
    X = X[norms > 0.0] / norms[norms > 0.0, None]
    if len(X) < 4:
        return M
    for _ in range(rounds):
        moved = X @ M.T
        moved /= np.linalg.norm(moved, axis=1)[:, None]
        values, vectors = np.linalg.eigh(moved.T @ moved / len(moved))
        stretch = 1.0 / np.sqrt(np.maximum(4.0 * values, 1e-12))
        M = (vectors * stretch) @ vectors.T @ M
        M /= np.linalg.norm(M)
    return M

"""Section 3.2: homogeneous coordinates and the small helpers every chapter uses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def homogenize(x: F64) -> F64:
    """Append a 1 to each row: (..., d) -> (..., d + 1)."""
    return np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)


def dehomogenize(xh: F64) -> F64:
    """Divide by the last coordinate: (..., d + 1) -> (..., d); points at infinity give inf or NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return xh[..., :-1] / xh[..., -1:]


def cross_matrix(a: F64) -> F64:
    """[a]x with ``cross_matrix(a) @ b == cross(a, b)``; (..., 3) -> (..., 3, 3)."""
    z = np.zeros(a.shape[:-1])
    rows = [z, -a[..., 2], a[..., 1], a[..., 2], z, -a[..., 0], -a[..., 1], a[..., 0], z]
    return np.stack(rows, axis=-1).reshape(*a.shape[:-1], 3, 3)


def normalizing_transform(xy: F64) -> F64:
    """Hartley's conditioning: centroid to 0, mean distance to sqrt(2); (N, 2) -> (3, 3).

    Raises ``ValueError`` where all points are equal (no scale exists).
    """
    centroid = xy.mean(axis=0)
    distance = float(np.linalg.norm(xy - centroid, axis=1).mean())
    if not distance > 1e-12 * max(1.0, float(np.abs(centroid).max())):
        raise ValueError(f"normalizing_transform needs points that differ; got {len(xy)} equal points")
    s = np.sqrt(2.0) / distance
    return np.array([[s, 0.0, -s * centroid[0]], [0.0, s, -s * centroid[1]], [0.0, 0.0, 1.0]])


def pixel_from_unit(sizes: NDArray[np.int64]) -> F64:
    """Transforms (V, 3, 3) from unit-free to pixel coordinates of images of ``sizes`` (V, 2) width, height.

    The origin of unit-free coordinates is the image centre, their unit the long side.
    """
    scale = sizes.max(axis=1).astype(np.float64)
    T = np.zeros((len(sizes), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = (sizes - 1.0) / 2.0
    T[:, 2, 2] = 1.0
    return T

"""Section 3.2: homogeneous coordinates and the small helpers every chapter uses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64


def require_finite(caller: str, *arrays: F64) -> None:
    """``ValueError`` that names ``caller`` where an entry is NaN or infinite: decompositions fail there."""
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError(f"{caller} needs finite numbers; some are NaN or infinite")


def inverse_of(G: F64, caller: str) -> F64:
    """G^-1 (..., d, d); ``ValueError`` that names ``caller`` where G is singular or not finite."""
    require_finite(caller, G)
    try:
        return np.asarray(np.linalg.inv(G), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{caller} needs an invertible matrix; got a singular one of {G.shape}") from error


def unit_of(array: F64, caller: str) -> F64:
    """An array of any shape with Frobenius norm 1; ``ValueError`` where it is zero or not finite."""
    require_finite(caller, array)
    norm = float(np.linalg.norm(array))
    if not norm > 0.0:
        raise ValueError(f"{caller} needs numbers that are not all zero")
    return array / norm


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

    Raises ``ValueError`` where all points are equal (no scale exists) and where one is not finite.
    """
    require_finite("normalizing_transform", xy)
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

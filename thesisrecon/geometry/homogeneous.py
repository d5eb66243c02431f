"""Section 3.2: homogeneous coordinates, and the transforms and scales that condition them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64, require_finite


def homogenize(x: F64) -> F64:
    """Append a coordinate 1 to each point (..., d)."""
    return np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)


def dehomogenize(xh: F64) -> F64:
    """Divide homogeneous points by their last coordinate; inf or NaN for points at infinity."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return xh[..., :-1] / xh[..., -1:]


def map_in_front(H: F64, x: F64) -> F64:
    """Map points (..., d) by a homography, NaN where the last coordinate is not positive."""
    xh = homogenize(x) @ H.T
    return np.where(xh[..., -1:] > 0.0, dehomogenize(xh), np.nan)


def unit_normals(l: F64) -> F64:
    """Scale lines l or planes such that l . (x, 1) is a signed distance; those at infinity stay."""
    norm = np.linalg.norm(l[..., :-1], axis=-1, keepdims=True)
    return l / np.where(norm > 0.0, norm, 1.0)


def directions_across(v: F64) -> F64:
    """Orthonormal rows (D - 1, D) orthogonal to a vector (D,): those of a Householder reflection."""
    u = v / np.linalg.norm(v)
    u[0] += np.copysign(1.0, u[0])
    return (np.eye(len(u)) - np.outer(2.0 / (u @ u) * u, u))[1:]


def cross_matrix(a: F64) -> F64:
    """The skew-symmetric matrix [a]x with [a]x b = a x b."""
    out = np.zeros((*a.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., j, i], out[..., i, j] = a[..., k], -a[..., k]
    return out


_MAX_STRETCH = 1e3
"""Largest stretch s of one direction of space against another in a whitened frame.

Rounding errors grow to s eps of the scene, 2e-9 px in an image of 1e4 px. Relief below 1 / s of the scene
moves its images by no more than their noise (1 px in 1e3), and with more stretch noise moves points farther
than a linearisation holds.
"""


def checked_inverse(G: F64, caller: str) -> F64:
    """Invert a matrix; a singular one is a ``ValueError`` in the name of the caller."""
    require_finite(caller, G)
    try:
        return np.asarray(np.linalg.inv(G), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{caller} needs an invertible matrix; got a singular one of {G.shape}") from error


def checked_unit(array: F64, caller: str) -> F64:
    """Scale to unit Frobenius norm; zeros are a ``ValueError`` in the name of the caller."""
    require_finite(caller, array)
    norm = float(np.linalg.norm(array))
    if not norm > 0.0:
        raise ValueError(f"{caller} needs numbers that are not all zero")
    return array / norm


def normalizing_transform(xy: F64) -> F64:
    """Hartley's normalisation: centroid to 0, mean distance to sqrt(2) (PAMI 19(6), 1997)."""
    require_finite("normalizing_transform", xy)
    centroid = xy.mean(axis=0)
    distance = float(np.linalg.norm(xy - centroid, axis=1).mean())
    if not distance > 1e-12 * max(1.0, float(np.abs(centroid).max())):
        raise ValueError(f"normalizing_transform needs points that differ; got {len(xy)} equal points")
    s = np.sqrt(2.0) / distance
    return np.array([[s, 0.0, -s * centroid[0]], [0.0, s, -s * centroid[1]], [0.0, 0.0, 1.0]])


def pixel_from_unit(sizes: NDArray[np.int64]) -> F64:
    """Transforms (V, 3, 3) to pixels from coordinates about the image centre in units of the longer side."""
    scale = sizes.max(axis=1).astype(np.float64)
    T = np.zeros((len(sizes), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = (sizes - 1.0) / 2.0
    T[:, 2, 2] = 1.0
    return T


def pixel_conditioning(xy: F64) -> F64:
    """Isotropic transform of the pixels' bounding box to centre 0 and half-diagonal 1."""
    if len(xy) == 0:
        return np.eye(3)
    low, high = xy.min(axis=0), xy.max(axis=0)
    half = 0.5 * float(np.hypot(*(high - low)))
    s = 1.0 / half if half > 0.0 else 1.0
    cx, cy = 0.5 * (low + high)
    return np.array([[s, 0.0, -s * cx], [0.0, s, -s * cy], [0.0, 0.0, 1.0]])


def scene_frame(X: F64) -> tuple[F64, float]:
    """Median (3,) of a point set and 1 / median distance from it; 0 and 1 without points."""
    if len(X) == 0:
        return np.zeros(3), 1.0
    origin = np.median(X, axis=0)
    size = float(np.median(np.linalg.norm(X - origin, axis=1)))
    return origin, 1.0 / size if size > 0.0 else 1.0


class SpaceFrame(NamedTuple):
    """Coordinates S N X of space: N (4, 4) centres and scales, S (4, 4) stretches, apart to keep digits."""

    N: F64
    S: F64

    def points(self, X: F64) -> F64:
        """Return points (N, 4) in the frame."""
        return np.asarray(X @ self.N.T @ self.S.T)

    def cameras(self, P: F64) -> F64:
        """Return cameras (..., 3, 4) in the frame."""
        return np.asarray(P @ np.linalg.inv(self.N) @ np.linalg.inv(self.S))

    def points_back(self, X: F64) -> F64:
        """Return points (N, 4) of the frame in the caller's coordinates."""
        return np.asarray(X @ np.linalg.inv(self.S).T @ np.linalg.inv(self.N).T)

    def cameras_back(self, P: F64) -> F64:
        """Return cameras (..., 3, 4) of the frame in the caller's coordinates."""
        return np.asarray(P @ self.S @ self.N)


def centring_transform(X: F64) -> F64:
    """Similarity (4, 4) that takes the median of homogeneous points to 0, their median distance to 1."""
    # The rounding of points at infinity is a few units in the last place, as of a point at 1e15.
    finite = np.abs(X[:, 3]) > 1e-12 * np.linalg.norm(X, axis=1)
    origin, scale = scene_frame(X[finite, :3] / X[finite, 3:])
    return np.block([[scale * np.eye(3), -scale * origin[:, None]], [np.eye(4)[3:]]])


def whitening_transform(X: F64, *, rounds: int = 4) -> F64:
    """M for which the unit vectors x = M X / |M X| have sum x x' proportional to I (Tyler, Ann. Stat. 1987).

    Neither homogeneous scales nor a few far points matter. No direction is stretched more than
    ``_MAX_STRETCH`` times another. det M > 0, which keeps orientations; I for fewer than 4 points.
    """
    M = np.eye(4)
    X = X[np.linalg.norm(X, axis=1) > 0.0]
    if len(X) < 4:
        return M
    for _ in range(rounds):
        moved = X @ M.T
        moved /= np.linalg.norm(moved, axis=1)[:, None]
        values, vectors = np.linalg.eigh(moved.T @ moved / len(moved))
        M = (vectors / np.sqrt(np.maximum(4.0 * values, _MAX_STRETCH**-2))) @ vectors.T @ M
        U, s, Vt = np.linalg.svd(M)
        M = (U * np.minimum(s / s[3], _MAX_STRETCH)) @ Vt
    return M


def whitened_frame(X: F64) -> SpaceFrame:
    """Frame that centres points (N, 4), then whitens them."""
    N = centring_transform(X)
    return SpaceFrame(N, whitening_transform(X @ N.T))


def quadratic_rows(x: F64, y: F64) -> F64:
    """Rows (..., n (n + 1) / 2) with r . q = x' Q y for the upper triangle q of a symmetric Q, row by row."""
    pairs = zip(*np.triu_indices(x.shape[-1]), strict=True)
    terms = [x[..., a] * y[..., b] + (x[..., b] * y[..., a] if a != b else 0.0) for a, b in pairs]
    return np.stack(terms, axis=-1)


def symmetric(q: F64) -> F64:
    """The symmetric matrices (..., n, n) of upper triangles (..., n (n + 1) / 2)."""
    n = int(np.sqrt(2 * q.shape[-1]))
    place, upper = np.empty((n, n), np.int64), np.triu_indices(n)
    place[upper] = place[upper[::-1]] = np.arange(q.shape[-1])
    return q[..., place]


def unit_norm(F: F64) -> F64:
    """Scale matrices (..., m, n) to unit Frobenius norm; zeros stay zeros."""
    norm = np.sqrt(np.sum(F**2, axis=(-2, -1), keepdims=True))
    return F / np.where(norm > 0.0, norm, 1.0)


def unit_tensor(T: F64) -> F64:
    """Scale a tensor (3, 3, 3) to unit norm; zeros stay zeros."""
    norm = float(np.linalg.norm(T))
    return T / norm if norm > 0.0 else T

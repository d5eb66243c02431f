"""Section 3.2: homogeneous coordinates."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64


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


def cross_matrix(a: F64) -> F64:
    """The skew-symmetric matrix [a]x with [a]x b = a x b."""
    z = np.zeros(a.shape[:-1])
    rows = [z, -a[..., 2], a[..., 1], a[..., 2], z, -a[..., 0], -a[..., 1], a[..., 0], z]
    return np.stack(rows, axis=-1).reshape(*a.shape[:-1], 3, 3)

"""Section 3.2: homogeneous coordinates."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64


def homogenize(x: F64) -> F64:
    """Append a coordinate 1 to each point.

    Parameters
    ----------
    x : ndarray (..., d)
        Points.

    Returns
    -------
    ndarray (..., d + 1)
    """
    return np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)


def dehomogenize(xh: F64) -> F64:
    """Divide homogeneous points by their last coordinate.

    Parameters
    ----------
    xh : ndarray (..., d + 1)
        Homogeneous points.

    Returns
    -------
    ndarray (..., d)
        Inf or NaN for points at infinity.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return xh[..., :-1] / xh[..., -1:]


def unit_normals(l: F64) -> F64:
    """Scale lines l or planes such that l . (x, 1) is a signed distance; those at infinity stay as they are.

    Parameters
    ----------
    l : ndarray (..., 3) or (..., 4)
        Lines or planes; a point lies on them if l . x = 0.

    Returns
    -------
    ndarray (..., 3) or (..., 4)
    """
    norm = np.linalg.norm(l[..., :-1], axis=-1, keepdims=True)
    return l / np.where(norm > 0.0, norm, 1.0)


def cross_matrix(a: F64) -> F64:
    """Return the skew-symmetric matrix [a]x with [a]x b = a x b.

    Parameters
    ----------
    a : ndarray (..., 3)
        Vectors.

    Returns
    -------
    ndarray (..., 3, 3)

    Examples
    --------
    >>> import numpy as np
    >>> a, b = np.array([1.0, 2, 3]), np.array([4.0, 5, 6])
    >>> bool(np.allclose(cross_matrix(a) @ b, np.cross(a, b)))
    True
    """
    z = np.zeros(a.shape[:-1])
    rows = [z, -a[..., 2], a[..., 1], a[..., 2], z, -a[..., 0], -a[..., 1], a[..., 0], z]
    return np.stack(rows, axis=-1).reshape(*a.shape[:-1], 3, 3)

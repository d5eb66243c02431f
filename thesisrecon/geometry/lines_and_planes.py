"""Section 3.2: points, lines and planes in homogeneous coordinates: incidence, joins and meets.

An image line is l (3,) with l . x = 0, a plane Pi (4,) with Pi . X = 0; a camera P maps the plane P'l to the
line l. A line of space is its Pluecker matrix L = X Y' - Y X' of two of its points, or L* = Pi Psi' - Psi Pi'
of two of its planes (Hartley and Zisserman 3.2.2, which the thesis omits); its image is [l]x = P L P'.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import camera_centre


def join(*points: F64) -> F64:
    """Return the line of two points or the plane of three; by duality, where lines or planes meet.

    The line of two image points and the intersection of two image lines are x cross y; L of two space points
    and L* of two planes are X Y' - Y X'; the plane of three points and the point of three planes are minors
    (3.24). Entities that coincide, or three points of one line, give zeros.

    Parameters
    ----------
    *points : ndarray (..., 3) or (..., 4)
        Two or three homogeneous points, or image lines or planes.

    Returns
    -------
    ndarray (..., 3), (..., 4, 4) or (..., 4)

    Examples
    --------
    >>> join(np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 1.0])).tolist()
    [-1.0, 1.0, 0.0]
    >>> plane = join(*(np.eye(4)[:3] + [0.0, 0.0, 0.0, 1.0]))
    >>> (plane / plane[0]).round(9).tolist()
    [1.0, 1.0, 1.0, -1.0]
    """
    if points[0].shape[-1] == 3:
        return np.cross(points[0], points[1])
    if len(points) == 3:
        return camera_centre(np.stack(np.broadcast_arrays(*points), axis=-2))
    outer = points[0][..., :, None] * points[1][..., None, :]
    return np.asarray(outer - np.swapaxes(outer, -1, -2))


def unit_normals(l: F64) -> F64:
    """Scale lines or planes such that l . (x, 1) is a signed distance; those at infinity stay as they are.

    Parameters
    ----------
    l : ndarray (..., 3) or (..., 4)
        Lines or planes.

    Returns
    -------
    ndarray (..., 3) or (..., 4)

    Examples
    --------
    >>> unit_normals(np.array([3.0, 4.0, 10.0])).tolist()
    [0.6, 0.8, 2.0]
    """
    norm = np.linalg.norm(l[..., :-1], axis=-1, keepdims=True)
    return l / np.where(norm > 0.0, norm, 1.0)


def dual_line(L: F64) -> F64:
    """Convert a Pluecker matrix L to L*, and L* to L: entries 12, 13, 14 are exchanged with 34, 42, 23.

    Parameters
    ----------
    L : ndarray (..., 4, 4)
        Pluecker matrices.

    Returns
    -------
    ndarray (..., 4, 4)
    """
    dual = np.zeros_like(L)
    for (a, b), (c, d) in (((0, 1), (2, 3)), ((0, 2), (3, 1)), ((0, 3), (1, 2))):
        dual[..., a, b], dual[..., c, d] = L[..., c, d], L[..., a, b]
        dual[..., b, a], dual[..., d, c] = L[..., d, c], L[..., b, a]
    return dual


def meet_of_line_and_plane(L: F64, plane: F64) -> F64:
    """Return the point L Pi in which a line meets a plane; the plane L* X of a line and a point for L*.

    Parameters
    ----------
    L : ndarray (..., 4, 4)
        Pluecker matrices of lines, L or L*.
    plane : ndarray (..., 4)
        Planes, or points for L*.

    Returns
    -------
    ndarray (..., 4)
        Zeros if the line lies in the plane or contains the point.
    """
    return np.asarray(np.einsum("...ij,...j->...i", L, plane))

"""Section 3.2: points, lines and planes in homogeneous coordinates: incidence, joins and meets.

An image line is l (3,) with l . x = 0, a plane Pi (4,) with Pi . X = 0. A line of space is its Pluecker
matrix L = X Y' - Y X' of two of its points, or L* = Pi Psi' - Psi Pi' of two of its planes (Hartley and
Zisserman 3.2.2, which the thesis omits).
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import camera_centre


def line_through(x: F64, y: F64) -> F64:
    """Return the line x cross y of two image points.

    Parameters
    ----------
    x, y : ndarray (..., 3), homogeneous image points

    Returns
    -------
    ndarray (..., 3), line; zero if the points are equal

    Examples
    --------
    >>> line_through(np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 1.0])).tolist()
    [-1.0, 1.0, 0.0]
    """
    return np.cross(x, y)


def meet_of_lines(l: F64, m: F64) -> F64:
    """Return the intersection l cross m of two image lines.

    Parameters
    ----------
    l, m : ndarray (..., 3), lines

    Returns
    -------
    ndarray (..., 3), homogeneous point, at infinity for parallel lines; zero if the lines are equal

    Examples
    --------
    >>> meet_of_lines(np.array([1.0, 0.0, -2.0]), np.array([0.0, 1.0, -3.0])).tolist()
    [2.0, 3.0, 1.0]
    """
    return np.cross(l, m)


def incidence_sine(dual: F64, point: F64) -> F64:
    """Return |dual . point| / (|dual| |point|), 0 if the line or plane contains the point.

    Parameters
    ----------
    dual : ndarray (..., d), lines (d = 3) or planes (d = 4) of any scale
    point : ndarray (..., d), homogeneous points of any scale

    Returns
    -------
    ndarray (...), values in [0, 1]; 0 for zero vectors
    """
    size = np.linalg.norm(dual, axis=-1) * np.linalg.norm(point, axis=-1)
    return np.asarray(np.abs(np.sum(dual * point, axis=-1)) / np.maximum(size, 1e-300))


def unit_normals(l: F64) -> F64:
    """Scale lines or planes such that l . (x, 1) is a signed distance.

    Parameters
    ----------
    l : ndarray (..., 3) or (..., 4), lines or planes; those at infinity are returned unchanged

    Returns
    -------
    ndarray, scaled lines or planes, of the shape of ``l``

    Examples
    --------
    >>> unit_normals(np.array([3.0, 4.0, 10.0])).tolist()
    [0.6, 0.8, 2.0]
    """
    norm = np.linalg.norm(l[..., :-1], axis=-1, keepdims=True)
    return l / np.where(norm > 0.0, norm, 1.0)


def plane_through(X: F64, Y: F64, Z: F64) -> F64:
    """Return the plane of three points.

    Parameters
    ----------
    X, Y, Z : ndarray (..., 4), homogeneous points

    Returns
    -------
    ndarray (..., 4), plane, by the minors of (3.24); zero if the points are collinear

    Examples
    --------
    >>> X, Y, Z = np.eye(4)[:3] + [0.0, 0.0, 0.0, 1.0]
    >>> plane = plane_through(X, Y, Z)
    >>> (plane / plane[0]).round(9).tolist()
    [1.0, 1.0, 1.0, -1.0]
    """
    return camera_centre(np.stack(np.broadcast_arrays(X, Y, Z), axis=-2))


def meet_of_planes(plane1: F64, plane2: F64, plane3: F64) -> F64:
    """Return the common point of three planes.

    Parameters
    ----------
    plane1, plane2, plane3 : ndarray (..., 4), planes

    Returns
    -------
    ndarray (..., 4), homogeneous point; zero if the planes share a line
    """
    return plane_through(plane1, plane2, plane3)


def join_points(X: F64, Y: F64) -> F64:
    """Return the Pluecker matrix X Y' - Y X' of the line through two points.

    The same expression of two planes is L* of their common line; :func:`dual_line` converts between the two.

    Parameters
    ----------
    X, Y : ndarray (..., 4), homogeneous points

    Returns
    -------
    ndarray (..., 4, 4), skew-symmetric L; zero if the points are equal
    """
    outer = X[..., :, None] * Y[..., None, :]
    return np.asarray(outer - np.swapaxes(outer, -1, -2))


def dual_line(L: F64) -> F64:
    """Convert a Pluecker matrix L to L*, and L* to L.

    Parameters
    ----------
    L : ndarray (..., 4, 4), Pluecker matrices

    Returns
    -------
    ndarray (..., 4, 4), entries 12, 13, 14 exchanged with 34, 42, 23
    """
    dual = np.zeros_like(L)
    for (a, b), (c, d) in (((0, 1), (2, 3)), ((0, 2), (3, 1)), ((0, 3), (1, 2))):
        dual[..., a, b], dual[..., c, d] = L[..., c, d], L[..., a, b]
        dual[..., b, a], dual[..., d, c] = L[..., d, c], L[..., b, a]
    return dual


def meet_of_line_and_plane(L: F64, plane: F64) -> F64:
    """Return the point L Pi in which a line meets a plane.

    Parameters
    ----------
    L : ndarray (..., 4, 4), Pluecker matrices of lines
    plane : ndarray (..., 4), planes

    Returns
    -------
    ndarray (..., 4), homogeneous points; zero if the plane contains the line

    Examples
    --------
    >>> z_axis = join_points(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0, 0.0]))
    >>> X = meet_of_line_and_plane(z_axis, np.array([0.0, 0.0, 1.0, -5.0]))
    >>> (X / X[3]).tolist()
    [0.0, 0.0, 5.0, 1.0]
    """
    return np.asarray(np.einsum("...ij,...j->...i", L, plane))


def join_of_line_and_point(L: F64, X: F64) -> F64:
    """Return the plane L* X of a line and a point.

    Parameters
    ----------
    L : ndarray (..., 4, 4), Pluecker matrices of lines
    X : ndarray (..., 4), homogeneous points

    Returns
    -------
    ndarray (..., 4), planes; zero if the line contains the point
    """
    return meet_of_line_and_plane(dual_line(L), X)


def lines_meet_residual(L: F64, M: F64) -> F64:
    """Return |trace(L* M)| / (|L| |M|), 0 if two lines meet or are parallel.

    Parameters
    ----------
    L, M : ndarray (..., 4, 4), Pluecker matrices of lines of space

    Returns
    -------
    ndarray (...), residuals >= 0
    """
    size = np.linalg.norm(L, axis=(-2, -1)) * np.linalg.norm(M, axis=(-2, -1))
    return np.asarray(np.abs(np.einsum("...ij,...ji->...", dual_line(L), M)) / np.maximum(size, 1e-300))


def project_line(P: F64, L: F64) -> F64:
    """Project a line of space: [l]x = P L P'.

    Parameters
    ----------
    P : ndarray (3, 4), camera
    L : ndarray (..., 4, 4), Pluecker matrices of lines

    Returns
    -------
    ndarray (..., 3), image lines; zero for lines through the camera centre

    Examples
    --------
    >>> L = join_points(np.array([0.0, 1.0, 2.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    >>> l = project_line(np.eye(3, 4), L)
    >>> np.allclose(l / l[1], [0.0, 1.0, -0.5])
    True
    """
    S = P @ L @ P.T
    return np.stack([S[..., 2, 1], S[..., 0, 2], S[..., 1, 0]], axis=-1)


def back_project_lines(P: F64, l: F64) -> F64:
    """Return the planes P' l through the camera centre that project to the lines.

    Parameters
    ----------
    P : ndarray (3, 4), camera
    l : ndarray (..., 3), image lines

    Returns
    -------
    ndarray (..., 4), planes
    """
    return np.asarray(l @ P)

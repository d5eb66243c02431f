"""Section 3.2: points, lines and planes in homogeneous coordinates: incidence, joins and meets.

A line of an image is l (3,) with l . x = 0, a plane Pi (4,) with Pi . X = 0. A line of space has no vector
that a point can be tested with; it is kept as its Pluecker matrix L = X Y' - Y X' of two of its points, or
L* = Pi Psi' - Psi Pi' of two of its planes (Hartley and Zisserman 3.2.2, which the thesis leaves out).
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import camera_centre


def line_through(x: F64, y: F64) -> F64:
    """Line x cross y of two image points (..., 3); zero where they are the same point."""
    return np.cross(x, y)


def meet_of_lines(l: F64, m: F64) -> F64:
    """Image point l cross m of two lines (..., 3): at infinity for parallel lines, zero for equal ones."""
    return np.cross(l, m)


def incidence_sine(dual: F64, point: F64) -> F64:
    """|dual . point| / (|dual| |point|), in [0, 1]: 0 where the line or plane holds the point.

    dual (..., d), point (..., d); does not change when either is scaled. Zero vectors give 0.
    """
    size = np.linalg.norm(dual, axis=-1) * np.linalg.norm(point, axis=-1)
    return np.asarray(np.abs(np.sum(dual * point, axis=-1)) / np.maximum(size, 1e-300))


def unit_normals(l: F64) -> F64:
    """Lines (..., 3) or planes (..., 4) scaled such that l . (x, 1) is a signed distance.

    The line and the plane at infinity have no normal and come back as they are.
    """
    norm = np.linalg.norm(l[..., :-1], axis=-1, keepdims=True)
    return l / np.where(norm > 0.0, norm, 1.0)


def plane_through(X: F64, Y: F64, Z: F64) -> F64:
    """Plane (..., 4) of three points (..., 4), by the minors of (3.24); zero where they lie on a line."""
    return camera_centre(np.stack(np.broadcast_arrays(X, Y, Z), axis=-2))


def meet_of_planes(plane1: F64, plane2: F64, plane3: F64) -> F64:
    """Point (..., 4) of three planes (..., 4); zero where they share a line."""
    return plane_through(plane1, plane2, plane3)


def join_points(X: F64, Y: F64) -> F64:
    """Pluecker matrix X Y' - Y X' (..., 4, 4) of the line of two points (..., 4); zero where they are equal.

    The line of two planes is this matrix of the planes, L*; :func:`dual_line` takes one to the other.
    """
    outer = X[..., :, None] * Y[..., None, :]
    return np.asarray(outer - np.swapaxes(outer, -1, -2))


def dual_line(L: F64) -> F64:
    """L* of L, and L of L* (..., 4, 4): entries 12, 13, 14 trade places with 34, 42, 23."""
    dual = np.zeros_like(L)
    for (a, b), (c, d) in (((0, 1), (2, 3)), ((0, 2), (3, 1)), ((0, 3), (1, 2))):
        dual[..., a, b], dual[..., c, d] = L[..., c, d], L[..., a, b]
        dual[..., b, a], dual[..., d, c] = L[..., d, c], L[..., b, a]
    return dual


def meet_of_line_and_plane(L: F64, plane: F64) -> F64:
    """Point L Pi (..., 4) of a line (..., 4, 4) and a plane (..., 4); zero where the plane holds the line."""
    return np.asarray(np.einsum("...ij,...j->...i", L, plane))


def join_of_line_and_point(L: F64, X: F64) -> F64:
    """Plane L* X (..., 4) of a line (..., 4, 4) and a point (..., 4); zero where the line holds the point."""
    return meet_of_line_and_plane(dual_line(L), X)


def lines_meet_residual(L: F64, M: F64) -> F64:
    """trace(L* M) / (|L| |M|) up to sign (...): 0 where two lines of space share a point or are parallel."""
    size = np.linalg.norm(L, axis=(-2, -1)) * np.linalg.norm(M, axis=(-2, -1))
    return np.asarray(np.abs(np.einsum("...ij,...ji->...", dual_line(L), M)) / np.maximum(size, 1e-300))


def project_line(P: F64, L: F64) -> F64:
    """Image line (..., 3) of a line of space (..., 4, 4) in a camera (3, 4): [l]x = P L P'.

    Zero where the line runs through the camera's centre.
    """
    S = P @ L @ P.T
    return np.stack([S[..., 2, 1], S[..., 0, 2], S[..., 1, 0]], axis=-1)


def back_project_lines(P: F64, l: F64) -> F64:
    """Planes P' l (..., 4) through the centre of a camera (3, 4) that are seen as the lines (..., 3)."""
    return np.asarray(l @ P)

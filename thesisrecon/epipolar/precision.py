"""Section 5.5: covariance of F and of its epipolar lines."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar._frame import PairFrame, as_matches
from thesisrecon.epipolar._refinement import (
    SAMPSON,
    normal_equations,
    orthonormal_from_fundamental,
    orthonormal_tangent,
)
from thesisrecon.geometry.homogeneous import homogenize

# Smallest curvature relative to the largest: the F of a plane stays uncertain but finite.
FLATTEST_REL = 1e-14


def fundamental_covariance(frame: PairFrame, f: F64, points: F64, sigma: float) -> F64:
    """Compute the first-order covariance of F from the curvature of the Sampson criterion.

    sigma^2 B (J'J)^-1 B' with J the derivatives of the Sampson distances by the seven parameters and B those
    of vec(F).

    Parameters
    ----------
    frame : PairFrame
        Frame of the other arguments.
    f : ndarray (9,)
        F, row-major.
    points : ndarray (N, 4)
        Inliers, rows (x1, y1, x2, y2).
    sigma : float
        Standard deviation of one image coordinate.

    Returns
    -------
    ndarray (9, 9)
        Covariance of vec(F), row-major, for F in pixels with unit norm; rank 7.
    """
    U, V, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((9, 7))
    G, h = np.empty((9, 9)), np.empty(9)
    phi = orthonormal_from_fundamental(f, U, V)
    orthonormal_tangent(U, V, phi, B)
    normal_equations(f, points, SAMPSON, np.inf, 1e150, G, h)
    values, vectors = np.linalg.eigh(B.T @ G @ B)
    half = B @ (vectors / np.sqrt(np.maximum(values, FLATTEST_REL * max(values[-1], 1e-300))))
    to_pixels = frame.to_pixels
    pixels = to_pixels @ f
    norm = float(np.linalg.norm(pixels))
    moved = to_pixels @ half / norm
    moved -= np.outer(pixels, pixels @ moved) / norm**2
    covariance: F64 = sigma**2 * moved @ moved.T
    return covariance


def epipolar_distance_std(F: F64, covariance: F64, xy1: F64, xy2: F64) -> F64:
    """Compute the standard deviation of the distances of exact matches to their epipolar lines in image 2.

    First order in the error of F alone. A match with own noise sigma has sqrt(std^2 + sigma^2 (1 + g1 / g2))
    with g1 and g2 the squared gradients of x2' F x1 by x1 and x2.

    Parameters
    ----------
    F : ndarray (3, 3)
        Fundamental matrix, unit norm.
    covariance : ndarray (9, 9)
        Covariance of vec(F).
    xy1, xy2 : array_like (N, 2)
        Matched points, px.

    Returns
    -------
    ndarray (N,)
        Standard deviations, px.

    Examples
    --------
    >>> import numpy as np
    >>> F = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2)
    >>> covariance = np.diag([1e-6, 0, 0, 0, 0, 0, 0, 0, 0])
    >>> epipolar_distance_std(F, covariance, np.array([[10.0, 5.0]]), np.array([[20.0, 5.0]])).round(3)
    array([0.283])
    """
    xy1, xy2 = as_matches(xy1, xy2)
    x1, x2 = homogenize(xy1), homogenize(xy2)
    lines = x1 @ F.T
    norm = np.sqrt(np.sum(lines[:, :2] ** 2, axis=1, keepdims=True)) + 1e-300
    # The distance is x2 . l / |l12|; near 0 only the derivative of the numerator matters.
    foot = x2.copy()
    foot[:, :2] -= np.sum(x2 * lines, axis=1, keepdims=True) * lines[:, :2] / norm**2
    gradient = (foot[:, :, None] * x1[:, None, :]).reshape(-1, 9) / norm
    variance = np.einsum("na,ab,nb->n", gradient, covariance, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

"""The uncertainty of an estimated F: from the curvature of the gradient criterion at its minimum."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.frame import PairFrame
from thesisrecon.epipolar.rank2.kernels import GRADIENT, normal_equations, split, tangent

F64 = NDArray[np.float64]

FLATTEST_REL = 1e-14
"""Curvatures below this share of the largest are raised to it: a plane's F is uncertain, not inf."""


def fundamental_covariance(frame: PairFrame, f: F64, points: F64, sigma: float) -> F64:
    """Covariance (9, 9) of vec(F), F in pixels with unit norm, to first order: sigma^2 B (J'J)^-1 B'.

    ``f`` (9,) and ``points`` (N, 4) (the inliers) in ``frame``, ``sigma`` of one image coordinate in its
    units. J are the derivatives of the Sampson distances by the seven parameters, B those of vec(F). Rank 7.
    """
    U, V, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((9, 7))
    G, h = np.empty((9, 9)), np.empty(9)
    phi = split(f, U, V)
    tangent(U, V, phi, B)
    normal_equations(f, points, GRADIENT, np.inf, 1e150, G, h)
    values, vectors = np.linalg.eigh(B.T @ G @ B)
    half = B @ (vectors / np.sqrt(np.maximum(values, FLATTEST_REL * max(values[-1], 1e-300))))
    to_pixels = frame.to_pixels
    pixels = to_pixels @ f
    norm = float(np.linalg.norm(pixels))
    moved = to_pixels @ half / norm
    moved -= np.outer(pixels, pixels @ moved) / norm**2
    covariance: F64 = sigma**2 * moved @ moved.T
    return covariance

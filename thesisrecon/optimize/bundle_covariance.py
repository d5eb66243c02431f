"""Covariance of poses and intrinsics after bundle adjustment, and the noise scale from the residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.optimize.levenberg_marquardt import invert_information
from thesisrecon.optimize.metric_cameras import FOCAL, POSE_DOF

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]
MAD_TO_SIGMA = 1.4826
# Variance of a standard normal variable cut at +-2.5.
TRIM, TRIMMED_VARIANCE = 2.5, 0.91126


def robust_sigma(residual: F64, parameters: int) -> float:
    """Standard deviation of one coordinate of residuals (K, 2) that ``parameters`` freedoms were fitted to.

    Root mean square within 2.5 sigma, sigma starting from the median, corrected for the trimming of a normal
    distribution and for the fitted freedoms. 0 where nothing is left over.
    """
    size, count = np.abs(residual).ravel(), residual.size
    if count <= max(parameters, 0):
        return 0.0
    sigma = MAD_TO_SIGMA * float(np.median(size))
    for _ in range(5):
        kept = size[size <= TRIM * sigma]
        if len(kept):
            sigma = float(np.sqrt(np.mean(kept**2) / TRIMMED_VARIANCE))
    return sigma * float(np.sqrt(count / (count - parameters)))


@dataclass(frozen=True)
class CovarianceInput:
    """The reduced information ``S`` (D, D) (upper triangle), columns of the ``free_views`` (V,) first; poses
    ``R`` (V, 3, 3), ``t`` (V, 3); ``held``: observed views are fixed, so that the frame is too."""

    S: F64
    free_views: B8
    R: F64
    t: F64
    held: bool


def bundle_covariances(found: CovarianceInput, number: I64, focal: F64, scale: float) -> tuple[F64, F64]:
    """Covariances of intrinsics (G, C, C), entry ``number`` (G, C) an unknown's, and of poses (V, 6, 6).

    S is singular along the directions N of the frame's seven freedoms; (S + N N')^-1 is S's generalised
    inverse with the freedoms at unit variance, which are then removed. N has no part in the intrinsics, so
    their covariance does not depend on the frame. ``focal`` (G,) takes log f to f, ``scale`` the lengths.
    """
    S = np.triu(found.S) + np.triu(found.S, 1).T
    views = np.flatnonzero(found.free_views)
    if found.held or not len(views):
        covariance = invert_information(S)
    else:
        N = gauge_directions(found.R[views], found.t[views], len(S))
        weight = float(np.median(np.diag(S)))
        covariance = invert_information(S + weight * N @ N.T)
        covariance = covariance - N @ (N.T @ covariance @ N) @ N.T
    poses = np.zeros((len(found.t), POSE_DOF, POSE_DOF))
    units = np.array([1.0, 1.0, 1.0, 1.0 / scale, 1.0 / scale, 1.0 / scale])
    for n, view in enumerate(views):
        block = slice(POSE_DOF * n, POSE_DOF * (n + 1))
        poses[view] = covariance[block, block] * units * units[:, None]
    intrinsics = np.zeros((*number.shape, number.shape[1]))
    for g, row in enumerate(number):
        moves = np.flatnonzero(row >= 0)
        index = POSE_DOF * len(views) + row[moves]
        units = np.where(moves == FOCAL, focal[g], 1.0)
        intrinsics[g][np.ix_(moves, moves)] = covariance[np.ix_(index, index)] * units * units[:, None]
    return intrinsics, poses


def gauge_directions(R: F64, t: F64, size: int) -> F64:
    """Orthonormal (size, 7): how the poses, first of ``size`` unknowns, move when the world is shifted,
    turned and scaled."""
    directions = np.zeros((len(t), POSE_DOF, 7))
    directions[:, 3:, 0:3] = -R
    directions[:, :3, 3:6] = -R
    directions[:, 3:, 3:6] = -cross_matrix(t) @ R
    directions[:, 3:, 6] = t
    N = np.zeros((size, 7))
    N[: len(t) * POSE_DOF] = directions.reshape(-1, 7)
    return np.asarray(np.linalg.qr(N)[0])

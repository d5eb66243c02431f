"""Covariance of poses and intrinsics after bundle adjustment, and the noise scale from the residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.optimize.levenberg_marquardt import invert_information
from thesisrecon.optimize.metric_cameras import FOCAL, POSE_DOF
from thesisrecon.optimize.reduced_solvers import ReducedSystem

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]
SIMILARITY_DOF = 7
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
    """The ``reduced`` information; ``block`` (V,) of each view whose pose moves, -1 for others; poses ``R``
    (V, 3, 3), ``t`` (V, 3); ``held``: observed views are fixed, so that the frame is too."""

    reduced: ReducedSystem
    block: I64
    R: F64
    t: F64
    held: bool


def bundle_covariances(found: CovarianceInput, number: I64, focal: F64, scale: float) -> tuple[F64, F64]:
    """Covariances of intrinsics (G, C, C), entry ``number`` (G, C) a column's, and of poses (V, 6, 6).

    S is singular along the directions N of the frame's seven freedoms; (S + N N')^-1 is S's generalised
    inverse with the freedoms at unit variance, which are then removed. N has no part in the intrinsics, so
    their covariance does not depend on the frame. ``focal`` (G,) takes log f to f, ``scale`` the lengths.
    """
    S = found.reduced.dense()
    S = np.triu(S) + np.triu(S, 1).T
    width = found.reduced.sums.border.shape[1]
    views = np.flatnonzero(found.block >= 0)
    columns = width * found.block[views, None] + np.arange(POSE_DOF)
    if found.held or not len(views):
        covariance = invert_information(S)
    else:
        N = np.zeros((len(S), SIMILARITY_DOF))
        N[columns.ravel()] = gauge_directions(found.R[views], found.t[views])
        weight = float(np.median(np.diag(S)))
        covariance = invert_information(S + weight * N @ N.T)
        covariance = covariance - N @ (N.T @ covariance @ N) @ N.T
    poses = np.zeros((len(found.t), POSE_DOF, POSE_DOF))
    units = np.array([1.0, 1.0, 1.0, 1.0 / scale, 1.0 / scale, 1.0 / scale])
    poses[views] = covariance[columns[:, :, None], columns[:, None, :]] * units * units[:, None]
    intrinsics = np.zeros((*number.shape, number.shape[1]))
    for g, row in enumerate(number):
        moves = np.flatnonzero(row >= 0)
        units = np.where(moves == FOCAL, focal[g], 1.0)
        intrinsics[g][np.ix_(moves, moves)] = (
            covariance[np.ix_(row[moves], row[moves])] * units * units[:, None]
        )
    return intrinsics, poses


def gauge_directions(R: F64, t: F64) -> F64:
    """Orthonormal (6 V, 7): how poses move when the world is shifted, turned and scaled."""
    directions = np.zeros((len(t), POSE_DOF, SIMILARITY_DOF))
    directions[:, 3:, 0:3] = -R
    directions[:, :3, 3:6] = -R
    directions[:, 3:, 3:6] = -cross_matrix(t) @ R
    directions[:, 3:, 6] = t
    return np.asarray(np.linalg.qr(directions.reshape(-1, SIMILARITY_DOF))[0])

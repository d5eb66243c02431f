"""Covariance of poses and intrinsics after bundle adjustment, and the noise from the residuals."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.numerics._metric_kernels import FOCAL, POSE_DOF
from thesisrecon.numerics._reduced_solvers import ReducedSystem, order_views
from thesisrecon.numerics.levenberg_marquardt import invert_information

SIMILARITY_DOF = 7
# Largest number of unknowns for dense inversion.
MAX_DENSE = 1200
MAD_TO_SIGMA = 1.4826
# Trimming point and variance of a standard normal variable trimmed there.
TRIM, TRIMMED_VARIANCE = 2.5, 0.91126
# Least fraction of the variance that a coordinate must keep to contribute.
MIN_KEPT = 0.1


def robust_sigma(residual: F64, leverage: F64, dof: int) -> float:
    """Estimate the standard deviation of one image coordinate from residuals (K, 2); 0 if unknown.

    The root mean square within 2.5 sigma, corrected for the trimming, of the residuals scaled up by their
    remaining variance: points absorb ``leverage`` (K, 2) of it, ``dof`` camera unknowns the same of all.
    """
    if not len(residual):
        return 0.0
    kept = 1.0 - leverage - max(dof, 0) / residual.size
    informative = kept > MIN_KEPT
    if not informative.any():
        return 0.0
    size = np.abs(residual[informative]) / np.sqrt(kept[informative])
    sigma = MAD_TO_SIGMA * float(np.median(size))
    for _ in range(5):
        within = size[size <= TRIM * sigma]
        if len(within):
            sigma = float(np.sqrt(np.mean(within**2) / TRIMMED_VARIANCE))
    return sigma


def bundle_covariances(
    reduced: ReducedSystem, R: F64, t: F64, number: I64, focal: F64, scale: float
) -> tuple[F64, F64]:
    """Return covariances of intrinsics (G, C, C) and poses (b, 6, 6), with unit of length 1 / ``scale``.

    Poses refer to the inner gauge: of all solutions that differ by a similarity, the one that moved the
    cameras least. ``R`` and ``t`` are those of the b views with observations, ``number`` (G, C) is the column
    of each intrinsic; ``focal`` (G,) converts log f to f.
    """
    b, C, e = reduced.sums.border.shape
    intrinsics, edge = np.zeros((*number.shape, number.shape[1])), b * C
    if not b:
        return intrinsics, np.zeros((0, POSE_DOF, POSE_DOF))
    blocks = _dense_blocks(reduced, R, t) if edge + e <= MAX_DENSE else _band_blocks(reduced, R, t)
    units = np.array([1.0, 1.0, 1.0, 1.0 / scale, 1.0 / scale, 1.0 / scale])
    poses = blocks[:, :POSE_DOF, :POSE_DOF] * units * units[:, None]
    for g, row in enumerate(number):
        moves = np.flatnonzero(row >= 0)
        own = row[moves][row[moves] < edge] // C
        block = int(own[0]) if len(own) else 0
        index = np.where(row[moves] < edge, row[moves] - C * block, row[moves] - edge + C)
        units = np.where(moves == FOCAL, focal[g], 1.0)
        intrinsics[g][np.ix_(moves, moves)] = blocks[block][np.ix_(index, index)] * units * units[:, None]
    return intrinsics, poses


def _dense_blocks(reduced: ReducedSystem, R: F64, t: F64) -> F64:
    """Return the covariance blocks of each view and the border by dense inversion."""
    b, C, e = reduced.sums.border.shape
    S = reduced.dense()
    covariance = invert_in_inner_gauge(np.triu(S) + np.triu(S, 1).T, _gauge_basis(reduced, R, t))
    index = np.concatenate(
        [C * np.arange(b)[:, None] + np.arange(C), np.broadcast_to(b * C + np.arange(e), (b, e))], axis=1
    )
    return np.asarray(covariance[index[:, :, None], index[:, None, :]])


def invert_in_inner_gauge(information: F64, N: F64) -> F64:
    """Invert an information matrix that is singular along the orthonormal gauge directions N (D, 7).

    (S + w N N')^-1 is the generalised inverse of S with variance 1 / w along N, which is then removed.
    """
    weight = float(np.median(np.diag(information)))
    C = invert_information(information + weight * N @ N.T)
    return np.asarray(C - N @ (N.T @ C @ N) @ N.T)


def _band_blocks(reduced: ReducedSystem, R: F64, t: F64) -> F64:
    """Return the covariance blocks from a banded factor.

    Seven coordinates fix the frame; Baarda's S-transformation (I - N N') Q (I - N N') changes to the inner
    gauge.
    """
    b, C, e = reduced.sums.border.shape
    _fix_gauge(reduced, R, t)
    factored = order_views(reduced.row, reduced.column, b).factor(reduced)
    N = _gauge_basis(reduced, R, t)
    moved = None if factored is None else factored.solve(N)
    if factored is None or moved is None:
        return np.full((b, C + e, C + e), np.inf)

    def rows(matrix: F64) -> F64:
        own = matrix[: b * C].reshape(b, C, -1)
        return np.concatenate([own, np.broadcast_to(matrix[b * C :], (b, e, own.shape[2]))], axis=1)

    n, m, middle = rows(N), rows(moved), N.T @ moved
    cross = m @ np.swapaxes(n, 1, 2)
    blocks = factored.inverse_blocks()
    return np.asarray(blocks - cross - np.swapaxes(cross, 1, 2) + n @ middle @ np.swapaxes(n, 1, 2))


def _fix_gauge(reduced: ReducedSystem, R: F64, t: F64) -> None:
    """Add weight to seven coordinates: one pose, and the distance to the farthest camera."""
    sums, C = reduced.sums, reduced.sums.border.shape[1]
    centres = -np.einsum("vba,vb->va", R, t)
    far = int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))
    line = R[far] @ (centres[far] - centres[0])
    diagonal = (reduced.row == reduced.column).nonzero()[0]
    weight = float(np.median(sums.blocks[diagonal][:, np.arange(C), np.arange(C)]))
    sums.blocks[diagonal[0], np.arange(POSE_DOF), np.arange(POSE_DOF)] += weight
    sums.blocks[diagonal[far], 3:6, 3:6] += weight * np.outer(line, line) / max(float(line @ line), 1e-300)


def _gauge_basis(reduced: ReducedSystem, R: F64, t: F64) -> F64:
    """Return the orthonormal motion (D, 7) of all columns under similarities of the world."""
    N = np.zeros((len(reduced.sums.rhs), SIMILARITY_DOF))
    columns = reduced.sums.border.shape[1] * np.arange(len(t))[:, None] + np.arange(POSE_DOF)
    N[columns.ravel()] = gauge_directions(R, t)
    return N


def gauge_directions(R: F64, t: F64) -> F64:
    """Return the orthonormal motion (6 V, 7) of poses under similarities of the world."""
    directions = np.zeros((len(t), POSE_DOF, SIMILARITY_DOF))
    directions[:, 3:, 0:3] = -R
    directions[:, :3, 3:6] = -R
    directions[:, 3:, 3:6] = -cross_matrix(t) @ R
    directions[:, 3:, 6] = t
    return np.asarray(np.linalg.qr(directions.reshape(-1, SIMILARITY_DOF))[0])

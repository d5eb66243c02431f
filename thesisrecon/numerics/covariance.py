"""Covariance of poses and intrinsics after bundle adjustment, and the noise scale from the residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.numerics.levenberg_marquardt import invert_information
from thesisrecon.numerics.metric_cameras import FOCAL, POSE_DOF
from thesisrecon.numerics.reduced_solvers import ReducedSystem, order_views

SIMILARITY_DOF = 7
# Unknowns up to which the whole matrix is inverted.
DENSE = 1200
MAD_TO_SIGMA = 1.4826
# Variance of a standard normal variable cut at +-2.5.
TRIM, TRIMMED_VARIANCE = 2.5, 0.91126
# Coordinates that keep less than this share of their variance say little of the noise.
LEAST_SHARE = 0.1


def robust_sigma(residual: F64, leverage: F64, freedoms: int) -> float:
    """Standard deviation of one image coordinate from residuals (K, 2) after a fit.

    ``leverage`` (K, 2) is the share of a coordinate's variance that the fit of its point took, ``freedoms``
    those of the cameras, which take theirs from all alike. Of the residuals scaled up by what was left to
    them the root mean square within 2.5 sigma, sigma starting from the median, corrected for the trimming of
    a normal distribution. 0 where nothing is left over.
    """
    if not len(residual):
        return 0.0
    kept = 1.0 - leverage - max(freedoms, 0) / residual.size
    told = kept > LEAST_SHARE
    if not told.any():
        return 0.0
    size = np.abs(residual[told]) / np.sqrt(kept[told])
    sigma = MAD_TO_SIGMA * float(np.median(size))
    for _ in range(5):
        within = size[size <= TRIM * sigma]
        if len(within):
            sigma = float(np.sqrt(np.mean(within**2) / TRIMMED_VARIANCE))
    return sigma


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

    Poses are taken with respect to the inner gauge: of all solutions that differ by a similarity, that which
    moved the cameras least. The frame has no part in the intrinsics, so their covariance does not depend on
    it. ``focal`` (G,) takes log f to f, ``scale`` the lengths.
    """
    b, C, e = found.reduced.sums.border.shape
    width, edge = (C if b else 0), b * C
    views = np.flatnonzero(found.block >= 0)
    blocks = _dense_blocks(found, views) if edge + e <= DENSE or not b else _band_blocks(found, views)
    poses = np.zeros((len(found.t), POSE_DOF, POSE_DOF))
    units = np.array([1.0, 1.0, 1.0, 1.0 / scale, 1.0 / scale, 1.0 / scale])
    if len(views):
        poses[views] = blocks[found.block[views], :POSE_DOF, :POSE_DOF] * units * units[:, None]
    intrinsics = np.zeros((*number.shape, number.shape[1]))
    for g, row in enumerate(number):
        moves = np.flatnonzero(row >= 0)
        own = row[moves][row[moves] < edge] // width if width else row[:0]
        block = int(own[0]) if len(own) else 0
        index = np.where(row[moves] < edge, row[moves] - width * block, row[moves] - edge + width)
        units = np.where(moves == FOCAL, focal[g], 1.0)
        intrinsics[g][np.ix_(moves, moves)] = blocks[block][np.ix_(index, index)] * units * units[:, None]
    return intrinsics, poses


def _dense_blocks(found: CovarianceInput, views: I64) -> F64:
    """(b, C + e, C + e) covariances of each view's columns with the border's, by the whole matrix.

    Directions that the data do not determine get a huge variance.
    """
    b, C, e = found.reduced.sums.border.shape
    S = found.reduced.dense()
    S = np.triu(S) + np.triu(S, 1).T
    if found.held or not len(views):
        covariance = invert_information(S)
    else:
        covariance = invert_in_inner_gauge(S, _gauge(found, views))
    index = np.concatenate(
        [C * np.arange(b)[:, None] + np.arange(C), np.broadcast_to(b * C + np.arange(e), (b, e))], axis=1
    )
    index = index if b else np.arange(e)[None]
    return np.asarray(covariance[index[:, :, None], index[:, None, :]])


def invert_in_inner_gauge(information: F64, N: F64) -> F64:
    """Covariance (D, D) of an information matrix singular along the orthonormal N (D, 7) of the frame.

    (S + w N N')^-1 is S's generalised inverse with the frame's freedoms at variance 1 / w, which are then
    removed.
    """
    weight = float(np.median(np.diag(information)))
    C = invert_information(information + weight * N @ N.T)
    return np.asarray(C - N @ (N.T @ C @ N) @ N.T)


def _band_blocks(found: CovarianceInput, views: I64) -> F64:
    """The same from a banded factor: any seven coordinates hold the frame, then Baarda's S-transformation
    takes the covariance Q to the inner gauge, (I - N N') Q (I - N N')."""
    reduced = found.reduced
    b, C, e = reduced.sums.border.shape
    if not found.held:
        _hold_frame(found, views)
    factored = order_views(reduced.row, reduced.column, b).factor(reduced)
    if factored is None:
        return np.full((b, C + e, C + e), np.inf)
    blocks = factored.inverse_blocks()
    if found.held:
        return blocks
    N = _gauge(found, views)
    moved = factored.solve(N)
    if moved is None:
        return np.full((b, C + e, C + e), np.inf)

    def rows(matrix: F64) -> F64:
        own = matrix[: b * C].reshape(b, C, -1)
        return np.concatenate([own, np.broadcast_to(matrix[b * C :], (b, e, own.shape[2]))], axis=1)

    n, m, middle = rows(N), rows(moved), N.T @ moved
    cross = m @ np.swapaxes(n, 1, 2)
    return np.asarray(blocks - cross - np.swapaxes(cross, 1, 2) + n @ middle @ np.swapaxes(n, 1, 2))


def _hold_frame(found: CovarianceInput, views: I64) -> None:
    """Weight on seven coordinates that fix the frame: one pose, and the position of the camera farthest from
    it along the line between them."""
    sums, C = found.reduced.sums, found.reduced.sums.border.shape[1]
    centres = -np.einsum("vba,vb->va", found.R[views], found.t[views])
    far = int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))
    line = found.R[views[far]] @ (centres[far] - centres[0])
    held = (found.reduced.row == found.reduced.column).nonzero()[0]
    weight = float(np.median(sums.blocks[held][:, np.arange(C), np.arange(C)]))
    first, other = held[found.block[views[0]]], held[found.block[views[far]]]
    sums.blocks[first, np.arange(POSE_DOF), np.arange(POSE_DOF)] += weight
    sums.blocks[other, 3:6, 3:6] += weight * np.outer(line, line) / max(float(line @ line), 1e-300)


def _gauge(found: CovarianceInput, views: I64) -> F64:
    """Orthonormal (D, 7): how all columns move when the world is shifted, turned and scaled."""
    width = found.reduced.sums.border.shape[1]
    N = np.zeros((len(found.reduced.sums.rhs), SIMILARITY_DOF))
    columns = width * found.block[views, None] + np.arange(POSE_DOF)
    N[columns.ravel()] = gauge_directions(found.R[views], found.t[views])
    return N


def gauge_directions(R: F64, t: F64) -> F64:
    """Orthonormal (6 V, 7): how poses move when the world is shifted, turned and scaled."""
    directions = np.zeros((len(t), POSE_DOF, SIMILARITY_DOF))
    directions[:, 3:, 0:3] = -R
    directions[:, :3, 3:6] = -R
    directions[:, 3:, 3:6] = -cross_matrix(t) @ R
    directions[:, 3:, 6] = t
    return np.asarray(np.linalg.qr(directions.reshape(-1, SIMILARITY_DOF))[0])

"""Covariance of poses, intrinsics and points after bundle adjustment, and the noise from the residuals."""

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.optimize.bundle.elimination import BlockIndex
from thesisrecon.optimize.bundle.projection import FOCAL, POSE_DOF, Jacobians
from thesisrecon.optimize.bundle.schur import ReducedSystem, order_views
from thesisrecon.optimize.least_squares import MAD_FACTOR, invert_information, trimmed_noise_scale

SIMILARITY_DOF = 7
SAMPLES = 64  # solutions to noise from which the covariances of very many views are estimated
MAX_DENSE = 1200  # largest number of unknowns for dense inversion


def robust_sigma(residual: F64, leverage: F64, dof: int) -> float:
    """Noise from residuals (K, 2) in 2.5 sigma, corrected for ``leverage`` (K, 2) and ``dof`` unknowns."""
    if not len(residual):
        return 0.0
    kept = 1.0 - leverage - max(dof, 0) / residual.size
    informative = kept > 0.1
    if not informative.any():
        return 0.0
    size = np.abs(residual[informative]) / np.sqrt(kept[informative])
    return trimmed_noise_scale(size, MAD_FACTOR * float(np.median(size)), parameters=0)


def orthonormal_columns(B: F64, point: I64, n: int) -> F64:
    """B (K, 2, 3) times the inverse roots of the information B'B of its n points."""
    outer = np.einsum("kra,krb->kab", B, B).reshape(-1, 9)
    V = np.stack([np.bincount(point, c, minlength=n) for c in outer.T], axis=1).reshape(n, 3, 3)
    w, U = np.linalg.eigh(V)
    root = np.where(w > 1e-12 * w[:, 2:], 1.0 / np.sqrt(np.maximum(w, 1e-300)), 0.0)
    return np.asarray(B @ (U * root[:, None])[point])


def camera_blocks(
    reduced: ReducedSystem, R: F64, t: F64, row: I64, column: I64, gauge: F64 | None = None
) -> F64:
    """Return the covariance (n, C + e, C + e) of views ``row`` and the border with ``column`` and the border.

    In the inner gauge, of the solution that moved the cameras R, t (b of them) least; free are the
    similarities of ``gauge`` (7, m), None: all.
    """
    (b, C, e), D = reduced.sums.border.shape, len(reduced.sums.rhs)
    if not b:
        return np.zeros((0, C + e, C + e))
    index = np.concatenate(
        [C * np.arange(b)[:, None] + np.arange(C), np.broadcast_to(b * C + np.arange(e), (b, e))], axis=1
    )
    # For more unknowns, a sparse factor is less work if the views have an order with a narrow band.
    partly = gauge is not None and 0 < gauge.shape[1] < SIMILARITY_DOF
    if D <= MAX_DENSE or partly or 5 * order_views(reduced.row, reduced.column, b).reach > b:
        S = reduced.dense()
        covariance = invert_in_inner_gauge(np.triu(S) + np.triu(S, 1).T, gauge_basis(D, C, R, t, gauge))
        return np.asarray(covariance[index[row][:, :, None], index[column][:, None, :]])
    S = reduced.sparse()
    if not np.isfinite(S.data).all():
        return np.full((len(row), C + e, C + e), np.inf)
    if gauge is not None and not gauge.shape[1]:
        solve = scipy.sparse.linalg.splu(S).solve
    else:
        solve = sparse_inverse(S, C, R, t)
    blocks = np.empty((len(row), C + e, C + e))
    blocks[:, :, C:] = solve(unit_columns(D, b * C + np.arange(e)))[index[row]]
    for view in range(b):
        here = np.flatnonzero(column == view)
        blocks[here, :, :C] = solve(unit_columns(D, index[view, :C]))[index[row[here]]]
    return blocks


def sampled_blocks(solve: Callable[[F64], F64], noise: Iterator[F64], N: F64, width: int, views: int) -> F64:
    """Return the covariance (b, C + e, C + e) of each view and the border in the gauge N (D, m).

    That of the border is exact; the rest is that of ``SAMPLES`` solutions to noise, whose standard deviations
    are accurate to 9 %: exact columns of all views would take as many solutions as there are unknowns.
    """

    def inner(b: F64) -> F64:
        x = solve(b - N @ (N.T @ b))
        return np.asarray(x - N @ (N.T @ x))

    edge, e = width * views, len(N) - width * views
    X = np.array([inner(b) for b in islice(noise, SAMPLES)])
    border = np.broadcast_to(X[:, None, edge:], (SAMPLES, views, e))
    both = np.concatenate([X[:, :edge].reshape(SAMPLES, views, width), border], axis=2)
    blocks = np.einsum("svi,svj->vij", both, both, optimize=True) / SAMPLES
    units = unit_columns(len(N), edge + np.arange(e)).T
    columns = np.array([inner(unit) for unit in units]).reshape(e, len(N))
    blocks[:, width:, width:] = columns[:, edge:]
    cross = columns[:, :edge].reshape(e, views, width).transpose(1, 2, 0)
    blocks[:, :width, width:], blocks[:, width:, :width] = cross, cross.swapaxes(1, 2)
    return np.asarray(blocks)


def bundle_covariances(blocks: F64, width: int, number: I64, focal: F64, scale: float) -> tuple[F64, F64]:
    """Covariances of intrinsics (G, C, C) and poses (b, 6, 6); the unit of length is 1 / ``scale`` (6.7)."""
    intrinsics, edge = np.zeros((*number.shape, number.shape[1])), len(blocks) * width
    if not len(blocks):
        return intrinsics, np.zeros((0, POSE_DOF, POSE_DOF))
    units = np.array([1.0, 1.0, 1.0, 1.0 / scale, 1.0 / scale, 1.0 / scale])
    poses = blocks[:, :POSE_DOF, :POSE_DOF] * units * units[:, None]
    for g, row in enumerate(number):
        moves = np.flatnonzero(row >= 0)
        own = row[moves][row[moves] < edge] // width
        block = int(own[0]) if len(own) else 0
        index = np.where(row[moves] < edge, row[moves] - width * block, row[moves] - edge + width)
        units = np.where(moves == FOCAL, focal[g], 1.0)
        intrinsics[g][np.ix_(moves, moves)] = blocks[block][np.ix_(index, index)] * units * units[:, None]
    return intrinsics, poses


def joint_covariance(blocks: F64, width: int, number: I64, views: I64, focal: F64, scale: float) -> F64:
    """Covariance (6 V + G C, 6 V + G C) of all poses, then all intrinsics, of the ``blocks`` of all pairs.

    ``views`` (V,) are the numbers of the poses among the blocks, -1 for those that do not move.
    """
    b, e = int(np.sqrt(2 * len(blocks))), blocks.shape[1] - width
    edge, (i, j) = b * width, np.triu_indices(b)
    whole = np.empty((edge + e, edge + e))
    by_view = whole[:edge, :edge].reshape(b, width, b, width)
    by_view[i, :, j], by_view[j, :, i] = blocks[:, :width, :width], blocks[:, :width, :width].swapaxes(1, 2)
    whole[:edge, edge:] = blocks[i == j, :width, width:].reshape(edge, e)
    whole[edge:, :edge], whole[edge:, edge:] = whole[:edge, edge:].T, blocks[0, width:, width:]
    poses = np.where(views[:, None] < 0, -1, width * views[:, None] + np.arange(POSE_DOF))
    units = np.where(np.arange(number.shape[1]) == FOCAL, focal[:, None], 1.0)
    units = np.append(np.tile([1.0, 1.0, 1.0, 1.0 / scale, 1.0 / scale, 1.0 / scale], len(views)), units)
    index = np.append(poses, number)
    units[index < 0] = 0.0
    return np.asarray(whole[index[:, None], index] * units * units[:, None])


def point_covariances(blocks: F64, index: BlockIndex, J: Jacobians, inverse: F64) -> F64:
    """Covariance (N, 3, 3) of the points in the gauge of the cameras' ``blocks`` S: V^-1 + V^-1 W' S W V^-1.

    V = B'B of a point (``inverse``: V^-1), W' = sum B' [A E]; infinite for points in fewer than two views.
    """
    count = np.diff(index.start)
    out, C = inverse.copy(), J.A.shape[2]
    common = index.common[index.view_index]
    moves = np.concatenate([J.A, np.where(common[:, None] >= 0, J.E, 0.0)], axis=2)
    columns = np.concatenate(
        [np.broadcast_to(np.arange(C), (len(moves), C)), C + np.maximum(common, 0)], axis=1
    )
    point = np.repeat(np.arange(len(count)), count)
    T = inverse[point] @ np.swapaxes(J.B, 1, 2) @ moves
    block = index.block[index.view_index]
    numbers = len(index.row) * np.repeat(np.arange(len(index.row) - 1), np.diff(index.row)) + index.column
    # All pairs k <= m of observations of a point: m = k, k + 1, ... of a step at a time.
    for step in range(int(count.max(initial=0))):
        for first in range(0, len(T) - step, 16384):
            k = np.arange(first, min(first + 16384, len(T) - step))
            k = k[point[k] == point[k + step]]
            m = k + step
            pair = np.searchsorted(numbers, len(index.row) * block[k] + block[m])
            S = blocks[pair[:, None, None], columns[k][:, :, None], columns[m][:, None, :]]
            part = T[k] @ S @ np.swapaxes(T[m], 1, 2)
            np.add.at(out, point[k], part + np.swapaxes(part, 1, 2) if step else part)
    n_views = len(index.block)
    seen = np.unique(point * n_views + index.view_index) // max(n_views, 1)
    views = np.bincount(seen, minlength=len(count))
    out[views < 2] = np.diag([np.inf] * 3)
    return out


def invert_in_inner_gauge(information: F64, N: F64) -> F64:
    """Invert an information matrix, singular along orthonormal N (D, m): (S + w N N')^-1 - N N' / w."""
    weight = float(np.median(np.diag(information)))
    C = invert_information(information + weight * N @ N.T)
    return np.asarray(C - N @ (N.T @ C @ N) @ N.T)


def sparse_inverse(S: scipy.sparse.csc_matrix, width: int, R: F64, t: F64) -> Callable[[F64], F64]:
    """Return B -> C B for the inverse C of sparse information S (D, D) in the inner gauge, which is dense.

    A pose and a distance are fixed; Baarda's S-transformation leads from there to the inner gauge.
    """
    N, centres = gauge_basis(S.shape[0], width, R, t), -np.einsum("vba,vb->va", R, t)
    far = int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))
    line = R[far] @ (centres[far] - centres[0])
    moved = slice(width * far + 3, width * far + 6)
    fixed = scipy.sparse.lil_matrix(S.shape)
    fixed[:POSE_DOF, :POSE_DOF] = np.eye(POSE_DOF)
    fixed[moved, moved] = np.outer(line, line) / max(float(line @ line), 1e-300)
    factor = scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(S + float(np.median(S.diagonal())) * fixed), permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0, options={"SymmetricMode": True},
    )  # fmt: skip

    def without(B: F64) -> F64:
        return np.asarray(B - N @ (N.T @ B))

    return lambda B: without(factor.solve(without(B)))


def unit_columns(size: int, index: I64) -> F64:
    """Return the columns ``index`` of the identity, which would itself be dense."""
    columns = np.zeros((size, len(index)))
    columns[index, np.arange(len(index))] = 1.0
    return columns


def gauge_basis(size: int, width: int, R: F64, t: F64, free: F64 | None = None) -> F64:
    """Return the orthonormal motion (D, 7) of all ``size`` columns under similarities of the world.

    Of those of ``free`` (7, m) only: (D, m).
    """
    directions = gauge_directions(R, t, free)
    N = np.zeros((size, directions.shape[1]))
    N[(width * np.arange(len(t))[:, None] + np.arange(POSE_DOF)).ravel()] = directions
    return N


def gauge_directions(R: F64, t: F64, free: F64 | None = None) -> F64:
    """Return the orthonormal motion (6 V, 7) of poses under similarities, or those of ``free`` (7, m)."""
    motions = similarity_motions(R, t)
    return np.asarray(np.linalg.qr(motions if free is None else motions @ free)[0])


def similarity_motions(R: F64, t: F64) -> F64:
    """Return the motion (6 V, 7) of poses under shifts, turns and scaling of the world."""
    directions = np.zeros((len(t), POSE_DOF, SIMILARITY_DOF))
    directions[:, 3:, 0:3] = -R
    directions[:, :3, 3:6] = -R
    directions[:, 3:, 3:6] = -cross_matrix(t) @ R
    directions[:, 3:, 6] = t
    return directions.reshape(-1, SIMILARITY_DOF)

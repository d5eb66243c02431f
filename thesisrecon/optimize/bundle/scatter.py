"""Scatter of the intrinsics between blocks of the scene after bundle adjustment, relative to expected noise.

The sandwich covariance (Huber 1967, White 1980) summed by clusters (Liang and Zeger 1986): correlated errors
and errors of the lens model make the gradients of blocks larger than independent noise does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon._numba import kernel
from thesisrecon.arrays import B8, F64, I32, I64
from thesisrecon.geometry.homogeneous import scene_frame
from thesisrecon.optimize.bundle.covariance import (
    gauge_basis,
    invert_in_inner_gauge,
    orthonormal_columns,
    sparse_inverse,
    unit_columns,
)
from thesisrecon.optimize.bundle.intrinsic_unknowns import IntrinsicUnknowns, number_unknowns
from thesisrecon.optimize.bundle.projection import (
    LENS,
    POSE_DOF,
    Jacobians,
    MetricCameras,
    MetricModel,
    Observations,
    Weighting,
    linearize_metric,
)
from thesisrecon.records import IntrinsicsPrior

# Errors are correlated over large parts of the scene: their scatter is that of few large blocks.
_LARGE_BLOCKS = 4
# Number of unknowns above which matrices are sparse, if fewer than this fraction of the pairs of views share
# points.
_MANY, _SPARSE = 1200, 0.2
_ALL_POSES = 300  # Pose unknowns up to which the scatter of each is measured

_Solve = Callable[[F64], F64]
"""B -> C B for the covariance C, which is dense even if the information is sparse."""


@dataclass(frozen=True)
class BlockScatter:
    """Variances of the intrinsics (the focal relative) and their scatter between blocks of points.

    ``shared_variance`` (C,) would hold if all views shared one camera. ``ratio`` (G, C) is the scatter over
    its expectation, NaN for fixed intrinsics, ``large_ratio`` that of the ``large_blocks``; ``pose_ratios``
    (2, V, 2) are both of the rotation and the position of each observed view, NaN where not measured.
    ``overdispersion`` is the scatter between blocks over that between single points, 1 for independent noise.
    ``pull`` (G, C) is the step by which the prior moves the values, ``prior_variance`` (G, C) the part of the
    variance that is the prior's and not the images'.
    """

    variance: F64
    shared_variance: F64
    ratio: F64
    large_ratio: F64
    pose_ratios: F64
    pull: F64
    prior_variance: F64
    overdispersion: float
    blocks: int

    @property
    def large_blocks(self) -> int:
        """Number of large blocks."""
        return min(self.blocks, _LARGE_BLOCKS)

    @property
    def median_ratio(self) -> float:
        """Median of the ratios, 1 without any."""
        known = self.ratio[np.isfinite(self.ratio)]
        return float(np.median(known)) if len(known) else 1.0

    @property
    def inflation(self) -> float:
        """Factor on the noise that the blocks show, at least 1."""
        return float(np.sqrt(max(self.median_ratio, 1.0)))


def median_blocks(X: F64, used: B8, *, most: int = 32, least: int = 12) -> I64:
    """Divide points (N, d) into blocks of neighbours by median splits along the longest axis; -1 if not used.

    At most ``most`` blocks, of ``least`` points or more.
    """
    block = np.where(used, 0, -1)
    count = 1
    while 2 * count <= most and np.count_nonzero(used) >= 2 * count * least:
        for b in range(count):
            rows = np.flatnonzero(block == b)
            spread = np.subtract(*np.percentile(X[rows], [90, 10], axis=0))
            axis = int(np.argmax(spread))
            order = rows[np.argsort(X[rows, axis], kind="stable")]
            block[order[len(order) // 2 :]] = count + b
        count *= 2
    return np.asarray(block, dtype=np.int64)


def block_scatter(fit: LinearisedFit) -> BlockScatter:
    """Measure the scatter of the intrinsics' gradients between blocks of points after an adjustment (6.7).

    Let S_b be the information of block b on the cameras (its points eliminated), g_b its gradient and C the
    covariance with the column c_a of value a. Block b pulls value a by c_a' g_b; without correlation between
    blocks sum (c_a' g_b)^2 has the expectation sum c_a' (S_b - S_b C S_b) c_a, and the ratio of the two is 1.
    The information uses the weights of Huber's loss instead of its second derivatives, which
    `_loss_correction` corrects.
    """
    S, solve, values, first = fit.information, fit.solve, fit.values, fit.first
    # All intrinsics are tested, and all pose unknowns of few views, else about 30.
    poses = np.arange(0, first, max(first // 30, 1) if first > _ALL_POSES else 1)
    tested = np.concatenate([poses, np.arange(first, S.shape[0])])
    rows = solve(unit_columns(S.shape[0], tested)).T
    block = median_blocks(fit.X, np.bincount(fit.observations.point_index, minlength=len(fit.X)) > 0)
    curvature = _loss_correction(fit.residual.reshape(-1, 2), fit.loss_sigmas)
    ratio, large = (curvature * _block_ratio(fit, rows, b) for b in (block, block % _LARGE_BLOCKS))
    # The same ratio with every point a block of its own, whose effect on the fit is negligible. Not over the
    # variance: priors contribute to it without points.
    point, squares = np.repeat(fit.observations.point_index, 2), np.zeros(len(rows))
    for n, c in enumerate(rows):
        squares[n] = np.sum(np.bincount(point, (fit.J @ c) * fit.residual) ** 2)
    expected = np.sum((fit.J @ rows.T) ** 2, axis=0) - np.sum((fit.taken @ rows.T) ** 2, axis=0)
    alone = curvature * np.divide(squares, expected, out=np.full_like(squares, np.nan), where=expected > 0.0)
    valid = np.isfinite(ratio) & (alone > 0.0)
    estimated, number = values.number >= 0, values.number
    covariance = rows[len(poses) :, first:]
    variance, pull = np.diag(covariance), covariance @ values.terms.gradient(fit.start)
    of_prior = np.sum((covariance @ values.terms.information()) * covariance, axis=1)
    place_of = np.where(estimated, len(poses) + number, 0)
    pose_ratios = np.full((2, first), np.nan)
    pose_ratios[:, poses] = ratio[: len(poses)], large[: len(poses)]
    return BlockScatter(
        np.append(variance, 0.0)[np.where(estimated, number, -1)],
        _shared_variances(S, variance, values, fit.frame, fit.views),
        np.where(estimated, ratio[place_of], np.nan),
        np.where(estimated, large[place_of], np.nan),
        pose_ratios.reshape(2, -1, 2, 3).mean(axis=3),
        np.append(pull, 0.0)[np.where(estimated, number, -1)],
        np.append(of_prior, 0.0)[np.where(estimated, number, -1)],
        float(np.mean(ratio[valid]) / np.mean(alone[valid])) if valid.any() else np.nan,
        int(block.max()) + 1,
    )


@dataclass(frozen=True)
class PoseUncertainty:
    """How the poses of the V ``views`` depend on noise, on the intrinsics and on faults of the camera model.

    Rows are the rotation about the axes of the camera (rad) and the centre along those of the world, in the
    inner gauge: after the similarity that moves the cameras least. ``variance`` (V, 6) is that for known
    intrinsics, ``response`` (V, 6, n) the derivative by each of the n unknown intrinsics, ``covariance``
    (n, n) theirs, ``number`` (G, C) theirs in the table, -1 if fixed. ``fault`` (V, 6, 4) is the change by a
    unit of aspect ratio, of skew over focal length, and of either decentring coefficient (Brown 1966), and
    ``intrinsic_fault`` (n, 4) that of the intrinsics; ``decentring_change`` (n,) is its root mean square over
    the decentring that the images leave possible, 0 if that is estimated.
    """

    views: I64
    variance: F64
    response: F64
    covariance: F64
    number: I64
    fault: F64
    intrinsic_fault: F64
    decentring_change: F64

    def variances(self, noise: F64, std: F64, fault: float) -> F64:
        """Total variances (V, 6) for factors ``noise`` (V, 6) on standard deviations, and of other causes.

        ``std`` (n,) are those of the intrinsics, ``fault`` that of each fault of the camera model.
        """
        # The correlations stay those of the adjustment.
        scaled = self.response * (std / np.sqrt(np.diag(self.covariance)))
        intrinsics = np.einsum("vkm,vkm->vk", scaled @ self.covariance, scaled)
        return np.asarray(noise**2 * self.variance + intrinsics + fault**2 * np.sum(self.fault**2, axis=2))


def pose_uncertainty(fit: LinearisedFit, decentring_std: float) -> PoseUncertainty:
    """Propagate noise, intrinsics and faults of the camera model to the poses after an adjustment (6.7).

    ``decentring_std``: of the decentring coefficients of lenses, before the images are seen.
    """
    n, D, first = len(fit.views), fit.information.shape[0], fit.first
    R = fit.frame.R[fit.views]
    # Rows to (rotation, centre): C = -R' t moves by -R' d if t moves by d.
    turn = np.zeros((n, POSE_DOF, POSE_DOF))
    turn[:, :3, :3], turn[:, 3:, 3:] = np.eye(3), -np.swapaxes(R, 1, 2) / fit.scale
    S = scipy.sparse.csr_matrix(fit.information)
    poses = S[:first, :first]
    poses = poses if scipy.sparse.issparse(fit.information) else poses.toarray()
    known = _covariance(poses, fit.frame, fit.views)
    response = -known(S[:first, first:].toarray()).reshape(n, POSE_DOF, -1)
    variance = np.zeros((n, POSE_DOF))
    for v in range(n):
        rows = np.arange(POSE_DOF * v, POSE_DOF * (v + 1))
        own = known(unit_columns(first, rows))[rows]
        variance[v] = np.einsum("ka,ab,kb->k", turn[v], own, turn[v])
    fields = _faults(fit)
    moved = fit.solve(np.asarray(fit.J.T @ fields))
    _, mean, covariance = _decentring(fit, fields, moved, decentring_std)
    change = moved[first:, 2:]
    return PoseUncertainty(
        fit.views,
        np.maximum(variance, 0.0),
        turn @ response,
        fit.solve(unit_columns(D, np.arange(first, D)))[first:],
        fit.values.number,
        turn @ moved[:first].reshape(n, POSE_DOF, -1),
        moved[first:],
        np.sqrt((change @ mean) ** 2 + np.einsum("na,ab,nb->n", change, covariance, change)),
    )


def decentring_score(fit: LinearisedFit, std: float) -> float:
    """Twice the decrease of the cost that decentring promises, from a fit without it (score test, Rao 1948).

    Less the cost under a prior of standard deviation ``std``. At most chi-square with two degrees of freedom
    if the lens is centred.
    """
    fields = _faults(fit)
    return _decentring(fit, fields, fit.solve(np.asarray(fit.J.T @ fields)), std)[0]


def _decentring(fit: LinearisedFit, fields: F64, moved: F64, std: float) -> tuple[float, F64, F64]:
    """Return the score of the last two faults, and mean (2,) and covariance (2, 2) of the coefficients.

    Given the observations and a prior of standard deviation ``std``, by one step from zero. Zeros if the lens
    is decentred already.
    """
    if np.isin(fit.values.column, (LENS - 2, LENS - 1)).any():
        return 0.0, np.zeros(2), np.zeros((2, 2))
    fields = fields[:, 2:]
    information = fields.T @ fields - (fit.J.T @ fields).T @ moved[:, 2:]
    covariance = np.linalg.inv(information + np.eye(2) / std**2)
    # At the minimum residuals and prior have no gradient by the unknowns.
    gradient = fields.T @ fit.residual
    mean = covariance @ gradient
    return float(gradient @ mean), mean, covariance


def _faults(fit: LinearisedFit) -> F64:
    """Weighted displacements (2K, 4) of the observations by the faults that the points do not absorb."""
    o, columns = fit.observations, fit.centre_columns
    rows = fit.frame.intrinsics[fit.frame.group[o.view_index]]
    x, y = ((o.xy - rows[:, 3:5]) / rows[:, :1]).T
    square, none = x * x + y * y, np.zeros_like(x)
    fields = np.array(
        [[none, y], [y, none], [square + 2.0 * x * x, 2.0 * x * y], [2.0 * x * y, square + 2.0 * y * y]]
    )
    # The columns of the principal point weight displacements by px.
    weighted = np.einsum("krc,fck->krf", columns * rows[:, :1, None], fields).reshape(-1, 4)
    return np.asarray(weighted - fit.E @ (fit.E.T @ weighted))


@dataclass(frozen=True)
class LinearisedFit:
    """A linearised adjustment in a centred frame of size 1; the first ``first`` unknowns are the poses.

    ``X`` are the points before, ``loss_sigmas`` is the width of Huber's loss. Weighted residuals (2K,) have
    the Jacobian J (2K, D), of which the points take the part ``taken``; ``E`` (2K, 3N) are orthonormal
    columns that span the displacements by points, ``centre_columns`` (K, 2, 2) the derivatives by the
    principal point.
    """

    X: F64
    observations: Observations
    loss_sigmas: float
    residual: F64
    J: scipy.sparse.csr_matrix
    taken: scipy.sparse.csr_matrix
    E: scipy.sparse.csr_matrix
    centre_columns: F64
    information: F64 | scipy.sparse.csc_matrix
    solve: _Solve
    values: IntrinsicUnknowns
    start: F64
    frame: MetricCameras
    scale: float
    views: I64
    first: int


def linearise_fit(
    cameras: MetricCameras, X: F64, o: Observations, free: B8, prior: IntrinsicsPrior,
    noise: tuple[float, float],
) -> LinearisedFit:  # fmt: skip
    """Linearise an adjustment at its minimum; ``noise`` is the standard deviation and the loss width."""
    group, (sigma, loss), width = cameras.group, noise, cameras.intrinsics.shape[1]
    observed = np.bincount(o.view_index, minlength=len(group)) > 0
    used = np.bincount(group[observed], minlength=len(cameras.intrinsics)) > 0
    values, start, _ = number_unknowns(cameras, used, free, prior)
    views, first = np.flatnonzero(observed), POSE_DOF * int(observed.sum())
    origin, scale = scene_frame(X[np.unique(o.point_index)])
    frame = replace(cameras, t=scale * (cameras.t + cameras.R @ origin))
    model = MetricModel(frame.R, frame.t, frame.intrinsics, group, scale * (X - origin))
    weighted, none = Jacobians.empty(len(o.xy), POSE_DOF + width, 0), np.zeros(0, dtype=np.int64)
    linearize_metric(model, o, Weighting(sigma, loss / sigma), np.arange(width), none, weighted)
    number = values.number[group[o.view_index]]
    poses = POSE_DOF * (np.cumsum(observed) - 1)[o.view_index][:, None] + np.arange(POSE_DOF)
    column = np.concatenate([poses, np.where(number >= 0, first + number, 0)], axis=1)
    centre_columns = weighted.A[:, :, POSE_DOF + 3 : POSE_DOF + 5].copy()
    weighted.A[:, :, POSE_DOF:] *= (number >= 0)[:, None]
    J = _sparse(weighted.A, column, first + values.size)
    B, at = orthonormal_columns(weighted.B, o.point_index, len(X)), 3 * o.point_index[:, None] + np.arange(3)
    E, residual = _sparse(B, at, 3 * len(X)), weighted.residual.ravel()
    taken = scipy.sparse.csr_matrix(E.T @ J)
    residual -= E @ (E.T @ residual)
    S = _information(J, taken, values.terms.information().toarray(), o, len(views))
    return LinearisedFit(
        X, o, loss / sigma, residual, J, taken, E, centre_columns, S, _covariance(S, frame, views),
        values, start, frame, scale, views, first,
    )  # fmt: skip


def _information(
    J: scipy.sparse.csr_matrix, taken: scipy.sparse.csr_matrix, prior: F64, o: Observations, n_views: int
) -> F64 | scipy.sparse.csc_matrix:
    """Return the information (D, D) of the cameras, sparse if most views have no common point."""
    D, size = J.shape[1], len(prior)
    seen = scipy.sparse.csr_matrix((np.ones(len(o.xy)), (o.view_index, o.point_index)))
    if D <= _MANY or (seen @ seen.T).nnz > _SPARSE * n_views**2:
        S = _gram_matrix(J) - _gram_matrix(taken)
        S[D - size :, D - size :] += prior
        return S
    both = scipy.sparse.block_diag([scipy.sparse.csc_matrix((D - size, D - size)), prior])
    return scipy.sparse.csc_matrix(J.T @ J - taken.T @ taken + both)


def _gram_matrix(A: scipy.sparse.csr_matrix) -> F64:
    """Return A'A as a dense matrix, since most pairs of views share points here."""
    G = np.zeros((A.shape[1], A.shape[1]))
    _add_gram(A.indptr, A.indices, A.data, G)
    return G + np.tril(G, -1).T


@kernel
def _add_gram(start: I32, column: I32, value: F64, G: F64) -> None:
    """Add the lower triangle of A'A; row i of A has the values of start[i] <= k < start[i + 1]."""
    for i in range(len(start) - 1):
        for k in range(start[i], start[i + 1]):
            row, factor = G[column[k]], value[k]
            for m in range(start[i], start[i + 1]):
                if column[m] <= column[k]:
                    row[column[m]] += factor * value[m]


def _sparse(values: F64, column: I64, width: int) -> scipy.sparse.csr_matrix:
    """Return rows (2K, width) with values (K, 2, n) in the columns (K, n)."""
    K, _, n = values.shape
    rows = np.repeat(np.arange(2 * K), n)
    return scipy.sparse.csr_matrix(
        (values.ravel(), (rows, np.repeat(column, 2, axis=0).ravel())), (2 * K, width)
    )


def _covariance(S: F64 | scipy.sparse.csc_matrix, cameras: MetricCameras, views: I64) -> _Solve:
    """Return the inverse of S without the gauge freedoms."""
    R, t = cameras.R[views], cameras.t[views]
    if not isinstance(S, np.ndarray):
        return sparse_inverse(S, POSE_DOF, R, t)
    C = invert_in_inner_gauge(S, gauge_basis(len(S), POSE_DOF, R, t))
    return lambda B: C @ B


def _shared_variances(
    S: F64 | scipy.sparse.csc_matrix, variance: F64, values: IntrinsicUnknowns, cameras: MetricCameras,
    views: I64,
) -> F64:  # fmt: skip
    """Return the variances (C,) of the intrinsics if all cameras were one, from S and those of each value."""
    first, width = S.shape[0] - values.size, values.number.shape[1]
    column = values.column[: values.n_table]
    if values.size == len(np.unique(column)):
        variances = np.zeros(width)
        variances[column] = variance
        return variances
    used = np.unique(column)
    place = np.searchsorted(used, column)
    rows, columns = np.arange(first + values.n_table), np.concatenate([np.arange(first), first + place])
    T = scipy.sparse.csc_matrix((np.ones(len(rows)), (rows, columns)), (S.shape[0], first + len(used)))
    together = T.T @ S @ T
    solve = _covariance(together if scipy.sparse.issparse(S) else np.asarray(together), cameras, views)
    shared = np.zeros(width)
    shared[used] = np.diag(solve(unit_columns(first + len(used), first + np.arange(len(used))))[first:])
    return shared


def _block_ratio(fit: LinearisedFit, rows: F64, block: I64) -> F64:
    """Squared pulls of the blocks on ``rows`` of C over sum C (S_b - S_b C S_b) C, their expectation."""
    squares, expected = np.zeros(len(rows)), np.zeros(len(rows))
    of_residual, of_point = block[np.repeat(fit.observations.point_index, 2)], np.repeat(block, 3)
    for b in range(int(block.max()) + 1):
        here = np.flatnonzero(of_residual == b)
        J, taken = fit.J[here], fit.taken[np.flatnonzero(of_point == b)]
        half = (J.T @ (J @ rows.T) - taken.T @ (taken @ rows.T)).T
        expected += np.sum(half * rows, axis=1) - np.sum(fit.solve(half.T).T * half, axis=1)
        squares += (rows @ (J.T @ fit.residual[here])) ** 2
    return np.asarray(np.divide(squares, expected, np.full(len(rows), np.nan), where=expected > 0.0))


def _loss_correction(weighted: F64, delta: float) -> float:
    """Return (mean weight / mean slope)^2 of Huber's loss from weighted residuals."""
    squared = np.sum(weighted**2, axis=1)
    # Outside, |w r|^2 = delta |r|, hence the weight delta / |r| = delta^2 / |w r|^2.
    outside = squared > delta**2
    weight = np.where(outside, delta**2 / np.maximum(squared, 1e-300), 1.0)
    slope = np.where(outside, 0.5 * weight, 1.0)
    return float(weight.mean() / slope.mean()) ** 2

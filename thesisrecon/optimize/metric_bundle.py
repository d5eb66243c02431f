"""Metric bundle adjustment: poses, points and shared intrinsics with priors, and the covariance of the
answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.optimize import kernels
from thesisrecon.optimize.levenberg_marquardt import invert_information, run_levenberg_marquardt
from thesisrecon.optimize.losses import LossName, loss_code
from thesisrecon.optimize.schur import (
    BundleStep,
    BundleSystem,
    Columns,
    Jacobians,
    Observations,
    assemble_system,
    sort_observations,
)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]
POSE_DOF, INTRINSIC_DOF = 6, 6
SIMILARITY_DOF = 7
MAD_TO_SIGMA = 1.4826
# Variance of a standard normal variable cut at +-2.5.
TRIM, TRIMMED_VARIANCE = 2.5, 0.91126


@dataclass(frozen=True)
class MetricCameras:
    """Calibrated cameras that share intrinsics in groups.

    ``R`` (V, 3, 3) world-to-camera, ``t`` (V, 3); ``intrinsics`` (G, 6) rows [focal_px, aspect fy/fx,
    skew_px, cx_px, cy_px, k1]; ``group`` (V,) the row of each view. A normalised point (x, y) is seen at (x,
    y) (1 + k1 r^2), then at K = [[f, skew, cx], [0, aspect f, cy], [0, 0, 1]].
    """

    R: F64
    t: F64
    intrinsics: F64
    group: I64

    @property
    def K(self) -> F64:
        """(V, 3, 3) calibration matrices."""
        f, aspect, skew, cx, cy, _ = self.intrinsics[self.group].T
        zero, one = np.zeros_like(f), np.ones_like(f)
        rows = [f, skew, cx, zero, aspect * f, cy, zero, zero, one]
        return np.stack(rows, axis=-1).reshape(-1, 3, 3)

    @property
    def P(self) -> F64:
        """(V, 3, 4) cameras before distortion, K [R t]."""
        return np.asarray(self.K @ np.concatenate([self.R, self.t[:, :, None]], axis=2))


@dataclass(frozen=True)
class IntrinsicsPrior:
    """Gaussian priors on the intrinsics: ``mean``, ``std`` (G, 6), std inf = nothing is assumed.

    Units are those of the intrinsics (px; aspect and k1 pure numbers), but the focal's std is relative: the
    prior acts on log f.
    """

    mean: F64
    std: F64


@dataclass(frozen=True)
class MetricBundleResult:
    """Refined cameras and points with their uncertainty.

    ``residual_px`` (K, 2) projection minus observation in the caller's order; ``cost``, ``initial_cost`` 1/2
    sum rho in units of the given sigma, priors included; ``sigma_px`` the standard deviation of one image
    coordinate estimated from the residuals. With ``covariance=True``: ``intrinsics_covariance`` (G, 6, 6),
    zero for fixed entries, and ``pose_covariance`` (V, 6, 6) of (rotation vector in rad, translation) of x ->
    exp(w) x + d in each camera's frame, with respect to the centre of all poses (the inner gauge: no camera
    is taken as exact).
    """

    cameras: MetricCameras
    X: F64
    residual_px: F64
    cost: float
    initial_cost: float
    iterations: int
    converged: bool
    intrinsics_covariance: F64
    pose_covariance: F64 | None
    sigma_px: float


@dataclass(frozen=True)
class _State:
    R: F64
    t: F64
    intrinsics: F64
    X: F64


@dataclass(frozen=True)
class _MetricProblem:
    """Reprojection in units of ``sigma_px`` plus the priors; columns are poses (6 each), then groups (F
    each)."""

    observations: Observations
    columns: Columns
    free_views: B8
    group: I64
    free: I64
    prior: IntrinsicsPrior
    loss: int
    loss_scale: float
    sigma_px: float
    jacobians: Jacobians

    def linearize(self, state: _State) -> BundleSystem:
        o, J, s = self.observations, self.jacobians, state
        cost = kernels.linearize_metric(
            s.R,
            s.t,
            s.intrinsics,
            self.group,
            s.X,
            o.view_index,
            o.point_index,
            o.xy,
            self.free,
            self.sigma_px,
            self.loss,
            self.loss_scale,
            J.residual,
            J.A,
            J.G,
            J.B,
        )
        deviation, information = self._prior_terms(state)
        diagonal, gradient = np.zeros(self.columns.size), np.zeros(self.columns.size)
        first = POSE_DOF * int(self.free_views.sum())
        diagonal[first:] = information[:, self.free].ravel()
        gradient[first:] = (information * deviation)[:, self.free].ravel()
        cost += 0.5 * float(np.sum(information * deviation**2))
        return assemble_system(cost, o.start, self.columns, J, prior=(diagonal, gradient))

    def retract(self, state: _State, step: BundleStep) -> _State:
        split = POSE_DOF * int(self.free_views.sum())
        poses = np.zeros((len(state.t), POSE_DOF))
        poses[self.free_views] = step.cameras[:split].reshape(-1, POSE_DOF)
        turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        t = np.einsum("vab,vb->va", turn, state.t) + poses[:, 3:]
        moves = np.zeros_like(state.intrinsics)
        moves[:, self.free] = step.cameras[split:].reshape(len(moves), -1)
        intrinsics = state.intrinsics + moves
        # A focal can never change sign; the bound only matters for steps that will be refused anyway.
        intrinsics[:, 0] = state.intrinsics[:, 0] * np.exp(np.clip(moves[:, 0], -3.0, 3.0))
        R, X = turn @ state.R, state.X + step.points
        o = self.observations
        before = np.column_stack([state.R[:, 2], state.t[:, 2]])
        after = np.column_stack([R[:, 2], t[:, 2]])
        kernels.hold_flipping_points(o.start, o.view_index, before, after, state.X, X)
        return _State(R, t, intrinsics, X)

    def residual(self, state: _State) -> tuple[F64, F64]:
        """Residuals (K, 2) in px and depths (K,)."""
        o, s = self.observations, state
        residual, depth = np.empty_like(o.xy), np.empty(len(o.xy))
        kernels.project_metric(
            s.R, s.t, s.intrinsics, self.group, s.X, o.view_index, o.point_index, o.xy, residual, depth
        )
        return residual, depth

    def cost(self, state: _State) -> float:
        deviation, information = self._prior_terms(state)
        residual = self.residual(state)[0] / self.sigma_px
        data = float(kernels.robust_cost(residual, self.loss, self.loss_scale))
        return data + 0.5 * float(np.sum(information * deviation**2))

    def _prior_terms(self, state: _State) -> tuple[F64, F64]:
        """Deviation from the prior's mean and information (1 / std^2), (G, 6) each; zero where nothing is
        assumed."""
        deviation = state.intrinsics - self.prior.mean
        deviation[:, 0] = np.log(state.intrinsics[:, 0] / self.prior.mean[:, 0])
        information = np.zeros_like(deviation)
        free = self.free
        information[:, free] = 1.0 / self.prior.std[:, free] ** 2
        return np.where(information > 0.0, deviation, 0.0), information


def refine_metric_bundle(
    cameras: MetricCameras,
    X: F64,
    view_index: I64,
    point_index: I64,
    xy: F64,
    *,
    free: B8,
    prior: IntrinsicsPrior | None = None,
    sigma_px: float = 1.0,
    loss_px: float = 1.0,
    loss: LossName = "huber",
    max_iterations: int = 20,
    fixed_views: B8 | None = None,
    covariance: bool = False,
) -> MetricBundleResult:
    """Minimise sum rho(|x - project(X)|^2 / sigma^2) + sum ((q - mean) / std)^2 over poses, points and
    intrinsics q.

    Sparse Levenberg-Marquardt; the focal is stepped as log f, the seven freedoms of the frame are left to the
    damping, and the frame is centred and scaled inside so that they are well conditioned.

    Parameters
    ----------
    cameras : where to start. X : (N, 3) points.
    view_index, point_index : (K,) of each observation; xy : (K, 2) px. Any order; sorted by point is fastest.
    free : (6,) which of (focal, aspect, skew, cx, cy, k1) move. prior : what is known of them, none by
    default. sigma_px : standard deviation of one image coordinate, the weight of the data against the prior.
    loss_px : where the loss turns, px. fixed_views : (V,) True for poses that must not move. covariance :
    whether to compute the covariances (one more linear system).

    Views and points without observations come back untouched. The cost never rises; singular systems end the
    iterations instead of raising. Raises ``ValueError`` for wrong shapes, values that are not finite or
    focals that are not positive.
    """
    X = np.array(X, dtype=np.float64)
    _check(cameras, X, free, prior)
    if not sigma_px > 0.0:
        raise ValueError(f"sigma_px must be positive; got {sigma_px}")
    observations = sort_observations(view_index, point_index, xy, len(cameras.R), len(X))
    seen = np.bincount(observations.view_index, minlength=len(cameras.R)) > 0
    seen_points = np.diff(observations.start) > 0
    free_views = seen & ~(np.zeros(len(seen), bool) if fixed_views is None else np.asarray(fixed_views, bool))
    code = loss_code(loss, loss_px)
    columns = _columns(observations, cameras, free_views, int(np.count_nonzero(free)))
    problem = _MetricProblem(
        observations,
        columns,
        free_views,
        np.ascontiguousarray(cameras.group, dtype=np.int64),
        np.flatnonzero(free),
        prior or IntrinsicsPrior(cameras.intrinsics, np.full_like(cameras.intrinsics, np.inf)),
        code,
        loss_px / sigma_px,
        sigma_px,
        Jacobians.allocate(len(observations.xy), POSE_DOF, int(np.count_nonzero(free))),
    )
    origin, scale = _frame(X[seen_points])
    state = _State(
        np.array(cameras.R, dtype=np.float64),
        scale * (cameras.t + cameras.R @ origin),
        np.array(cameras.intrinsics, dtype=np.float64),
        np.ascontiguousarray(scale * (X - origin)),
    )
    solution = run_levenberg_marquardt(problem, state, max_iterations=max_iterations)
    end = solution.state
    residual = problem.residual(end)[0]
    sigma = _robust_sigma(residual, columns.size + 3 * int(seen_points.sum()) - SIMILARITY_DOF)
    intrinsics_covariance = np.zeros((len(cameras.intrinsics), INTRINSIC_DOF, INTRINSIC_DOF))
    pose_covariance = None
    if covariance:
        intrinsics_covariance, pose_covariance = _covariances(problem, end, sigma or sigma_px, scale)
    refined = MetricCameras(
        np.where(free_views[:, None, None], end.R, cameras.R),
        np.where(free_views[:, None], end.t / scale - end.R @ origin, cameras.t),
        end.intrinsics,
        cameras.group,
    )
    return MetricBundleResult(
        refined,
        np.where(seen_points[:, None], end.X / scale + origin, X),
        observations.unsort(residual),
        solution.cost,
        solution.initial_cost,
        solution.iterations,
        solution.converged,
        intrinsics_covariance,
        pose_covariance,
        sigma,
    )


def _check(cameras: MetricCameras, X: F64, free: B8, prior: IntrinsicsPrior | None) -> None:
    """Shapes and values of a call, as ``ValueError``."""
    n_views, n_groups = len(cameras.R), len(cameras.intrinsics)
    shapes = (cameras.R.shape, cameras.t.shape, cameras.intrinsics.shape, cameras.group.shape, X.shape[1:])
    if shapes != ((n_views, 3, 3), (n_views, 3), (n_groups, 6), (n_views,), (3,)):
        raise ValueError(
            f"a metric bundle needs R (V, 3, 3), t (V, 3), intrinsics (G, 6), group (V,); got {shapes}"
        )
    if np.shape(free) != (INTRINSIC_DOF,):
        raise ValueError(f"free is one flag for each of the 6 intrinsics; got shape {np.shape(free)}")
    finite = (np.isfinite(a).all() for a in (cameras.R, cameras.t, cameras.intrinsics, X))
    if not all(finite) or not (cameras.intrinsics[:, 0] > 0.0).all():
        raise ValueError("cameras and points must be finite and focals positive")
    if n_views and (cameras.group.min() < 0 or cameras.group.max() >= n_groups):
        raise ValueError(f"groups must lie in 0..{n_groups - 1}")
    if prior is not None and not (
        prior.mean.shape == prior.std.shape == cameras.intrinsics.shape
        and (prior.std > 0.0).all()
        and np.isfinite(prior.mean).all()
        and (prior.mean[:, 0] > 0.0).all()
    ):
        raise ValueError(f"a prior needs finite means and positive stds of shape {cameras.intrinsics.shape}")


def _columns(observations: Observations, cameras: MetricCameras, free_views: B8, n_free: int) -> Columns:
    """First columns of each observation: poses of the free views, then the groups."""
    first = np.where(free_views, POSE_DOF * (np.cumsum(free_views) - 1), -1)
    base = POSE_DOF * int(free_views.sum())
    group = base + n_free * np.asarray(cameras.group, dtype=np.int64)
    view = observations.view_index
    return Columns(first[view], group[view], base + n_free * len(cameras.intrinsics))


def _frame(X: F64) -> tuple[F64, float]:
    """Middle and inverse size of the scene by medians, so that far points do not matter."""
    if len(X) == 0:
        return np.zeros(3), 1.0
    origin = np.median(X, axis=0)
    size = float(np.median(np.linalg.norm(X - origin, axis=1)))
    return origin, 1.0 / size if size > 0.0 else 1.0


def _robust_sigma(residual: F64, parameters: int) -> float:
    """Standard deviation of one coordinate: root mean square of the residuals within 2.5 sigma, sigma
    starting from the median, corrected for the trimming of a normal distribution and for the fitted
    freedoms."""
    size, count = np.abs(residual).ravel(), residual.size
    if count <= max(parameters, 0):
        return 0.0
    sigma = MAD_TO_SIGMA * float(np.median(size))
    for _ in range(5):
        kept = size[size <= TRIM * sigma]
        if len(kept):
            sigma = float(np.sqrt(np.mean(kept**2) / TRIMMED_VARIANCE))
    return sigma * float(np.sqrt(count / (count - parameters)))


def _covariances(problem: _MetricProblem, state: _State, sigma_px: float, scale: float) -> tuple[F64, F64]:
    """Covariances of intrinsics (G, 6, 6) and poses (V, 6, 6), t in the caller's units.

    The reduced information matrix S is singular along the directions N of the frame's seven freedoms; (S + N
    N')^-1 is S's generalised inverse with the freedoms at unit variance, which are then removed. N has no
    part in the intrinsics, so their covariance does not depend on the frame.
    """
    problem = _MetricProblem(**{**problem.__dict__, "sigma_px": sigma_px})
    S, _, _ = problem.linearize(state).reduce(1e-10)
    S = np.triu(S) + np.triu(S, 1).T
    views, n_free = np.flatnonzero(problem.free_views), len(problem.free)
    covariance = np.zeros_like(S)
    if problem.free_views[problem.observations.view_index].all():
        N = _gauge_directions(state, views, len(S))
        weight = float(np.median(np.diag(S))) if len(S) else 1.0
        covariance = invert_information(S + weight * N @ N.T)
        covariance = covariance - N @ (N.T @ covariance @ N) @ N.T
    else:
        covariance = invert_information(S)
    poses = np.zeros((len(state.t), POSE_DOF, POSE_DOF))
    units = np.array([1.0, 1.0, 1.0, 1.0 / scale, 1.0 / scale, 1.0 / scale])
    for n, view in enumerate(views):
        block = slice(POSE_DOF * n, POSE_DOF * (n + 1))
        poses[view] = covariance[block, block] * units * units[:, None]
    intrinsics = np.zeros((len(state.intrinsics), INTRINSIC_DOF, INTRINSIC_DOF))
    for g in range(len(intrinsics)):
        begin = POSE_DOF * len(views) + n_free * g
        block = slice(begin, begin + n_free)
        # From log f to f.
        units = np.where(problem.free == 0, state.intrinsics[g, 0], 1.0)
        intrinsics[g][np.ix_(problem.free, problem.free)] = covariance[block, block] * units * units[:, None]
    return intrinsics, poses


def _gauge_directions(state: _State, views: I64, size: int) -> F64:
    """Orthonormal (D, 7): how the poses move when the world is shifted, turned and scaled."""
    R, t = state.R[views], state.t[views]
    directions = np.zeros((len(views), POSE_DOF, SIMILARITY_DOF))
    directions[:, 3:, 0:3] = -R
    directions[:, :3, 3:6] = -R
    directions[:, 3:, 3:6] = -cross_matrix(t) @ R
    directions[:, 3:, 6] = t
    N = np.zeros((size, SIMILARITY_DOF))
    N[: directions.shape[0] * POSE_DOF] = directions.reshape(-1, SIMILARITY_DOF)
    return np.asarray(np.linalg.qr(N)[0])

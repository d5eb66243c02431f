"""Metric bundle adjustment: poses, points and intrinsics that views share or have on their own, with
priors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thesisrecon.optimize import kernels
from thesisrecon.optimize.bundle_covariance import CovarianceInput, bundle_covariances, robust_sigma
from thesisrecon.optimize.intrinsic_values import IntrinsicValues, number_values
from thesisrecon.optimize.levenberg_marquardt import run_levenberg_marquardt
from thesisrecon.optimize.losses import LossName, loss_code
from thesisrecon.optimize.metric_cameras import (
    POSE_DOF,
    IntrinsicsPrior,
    MetricCameras,
    check_cameras,
    check_prior,
)
from thesisrecon.optimize.schur import (
    BundleStep,
    BundleSystem,
    Columns,
    Jacobians,
    Observations,
    SortedObservations,
    assemble_system,
    sort_observations,
)

__all__ = [
    "BundleOptions",
    "IntrinsicsPrior",
    "MetricBundleResult",
    "MetricCameras",
    "Observations",
    "refine_metric_bundle",
]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]
SIMILARITY_DOF = 7


@dataclass(frozen=True)
class BundleOptions:
    """How a metric bundle is weighed and when it ends.

    Parameters
    ----------
    sigma_px : standard deviation of one image coordinate, the weight of the data against the priors.
    loss, loss_px : the robust loss and where it turns, px.
    max_iterations : linear systems at the most.
    fixed_views : (V,) True for poses that must not move; None: all move.
    covariance : whether to compute the covariances (one more linear system).
    noise_floor_px : the covariances take the noise to be at least this, whatever the residuals say.
    """

    sigma_px: float = 1.0
    loss: LossName = "huber"
    loss_px: float = 1.0
    max_iterations: int = 20
    fixed_views: B8 | None = field(default=None, compare=False)
    covariance: bool = False
    noise_floor_px: float = 0.0

    def __post_init__(self) -> None:
        loss_code(self.loss, self.loss_px)
        if not self.sigma_px > 0.0:
            raise ValueError(f"sigma_px must be positive; got {self.sigma_px}")


@dataclass(frozen=True)
class MetricBundleResult:
    """Refined cameras and points with their uncertainty.

    ``residual_px`` (K, 2) projection minus observation in the caller's order; ``cost``, ``initial_cost`` 1/2
    sum rho in units of the given sigma, priors included; ``sigma_px`` the standard deviation of one image
    coordinate estimated from the residuals. With ``covariance``: ``intrinsics_covariance`` (G, C, C), zero
    for entries that do not move, and ``pose_covariance`` (V, 6, 6) of (rotation vector in rad, translation)
    of x -> exp(w) x + d in each camera's frame, with respect to the centre of all poses (the inner gauge: no
    camera is taken as exact).
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
    values: F64
    intrinsics: F64
    X: F64


@dataclass(frozen=True)
class _MetricProblem:
    """Reprojection in units of ``sigma_px`` plus the priors; unknowns are poses (6 each), then values."""

    observations: SortedObservations
    columns: Columns
    free_views: B8
    group: I64
    free: I64
    values: IntrinsicValues
    loss: int
    loss_scale: float
    sigma_px: float
    jacobians: Jacobians

    @property
    def n_pose(self) -> int:
        """Unknowns of the poses; those of the intrinsics follow."""
        return POSE_DOF * int(self.free_views.sum())

    def linearize(self, state: _State) -> BundleSystem:
        o, J, s = self.observations, self.jacobians, state
        cost = kernels.linearize_metric(
            s.R, s.t, s.intrinsics, self.group, s.X, o.view_index, o.point_index, o.xy, self.free,
            self.sigma_px, self.loss, self.loss_scale, J.residual, J.A, J.G, J.B,
        )  # fmt: skip
        links, first = self.values.links, self.n_pose
        Q, q = np.zeros((self.columns.unknowns,) * 2), np.zeros(self.columns.unknowns)
        Q[first:, first:] = links.information(self.values.size)
        q[first:] = links.gradient(s.values)
        return assemble_system(cost + links.cost(s.values), o.start, self.columns, J, prior=(Q, q))

    def retract(self, state: _State, step: BundleStep) -> _State:
        poses = np.zeros((len(state.t), POSE_DOF))
        poses[self.free_views] = step.cameras[: self.n_pose].reshape(-1, POSE_DOF)
        turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        t = np.einsum("vab,vb->va", turn, state.t) + poses[:, 3:]
        values = self.values.step(state.values, step.cameras[self.n_pose :])
        R, X = turn @ state.R, state.X + step.points
        o = self.observations
        before = np.column_stack([state.R[:, 2], state.t[:, 2]])
        after = np.column_stack([R[:, 2], t[:, 2]])
        kernels.hold_flipping_points(o.start, o.view_index, before, after, state.X, X)
        return _State(R, t, values, self.values.write(state.intrinsics, values), X)

    def residual(self, state: _State) -> tuple[F64, F64]:
        """Residuals (K, 2) in px and depths (K,)."""
        o, s = self.observations, state
        residual, depth = np.empty_like(o.xy), np.empty(len(o.xy))
        kernels.project_metric(
            s.R, s.t, s.intrinsics, self.group, s.X, o.view_index, o.point_index, o.xy, residual, depth
        )
        return residual, depth

    def cost(self, state: _State) -> float:
        residual = self.residual(state)[0] / self.sigma_px
        data = float(kernels.robust_cost(residual, self.loss, self.loss_scale))
        return data + self.values.links.cost(state.values)


def refine_metric_bundle(
    cameras: MetricCameras,
    X: F64,
    observations: Observations,
    *,
    free: B8,
    prior: IntrinsicsPrior | None = None,
    options: BundleOptions | None = None,
) -> MetricBundleResult:
    """Minimise sum rho(|x - project(X)|^2 / sigma^2) + sum ((q - mean) / std)^2 over poses, points and
    intrinsics q.

    Sparse Levenberg-Marquardt; the focal is stepped as log f, the seven freedoms of the frame are left to the
    damping, and the frame is centred and scaled inside so that they are well conditioned.

    Parameters
    ----------
    cameras : where to start, and which intrinsics are shared. X : (N, 3) points.
    observations : K of them, in any order.
    free : (C,) which of the intrinsics move at all. prior : what is known of them, which
    may hold single ones; nothing by default.

    Views and points without observations come back untouched. The cost never rises; singular systems end the
    iterations instead of raising. Raises ``ValueError`` for wrong shapes, values that are not finite or
    focals that are not positive.
    """
    options = options or BundleOptions()
    X = np.array(X, dtype=np.float64)
    check_cameras(cameras, X, free)
    if prior is not None:
        check_prior(prior, cameras.intrinsics.shape)
    o = sort_observations(
        observations.view_index, observations.point_index, observations.xy, len(cameras.R), len(X)
    )
    seen_points = np.diff(o.start) > 0
    origin, scale = _frame(X[seen_points])
    problem, values, table = _metric_problem(cameras, o, np.asarray(free, dtype=bool), prior, options)
    state = _State(
        np.array(cameras.R, dtype=np.float64),
        scale * (cameras.t + cameras.R @ origin),
        values,
        problem.values.write(table, values),
        np.ascontiguousarray(scale * (X - origin)),
    )
    solution = run_levenberg_marquardt(problem, state, max_iterations=options.max_iterations)
    end, moved = solution.state, problem.free_views
    residual = problem.residual(end)[0]
    sigma = robust_sigma(residual, problem.columns.unknowns + 3 * int(seen_points.sum()) - SIMILARITY_DOF)
    intrinsics_covariance, pose_covariance = np.zeros((*table.shape, table.shape[1])), None
    if options.covariance:
        intrinsics_covariance, pose_covariance = _covariances(
            problem, end, max(sigma or options.sigma_px, options.noise_floor_px), scale
        )
    refined = replace(
        cameras,
        R=np.where(moved[:, None, None], end.R, cameras.R),
        t=np.where(moved[:, None], end.t / scale - end.R @ origin, cameras.t),
        intrinsics=end.intrinsics,
    )
    return MetricBundleResult(
        refined,
        np.where(seen_points[:, None], end.X / scale + origin, X),
        o.unsort(residual),
        solution.cost,
        solution.initial_cost,
        solution.iterations,
        solution.converged,
        intrinsics_covariance,
        pose_covariance,
        sigma,
    )


def _metric_problem(
    cameras: MetricCameras,
    o: SortedObservations,
    free: B8,
    prior: IntrinsicsPrior | None,
    options: BundleOptions,
) -> tuple[_MetricProblem, F64, F64]:
    """The problem, where its intrinsic values start, and the table of intrinsics they are put into."""
    group = np.ascontiguousarray(cameras.group, dtype=np.int64)
    seen = np.bincount(o.view_index, minlength=len(group)) > 0
    used = np.bincount(group[seen], minlength=len(cameras.intrinsics)) > 0
    values, start, table = number_values(cameras, used, free, prior)
    fixed = np.zeros(len(group), bool) if options.fixed_views is None else options.fixed_views
    free_views, n_free = seen & ~np.asarray(fixed, bool), int(np.count_nonzero(free))
    first = np.where(free_views, POSE_DOF * (np.cumsum(free_views) - 1), -1)
    base = POSE_DOF * int(free_views.sum())
    tail = values.number[:, free].ravel()
    fold = np.concatenate([np.arange(base), np.where(tail >= 0, base + tail, -1)])
    columns = Columns(
        first[o.view_index], base + n_free * group[o.view_index], len(fold), fold, base + values.size
    )
    problem = _MetricProblem(
        o, columns, free_views, group, np.flatnonzero(free), values, loss_code(options.loss, options.loss_px),
        options.loss_px / options.sigma_px, options.sigma_px, Jacobians.allocate(len(o.xy), POSE_DOF, n_free),
    )  # fmt: skip
    return problem, start, table


def _frame(X: F64) -> tuple[F64, float]:
    """Middle and inverse size of the scene by medians, so that far points do not matter."""
    if len(X) == 0:
        return np.zeros(3), 1.0
    origin = np.median(X, axis=0)
    size = float(np.median(np.linalg.norm(X - origin, axis=1)))
    return origin, 1.0 / size if size > 0.0 else 1.0


def _covariances(problem: _MetricProblem, state: _State, sigma_px: float, scale: float) -> tuple[F64, F64]:
    """Covariances of intrinsics (G, C, C) and poses (V, 6, 6) for the noise found, t in the caller's unit."""
    S, _, _ = replace(problem, sigma_px=sigma_px).linearize(state).reduce(1e-10)
    held = not problem.free_views[problem.observations.view_index].all()
    found = CovarianceInput(S, problem.free_views, state.R, state.t, held)
    return bundle_covariances(found, problem.values.number, state.intrinsics[:, 0], scale)

"""Metric bundle adjustment: poses, points and intrinsics, shared or separate, with priors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.homogeneous import scene_frame
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.covariance import (
    SIMILARITY_DOF,
    CovarianceInput,
    bundle_covariances,
    robust_sigma,
)
from thesisrecon.numerics.elimination import sum_leverages
from thesisrecon.numerics.intrinsic_unknowns import (
    IntrinsicColumns,
    IntrinsicUnknowns,
    assign_columns,
    number_unknowns,
)
from thesisrecon.numerics.levenberg_marquardt import Solution, run_levenberg_marquardt
from thesisrecon.numerics.losses import LossName, loss_code
from thesisrecon.numerics.metric_cameras import (
    POSE_DOF,
    MetricCameras,
    MetricModel,
    check_cameras,
    check_prior,
    linearize_metric,
    metric_cost,
    move_poses,
    project_metric,
)
from thesisrecon.numerics.observations import (
    Jacobians,
    Observations,
    SortedObservations,
    Weighting,
    sort_observations,
)
from thesisrecon.numerics.schur import (
    BundleLayout,
    BundleStep,
    BundleSystem,
    CameraPrior,
    build_layout,
)

# Below a relative gain of NEWTON_GAIN, MIN_CURVATURE of the curvature along a residual is kept if its loss
# bends: reweighting is safe far from the minimum, Newton's method is faster near it.
MIN_CURVATURE, NEWTON_GAIN = 0.3, 1e-3
CURVED_LOSSES = ("huber", "soft_l1", "cauchy")


@dataclass(frozen=True)
class BundleOptions:
    """Weighting and end of a metric bundle adjustment.

    Attributes
    ----------
    sigma_px : float, standard deviation of one image coordinate, the weight of the data against the priors
    loss : str, robust loss
    loss_px : float, turning point of the loss, px
    max_iterations : int, maximum number of linear solves
    fixed_views : ndarray (V,) of bool, optional, poses that must not move
    covariance : bool, whether to compute covariances (one more linear system)
    noise_floor_px : float, least noise assumed for the covariances, px
    threads : int, worker threads; the result does not depend on them
    """

    sigma_px: float = 1.0
    loss: LossName = "huber"
    loss_px: float = 1.0
    max_iterations: int = 20
    fixed_views: B8 | None = field(default=None, compare=False)
    covariance: bool = False
    noise_floor_px: float = 0.0
    threads: int = 1

    def __post_init__(self) -> None:
        loss_code(self.loss, self.loss_px)
        if not self.sigma_px > 0.0:
            raise ValueError(f"sigma_px must be positive; got {self.sigma_px}")
        if self.threads < 1 or self.max_iterations < 0:
            raise ValueError(
                f"a bundle needs a thread and iterations >= 0; got {self.threads}, {self.max_iterations}"
            )


@dataclass(frozen=True)
class MetricBundleResult:
    """Refined cameras and points with their uncertainty.

    Attributes
    ----------
    cameras : MetricCameras, refined cameras
    X : ndarray (N, 3), refined points
    residual_px : ndarray (K, 2), projection minus observation in the caller's order
    cost, initial_cost : float, 1/2 sum rho in units of the given sigma, priors included
    iterations : int, linear solves
    converged : bool, whether the loop converged
    intrinsics_covariance : ndarray (G, C, C), zero for entries that do not move, and without ``covariance``
    pose_covariance : ndarray (V, 6, 6) or None
        Of (rotation vector in rad, translation) of x -> exp(w) x + d in each camera frame, with respect to
        the centre of all poses (the inner gauge: no camera is taken as exact).
    sigma_px : float, standard deviation of one image coordinate, estimated from the residuals
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
    model: MetricModel
    values: F64


@dataclass(frozen=True)
class _MetricProblem:
    """Reprojection in units of sigma plus the priors.

    The columns of a view are its pose and the intrinsics that no other view shares; other unknowns are common
    columns.
    """

    layout: BundleLayout
    columns: IntrinsicColumns
    free_views: B8
    values: IntrinsicUnknowns
    weighting: Weighting
    jacobians: Jacobians

    def linearize(self, state: _State) -> BundleSystem:
        J, c = self.jacobians, self.columns

        def work(which: slice, obs: Observations) -> float:
            part = J.part(which.start, which.stop)
            return float(linearize_metric(state.model, obs, self.weighting, c.own, c.common, part))

        cost = sum(self.layout.over_observations(work)) + self.values.terms.cost(state.values)
        if c.pinned.any():
            J.A[:] = np.where(c.pinned[self.layout.observations.view_index][:, None], 0.0, J.A)
        return BundleSystem(cost, self.layout, J, self._prior(state))

    def _prior(self, state: _State) -> CameraPrior | None:
        terms, place = self.values.terms, self.columns.place
        if not len(terms.first):
            return None
        gradient = np.zeros(self.layout.size)
        gradient[place] = terms.gradient(state.values)
        return CameraPrior(
            self.columns.columns_of(terms.first),
            self.columns.columns_of(terms.second),
            terms.weight,
            gradient,
        )

    def retract(self, state: _State, step: BundleStep) -> _State:
        m, layout = state.model, self.layout
        n_own = layout.size - layout.border
        poses = np.zeros((len(m.t), POSE_DOF))
        poses[self.free_views] = step.cameras[:n_own].reshape(-1, layout.width)[
            layout.index.block[self.free_views], :POSE_DOF
        ]
        R, t = np.empty_like(m.R), np.empty_like(m.t)
        move_poses(m.R, m.t, poses, R, t)
        values = self.values.step(state.values, step.cameras[self.columns.place])
        X = m.X + step.points
        before, after = np.column_stack([m.R[:, 2], m.t[:, 2]]), np.column_stack([R[:, 2], t[:, 2]])
        layout.revert_cheirality_violations(before, after, m.X, X)
        return _State(MetricModel(R, t, self.values.write(m.intrinsics, values), m.group, X), values)

    def residual(self, state: _State) -> F64:
        """Return residuals (K, 2), px."""
        K = len(self.layout.observations.xy)
        residual, depth = np.empty((K, 2)), np.empty(K)

        def work(which: slice, obs: Observations) -> None:
            project_metric(state.model, obs, residual[which], depth[which])

        self.layout.over_observations(work)
        return residual

    def sigma(self, state: _State, residual: F64) -> float:
        """Return the noise of one coordinate, px, from the residuals at the minimum."""
        leverage = np.empty_like(residual)
        self.linearize(state)
        sum_leverages(self.layout.observations.start, self.jacobians.B, leverage)
        fixed_frame = not self.free_views[self.layout.observations.view_index].all()
        poses = POSE_DOF * int(self.free_views.sum())
        return robust_sigma(
            residual, leverage, poses + self.values.size - (0 if fixed_frame else SIMILARITY_DOF)
        )

    def cost(self, state: _State) -> float:
        def work(_: slice, obs: Observations) -> float:
            return float(metric_cost(state.model, obs, self.weighting))

        return sum(self.layout.over_observations(work)) + self.values.terms.cost(state.values)


def refine_metric_bundle(
    cameras: MetricCameras,
    X: F64,
    observations: Observations,
    *,
    free: B8,
    prior: IntrinsicsPrior | None = None,
    options: BundleOptions | None = None,
) -> MetricBundleResult:
    """Minimise reprojection errors and prior deviations over poses, points and intrinsics.

    The cost is sum rho(|x - project(X)|^2 / sigma^2) + sum ((q - mean) / std)^2 with the intrinsics q. Sparse
    Levenberg-Marquardt; the focal length is stepped as log f, the seven gauge freedoms are left to the
    damping, and the scene is centred and scaled inside. The cost never rises; singular systems end the
    iterations.

    Parameters
    ----------
    cameras : MetricCameras, start, and which intrinsics are shared
    X : ndarray (N, 3), points
    observations : Observations, observations in any order
    free : ndarray (C,) of bool, intrinsics that move
    prior : IntrinsicsPrior, optional, prior of the intrinsics, which may fix single values
    options : BundleOptions, optional, weighting and end

    Returns
    -------
    MetricBundleResult
        Refined cameras and points; views and points without observations are returned unchanged.

    Raises
    ------
    ValueError
        Wrong shapes, values that are not finite, or focal lengths that are not positive.
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
    origin, scale = scene_frame(X[seen_points])
    problem, values, table = _metric_problem(cameras, o, np.asarray(free, dtype=bool), prior, options)
    start = MetricModel(
        np.array(cameras.R, dtype=np.float64),
        scale * (cameras.t + cameras.R @ origin),
        problem.values.write(table, values),
        np.ascontiguousarray(cameras.group, dtype=np.int64),
        np.ascontiguousarray(scale * (X - origin)),
    )
    solution = _minimize(problem, _State(start, values), options)
    refined = _refined(cameras, problem.free_views, solution.state.model, origin, scale)
    residual = problem.residual(solution.state)
    sigma = problem.sigma(solution.state, residual)
    intrinsics_covariance, pose_covariance = np.zeros((*table.shape, table.shape[1])), None
    if options.covariance:
        noise = max(sigma or options.sigma_px, options.noise_floor_px)
        intrinsics_covariance, pose_covariance = _covariances(problem, solution.state, noise, scale)
    return MetricBundleResult(
        refined,
        np.where(seen_points[:, None], solution.state.model.X / scale + origin, X),
        o.unsort(residual),
        solution.cost,
        solution.initial_cost,
        solution.iterations,
        solution.converged,
        intrinsics_covariance,
        pose_covariance,
        sigma,
    )


def _refined(cameras: MetricCameras, moved: B8, end: MetricModel, origin: F64, scale: float) -> MetricCameras:
    """Return the final cameras in the caller's frame; cameras that did not move are unchanged."""
    return replace(
        cameras,
        R=np.where(moved[:, None, None], end.R, cameras.R),
        t=np.where(moved[:, None], end.t / scale - end.R @ origin, cameras.t),
        intrinsics=end.intrinsics,
    )


def _minimize(problem: _MetricProblem, state: _State, options: BundleOptions) -> Solution[_State]:
    """Minimise, by reweighting first and nearly Newton's steps at the end."""
    if options.loss not in CURVED_LOSSES:
        return run_levenberg_marquardt(problem, state, max_iterations=options.max_iterations)
    far = run_levenberg_marquardt(
        problem, state, max_iterations=options.max_iterations, tolerance=NEWTON_GAIN
    )
    left = options.max_iterations - far.iterations
    if left < 1:
        return far
    near = replace(problem, weighting=problem.weighting._replace(min_curvature=MIN_CURVATURE))
    end = run_levenberg_marquardt(near, far.state, max_iterations=left)
    return replace(end, initial_cost=far.initial_cost, iterations=far.iterations + end.iterations)


def _metric_problem(
    cameras: MetricCameras,
    o: SortedObservations,
    free: B8,
    prior: IntrinsicsPrior | None,
    options: BundleOptions,
) -> tuple[_MetricProblem, F64, F64]:
    """Return the problem, the start of its intrinsic unknowns, and the table of intrinsics."""
    group = np.asarray(cameras.group, dtype=np.int64)
    observed = np.bincount(o.view_index, minlength=len(group)) > 0
    used = np.bincount(group[observed], minlength=len(cameras.intrinsics)) > 0
    values, start, table = number_unknowns(cameras, used, free, prior)
    fixed = np.zeros(len(group), bool) if options.fixed_views is None else np.asarray(options.fixed_views)
    if fixed.shape != group.shape:
        raise ValueError(f"fixed_views is one flag for each of {len(group)} views; got shape {fixed.shape}")
    free_views = observed & ~fixed.astype(bool)
    columns = assign_columns(values, group, np.flatnonzero(free), observed, free_views)
    layout = build_layout(
        o,
        columns.block,
        width=POSE_DOF + len(columns.own),
        common=columns.border,
        border=columns.n_border,
        threads=options.threads,
    )
    weighting = Weighting(
        options.sigma_px, loss_code(options.loss, options.loss_px), options.loss_px / options.sigma_px
    )
    problem = _MetricProblem(layout, columns, free_views, values, weighting, layout.jacobians())
    return problem, start, table


def _covariances(problem: _MetricProblem, state: _State, sigma_px: float, scale: float) -> tuple[F64, F64]:
    """Return covariances of intrinsics (G, C, C) and poses (V, 6, 6), t in the caller's unit."""
    w = problem.weighting
    problem = replace(problem, weighting=Weighting(sigma_px, w.code, w.delta))
    reduced, _, _ = problem.linearize(state).reduce(1e-10)
    layout, m = problem.layout, state.model
    fixed_frame = not problem.free_views[layout.observations.view_index].all()
    block = np.where(problem.free_views, layout.index.block, -1)
    found = CovarianceInput(reduced, block, m.R, m.t, fixed_frame)
    number = problem.columns.columns_of(problem.values.number)
    return bundle_covariances(found, number, m.intrinsics[:, 0], scale)

"""Metric bundle adjustment: poses, points and intrinsics, shared or separate, with priors."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import require_range
from thesisrecon.geometry.homogeneous import scene_frame
from thesisrecon.optimize.bundle import covariance, intrinsic_unknowns, projection
from thesisrecon.optimize.bundle.covariance import similarity_motions
from thesisrecon.optimize.bundle.elimination import revert_crossing_points
from thesisrecon.optimize.bundle.intrinsic_unknowns import IntrinsicColumns, IntrinsicUnknowns
from thesisrecon.optimize.bundle.knowledge import BundleKnowledge, KnowledgeTerms, remaining_gauge
from thesisrecon.optimize.bundle.scatter import median_blocks
from thesisrecon.optimize.bundle.schur import EXACT, BundleLayout, BundleStep, BundleSystem, build_layout
from thesisrecon.optimize.least_squares import Descent, run_levenberg_marquardt
from thesisrecon.records import IntrinsicsPrior

MAX_ITERATIONS = 300
"""Bound of the linear solves of one adjustment: a long valley of the cost takes fifty to a hundred."""
MAX_SIGMAS_TO_MINIMUM = 0.1
"""Distance of the cameras from the minimum, in standard deviations, up to which it counts as reached."""

_Covariances = tuple[F64, F64 | None, F64 | None, F64 | None]
"""Covariances of intrinsics (G, C, C), poses (V, 6, 6) and points (N, 3, 3)."""


@dataclass(frozen=True)
class BundleOptions:
    """Options of :func:`refine_metric_bundle`: the noise ``sigma_px``, the width ``loss_px`` of Huber's loss.

    The adjustment also ends when the predicted gain of the cameras is below ``settled``: half the squared
    distance of all cameras from the minimum, in standard deviations. ``noise`` is measured if asked for, or
    for covariances, which are those of at least ``noise_floor_px``.
    """

    sigma_px: float = 1.0
    loss_px: float = 1.0
    max_iterations: int = MAX_ITERATIONS
    settled: float = 0.0
    noise: bool = False
    covariance: bool = False
    point_covariance: bool = False
    joint_covariance: bool = False
    noise_floor_px: float = 0.0
    threads: int = 1

    def __post_init__(self) -> None:
        require_range(self, sigma_px="(0, inf)", loss_px="(0, inf]")


@dataclass(frozen=True)
class MetricBundleResult:
    """Refined cameras and points with their uncertainty, in the inner gauge (no camera is exact).

    ``residual_px`` (K, 2) is projection minus observation in the caller's order, ``cost`` 1/2 sum rho in
    units of the given sigma, priors included, ``sigma_px`` NaN if not asked for. ``intrinsics_covariance``
    (G, C, C) is zero for entries that do not move, ``pose_covariance`` (V, 6, 6) that of (w, d) of x ->
    exp(w) x + d in each camera frame, ``point_covariance`` (N, 3, 3) infinite for points in fewer than two
    views. ``sigmas_to_minimum`` is the largest undamped step of any function of the cameras in its standard
    deviations, (g' H^-1 g)^(1/2).
    """

    cameras: projection.MetricCameras
    X: F64
    residual_px: F64
    cost: float
    intrinsics_covariance: F64
    pose_covariance: F64 | None
    sigma_px: float
    point_covariance: F64 | None
    sigmas_to_minimum: float
    joint_covariance: F64 | None = None  #: of all poses, then all intrinsics


@dataclass(frozen=True)
class _State:
    model: projection.MetricModel
    values: F64


@dataclass(frozen=True)
class _MetricProblem:
    """Reprojection in units of sigma plus the priors."""

    layout: BundleLayout
    columns: IntrinsicColumns
    moves: B8
    values: IntrinsicUnknowns
    weighting: projection.Weighting
    jacobians: projection.Jacobians
    information: tuple[I64, I64, F64]
    known: KnowledgeTerms | None = None
    #: (7, m) similarities of the world that are free; None: all
    gauge: F64 | None = None

    def linearize(self, state: _State) -> BundleSystem:
        J, c, known, w = self.jacobians, self.columns, self.known, self.weighting

        def work(rows: slice, obs: projection.Observations) -> float:
            part = projection.Jacobians(*(a[rows] for a in J))
            if known is None:
                return float(projection.linearize_metric(state.model, obs, w, c.own, c.common, part))
            projection.linearize_metric(
                state.model, obs, projection.Weighting(w.sigma, np.inf), c.own, c.common, part
            )
            return known.weigh(rows, state.model, obs, part, w)

        cost = self.layout.sum_over_observations(work) + self.values.terms.cost(state.values)
        if c.pinned.any():
            J.A[:] = np.where(c.pinned[self.layout.observations.seen.view_index][:, None], 0.0, J.A)
        gradient = np.zeros(self.layout.size)
        gradient[c.place] = self.values.terms.gradient(state.values)
        motions = None if self.layout.coarse is None else self._motions(state.model)
        return BundleSystem(cost, self.layout, J, (*self.information, gradient), motions)

    def _motions(self, model: projection.MetricModel) -> F64:
        """Motions of the views with their cluster: similarities, and a common change of own intrinsics."""
        C, poses = self.layout.width, similarity_motions(model.R[self.moves], model.t[self.moves])
        W = np.zeros((self.layout.views, C, C + 1))
        W[:, : projection.POSE_DOF, : projection.POSE_DOF + 1] = poses.reshape(
            -1, projection.POSE_DOF, projection.POSE_DOF + 1
        )
        W[:, projection.POSE_DOF :, projection.POSE_DOF + 1 :] = np.eye(C - projection.POSE_DOF)
        W[self.columns.pinned[self.moves]] = 0.0
        return W

    def noise(self, system: BundleSystem) -> Iterator[F64]:
        """Draw right sides (D,) of adjustments to noise, whose covariance is the information."""
        rng, terms, J = np.random.default_rng(0), self.values.terms, self.jacobians
        while True:
            J.residual[:] = rng.normal(size=J.residual.shape)
            rhs = system.eliminate(0.0)[0].rhs
            rhs[self.columns.place] += terms.A.T @ (
                np.sqrt(terms.weight) * rng.normal(size=len(terms.weight))
            )
            yield rhs

    def retract(self, state: _State, step: BundleStep) -> _State:
        m, layout = state.model, self.layout
        camera_step, point_step = step
        own = camera_step[: layout.size - layout.border].reshape(-1, layout.width)
        poses = np.zeros((len(m.t), projection.POSE_DOF))
        poses[self.moves] = own[:, : projection.POSE_DOF]
        R, t = np.empty_like(m.R), np.empty_like(m.t)
        projection.move_poses(m.R, m.t, poses, R, t)
        values = self.values.step(state.values, camera_step[self.columns.place])
        X = m.X + point_step
        before, after = np.column_stack([m.R[:, 2], m.t[:, 2]]), np.column_stack([R[:, 2], t[:, 2]])
        o = layout.observations
        revert_crossing_points(o.start, o.seen.view_index, before, after, m.X, X)
        return _State(
            projection.MetricModel(R, t, self.values.write(m.intrinsics, values), m.group, X), values
        )

    def cost(self, state: _State) -> float:
        def work(rows: slice, obs: projection.Observations) -> float:
            if self.known is None:
                return float(projection.metric_cost(state.model, obs, self.weighting))
            e = projection.project_metric(state.model, obs) / self.weighting.sigma
            e = self.known.residuals(rows, state.model, obs, e)
            return self.known.cost(rows, e, self.weighting.delta)

        return self.layout.sum_over_observations(work) + self.values.terms.cost(state.values)

    def sigma(self, state: _State, residual: F64) -> float:
        """Return the noise of one coordinate, px, from the residuals at the minimum."""
        self.linearize(state)
        o, known = self.layout.observations, self.known
        # What the unknowns of the points absorb, B V^-1 B'.
        own = covariance.orthonormal_columns(self.jacobians.B, o.seen.point_index, len(state.model.X))
        leverage = np.sum(own**2, axis=2)
        moved = int((~self.columns.pinned[:, 0])[self.moves].sum())
        free = covariance.SIMILARITY_DOF if self.gauge is None else self.gauge.shape[1]
        dof = projection.POSE_DOF * moved + self.values.size - free
        if known is not None:
            residual = known.residuals(slice(None), state.model, o.seen, residual)
            if known.fixed_points is not None:
                leverage[known.fixed_points[o.seen.point_index]] = 0.0
            residual, leverage = residual[known.observed], leverage[known.observed]
        return covariance.robust_sigma(residual, leverage, dof)


def refine_metric_bundle(
    cameras: projection.MetricCameras, X: F64, observations: projection.Observations, *, free: B8,
    prior: IntrinsicsPrior | None = None, options: BundleOptions | None = None, fixed: B8 | None = None,
    knowledge: BundleKnowledge | None = None,
) -> MetricBundleResult:  # fmt: skip
    """Minimise reprojection errors and prior deviations over poses, points and ``free`` intrinsics (6.7).

    The cost is sum rho(|x - project(X)|^2 / sigma^2) + sum ((q - mean) / std)^2 with the intrinsics q. Sparse
    Levenberg-Marquardt; the focal length is stepped as log f, the seven gauge freedoms are left to the
    damping, and the scene is centred and scaled inside. The cost never rises; ``fixed`` (V,) views, and views
    and points without observations, do not change. ``knowledge`` adds other losses, covariances of the
    observations, fixed poses and points, and priors of positions.
    """
    options, given = options or BundleOptions(), len(observations.xy)
    if knowledge is not None:
        observations = knowledge.observations(observations)
    o = projection.sort_observations(observations, len(cameras.R), len(X))
    seen_points = np.diff(o.start) > 0
    origin, scale = scene_frame(X[seen_points])
    moves = np.bincount(o.seen.view_index, minlength=len(cameras.R)) > 0
    if fixed is not None:
        moves &= ~fixed
    problem, values, table = _metric_problem(cameras, X, o, (moves, np.asarray(free, bool)), prior, options)
    start = projection.MetricModel(
        np.ascontiguousarray(cameras.R),
        scale * (cameras.t + cameras.R @ origin),
        problem.values.write(table, values),
        np.ascontiguousarray(cameras.group, dtype=np.int64),
        np.ascontiguousarray(scale * (X - origin)),
    )
    if knowledge is not None:
        centres, points = (p.in_frame(origin, scale) for p in (knowledge.centres, knowledge.points))
        known = replace(knowledge, centres=centres, points=points)
        pinned = problem.columns.pinned
        if known.fixed_poses is not None:
            pose = np.arange(pinned.shape[1]) < projection.POSE_DOF
            pinned = pinned | ((known.fixed_poses & moves)[:, None] & pose)
        problem = replace(
            problem,
            columns=replace(problem.columns, pinned=pinned),
            known=KnowledgeTerms.of(known, o, given),
            gauge=remaining_gauge(known, start.R, start.t, start.X),
        )
    found = _minimize(problem, _State(start, values), options)
    state, cost = found.state, found.cost
    end, moved = state.model, problem.moves & ~problem.columns.pinned[:, 0]
    refined = replace(
        cameras,
        R=np.where(moved[:, None, None], end.R, cameras.R),
        t=np.where(moved[:, None], end.t / scale - end.R @ origin, cameras.t),
        intrinsics=end.intrinsics,
    )
    residual = projection.project_metric(end, o.seen)
    sigma = problem.sigma(state, residual) if options.noise or options.covariance else np.nan
    covariances: _Covariances = (np.zeros((*table.shape, table.shape[1])), None, None, None)
    if options.covariance:
        noise = max(sigma or options.sigma_px, options.noise_floor_px)
        covariances = _covariances(problem, state, noise, scale, options)
    if knowledge is not None and knowledge.fixed_points is not None:
        seen_points &= ~knowledge.fixed_points
    return MetricBundleResult(
        refined, np.where(seen_points[:, None], end.X / scale + origin, X), o.unsort(residual)[:given], cost,
        *covariances[:2], sigma, covariances[2], float(np.sqrt(2.0 * max(found.remaining, 0.0))),
        covariances[3],
    )  # fmt: skip


def _minimize(problem: _MetricProblem, state: _State, options: BundleOptions) -> Descent[_State]:
    """Return the minimum: by reweighting, then by steps close to Newton's that keep 0.3 of the curvature."""
    most, settled = options.max_iterations, options.settled
    found = run_levenberg_marquardt(
        problem.linearize, problem.retract, problem.cost, state,
        max_iterations=most, tolerance=1e-3, min_camera_gain=settled,
    )  # fmt: skip
    if found.iterations < most:
        near = replace(problem, weighting=problem.weighting._replace(min_curvature=0.3))
        found = run_levenberg_marquardt(
            near.linearize, near.retract, near.cost, found.state,
            max_iterations=most - found.iterations, min_camera_gain=settled, initial_damping=found.damping,
        )  # fmt: skip
    return found


def _metric_problem(
    cameras: projection.MetricCameras, X: F64, o: projection.SortedObservations, unknown: tuple[B8, B8],
    prior: IntrinsicsPrior | None, options: BundleOptions,
) -> tuple[_MetricProblem, F64, F64]:  # fmt: skip
    """Return the problem, the start of its intrinsic unknowns, and the table of intrinsics."""
    # `unknown`: the views (V,) that move, and the intrinsics (C,) that do.
    group, (moves, free) = np.asarray(cameras.group, dtype=np.int64), unknown
    used = np.bincount(group[moves], minlength=len(cameras.intrinsics)) > 0
    values, start, table = intrinsic_unknowns.number_unknowns(cameras, used, free, prior)
    columns = intrinsic_unknowns.assign_columns(values, group, np.flatnonzero(free), moves)

    def clusters() -> I64:
        # Of views from near places that see near points.
        view, centre = o.seen.view_index, -np.einsum("vba,vb->va", cameras.R, cameras.t)
        sums = [np.bincount(view, x, len(centre)) for x in (np.ones(len(view)), *X[o.seen.point_index].T)]
        place = np.column_stack([centre, *(x / np.maximum(sums[0], 1.0) for x in sums[1:])])[moves]
        return median_blocks(place, np.ones(len(place), dtype=bool), most=256, least=8)

    layout = build_layout(
        o, columns.block, width=projection.POSE_DOF + len(columns.own), common=columns.border,
        border=columns.n_border, threads=options.threads,
        clusters=None if options.point_covariance else clusters,
    )  # fmt: skip
    weighting = projection.Weighting(options.sigma_px, options.loss_px / options.sigma_px)
    Q = values.terms.information().tocoo()
    information = columns.place[Q.row], columns.place[Q.col], Q.data
    buffers = layout.jacobians()
    return _MetricProblem(layout, columns, moves, values, weighting, buffers, information), start, table


def _covariances(
    problem: _MetricProblem, state: _State, sigma_px: float, scale: float, options: BundleOptions
) -> _Covariances:
    """Return the covariances, lengths in the caller's unit."""
    problem = replace(problem, weighting=projection.Weighting(sigma_px, problem.weighting.delta))
    system = problem.linearize(state)
    reduced, sums, _ = system.reduce(1e-10)
    m, seen, layout = state.model, problem.moves, problem.layout
    number = np.append(problem.columns.place, -1)[problem.values.number]
    own = np.arange(int(seen.sum()))
    row, column = (layout.row, layout.column) if options.point_covariance else (own, own)
    if (solve := None if layout.coarse is None else system.iterative_solver(1e-10, reduced, sums)) is None:
        blocks = covariance.camera_blocks(reduced, m.R[seen], m.t[seen], row, column, problem.gauge)
    else:
        N = covariance.gauge_basis(layout.size, layout.width, m.R[seen], m.t[seen], problem.gauge)
        exact = partial(solve, forcing=EXACT)
        blocks = covariance.sampled_blocks(exact, problem.noise(system), N, layout.width, len(own))
    poses = np.zeros((len(m.t), projection.POSE_DOF, projection.POSE_DOF))
    intrinsics, poses[seen] = covariance.bundle_covariances(
        blocks[row == column], layout.width, number, m.intrinsics[:, 0], scale
    )
    pinned, joint = problem.columns.pinned[:, 0], None
    poses[pinned] = 0.0
    if options.joint_covariance and len(own):
        pairs = np.triu_indices(len(own))
        blocks_of_pairs = covariance.camera_blocks(reduced, m.R[seen], m.t[seen], *pairs, problem.gauge)
        views = np.where(seen & ~pinned, np.cumsum(seen) - 1, -1)
        sizes = m.intrinsics[:, 0], scale
        joint = covariance.joint_covariance(blocks_of_pairs, layout.width, number, views, *sizes)
    if not options.point_covariance:
        return intrinsics, poses, None, joint
    of_points = covariance.point_covariances(blocks, layout.index, problem.jacobians, sums.inverse)
    if problem.known is not None and problem.known.fixed_points is not None:
        of_points[problem.known.fixed_points] = 0.0
    return intrinsics, poses, of_points / scale**2, joint

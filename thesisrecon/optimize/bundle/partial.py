"""Structure-only and motion-only bundle adjustment: points, one projective camera or one calibrated pose.

Also triangulation by any method of section 6.3, among them the least reprojection error.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from thesisrecon._numba import copy_to, empty, kernel
from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry import homogeneous
from thesisrecon.geometry.polynomial_triangulation import triangulate_polynomial
from thesisrecon.geometry.small_matrices import solve_damped
from thesisrecon.geometry.triangulation import PASSES, sort_by_point, triangulate_linear, triangulate_midpoint
from thesisrecon.optimize.bundle.projection import (
    Jacobians,
    MetricModel,
    Observations,
    SortedObservations,
    Weighting,
    away_from_zero,
    linearize_metric,
    loss_value,
    loss_weight,
    metric_cost,
    move_poses,
    project_metric,
    sort_observations,
)
from thesisrecon.optimize.bundle.projective import (
    UnitState,
    linearize_projective,
    projective_cost,
    tangent_reflectors,
    tangent_step,
)
from thesisrecon.optimize.least_squares import DenseSystem, invert_information, run_levenberg_marquardt

_BLOCK = 8192  # Points whose derivatives are in memory at a time
TriangulationMethod = Literal["polynomial", "linear", "midpoint", "iterated", "optimal"]


class _PointOptions(NamedTuple):
    """The refinement ends after ``patience`` relative gains below ``tolerance``.

    ``delta`` is the width of Huber's loss. With ``keep_cheirality`` steps that change the number of cameras
    that a point lies behind are rejected.
    """

    delta: float
    iterations: int
    tolerance: float
    patience: int
    keep_cheirality: bool


@kernel
def _point_cost(P: F64, x: F64, view_index: I64, xy: F64, options: _PointOptions) -> tuple[float, int]:
    """Return 1/2 sum rho of one point's observations and the number of cameras it lies behind."""
    cost, behind = 0.0, 0
    for k in range(len(xy)):
        p = P[view_index[k]]
        u0 = p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]
        u1 = p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]
        u2 = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3]
        w = away_from_zero(u2)
        if u2 < 0.0:
            behind += 1
        r0, r1 = u0 / w - xy[k, 0], u1 / w - xy[k, 1]
        cost += loss_value(r0 * r0 + r1 * r1, options.delta)
    return 0.5 * cost, behind


@kernel
def _linearize_point(
    P: F64, x: F64, tangent: tuple[F64, float, F64], view_index: I64, xy: F64, options: _PointOptions,
    H: F64, g: F64,
) -> None:  # fmt: skip
    """Fill the lower triangle of J'J (3, 3) and J'r (3,) of a unit point in its ``tangent`` space."""
    # `tangent`: Householder vector, its factor, and scratch memory (2, 4).
    v, beta, J = tangent
    H[:] = 0.0
    g[:] = 0.0
    for k in range(len(xy)):
        p = P[view_index[k]]
        u0 = p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]
        u1 = p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]
        w = away_from_zero(p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3])
        a, b = u0 / w, u1 / w
        r0, r1 = a - xy[k, 0], b - xy[k, 1]
        weight = loss_weight(r0 * r0 + r1 * r1, options.delta)
        d0 = d1 = 0.0
        for c in range(4):
            J[0, c] = (p[0, c] - a * p[2, c]) / w
            J[1, c] = (p[1, c] - b * p[2, c]) / w
            d0 += J[0, c] * v[c]
            d1 += J[1, c] * v[c]
        for c in range(4):
            J[0, c] -= beta * d0 * v[c]
            J[1, c] -= beta * d1 * v[c]
        for m in range(3):
            g[m] += weight * (J[0, m + 1] * r0 + J[1, m + 1] * r1)
            for n in range(m + 1):
                H[m, n] += weight * (J[0, m + 1] * J[0, n + 1] + J[1, m + 1] * J[1, n + 1])


@kernel
def _refine_each_point(P: F64, X: F64, start: I64, view_index: I64, xy: F64, options: _PointOptions) -> None:
    """Refine every unit point of X (N, 4) in place by Levenberg-Marquardt in its tangent space."""
    H, g, step = empty((3, 3)), empty(3), empty((1, 3))
    v, beta, moved, J = empty((1, 4)), empty(1), empty((1, 4)), empty((2, 4))
    for j in range(len(start) - 1):
        first, last = start[j], start[j + 1]
        if last - first < 2:
            continue
        x = X[j : j + 1]
        if x[0, 0] == 0.0 and x[0, 1] == 0.0 and x[0, 2] == 0.0 and x[0, 3] == 0.0:
            continue
        view, seen = view_index[first:last], xy[first:last]
        cost, behind = _point_cost(P, x[0], view, seen, options)
        damping, small_gains, accepted = 1e-4, 0, True
        for _ in range(options.iterations):
            if accepted:
                tangent_reflectors(x, v, beta)
                _linearize_point(P, x[0], (v[0], beta[0], J), view, seen, options, H, g)
            accepted, promised = solve_damped(H, g, damping, step[0]), np.inf
            if accepted:
                promised = -(g[0] * step[0, 0] + g[1] * step[0, 1] + g[2] * step[0, 2])
                tangent_step(x, v, beta, step, moved)
                candidate, flipped = _point_cost(P, moved[0], view, seen, options)
                accepted = candidate < cost and (flipped == behind or not options.keep_cheirality)
            if accepted:
                copy_to(x[0], moved[0])
                gain = cost - candidate
                cost, behind = candidate, flipped
                damping = max(damping * 0.2, 1e-9)
                small_gains = small_gains + 1 if gain <= options.tolerance * cost else 0
                if small_gains == options.patience:
                    break
            else:
                damping *= 10.0
                # At the minimum rounding decides whether a step is accepted; shorter steps gain nothing.
                if damping > 1e12 or promised <= 1e-15 * cost:
                    break


@dataclass(frozen=True)
class PoseRefinement:
    """Refined pose and row of intrinsics, their covariance for noise of 1 px, and the residuals (M, 2).

    The covariance (6 + F, 6 + F) is of rotation vector (rad) and translation of x -> exp(w) x + d in the
    camera frame, and of the F free intrinsics, the focal length as log f.
    """

    R: F64
    t: F64
    intrinsics: F64
    covariance: F64
    residual_px: F64


def refine_points(
    P: F64, X: F64, view_index: I64, point_index: I64, xy: F64, *, loss_px: float = 1.0, iterations: int = 5
) -> F64:
    """Refine each point (N, 4) with the cameras fixed: least sum of rho(|x - P X|^2), Huber's loss.

    The cost of no point rises and no point crosses the focal plane of a view that observes it. Norms and
    signs stay, and points that are zero, not finite or observed less than twice.
    """
    o, used = _usable_points(P, X, Observations(view_index, point_index, xy))
    if not used.any():
        return X
    options = _PointOptions(loss_px, iterations, 1e-9, 1, True)
    return _refine_in_frame(P, X, o, used, homogeneous.whitened_frame(X[used]), options)


def minimize_reprojection(P: F64, X: F64, view_index: I64, point_index: I64, xy: F64) -> F64:
    """Move each point to a minimum of its squared reprojection errors, in a frame of orthonormal cameras."""
    o, used = _usable_points(P, X, Observations(view_index, point_index, xy))
    if not used.any():
        return X
    N = homogeneous.centring_transform(X[used])
    cameras = homogeneous.unit_norm(homogeneous.pixel_conditioning(o.seen.xy) @ P @ np.linalg.inv(N))
    S = np.asarray(np.linalg.qr(cameras.reshape(-1, 4))[1])
    # Cameras with one centre leave a direction of space undetermined.
    if len(S) < 4 or not np.abs(np.diag(S)).min() > 1e-13 * np.abs(S).max():
        S = np.eye(4)
    # The median point takes four or five iterations.
    options = _PointOptions(np.inf, 200, 1e-14, 2, False)
    return _refine_in_frame(P, X, o, used, homogeneous.SpaceFrame(N, S), options)


def triangulate_points(P: F64, xy: F64, *, method: TriangulationMethod | None = None) -> F64:
    """Triangulate points by a method of section 6.3; see :func:`thesisrecon.triangulate`."""
    method = method or ("polynomial" if len(P) == 2 else "optimal")
    if method == "polynomial":
        return triangulate_polynomial(P, xy)
    listed = sort_by_point(xy)
    if method == "midpoint":
        return triangulate_midpoint(P, listed)
    if method != "optimal":
        return triangulate_linear(P, listed, PASSES if method == "iterated" else 0)
    start, view, pixels = listed
    point = np.repeat(np.arange(len(start) - 1), np.diff(start))
    X = minimize_reprojection(P, triangulate_linear(P, listed, 0), view, point, pixels)
    sizes = np.linalg.norm(X, axis=1, keepdims=True)
    return np.asarray(X / np.where(sizes > 0.0, sizes, 1.0))


def _usable_points(P: F64, X: F64, observations: Observations) -> tuple[SortedObservations, B8]:
    """Return sorted observations, and the finite non-zero points with two of them or more."""
    o, norms = sort_observations(observations, len(P), len(X)), np.linalg.norm(X, axis=1)
    return o, np.isfinite(norms) & (norms > 0.0) & (np.diff(o.start) >= 2)


def _refine_in_frame(
    P: F64, X: F64, o: SortedObservations, used: B8, frame: homogeneous.SpaceFrame, options: _PointOptions
) -> F64:
    """Refine the ``used`` points in conditioned pixels and a frame of space; norms and signs are kept."""
    norms, T = np.linalg.norm(X, axis=1), homogeneous.pixel_conditioning(o.seen.xy)
    # The scale of a camera has no effect on its projections, but must not push depths below rounding.
    cameras = np.ascontiguousarray(homogeneous.unit_norm(frame.cameras(T @ P)))
    moved = frame.points(np.where(used[:, None], X, 0.0))
    moved[used] /= np.linalg.norm(moved[used], axis=1, keepdims=True)
    xy = o.seen.xy * T[0, 0] + T[:2, 2]
    options = options._replace(delta=options.delta * float(T[0, 0]))
    _refine_each_point(cameras, moved, o.start, o.seen.view_index, xy, options)
    back = frame.points_back(moved)
    lengths = np.linalg.norm(back, axis=1, keepdims=True)
    back *= norms[:, None] / np.where(lengths > 0.0, lengths, 1.0)
    return np.where(used[:, None] & np.isfinite(back).all(axis=1, keepdims=True), back, X)


def _one_view_observations(xy: F64) -> Observations:
    """Return observations of every point by the only view."""
    return Observations(np.zeros(len(xy), dtype=np.int64), np.arange(len(xy)), np.ascontiguousarray(xy))


def _dense_system(
    X: F64, xy: F64, columns: int, linearize: Callable[[F64, Observations, Jacobians], float]
) -> DenseSystem:
    """Return the normal equations of the columns of one camera, added up over blocks of points."""
    cost, hessian, gradient = 0.0, np.zeros((columns, columns)), np.zeros(columns)
    for k in range(0, len(X), _BLOCK):
        block = X[k : k + _BLOCK]
        J = Jacobians.empty(len(block), columns, 0)
        cost += float(linearize(block, _one_view_observations(xy[k : k + _BLOCK]), J))
        A, r = J.A.reshape(-1, columns), J.residual.ravel()
        hessian += A.T @ A
        gradient += A.T @ r
    return DenseSystem(cost, hessian, gradient)


def refine_camera(P: F64, X: F64, xy: F64, *, loss_px: float = 1.0, iterations: int = 20) -> tuple[F64, F64]:
    """Refine one projective camera by fixed points (6.4); return P and the covariance (12, 12) for 1 px.

    P keeps the norm and sign of its start. The covariance of its row-major entries has no part along P, and
    huge variances in undetermined directions.
    """
    size = float(np.linalg.norm(P))
    T, frame = homogeneous.pixel_conditioning(xy), homogeneous.whitened_frame(X)
    points = frame.points(X)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    start, scale = frame.cameras(T @ P).reshape(1, 12), float(T[0, 0])
    obs, weighting = _one_view_observations(xy * scale + T[:2, 2]), Weighting(1.0, loss_px * scale)

    def linearize(state: F64) -> DenseSystem:
        return _dense_system(
            points, obs.xy, 11,
            lambda X, some, J: linearize_projective(UnitState.at(state, X), some, weighting, J),
        )  # fmt: skip

    def retract(state: F64, step: F64) -> F64:
        s, moved = UnitState.at(state, points), np.empty_like(state)
        tangent_step(state, s.vP, s.bP, step[None], moved)
        return moved

    end = run_levenberg_marquardt(
        linearize, retract, lambda s: float(projective_cost(UnitState.at(s, points), obs, weighting)),
        start / float(np.linalg.norm(start)), max_iterations=iterations,
    ).state  # fmt: skip
    # Row-major entries: vec(T^-1 P M) = (T^-1 kron M') vec(P).
    back = np.kron(np.linalg.inv(T), (frame.S @ frame.N).T)
    raw = frame.cameras_back(np.linalg.inv(T) @ end.reshape(3, 4)).ravel()
    back *= size / np.linalg.norm(raw)
    raw *= size / np.linalg.norm(raw)
    # The norm is fixed, so the part of an error along P is only a change of scale.
    back -= np.outer(raw, raw @ back) / size**2
    v, beta = np.empty_like(end), np.empty(1)
    tangent_reflectors(end, v, beta)
    basis = (np.eye(12) - beta[0] * np.outer(v[0], v[0]))[:, 1:]
    of_unit_camera = basis @ invert_information(linearize(end).hessian) @ basis.T
    covariance = back @ of_unit_camera @ back.T * scale**2
    return raw.reshape(3, 4), covariance


def refine_pose(
    R: F64, t: F64, intrinsics: F64, X: F64, xy: F64, *, free: B8, loss_px: float = 1.0, iterations: int = 20
) -> PoseRefinement:
    """Refine a pose and its ``free`` intrinsics, a row of ``MetricCameras``, with the points fixed."""
    columns = np.flatnonzero(free)
    R = np.ascontiguousarray(R)
    # With centred and scaled points the pose unknowns are well conditioned.
    origin = X.mean(axis=0)
    size = float(np.linalg.norm(X - origin, axis=1).mean())
    scale = 1.0 / size if size > 0.0 else 1.0
    obs, weighting = _one_view_observations(xy), Weighting(1.0, loss_px)
    moved, points = scale * (t + R @ origin), np.ascontiguousarray(scale * (X - origin))
    start = MetricModel(R[None], moved[None], intrinsics[None], np.zeros(1, dtype=np.int64), points)

    def linearize(state: MetricModel) -> DenseSystem:
        return _dense_system(
            points, obs.xy, 6 + len(columns),
            lambda X, some, J: linearize_metric(
                state._replace(X=X), some, weighting, columns, columns[:0], J
            ),
        )  # fmt: skip

    def retract(state: MetricModel, step: F64) -> MetricModel:
        R, t = np.empty_like(state.R), np.empty_like(state.t)
        move_poses(state.R, state.t, step[None, :6], R, t)
        moves = np.zeros(state.intrinsics.shape[1])
        moves[columns] = step[6:]
        intrinsics = state.intrinsics + moves
        intrinsics[0, 0] = state.intrinsics[0, 0] * np.exp(np.clip(moves[0], -3.0, 3.0))
        return state._replace(R=R, t=t, intrinsics=intrinsics)

    end = run_levenberg_marquardt(
        linearize, retract, lambda state: float(metric_cost(state, obs, weighting)),
        start, max_iterations=iterations,
    ).state  # fmt: skip
    units = np.ones(6 + len(columns))
    units[3:6] = 1.0 / scale
    covariance = invert_information(linearize(end).hessian) * units * units[:, None]
    t = end.t[0] / scale - end.R[0] @ origin
    return PoseRefinement(end.R[0], t, end.intrinsics[0], covariance, project_metric(end, obs))

"""Projective bundle adjustment (section 6.7): 11 unknowns per camera, 3 per point, no gauge fixed.

Unit cameras and points move in their tangent spaces, spanned by Householder reflections.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.homogeneous import pixel_conditioning, require_shapes, whitening_transform
from thesisrecon.numerics.levenberg_marquardt import run_levenberg_marquardt
from thesisrecon.numerics.losses import loss_code, loss_value, loss_weight
from thesisrecon.numerics.observations import (
    Jacobians,
    Observations,
    SortedObservations,
    Weighting,
    sort_observations,
)
from thesisrecon.numerics.schur import BundleLayout, BundleStep, BundleSystem, build_layout
from thesisrecon.numerics.small_solvers import away_from_zero

VIEW_DOF = 11


class UnitState(NamedTuple):
    """Unit cameras ``P`` (V, 12) and points ``X`` (N, 4) with Householder vectors and factors."""

    P: F64
    X: F64
    vP: F64
    bP: F64
    vX: F64
    bX: F64

    @classmethod
    def at(cls, P: F64, X: F64) -> UnitState:
        """Return the state of unit cameras (V, 12) and points (N, 4)."""
        vP, vX, bP, bX = np.empty_like(P), np.empty_like(X), np.empty(len(P)), np.empty(len(X))
        tangent_reflectors(P, vP, bP)
        tangent_reflectors(X, vX, bX)
        return cls(P, X, vP, bP, vX, bX)


@njit(cache=True, nogil=True)
def tangent_reflectors(p: F64, v: F64, beta: F64) -> None:
    """Compute the Householder reflections that take unit rows to -+e0; columns 1.. span the tangent spaces.

    Parameters
    ----------
    p : ndarray (n, d), unit rows
    v : ndarray (n, d), output: Householder vectors
    beta : ndarray (n,), output: Householder factors
    """
    for i in range(p.shape[0]):
        for c in range(p.shape[1]):
            v[i, c] = p[i, c]
        v[i, 0] += 1.0 if p[i, 0] >= 0.0 else -1.0
        norm = 0.0
        for c in range(p.shape[1]):
            norm += v[i, c] * v[i, c]
        beta[i] = 2.0 / norm if norm > 0.0 else 0.0


@njit(cache=True, nogil=True)
def tangent_step(p: F64, v: F64, beta: F64, step: F64, out: F64) -> None:
    """Move unit rows along their tangent spaces: normalise(p + H[:, 1:] step); signs are kept.

    Parameters
    ----------
    p : ndarray (n, d), unit rows
    v : ndarray (n, d), Householder vectors
    beta : ndarray (n,), Householder factors
    step : ndarray (n, d - 1), steps
    out : ndarray (n, d), output: moved unit rows
    """
    d = p.shape[1]
    for i in range(p.shape[0]):
        along = 0.0
        for c in range(1, d):
            along += v[i, c] * step[i, c - 1]
        norm = 0.0
        for c in range(d):
            moved = p[i, c] - beta[i] * along * v[i, c]
            if c > 0:
                moved += step[i, c - 1]
            out[i, c] = moved
            norm += moved * moved
        norm = np.sqrt(norm)
        for c in range(d):
            out[i, c] /= norm if norm > 0.0 else 1.0


@njit(cache=True, nogil=True)
def project_projective(P: F64, X: F64, obs: Observations, residual: F64, depth: F64) -> None:
    """Compute residuals, projection minus observation.

    Parameters
    ----------
    P : ndarray (V, 3, 4), cameras
    X : ndarray (N, 4), homogeneous points
    obs : Observations, observations
    residual : ndarray (K, 2), output
    depth : ndarray (K,), output: third row of P X
    """
    for k in range(len(obs.xy)):
        p, x = P[obs.view_index[k]], X[obs.point_index[k]]
        z0 = p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]
        z1 = p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]
        z2 = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3]
        w = away_from_zero(z2)
        depth[k] = z2
        residual[k, 0] = z0 / w - obs.xy[k, 0]
        residual[k, 1] = z1 / w - obs.xy[k, 1]


@njit(cache=True, nogil=True)
def linearize_projective(state: UnitState, obs: Observations, weighting: Weighting, J: Jacobians) -> float:
    """Compute weighted residuals and their Jacobians in the tangent spaces.

    With u = P X: d pi = (1 / u2) [[1, 0, -x], [0, 1, -y]] du (methods 6.7).

    Parameters
    ----------
    state : UnitState, cameras and points
    obs : Observations, observations
    weighting : Weighting, loss; ``sigma`` is not used
    J : Jacobians, output: A (K, 2, 11), B (K, 2, 3)

    Returns
    -------
    float, 1/2 sum rho
    """
    cost = 0.0
    for k in range(len(obs.xy)):
        i, j = obs.view_index[k], obs.point_index[k]
        p, x, v, y = state.P[i], state.X[j], state.vP[i], state.vX[j]
        bP, bX = state.bP[i], state.bX[j]
        A, B = J.A[k], J.B[k]
        u0 = p[0] * x[0] + p[1] * x[1] + p[2] * x[2] + p[3] * x[3]
        u1 = p[4] * x[0] + p[5] * x[1] + p[6] * x[2] + p[7] * x[3]
        w = away_from_zero(p[8] * x[0] + p[9] * x[1] + p[10] * x[2] + p[11] * x[3])
        a, b = u0 / w, u1 / w
        r0, r1 = a - obs.xy[k, 0], b - obs.xy[k, 1]
        s = r0 * r0 + r1 * r1
        cost += loss_value(weighting.code, s, weighting.delta)
        root = np.sqrt(loss_weight(weighting.code, s, weighting.delta))
        J.residual[k, 0], J.residual[k, 1] = root * r0, root * r1
        f = root / w
        e0 = x[0] * v[0] + x[1] * v[1] + x[2] * v[2] + x[3] * v[3]
        e1 = x[0] * v[4] + x[1] * v[5] + x[2] * v[6] + x[3] * v[7]
        e2 = x[0] * v[8] + x[1] * v[9] + x[2] * v[10] + x[3] * v[11]
        c0, c1 = bP * f * (e0 - a * e2), bP * f * (e1 - b * e2)
        for c in range(1, 12):
            A[0, c - 1] = -c0 * v[c]
            A[1, c - 1] = -c1 * v[c]
        for c in range(4):
            fx = f * x[c]
            if c > 0:
                A[0, c - 1] += fx
            A[1, 3 + c] += fx
            A[0, 7 + c] -= a * fx
            A[1, 7 + c] -= b * fx
        d0 = d1 = 0.0
        for c in range(4):
            d0 += f * (p[c] - a * p[8 + c]) * y[c]
            d1 += f * (p[4 + c] - b * p[8 + c]) * y[c]
        for c in range(1, 4):
            B[0, c - 1] = f * (p[c] - a * p[8 + c]) - bX * d0 * y[c]
            B[1, c - 1] = f * (p[4 + c] - b * p[8 + c]) - bX * d1 * y[c]
    return 0.5 * cost


@njit(cache=True, nogil=True)
def projective_cost(state: UnitState, obs: Observations, weighting: Weighting) -> float:
    """Return 1/2 sum rho of the residuals.

    Parameters
    ----------
    state : UnitState, cameras and points
    obs : Observations, observations
    weighting : Weighting, loss; ``sigma`` is not used

    Returns
    -------
    float, cost
    """
    cost = 0.0
    for k in range(len(obs.xy)):
        p, x = state.P[obs.view_index[k]], state.X[obs.point_index[k]]
        u0 = p[0] * x[0] + p[1] * x[1] + p[2] * x[2] + p[3] * x[3]
        u1 = p[4] * x[0] + p[5] * x[1] + p[6] * x[2] + p[7] * x[3]
        w = away_from_zero(p[8] * x[0] + p[9] * x[1] + p[10] * x[2] + p[11] * x[3])
        r0, r1 = u0 / w - obs.xy[k, 0], u1 / w - obs.xy[k, 1]
        cost += loss_value(weighting.code, r0 * r0 + r1 * r1, weighting.delta)
    return 0.5 * cost


@dataclass(frozen=True)
class ProjectiveBundleResult:
    """Result of a projective bundle adjustment.

    Attributes
    ----------
    P : ndarray (V, 3, 4), cameras in the caller's frame, norms and signs
    X : ndarray (N, 4), points in the caller's frame, norms and signs
    residual_px : ndarray (K, 2), projection minus observation in the caller's order
    cost, initial_cost : float, 1/2 sum rho, px^2
    iterations : int, linear solves
    converged : bool, whether the loop converged
    """

    P: F64
    X: F64
    residual_px: F64
    cost: float
    initial_cost: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _ProjectiveProblem:
    """Reprojection in conditioned pixels; states are unit vectors, steps lie in their tangent spaces."""

    layout: BundleLayout
    weighting: Weighting
    jacobians: Jacobians

    def linearize(self, state: UnitState) -> BundleSystem:
        def work(which: slice, obs: Observations) -> float:
            part = self.jacobians.part(which.start, which.stop)
            return float(linearize_projective(state, obs, self.weighting, part))

        cost = sum(self.layout.over_observations(work))
        return BundleSystem(cost, self.layout, self.jacobians)

    def retract(self, state: UnitState, step: BundleStep) -> UnitState:
        block = self.layout.index.block
        views = np.zeros((len(state.P), VIEW_DOF))
        views[block >= 0] = step.cameras.reshape(-1, VIEW_DOF)
        P, X = np.empty_like(state.P), np.empty_like(state.X)
        tangent_step(state.P, state.vP, state.bP, views, P)
        tangent_step(state.X, state.vX, state.bX, step.points, X)
        self.layout.revert_cheirality_violations(state.P[:, 8:], P[:, 8:], state.X, X)
        return UnitState.at(P, X)

    def residual(self, state: UnitState) -> F64:
        K = len(self.layout.observations.xy)
        residual, depth = np.empty((K, 2)), np.empty(K)

        def work(which: slice, obs: Observations) -> None:
            project_projective(state.P.reshape(-1, 3, 4), state.X, obs, residual[which], depth[which])

        self.layout.over_observations(work)
        return residual

    def cost(self, state: UnitState) -> float:
        def work(_: slice, obs: Observations) -> float:
            return float(projective_cost(state, obs, self.weighting))

        return sum(self.layout.over_observations(work))


def refine_projective_bundle(
    P: F64,
    X: F64,
    view_index: I64,
    point_index: I64,
    xy: F64,
    *,
    loss_px: float = 1.0,
    max_iterations: int = 10,
    fixed_views: B8 | None = None,
) -> ProjectiveBundleResult:
    """Minimise sum rho(|x - P X|^2) over all cameras and points with Huber's loss.

    Sparse Levenberg-Marquardt in conditioned pixels and whitened space (sum XX' = I, |P| = |X| = 1); the
    damping handles the 15 gauge freedoms (methods 6.7). The cost never rises; singular systems end the
    iterations.

    Parameters
    ----------
    P : ndarray (V, 3, 4), cameras of any scale and sign, which are kept
    X : ndarray (N, 4), homogeneous points of any scale and sign, which are kept
    view_index, point_index : ndarray (K,) of int
        View and point of each observation, in any order; sorted by point is fastest.
    xy : ndarray (K, 2), pixels
    loss_px : float, turning point of Huber's loss, px
    max_iterations : int, maximum number of linear solves
    fixed_views : ndarray (V,) of bool, optional, cameras that must not move

    Returns
    -------
    ProjectiveBundleResult
        Refined cameras and points; views and points without observations are returned unchanged.

    Raises
    ------
    ValueError
        Wrong shapes, values that are not finite, or an observed camera or point that is all zero.
    """
    P, X = np.array(P, dtype=np.float64), np.array(X, dtype=np.float64)
    require_shapes("refine_projective_bundle", P=(P, ("V", 3, 4)), X=(X, ("N", 4)))
    observations = sort_observations(view_index, point_index, xy, len(P), len(X))
    observed = np.bincount(observations.view_index, minlength=len(P)) > 0
    seen_points = np.diff(observations.start) > 0
    free = observed & ~(np.zeros(len(P), bool) if fixed_views is None else np.asarray(fixed_views, bool))

    T, M = pixel_conditioning(observations.xy), whitening_transform(X[seen_points])
    conditioned, P_norms = _unit_rows((T @ P @ np.linalg.inv(M)).reshape(-1, 12), observed, "camera")
    points, X_norms = _unit_rows(X @ M.T, seen_points, "point")
    problem = _projective_problem(observations, T, free, loss_px)
    start = UnitState.at(conditioned, points)
    solution = run_levenberg_marquardt(problem, start, max_iterations=max_iterations)

    scale = T[0, 0]
    P_back = np.linalg.inv(T) @ (solution.state.P * P_norms[:, None]).reshape(-1, 3, 4) @ M
    X_back = (solution.state.X * X_norms[:, None]) @ np.linalg.inv(M).T
    residual = observations.unsort(problem.residual(solution.state)) / scale
    return ProjectiveBundleResult(
        np.where(free[:, None, None], _with_norms(P_back, P, axis=(1, 2)), P),
        np.where(seen_points[:, None], _with_norms(X_back, X, axis=1), X),
        residual,
        solution.cost / scale**2,
        solution.initial_cost / scale**2,
        solution.iterations,
        solution.converged,
    )


def _projective_problem(
    observations: SortedObservations, T: F64, free: B8, loss_px: float
) -> _ProjectiveProblem:
    """Set up the problem in conditioned pixels."""
    conditioned = replace(observations, xy=observations.xy * T[0, 0] + T[:2, 2])
    block = np.where(free, np.cumsum(free) - 1, -1)
    none = np.zeros((len(free), 0), dtype=np.int64)
    layout = build_layout(conditioned, block, width=VIEW_DOF, common=none, border=0)
    weighting = Weighting(1.0, loss_code("huber", loss_px), loss_px * float(T[0, 0]))
    return _ProjectiveProblem(layout, weighting, layout.jacobians())


def _unit_rows(rows: F64, used: B8, what: str) -> tuple[F64, F64]:
    """Return rows at unit norm and their norms; unused rows may be zero."""
    norms = np.linalg.norm(rows, axis=1)
    if not (np.isfinite(norms[used]).all() and (norms[used] > 0.0).all()):
        raise ValueError(f"every observed {what} must be finite and not zero")
    norms = np.where(used, norms, 1.0)
    return np.ascontiguousarray(np.where(used[:, None], rows / norms[:, None], 0.0)), norms


def _with_norms(moved: NDArray[Any], original: F64, *, axis: int | tuple[int, ...]) -> F64:
    """Scale ``moved`` to the norms of ``original``: homogeneous scales are the caller's."""
    wanted = np.linalg.norm(original, axis=axis, keepdims=True)
    have = np.linalg.norm(moved, axis=axis, keepdims=True)
    return np.asarray(moved * wanted / np.where(have > 0.0, have, 1.0))

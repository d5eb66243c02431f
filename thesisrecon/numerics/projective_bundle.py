"""Projective bundle adjustment (section 6.7): 11 degrees of freedom per camera, 3 per point, no gauge
fixed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.numerics import projective_cameras as kernels
from thesisrecon.numerics.levenberg_marquardt import loss_code, run_levenberg_marquardt
from thesisrecon.numerics.observations import (
    Jacobians,
    Seen,
    SortedObservations,
    Weighing,
    pixel_conditioning,
    sort_observations,
    whitening_transform,
)
from thesisrecon.numerics.projective_cameras import UnitState
from thesisrecon.numerics.schur import BundleLayout, BundleStep, BundleSystem, hold_flipping, lay_out

VIEW_DOF = 11


@dataclass(frozen=True)
class ProjectiveBundleResult:
    """Cameras ``P`` (V, 3, 4) and points ``X`` (N, 4) in the caller's frame, norms and signs; ``residual_px``
    (K, 2) projection minus observation in the caller's order; ``cost`` and ``initial_cost`` are 1/2 sum rho
    in px^2."""

    P: F64
    X: F64
    residual_px: F64
    cost: float
    initial_cost: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _ProjectiveProblem:
    """Reprojection in conditioned pixels; states hold unit vectors, steps lie in their tangent spaces."""

    layout: BundleLayout
    weighing: Weighing
    jacobians: Jacobians

    def linearize(self, state: UnitState) -> BundleSystem:
        def work(which: slice, seen: Seen) -> float:
            part = self.jacobians.part(which.start, which.stop)
            return float(kernels.linearize_projective(state, seen, self.weighing, part))

        cost = sum(self.layout.over_observations(work))
        return BundleSystem(cost, self.layout, self.jacobians)

    def retract(self, state: UnitState, step: BundleStep) -> UnitState:
        block = self.layout.places.block
        views = np.zeros((len(state.P), VIEW_DOF))
        views[block >= 0] = step.cameras.reshape(-1, VIEW_DOF)
        P, X = np.empty_like(state.P), np.empty_like(state.X)
        kernels.tangent_step(state.P, state.vP, state.bP, views, P)
        kernels.tangent_step(state.X, state.vX, state.bX, step.points, X)
        hold_flipping(self.layout, state.P[:, 8:], P[:, 8:], state.X, X)
        return UnitState.at(P, X)

    def residual(self, state: UnitState) -> F64:
        K = len(self.layout.observations.xy)
        residual, depth = np.empty((K, 2)), np.empty(K)

        def work(which: slice, seen: Seen) -> None:
            kernels.project_projective(
                state.P.reshape(-1, 3, 4), state.X, seen, residual[which], depth[which]
            )

        self.layout.over_observations(work)
        return residual

    def cost(self, state: UnitState) -> float:
        def work(_: slice, seen: Seen) -> float:
            return float(kernels.projective_cost(state, seen, self.weighing))

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
    """Minimise sum rho(|x - P X|^2) over all cameras and points, rho = Huber's loss turning at ``loss_px``.

    Sparse Levenberg-Marquardt in conditioned pixels and whitened space (sum XX' = I, |P| = |X| = 1), stepping
    in the tangent spaces; the damping takes care of the 15 freedoms of the frame (methods 6.7).

    Parameters
    ----------
    P : (V, 3, 4) cameras. X : (N, 4) homogeneous points. Both at any scale and sign, which are kept.
    view_index, point_index : (K,) of each observation; xy : (K, 2) px. Any order; sorted by point is fastest.
    fixed_views : (V,) True for cameras that must not move.

    Views and points without observations come back untouched. The cost never rises; singular systems end the
    iterations instead of raising. Raises ``ValueError`` for wrong shapes, values that are not finite, or an
    observed camera or point that is all zero.
    """
    P, X = np.array(P, dtype=np.float64), np.array(X, dtype=np.float64)
    if P.ndim != 3 or P.shape[1:] != (3, 4) or X.ndim != 2 or X.shape[1] != 4:
        raise ValueError(
            f"a projective bundle needs (V, 3, 4) cameras and (N, 4) points; got {P.shape}, {X.shape}"
        )
    observations = sort_observations(view_index, point_index, xy, len(P), len(X))
    seen = np.bincount(observations.view_index, minlength=len(P)) > 0
    seen_points = np.diff(observations.start) > 0
    free = seen & ~(np.zeros(len(P), bool) if fixed_views is None else np.asarray(fixed_views, bool))

    T, M = pixel_conditioning(observations.xy), whitening_transform(X[seen_points])
    conditioned, P_norms = _unit_rows((T @ P @ np.linalg.inv(M)).reshape(-1, 12), seen, "camera")
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
    """The problem in conditioned pixels, with buffers."""
    conditioned = replace(observations, xy=observations.xy * T[0, 0] + T[:2, 2])
    block = np.where(free, np.cumsum(free) - 1, -1)
    none = np.zeros((len(free), 0), dtype=np.int64)
    layout = lay_out(conditioned, block, width=VIEW_DOF, common=none, border=0)
    weighing = Weighing(1.0, loss_code("huber", loss_px), loss_px * float(T[0, 0]))
    return _ProjectiveProblem(layout, weighing, layout.jacobians())


def _unit_rows(rows: F64, used: B8, what: str) -> tuple[F64, F64]:
    """Rows at unit norm and their norms; rows that are not used may be zero."""
    norms = np.linalg.norm(rows, axis=1)
    if not (np.isfinite(norms[used]).all() and (norms[used] > 0.0).all()):
        raise ValueError(f"every observed {what} must be finite and not zero")
    norms = np.where(used, norms, 1.0)
    return np.ascontiguousarray(np.where(used[:, None], rows / norms[:, None], 0.0)), norms


def _with_norms(moved: NDArray[Any], original: F64, *, axis: int | tuple[int, ...]) -> F64:
    """``moved`` scaled to the norms of ``original``: homogeneous scales are the caller's."""
    wanted = np.linalg.norm(original, axis=axis, keepdims=True)
    have = np.linalg.norm(moved, axis=axis, keepdims=True)
    return np.asarray(moved * wanted / np.where(have > 0.0, have, 1.0))

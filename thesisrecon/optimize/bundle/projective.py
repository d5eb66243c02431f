"""Projective bundle adjustment (section 6.7): 11 unknowns per camera, 3 per point, no gauge fixed.

Unit cameras and points move in their tangent spaces, spanned by Householder reflections.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.conditioning import centred_frame, pixel_conditioning, whitening_transform
from thesisrecon.geometry.small_matrices import TINY
from thesisrecon.optimize.bundle.elimination import revert_crossing_points
from thesisrecon.optimize.bundle.observations import Jacobians, Observations, Weighting, sort_observations
from thesisrecon.optimize.bundle.projective_kernels import (
    UnitState,
    linearize_projective,
    projective_cost,
    tangent_step,
)
from thesisrecon.optimize.bundle.schur import BundleLayout, BundleStep, BundleSystem, build_layout
from thesisrecon.optimize.least_squares import run_levenberg_marquardt

_VIEW_DOF = 11


@dataclass(frozen=True)
class ProjectiveBundleResult:
    """Cameras and points in the caller's frame, norms and signs; their residuals (K, 2), 1/2 sum rho px^2."""

    P: F64
    X: F64
    residual_px: F64
    cost: float


@dataclass(frozen=True)
class _ProjectiveProblem:
    """Reprojection in conditioned pixels; states are unit vectors, steps lie in their tangent spaces."""

    layout: BundleLayout
    weighting: Weighting
    jacobians: Jacobians

    def linearize(self, state: UnitState) -> BundleSystem:
        def work(rows: slice, obs: Observations) -> float:
            part = Jacobians(*(a[rows] for a in self.jacobians))
            return float(linearize_projective(state, obs, self.weighting, part))

        return BundleSystem(self.layout.sum_over_observations(work), self.layout, self.jacobians)

    def retract(self, state: UnitState, step: BundleStep) -> UnitState:
        views = np.zeros((len(state.P), _VIEW_DOF))
        views[self.layout.index.block >= 0] = step[0].reshape(-1, _VIEW_DOF)
        P, X = np.empty_like(state.P), np.empty_like(state.X)
        tangent_step(state.P, state.vP, state.bP, views, P)
        tangent_step(state.X, state.vX, state.bX, step[1], X)
        o = self.layout.observations
        before, after = np.ascontiguousarray(state.P[:, 8:]), np.ascontiguousarray(P[:, 8:])
        revert_crossing_points(o.start, o.seen.view_index, before, after, state.X, X)
        return UnitState.at(P, X)

    def cost(self, state: UnitState) -> float:
        return self.layout.sum_over_observations(
            lambda _, obs: float(projective_cost(state, obs, self.weighting))
        )


def refine_projective_bundle(
    P: F64,
    X: F64,
    observations: Observations,
    *,
    loss_px: float = 1.0,
    max_iterations: int = 10,
    settled: float = 0.0,
    fixed_views: B8 | None = None,
) -> ProjectiveBundleResult:
    """Minimise sum rho(|x - P X|^2) over all points and cameras but ``fixed_views`` with Huber's loss (6.7).

    Sparse Levenberg-Marquardt in conditioned pixels and whitened space (sum XX' = I, |P| = |X| = 1); the
    damping handles the 15 gauge freedoms (methods 6.7). The cost never rises; views and points without
    observations do not change. The search also ends when the predicted gain of the cameras is below
    ``settled`` times the square of ``loss_px``.
    """
    o = sort_observations(observations, len(P), len(X))
    observed = np.bincount(o.seen.view_index, minlength=len(P)) > 0
    seen_points = np.diff(o.start) > 0
    free = observed & ~(np.zeros(len(P), bool) if fixed_views is None else np.asarray(fixed_views, bool))

    T, frame = pixel_conditioning(o.seen.xy), centred_frame(X[seen_points], whitening_transform)
    scale = float(T[0, 0])
    conditioned = replace(o, seen=o.seen._replace(xy=o.seen.xy * scale + T[:2, 2]))
    block = np.where(free, np.cumsum(free) - 1, -1)
    none = np.zeros((len(free), 0), dtype=np.int64)
    layout = build_layout(conditioned, block, width=_VIEW_DOF, common=none, border=0)
    problem = _ProjectiveProblem(layout, Weighting(1.0, loss_px * scale), layout.jacobians())
    cameras, P_norms = _unit_rows(frame.cameras(T @ P).reshape(-1, 12), observed)
    points, X_norms = _unit_rows(frame.points(X), seen_points)
    start = UnitState.at(cameras, points)
    end = run_levenberg_marquardt(
        problem, start, max_iterations=max_iterations, min_camera_gain=settled * (loss_px * scale) ** 2
    ).state

    P_back = frame.cameras_back(np.linalg.inv(T) @ (end.P * P_norms[:, None]).reshape(-1, 3, 4))
    X_back = frame.points_back(end.X * X_norms[:, None])
    P = np.where(free[:, None, None], _with_norms(P_back, P, axis=(1, 2)), P)
    X = np.where(seen_points[:, None], _with_norms(X_back, X, axis=1), X)
    residual = _residuals(P, X, observations)
    distance = np.linalg.norm(residual, axis=1)
    below = np.minimum(distance, loss_px)
    return ProjectiveBundleResult(P, X, residual, 0.5 * float(below @ (2.0 * distance - below)))


def _residuals(P: F64, X: F64, o: Observations) -> F64:
    """Return projection minus observation (K, 2) of what is returned; huge in a focal plane."""
    image = np.einsum("kab,kb->ka", P[o.view_index], X[o.point_index])
    w = image[:, 2:]
    tiny = TINY * np.abs(image).max(axis=1, keepdims=True, initial=TINY)
    return np.asarray(image[:, :2] / np.copysign(np.maximum(np.abs(w), tiny), w) - o.xy)


def _unit_rows(rows: F64, used: B8) -> tuple[F64, F64]:
    """Return rows at unit norm and their norms; unused rows may be zero."""
    norms = np.where(used, np.linalg.norm(rows, axis=1), 1.0)
    return np.ascontiguousarray(np.where(used[:, None], rows / norms[:, None], 0.0)), norms


def _with_norms(moved: F64, original: F64, *, axis: int | tuple[int, ...]) -> F64:
    """Scale ``moved`` to the norms of ``original``: homogeneous scales are the caller's."""
    wanted = np.linalg.norm(original, axis=axis, keepdims=True)
    have = np.linalg.norm(moved, axis=axis, keepdims=True)
    return np.asarray(moved * wanted / np.where(have > 0.0, have, 1.0))

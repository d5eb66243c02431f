"""Projective bundle adjustment (section 6.7): 11 unknowns per camera, 3 per point, no gauge fixed.

Unit cameras and points move in their tangent spaces, spanned by Householder reflections.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from thesisrecon._numba import kernel
from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.homogeneous import pixel_conditioning, whitened_frame
from thesisrecon.optimize.bundle import projection
from thesisrecon.optimize.bundle.elimination import revert_crossing_points
from thesisrecon.optimize.bundle.projection import TINY, away_from_zero, loss_value, loss_weight
from thesisrecon.optimize.bundle.schur import BundleLayout, BundleStep, BundleSystem, build_layout
from thesisrecon.optimize.least_squares import run_levenberg_marquardt

_VIEW_DOF = 11


class UnitState(NamedTuple):
    """Unit cameras ``P`` (V, 12) and points ``X`` (N, 4) with Householder vectors and factors."""

    P: F64
    X: F64
    vP: F64
    bP: F64
    vX: F64
    bX: F64

    @classmethod
    def at(cls, P: F64, X: F64) -> "UnitState":
        """Return the state of unit cameras (V, 12) and points (N, 4)."""
        vP, vX, bP, bX = np.empty_like(P), np.empty_like(X), np.empty(len(P)), np.empty(len(X))
        tangent_reflectors(P, vP, bP)
        tangent_reflectors(X, vX, bX)
        return cls(P, X, vP, bP, vX, bX)


@kernel
def tangent_reflectors(p: F64, v: F64, beta: F64) -> None:
    """Fill Householder vectors and factors that take unit rows to -+e0; columns 1.. span tangent spaces."""
    for i in range(p.shape[0]):
        for c in range(p.shape[1]):
            v[i, c] = p[i, c]
        v[i, 0] += 1.0 if p[i, 0] >= 0.0 else -1.0
        norm = 0.0
        for c in range(p.shape[1]):
            norm += v[i, c] * v[i, c]
        beta[i] = 2.0 / norm if norm > 0.0 else 0.0


@kernel
def tangent_step(p: F64, v: F64, beta: F64, step: F64, out: F64) -> None:
    """Move unit rows along their tangent spaces: normalise(p + H[:, 1:] step); signs are kept."""
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


@kernel
def linearize_projective(
    state: UnitState, obs: projection.Observations, weighting: projection.Weighting, J: projection.Jacobians
) -> float:
    """Fill weighted residuals, A (K, 2, 11), B (K, 2, 3): d pi = [[1, 0, -x], [0, 1, -y]] du / u2; cost."""
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
        cost += loss_value(s, weighting.delta)
        root = np.sqrt(loss_weight(s, weighting.delta))
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


@kernel
def projective_cost(state: UnitState, obs: projection.Observations, weighting: projection.Weighting) -> float:
    """Return 1/2 sum rho of the residuals."""
    cost = 0.0
    for k in range(len(obs.xy)):
        p, x = state.P[obs.view_index[k]], state.X[obs.point_index[k]]
        u0 = p[0] * x[0] + p[1] * x[1] + p[2] * x[2] + p[3] * x[3]
        u1 = p[4] * x[0] + p[5] * x[1] + p[6] * x[2] + p[7] * x[3]
        w = away_from_zero(p[8] * x[0] + p[9] * x[1] + p[10] * x[2] + p[11] * x[3])
        r0, r1 = u0 / w - obs.xy[k, 0], u1 / w - obs.xy[k, 1]
        cost += loss_value(r0 * r0 + r1 * r1, weighting.delta)
    return 0.5 * cost


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
    weighting: projection.Weighting
    jacobians: projection.Jacobians

    def linearize(self, state: UnitState) -> BundleSystem:
        def work(rows: slice, obs: projection.Observations) -> float:
            part = projection.Jacobians(*(a[rows] for a in self.jacobians))
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
    P: F64, X: F64, observations: projection.Observations, *, loss_px: float = 1.0, max_iterations: int = 10,
    settled: float = 0.0, fixed_views: B8 | None = None,
) -> ProjectiveBundleResult:  # fmt: skip
    """Minimise sum rho(|x - P X|^2) over all points and cameras but ``fixed_views`` with Huber's loss (6.7).

    Levenberg-Marquardt in conditioned pixels and whitened space (sum XX' = I, |P| = |X| = 1); the damping
    handles the 15 gauge freedoms. Views and points without observations do not change. The search also ends
    when the predicted gain of the cameras is below ``settled`` times the square of ``loss_px``.
    """
    o = projection.sort_observations(observations, len(P), len(X))
    observed = np.bincount(o.seen.view_index, minlength=len(P)) > 0
    seen_points = np.diff(o.start) > 0
    free = observed & ~(np.zeros(len(P), bool) if fixed_views is None else np.asarray(fixed_views, bool))

    T, frame = pixel_conditioning(o.seen.xy), whitened_frame(X[seen_points])
    scale = float(T[0, 0])
    conditioned = replace(o, seen=o.seen._replace(xy=o.seen.xy * scale + T[:2, 2]))
    block = np.where(free, np.cumsum(free) - 1, -1)
    none = np.zeros((len(free), 0), dtype=np.int64)
    layout = build_layout(conditioned, block, width=_VIEW_DOF, common=none, border=0)
    problem = _ProjectiveProblem(layout, projection.Weighting(1.0, loss_px * scale), layout.jacobians())
    cameras, P_norms = _unit_rows(frame.cameras(T @ P).reshape(-1, 12), observed)
    points, X_norms = _unit_rows(frame.points(X), seen_points)
    start = UnitState.at(cameras, points)
    end = run_levenberg_marquardt(
        problem.linearize, problem.retract, problem.cost, start,
        max_iterations=max_iterations, min_camera_gain=settled * (loss_px * scale) ** 2,
    ).state  # fmt: skip

    P_back = frame.cameras_back(np.linalg.inv(T) @ (end.P * P_norms[:, None]).reshape(-1, 3, 4))
    X_back = frame.points_back(end.X * X_norms[:, None])
    P = np.where(free[:, None, None], _with_norms(P_back, P, axis=(1, 2)), P)
    X = np.where(seen_points[:, None], _with_norms(X_back, X, axis=1), X)
    residual = _residuals(P, X, observations)
    distance = np.linalg.norm(residual, axis=1)
    below = np.minimum(distance, loss_px)
    return ProjectiveBundleResult(P, X, residual, 0.5 * float(below @ (2.0 * distance - below)))


def _residuals(P: F64, X: F64, o: projection.Observations) -> F64:
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

"""Compiled cost and Jacobians of unit cameras and points in their tangent spaces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thesisrecon._numba import kernel
from thesisrecon.arrays import F64
from thesisrecon.geometry.small_matrices import away_from_zero, loss_value, loss_weight
from thesisrecon.optimize.bundle.observations import Jacobians, Observations, Weighting


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
def linearize_projective(state: UnitState, obs: Observations, weighting: Weighting, J: Jacobians) -> float:
    """Fill weighted residuals and their Jacobians, A (K, 2, 11) and B (K, 2, 3); return the cost.

    With u = P X: d pi = (1 / u2) [[1, 0, -x], [0, 1, -y]] du (methods 6.7).
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
def projective_cost(state: UnitState, obs: Observations, weighting: Weighting) -> float:
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

"""Levenberg-Marquardt from many starts at once, for the few unknowns of a plane or a calibration."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from thesisrecon.selfcalibration.refinement import solve_guarded

F64 = NDArray[np.float64]

_STEP = 1e-6


def descend(
    residuals: Callable[[F64], F64], starts: F64, *, iterations: int, loss_scale: float = np.inf
) -> tuple[F64, F64]:
    """Where descents from ``starts`` (B, D) end, and their costs (B,): the mean loss of a residual.

    ``residuals`` takes (B, D) to (B, M) row by row; a row with NaN is refused. Soft-L1 loss that turns at
    ``loss_scale``, squares where it is infinite. Derivatives are central differences. No cost rises.
    """
    x, r = starts.copy(), residuals(starts)
    cost, damping = _cost(r, loss_scale), np.full(len(starts), 1e-2)
    for _ in range(iterations):
        J = derivatives(residuals, x)
        weight = (1.0 + (r / loss_scale) ** 2) ** -0.5
        N = np.einsum("bmi,bm,bmj->bij", J, weight, J)
        g = np.einsum("bmi,bm->bi", J, weight * r)
        N += damping[:, None, None] * np.eye(x.shape[1]) * (np.einsum("bii->bi", N) + 1e-12)[:, None, :]
        trial = x - solve_guarded(N, g)
        r_trial = residuals(trial)
        trial_cost = _cost(r_trial, loss_scale)
        better = trial_cost < cost
        settled = better & (cost - trial_cost <= 1e-14 * cost)
        x, r = np.where(better[:, None], trial, x), np.where(better[:, None], r_trial, r)
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, damping / 6.0, damping * 4.0)
        if (settled | (damping > 1e10) | ~np.isfinite(cost)).all():
            break
    return x, cost


def _cost(r: F64, loss_scale: float) -> F64:
    squares = r**2
    if np.isfinite(loss_scale):
        squares = 2.0 * loss_scale**2 * (np.sqrt(1.0 + squares / loss_scale**2) - 1.0)
    return np.asarray(np.nan_to_num(squares.mean(axis=1), nan=np.inf))


def derivatives(residuals: Callable[[F64], F64], x: F64) -> F64:
    """Central differences (B, M, D) of residuals (B, M) at x (B, D)."""
    steps = _STEP * (1.0 + np.abs(x))
    columns = []
    for k in range(x.shape[1]):
        shift = steps * (np.arange(x.shape[1]) == k)
        columns.append((residuals(x + shift) - residuals(x - shift)) / (2.0 * steps[:, k, None]))
    return np.stack(columns, axis=-1)

"""Refinement of (plane at infinity, focals): one criterion for the hypotheses of every method.

With C_i = K_i^-1 (A_i - a_i p') K_r every right hypothesis makes C_i a scaled rotation. The residuals are
the six entries of 3 C C' / tr(C C') - I, the nonlinear criterion of Pollefeys et al. (IJCV 32(1), 1999) in
its scale-free form; the focals are log f per camera group. Many hypotheses are refined at once.

Levenberg-Marquardt from many starts at once, for the few unknowns of a plane or a calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.selfcalibration.frame import ReferenceFrame

_UPPER = np.triu_indices(3)
_ENTRY_WEIGHT = np.where(_UPPER[0] == _UPPER[1], 1.0, np.sqrt(2.0))


@dataclass(frozen=True)
class RotationCriterion:
    """How far the upgraded cameras are from scaled rotations, robustly.

    ``scale``: residual norm of a camera beyond which it counts linearly (soft L1). ``focal_log_mean`` and
    ``focal_log_std`` with ``focal_weight``: a weak pull of every log focal (in long sides) of which nothing
    is known; it keeps hypotheses out of the absurd and is far below the noise of a well-determined problem.
    ``noise``: residual of a good camera, by which what is known of a focal weighs.
    """

    scale: float = 0.05
    focal_log_mean: float = 0.2
    focal_log_std: float = 1.0
    focal_weight: float = 2e-3
    noise: float = 0.01

    def camera_residuals(self, frame: ReferenceFrame, p: F64, log_f: F64) -> F64:
        """p (B, 3), log_f (B, G) -> (B, R, 6) weighted entries of 3CC'/tr(CC') - I."""
        f = np.exp(log_f)[:, frame.group]
        C = frame.A[None] - frame.a[None, :, :, None] * p[:, None, None, :]
        C[..., :2] *= f[:, frame.reference, None, None, None]
        C[..., :2, :] /= f[..., None, None]
        CC = C @ C.swapaxes(-1, -2)
        trace = np.trace(CC, axis1=-2, axis2=-1)[..., None, None]
        E = 3.0 * CC / np.maximum(trace, 1e-300) - np.eye(3)
        return np.asarray(E[..., _UPPER[0], _UPPER[1]] * _ENTRY_WEIGHT, dtype=np.float64)

    def cost(self, frame: ReferenceFrame, p: F64, log_f: F64) -> F64:
        """Robust cost per camera of each hypothesis; (B,)."""
        norm2 = np.sum(self.camera_residuals(frame, p, log_f) ** 2, axis=-1)
        robust = 2.0 * self.scale**2 * (np.sqrt(1.0 + norm2 / self.scale**2) - 1.0)
        pull = self._pull(frame, log_f)
        return np.asarray((robust.sum(axis=1) + np.sum(pull**2, axis=1)) / len(frame.views), dtype=np.float64)

    def _pull(self, frame: ReferenceFrame, log_f: F64) -> F64:
        weak = self.focal_weight * (log_f - self.focal_log_mean) / self.focal_log_std
        if frame.focal_mean is None or frame.focal_std is None:
            return weak
        known = np.isfinite(frame.focal_std)
        scale = np.where(known, frame.focal_std, 1.0)
        return np.where(known, self.noise * (log_f - np.where(known, frame.focal_mean, 0.0)) / scale, weak)

    def weighted_residuals(self, frame: ReferenceFrame, theta: F64, weights: F64) -> F64:
        """Residual vectors (B, 6 R + G) of theta = (p, log f) with fixed robust weights (B, R)."""
        residuals = self.camera_residuals(frame, theta[:, :3], theta[:, 3:]) * weights[..., None]
        return np.concatenate([residuals.reshape(len(theta), -1), self._pull(frame, theta[:, 3:])], axis=1)

    def weights(self, frame: ReferenceFrame, theta: F64) -> F64:
        """Square roots of the soft-L1 weights of each camera, (B, R)."""
        norm2 = np.sum(self.camera_residuals(frame, theta[:, :3], theta[:, 3:]) ** 2, axis=-1)
        return np.asarray((1.0 + norm2 / self.scale**2) ** -0.25, dtype=np.float64)


def _jacobian(criterion: RotationCriterion, frame: ReferenceFrame, theta: F64, weights: F64) -> F64:
    n = theta.shape[1]
    steps = 1e-6 * (1.0 + np.abs(theta))
    columns = []
    for k in range(n):
        shifted_up, shifted_down = theta.copy(), theta.copy()
        shifted_up[:, k] += steps[:, k]
        shifted_down[:, k] -= steps[:, k]
        difference = criterion.weighted_residuals(frame, shifted_up, weights) - criterion.weighted_residuals(
            frame, shifted_down, weights
        )
        columns.append(difference / (2.0 * steps[:, k, None]))
    return np.stack(columns, axis=-1)


def refine_hypotheses(
    criterion: RotationCriterion,
    frame: ReferenceFrame,
    theta: F64,
    *,
    iterations: int = 25,
    planes_only: bool = False,
) -> tuple[F64, F64]:
    """Levenberg-Marquardt on every row of theta (B, 3 + G) at once; -> refined theta and cost (B,).

    ``planes_only`` leaves the focals as they are.
    """
    theta = theta.copy()
    damping = np.full(len(theta), 1e-3)
    cost = criterion.cost(frame, theta[:, :3], theta[:, 3:])
    for _ in range(iterations):
        weights = criterion.weights(frame, theta)
        r = criterion.weighted_residuals(frame, theta, weights)
        J = _jacobian(criterion, frame, theta, weights)
        if planes_only:
            J[:, :, 3:] = 0.0
        N = np.einsum("bri,brj->bij", J, J)
        g = np.einsum("bri,br->bi", J, r)
        diagonal = np.einsum("bii->bi", N)
        N = N + damping[:, None, None] * np.eye(theta.shape[1]) * (diagonal + 1e-12)[:, None, :]
        trial = theta - solve_guarded(N, g)
        trial[:, 3:] = np.clip(trial[:, 3:], -4.0, 5.4)
        trial_cost = criterion.cost(frame, trial[:, :3], trial[:, 3:])
        better = np.asarray(trial_cost < cost)
        converged = better & (cost - trial_cost < 1e-10 * cost)
        theta[better], cost[better] = trial[better], trial_cost[better]
        damping = np.where(better, damping / 5.0, damping * 4.0)
        if (converged | (damping > 1e8)).all():
            break
    return theta, cost


def solve_guarded(N: F64, g: F64) -> F64:
    """Solve symmetric positive systems N x = g (B, n, n), (B, n); singular or non-finite ones give 0."""
    bad = np.asarray(~(np.isfinite(N).all(axis=(1, 2)) & np.isfinite(g).all(axis=1)))
    N = np.where(bad[:, None, None], np.eye(N.shape[1]), N)
    g = np.where(bad[:, None], 0.0, g)
    scale = np.maximum(np.abs(np.einsum("bii->bi", N)), 1e-300) ** -0.5
    scaled = N * scale[:, :, None] * scale[:, None, :] + 1e-13 * np.eye(N.shape[1])
    try:
        return np.asarray(np.linalg.solve(scaled, (g * scale)[..., None])[..., 0] * scale, dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.zeros_like(g)


def focal_std(criterion: RotationCriterion, frame: ReferenceFrame, theta: F64) -> tuple[F64, float]:
    """Standard deviations (G,) of log f at theta (3 + G,) and the noise of the residual entries.

    From J'J with the noise estimated from the residuals themselves (5 independent entries a camera, the
    reference included, less the unknowns); infinite where J'J is singular to rounding.
    """
    row = theta[None]
    weights = criterion.weights(frame, row)
    r = criterion.weighted_residuals(frame, row, weights)[0]
    J = _jacobian(criterion, frame, row, weights)[0]
    dof = max(5 * len(frame.views) - len(theta), 1)
    noise = float(np.sqrt(np.sum(r**2) / dof))
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    S, Vt = np.linalg.svd(J / scale)[1:]
    with np.errstate(divide="ignore"):
        variance = np.sum((Vt / np.maximum(S, 1e-300)[:, None]) ** 2, axis=0) / scale**2
    return noise * np.sqrt(variance[3:]), noise


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

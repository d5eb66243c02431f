"""Criterion and batched Levenberg-Marquardt for hypotheses of (plane at infinity, focal lengths).

With C_i = K_i^-1 (A_i - a_i p') K_r a correct hypothesis makes every C_i a scaled rotation. The residuals are
the six entries of 3 C C' / tr(C C') - I: the nonlinear criterion of Pollefeys et al. (IJCV 32(1), 1999) in
scale-free form, with one log f per camera group.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.optimize.least_squares import central_differences, soft_l1
from thesisrecon.selfcalibration._frame import ReferenceFrame

UPPER = np.triu_indices(3)
ENTRY_WEIGHT = np.where(UPPER[0] == UPPER[1], 1.0, np.sqrt(2.0))


def _weighted_entries(M: F64) -> F64:
    """Return the upper triangles (..., 6) of symmetric matrices, whose norm is the Frobenius norm."""
    return np.asarray(M[..., UPPER[0], UPPER[1]] * ENTRY_WEIGHT, dtype=np.float64)


def quadratic_rows(x: F64, y: F64) -> F64:
    """Return rows (..., n (n + 1) / 2) with r . q = x' Q y for the upper triangle q of a symmetric Q."""
    pairs = zip(*np.triu_indices(x.shape[-1]), strict=True)
    terms = [x[..., a] * y[..., b] + (x[..., b] * y[..., a] if a != b else 0.0) for a, b in pairs]
    return np.stack(terms, axis=-1)


def dual_image_residuals(frame: ReferenceFrame, K: F64, planes: F64) -> F64:
    """Entries (B, R, 6) of K K' / |K K'| - P Q P' / |P Q P'| for K (B, R, 3, 3) (IJCV 32(1), 1999)."""
    C = frame.homographies(planes) @ K[:, None, frame.reference]
    return _weighted_entries(_unit(K @ K.swapaxes(-1, -2)) - _unit(C @ C.swapaxes(-1, -2)))


def _unit(conic: F64) -> F64:
    norm = np.sqrt(np.sum(conic**2, axis=(-2, -1), keepdims=True))
    return np.asarray(conic / np.maximum(norm, 1e-300))


@dataclass(frozen=True)
class RotationCriterion:
    """Robust distance of upgraded cameras from scaled rotations, linear beyond ``scale``, and priors."""

    scale: float = 0.05  #: distance at which the loss changes from quadratic to linear
    focal_log_mean: float = 0.2  #: weak prior of an unknown focal length: mean of its logarithm
    focal_log_std: float = 1.0  #: standard deviation of that prior
    focal_weight: float = 2e-3  #: weight of that prior
    noise: float = 0.01  #: weight of a given focal length in units of its standard deviation

    def camera_residuals(self, frame: ReferenceFrame, p: F64, log_f: F64) -> F64:
        """Return the weighted entries (B, R, 6) of 3 C C' / tr(C C') - I for planes (B, 3), log_f (B, G)."""
        f = np.exp(log_f)[:, frame.group]
        C = frame.homographies(p)
        C[..., :2] *= f[:, frame.reference, None, None, None]
        C[..., :2, :] /= f[..., None, None]
        CC = C @ C.swapaxes(-1, -2)
        trace = np.trace(CC, axis1=-2, axis2=-1)[..., None, None]
        E = 3.0 * CC / np.maximum(trace, 1e-300) - np.eye(3)
        return _weighted_entries(E)

    def cost(self, frame: ReferenceFrame, p: F64, log_f: F64) -> F64:
        """Return the robust cost (B,) per camera of planes (B, 3) with log focal lengths (B, G)."""
        norm2 = np.sum(self.camera_residuals(frame, p, log_f) ** 2, axis=-1)
        robust = soft_l1(norm2, self.scale)[0]
        pull = self._focal_prior_residuals(frame, log_f)
        return np.asarray((robust.sum(axis=1) + np.sum(pull**2, axis=1)) / len(frame.views), dtype=np.float64)

    def _focal_prior_residuals(self, frame: ReferenceFrame, log_f: F64) -> F64:
        weak = self.focal_weight * (log_f - self.focal_log_mean) / self.focal_log_std
        known = np.isfinite(frame.focal_std)
        scale = np.where(known, frame.focal_std, 1.0)
        return np.where(known, self.noise * (log_f - np.where(known, frame.focal_mean, 0.0)) / scale, weak)

    def _linearized(self, frame: ReferenceFrame, theta: F64) -> tuple[F64, F64]:
        """Return residuals (B, 6 R + G) of cameras and focal priors, soft-L1 weighted, and derivatives."""
        norm2 = np.sum(self.camera_residuals(frame, theta[:, :3], theta[:, 3:]) ** 2, axis=-1)
        root_weights = (1.0 + norm2 / self.scale**2) ** -0.25

        def residuals(x: F64) -> F64:
            cameras = self.camera_residuals(frame, x[:, :3], x[:, 3:]) * root_weights[..., None]
            priors = self._focal_prior_residuals(frame, x[:, 3:])
            return np.concatenate([cameras.reshape(len(x), -1), priors], axis=1)

        return residuals(theta), central_differences(residuals, theta)


def _descend(
    normal_equations: Callable[[F64], tuple[F64, F64]], cost_of: Callable[[F64], F64], x: F64,
    iterations: int, *, damping: float, decrease: float, max_damping: float, tolerance: float,
    project: Callable[[F64], F64] = lambda x: x,
) -> tuple[F64, F64]:  # fmt: skip
    """Levenberg-Marquardt on all rows of x (B, D) until every row has finished; return x and costs (B,)."""
    cost, damped = cost_of(x), np.full(len(x), damping)
    for _ in range(iterations):
        N, g = normal_equations(x)
        diagonal = np.einsum("bii->bi", N)
        # Products with an identity matrix would be NaN where the diagonal is infinite.
        diagonal += damped[:, None] * (diagonal + 1e-12)
        trial = project(x - _solve_batch(N, g))
        trial_cost = cost_of(trial)
        better = np.asarray(trial_cost < cost)
        finished = (better & (cost - trial_cost <= tolerance * cost)) | ~np.isfinite(cost)
        x, cost = np.where(better[:, None], trial, x), np.where(better, trial_cost, cost)
        damped = np.where(better, damped / decrease, damped * 4.0)
        if (finished | (damped > max_damping)).all():
            break
    return x, cost


def _solve_batch(N: F64, g: F64) -> F64:
    """Solve N x = g for symmetric positive N (B, n, n); singular or non-finite systems give 0."""
    bad = np.asarray(~(np.isfinite(N).all(axis=(1, 2)) & np.isfinite(g).all(axis=1)))
    N = np.where(bad[:, None, None], np.eye(N.shape[1]), N)
    g = np.where(bad[:, None], 0.0, g)
    scale = np.maximum(np.abs(np.einsum("bii->bi", N)), 1e-300) ** -0.5
    scaled = N * scale[:, :, None] * scale[:, None, :] + 1e-13 * np.eye(N.shape[1])
    try:
        return np.asarray(np.linalg.solve(scaled, (g * scale)[..., None])[..., 0] * scale, dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.zeros_like(g)


def refine_hypotheses(
    criterion: RotationCriterion, frame: ReferenceFrame, theta: F64, *, planes_only: bool = False
) -> tuple[F64, F64]:
    """Refine hypotheses (p, log f) (B, 3 + G) at once; return them with their costs (B,)."""

    def normal_equations(x: F64) -> tuple[F64, F64]:
        r, J = criterion._linearized(frame, x)
        if planes_only:
            J[:, :, 3:] = 0.0
        return np.einsum("bri,brj->bij", J, J), np.einsum("bri,br->bi", J, r)

    return _descend(
        normal_equations, lambda x: criterion.cost(frame, x[:, :3], x[:, 3:]), theta, 25,
        damping=1e-3, decrease=5.0, max_damping=1e8, tolerance=1e-10,
        project=lambda x: np.concatenate([x[:, :3], np.clip(x[:, 3:], -4.0, 5.4)], axis=1),
    )  # fmt: skip


def focal_std(criterion: RotationCriterion, frame: ReferenceFrame, theta: F64) -> F64:
    """Standard deviations (G,) of the log focals at a minimum (p, log f) by (J'J)^-1; inf if singular."""
    r, J = (part[0] for part in criterion._linearized(frame, theta[None]))
    dof = max(5 * len(frame.views) - len(theta), 1)
    noise = float(np.sqrt(np.sum(r**2) / dof))
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    S, Vt = np.linalg.svd(J / scale)[1:]
    with np.errstate(divide="ignore"):
        variance = np.sum((Vt / np.maximum(S, 1e-300)[:, None]) ** 2, axis=0) / scale**2
    return np.asarray(noise * np.sqrt(variance[3:]), dtype=np.float64)


def minimize_batch(
    residuals: Callable[[F64], F64], starts: F64, *, iterations: int, loss_scale: float = np.inf
) -> tuple[F64, F64]:
    """Minimize residuals, (B, D) to (B, M) row by row, from many starts; return minima and mean losses."""

    def normal_equations(x: F64) -> tuple[F64, F64]:
        r, J = residuals(x), central_differences(residuals, x)
        weight = (1.0 + (r / loss_scale) ** 2) ** -0.5
        return np.einsum("bmi,bm,bmj->bij", J, weight, J), np.einsum("bmi,bm->bi", J, weight * r)

    def cost_of(x: F64) -> F64:
        squares = residuals(x) ** 2
        if np.isfinite(loss_scale):
            squares = soft_l1(squares, loss_scale)[0]
        return np.asarray(np.nan_to_num(squares.mean(axis=1), nan=np.inf))

    return _descend(
        normal_equations, cost_of, starts, iterations,
        damping=1e-2, decrease=6.0, max_damping=1e10, tolerance=1e-14,
    )  # fmt: skip

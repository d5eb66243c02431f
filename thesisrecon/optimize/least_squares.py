"""Levenberg-Marquardt: one damping loop, dense solvers of small problems; robust losses and noise."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.small_matrices import floored_diagonal, solve_positive

State = TypeVar("State")
Step = TypeVar("Step")
StepOut = TypeVar("StepOut", covariant=True)

_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e12
# Damping below which a step is as good as undamped: the curvature, relative to the diagonal, of the least
# determined combination of unknowns that must converge.
_WEAKEST = 1e-8
_ROUNDING = 1e-15  # gain relative to the cost that is below its rounding
_MANY = 1200  # unknowns above which information is inverted by Cholesky


class _LinearSystem(Protocol[StepOut]):
    """Normal equations at one state.

    ``solve`` returns the damped step, its gain, and the part of the cameras (or all); None if singular.
    """

    @property
    def cost(self) -> float: ...

    def solve(self, damping: float) -> tuple[StepOut, float, float] | None: ...


@dataclass(frozen=True)
class Descent(Generic[State]):
    """Final state, its cost, the number of linear solves and the last damping.

    ``remaining`` is the gain of the cameras that an undamped step promised at the final state, or at the one
    before it if that was small: half the squared Newton decrement.
    """

    state: State
    cost: float
    iterations: int
    damping: float
    remaining: float


def run_levenberg_marquardt(
    linearize: Callable[[State], _LinearSystem[Step]], retract: Callable[[State, Step], State],
    cost_of: Callable[[State], float], state: State, *, max_iterations: int, tolerance: float = 1e-10,
    min_camera_gain: float = 0.0, initial_damping: float = _WEAKEST,
) -> Descent[State]:  # fmt: skip
    """Minimise a cost by Levenberg-Marquardt (6.7); one that is not finite rejects a state.

    The damping multiplies the diagonal (Marquardt 1963), so that units and gauge freedoms do not matter; it
    follows Nielsen (IMM-REP-1999-05). It ends when the predicted gain of an undamped step is at most
    ``tolerance`` relative to the cost, or that of the cameras ``min_camera_gain``: in a valley the damping
    makes steps short.
    """
    system = linearize(state)
    cost, damping, growth = system.cost, initial_damping, 2.0
    iteration = 0
    while iteration < max_iterations and damping <= _MAX_DAMPING:
        iteration += 1
        solved, least = system.solve(damping), damping <= _WEAKEST
        gain, predicted, camera_gain, candidate = -1.0, np.inf, np.inf, state
        if solved is not None:
            step, predicted, camera_gain = solved
            candidate = retract(state, step)
            gain = cost - cost_of(candidate)
        small = camera_gain <= min_camera_gain or predicted <= tolerance * cost
        if gain > 0.0 and np.isfinite(gain):
            state, cost = candidate, cost - gain
            if small and least:
                return Descent(state, cost, iteration, damping, camera_gain)
            damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain / predicted - 1.0) ** 3), _MIN_DAMPING)
            if small and growth == 2.0:
                damping = min(damping, _WEAKEST)
            growth = 2.0
            system = linearize(state)
            cost = system.cost
        elif (small and least) or predicted <= _ROUNDING * cost:
            break
        else:
            damping, growth = damping * growth, growth * 2.0
    solved = system.solve(_WEAKEST)
    remaining = np.inf if solved is None else solved[2]
    return Descent(state, cost, iteration, damping, remaining)


@dataclass(frozen=True)
class DenseSystem:
    """Normal equations of a small problem, weighted by sqrt(rho'): 1/2 sum rho, J'J and J'r."""

    cost: float
    hessian: F64
    gradient: F64

    def solve(self, damping: float) -> tuple[F64, float, float] | None:
        """Return the step by Cholesky and its predicted gain, also as the gain of the cameras; or None.

        Unknowns without effect do not move.
        """
        diagonal = damping * floored_diagonal(np.diag(self.hessian))
        step = solve_positive(self.hessian + np.diag(diagonal), -self.gradient)
        if step is None:
            return None
        gain = 0.5 * float(step @ (diagonal * step - self.gradient))
        return step, gain, gain


def invert_information(information: F64) -> F64:
    """Invert an information matrix scaled to a unit diagonal, eigenvalues floored; inf if not finite."""
    if len(information) == 0:
        return np.zeros_like(information)
    if not np.isfinite(information).all():
        return np.full_like(information, np.inf)
    scale = 1.0 / np.sqrt(floored_diagonal(np.diag(information)))
    scaled = information * scale * scale[:, None]
    if len(scaled) > _MANY:
        # Cholesky is a tenth of the work, but fails if an eigenvalue is near the floor.
        factor, fault = scipy.linalg.lapack.dpotrf(scaled, lower=1)
        if not fault:
            lower = np.tril(scipy.linalg.lapack.dpotri(factor, lower=1)[0])
            return np.asarray((lower + np.tril(lower, -1).T) * scale * scale[:, None])
    values, vectors = np.linalg.eigh(scaled)
    inverse = (vectors / np.maximum(values, 1e-14 * max(float(values[-1]), 1e-300))) @ vectors.T
    return np.asarray(inverse * scale * scale[:, None])


@dataclass(frozen=True)
class ResidualMinimum:
    """Minimum x, 1/2 sum rho, sigma^2 (J'J)^-1 with sigma^2 = 2 cost / (M - D), and residuals (M,)."""

    x: F64
    cost: float
    covariance: F64
    residual: F64


def _squared(s: F64) -> tuple[F64, F64]:
    return s, np.ones_like(s)


def central_differences(function: Callable[[F64], F64], x: F64) -> F64:
    """Derivatives (..., D) of the values of a function by the last axis of x (..., D), one at a time."""
    if x.shape[-1] == 0:
        return np.empty((*function(x).shape, 0))
    steps, columns = 1e-6 * (1.0 + np.abs(x)), []
    for k in range(x.shape[-1]):
        shift = steps * (np.arange(x.shape[-1]) == k)
        change, width = function(x + shift) - function(x - shift), 2.0 * steps[..., k]
        columns.append(change / width.reshape(*width.shape, *[1] * (change.ndim - width.ndim)))
    return np.stack(columns, axis=-1)


def minimize_residuals(
    residual_fn: Callable[[F64], F64], x0: F64, *,
    loss: Callable[[F64], tuple[F64, F64]] = _squared, max_iterations: int = 50, tolerance: float = 1e-10,
) -> ResidualMinimum:  # fmt: skip
    """Minimise 1/2 sum rho(r_m(x)^2) by dense Levenberg-Marquardt with central differences.

    States with residuals that are not finite are rejected; such a start is a ``ValueError``.
    """
    if not (np.isfinite(x0).all() and np.isfinite(residual_fn(x0)).all()):
        raise ValueError("minimize_residuals needs a start with finite residuals")

    def linearize(x: F64) -> DenseSystem:
        r = residual_fn(x)
        J = np.nan_to_num(central_differences(residual_fn, x), posinf=0.0, neginf=0.0)
        rho, weight = loss(r**2)
        return DenseSystem(0.5 * float(rho.sum()), (J.T * weight) @ J, J.T @ (weight * r))

    def cost_at(x: F64) -> float:
        r = residual_fn(x)
        return 0.5 * float(loss(r**2)[0].sum()) if np.isfinite(r).all() else np.inf

    found = run_levenberg_marquardt(
        linearize, lambda x, step: x + step, cost_at, x0,
        max_iterations=max_iterations, tolerance=tolerance, initial_damping=1e-3,
    )  # fmt: skip
    x, cost = found.state, found.cost
    residual = residual_fn(x)
    variance = 2.0 * cost / max(len(residual) - len(x0), 1)
    return ResidualMinimum(x, cost, variance * invert_information(linearize(x).hessian), residual)


def huber(s: F64, delta: float) -> tuple[F64, F64]:
    """rho = s below delta^2, 2 delta sqrt(s) - delta^2 above (Huber 1964), and its derivative; convex."""
    root = np.sqrt(np.maximum(s, delta**2))
    inside = s <= delta**2
    return np.where(inside, s, 2.0 * delta * root - delta**2), np.where(inside, 1.0, delta / root)


def soft_l1(s: F64, delta: float) -> tuple[F64, F64]:
    """rho = 2 delta^2 (sqrt(1 + s / delta^2) - 1), smooth and convex, and its derivative."""
    root = np.sqrt(1.0 + s / delta**2)
    return 2.0 * delta**2 * (root - 1.0), 1.0 / root


NORMAL_95 = 1.959963984540054  # 97.5 % quantile of the normal distribution
# 1 / Phi^-1(0.75); the thesis' text has 1 / Phi(0.75), which is not consistent.
MAD_FACTOR = 1.4826022185056018
_RAYLEIGH_MEDIAN = 1.1774
INLIER_SIGMAS, VARIANCE_OF_INLIERS = 3.0, 0.9494
"""Residual of an inlier in standard deviations, and the variance of residuals within it."""
_HUBER_SIGMAS = (3.0, 2.0, 1.5, 1.0)


def noise_from_distances(distances: F64) -> float:
    """Standard deviation of a coordinate from lengths (N,) of residuals: their median by Rayleigh's."""
    return float(np.median(distances)) / _RAYLEIGH_MEDIAN


def student_factor(dof: int) -> float:
    """Student's 95 % quantile over the normal one; ``dof`` degrees of freedom estimate the noise."""
    return float(scipy.special.stdtrit(dof, 0.975) / NORMAL_95)


def next_inlier_limit(distance: F64, inliers: B8, limit: float, *, unknowns: int) -> float:
    """Limit of the inliers of the next round: ``INLIER_SIGMAS`` standard deviations of the noise of a fit."""
    # The median of the inliers alone would be too small, since their limit cuts off the noise.
    near = distance <= max(2.0 * limit, float(np.median(distance[inliers])))
    fitted = 2.0 * int(inliers.sum())
    return float(
        INLIER_SIGMAS * noise_from_distances(distance[near]) * np.sqrt(fitted / max(fitted - unknowns, 1.0))
    )


def trimmed_noise_scale(residuals: F64, start: float, *, parameters: int = 7) -> float:
    """Standard deviation of residuals >= 0 within 2.5 standard deviations; ``start`` if these are too few."""
    sigma = start
    for _ in range(5):
        kept = residuals[residuals <= 2.5 * sigma]
        if len(kept) <= 2 * parameters:
            return start
        # The variance of a normal variable trimmed there is 0.911.
        sigma = float(np.sqrt(kept @ kept / (len(kept) - parameters) / 0.91125))
    return sigma


def best_huber_width(residuals: F64, sigma: float, *, parameters: int = 7) -> float:
    """The width of Huber's loss with the least expected variance, infinite for least squares.

    The asymptotic variance mean(psi^2) / mean(psi')^2 (Huber 1964; Jaeckel 1971) must fall by more than
    chance.
    """
    n = len(residuals)
    if n <= 2 * parameters:
        return np.inf
    needed = (1.0 + 2.0 / np.sqrt(n)) * n / (n - 2 * parameters)
    width, least = np.inf, effective_noise(residuals, np.inf) ** 2
    for k in _HUBER_SIGMAS:
        variance = effective_noise(residuals, k * sigma) ** 2 * needed
        if variance < least:
            width, least = k * sigma, variance
    return width


def effective_noise(residuals: F64, width: float, *, parameters: int = 0) -> float:
    """Normal noise with which least squares is as uncertain as Huber's loss (Huber, 1973)."""
    n = len(residuals)
    psi = np.minimum(residuals, width)
    straight = max(int(np.count_nonzero(residuals < width)), 1) / n
    return float(np.sqrt(psi @ psi / max(n - parameters, 1))) / straight

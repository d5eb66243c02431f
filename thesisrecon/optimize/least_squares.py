"""Levenberg-Marquardt: one damping loop for every problem, and dense solvers for small ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.geometry.small_matrices import floored_diagonal, solve_positive

State = TypeVar("State")
Step = TypeVar("Step")
StepOut = TypeVar("StepOut", covariant=True)

_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e12
# Damping below which a step is as good as undamped: the curvature, relative to the diagonal, of the least
# determined combination of unknowns that must converge.
_WEAKEST = 1e-8
# Gain relative to the cost that is below its rounding.
_ROUNDING = 1e-15
# Unknowns above which information is inverted by Cholesky.
_MANY = 1200


class _LinearSystem(Protocol[StepOut]):
    """Normal equations at one state.

    ``solve`` returns the damped step, its predicted decrease in cost (gain), and the part due to the cameras
    (in small problems all of it); None if the system is singular.
    """

    @property
    def cost(self) -> float: ...

    def solve(self, damping: float) -> tuple[StepOut, float, float] | None: ...


class _Problem(Protocol[State, Step]):
    """``retract`` moves a state by a step; a ``cost`` that is not finite rejects a state."""

    def linearize(self, state: State) -> _LinearSystem[Step]: ...

    def retract(self, state: State, step: Step) -> State: ...

    def cost(self, state: State) -> float: ...


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
    problem: _Problem[State, Step], state: State, *, max_iterations: int, tolerance: float = 1e-10,
    min_camera_gain: float = 0.0, initial_damping: float = _WEAKEST,
) -> Descent[State]:  # fmt: skip
    """Minimise a problem by Levenberg-Marquardt (6.7).

    The damping multiplies the diagonal (Marquardt 1963), so that units do not matter and gauge freedoms need
    no other treatment; it follows Nielsen (IMM-REP-1999-05). It ends when the predicted gain of an undamped
    step is at most ``tolerance`` relative to the cost, or that of the cameras at most ``min_camera_gain``: in
    a valley the damping makes steps short.
    """
    system = problem.linearize(state)
    cost, damping, growth = system.cost, initial_damping, 2.0
    iteration = 0
    while iteration < max_iterations and damping <= _MAX_DAMPING:
        iteration += 1
        solved, least = system.solve(damping), damping <= _WEAKEST
        gain, predicted, camera_gain, candidate = -1.0, np.inf, np.inf, state
        if solved is not None:
            step, predicted, camera_gain = solved
            candidate = problem.retract(state, step)
            gain = cost - problem.cost(candidate)
        small = camera_gain <= min_camera_gain or predicted <= tolerance * cost
        if gain > 0.0 and np.isfinite(gain):
            state, cost = candidate, cost - gain
            if small and least:
                return Descent(state, cost, iteration, damping, camera_gain)
            damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain / predicted - 1.0) ** 3), _MIN_DAMPING)
            if small and growth == 2.0:
                damping = min(damping, _WEAKEST)
            growth = 2.0
            system = problem.linearize(state)
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


@dataclass(frozen=True)
class DenseProblem(Generic[State]):
    """A problem of functions of its state, with dense normal equations."""

    linearize: Callable[[State], DenseSystem]
    retract: Callable[[State, F64], State]
    cost: Callable[[State], float]


def invert_information(information: F64) -> F64:
    """Invert an information matrix, eigenvalues floored relative to the largest; inf if not finite.

    Undetermined directions get a huge variance; the matrix is scaled to a unit diagonal, so that units do not
    decide which these are.
    """
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


def _difference_jacobian(residual_fn: Callable[[F64], F64], x: F64, residual: F64) -> F64:
    """Return forward differences (M, D), steps sqrt(eps) (1 + |x|); columns outside the domain are 0."""
    J = np.zeros((len(residual), len(x)))
    for d in range(len(x)):
        h = 1.5e-8 * (1.0 + abs(x[d]))
        moved = x.copy()
        moved[d] += h
        column = (residual_fn(moved) - residual) / h
        J[:, d] = np.where(np.isfinite(column), column, 0.0)
    return J


def minimize_residuals(
    residual_fn: Callable[[F64], F64], x0: F64, *, jacobian: Callable[[F64], F64] | None = None,
    loss: Callable[[F64], tuple[F64, F64]] = _squared, max_iterations: int = 50, tolerance: float = 1e-10,
) -> ResidualMinimum:  # fmt: skip
    """Minimise 1/2 sum rho(r_m(x)^2) by dense Levenberg-Marquardt, with forward differences by default.

    States with residuals that are not finite are rejected; such a start is a ``ValueError``.
    """
    if not (np.isfinite(x0).all() and np.isfinite(residual_fn(x0)).all()):
        raise ValueError("minimize_residuals needs a start with finite residuals")

    def linearize(x: F64) -> DenseSystem:
        r = residual_fn(x)
        J = jacobian(x) if jacobian else _difference_jacobian(residual_fn, x, r)
        rho, weight = loss(r**2)
        return DenseSystem(0.5 * float(rho.sum()), (J.T * weight) @ J, J.T @ (weight * r))

    def cost_at(x: F64) -> float:
        r = residual_fn(x)
        return 0.5 * float(loss(r**2)[0].sum()) if np.isfinite(r).all() else np.inf

    problem = DenseProblem(linearize, lambda x, step: x + step, cost_at)
    found = run_levenberg_marquardt(
        problem, x0, max_iterations=max_iterations, tolerance=tolerance, initial_damping=1e-3
    )
    x, cost = found.state, found.cost
    residual = residual_fn(x)
    variance = 2.0 * cost / max(len(residual) - len(x0), 1)
    return ResidualMinimum(x, cost, variance * invert_information(linearize(x).hessian), residual)

"""Robust losses rho(s) of a squared residual s and their weights rho'(s).

The cost of a set of residuals r is 1/2 sum rho(|r|^2). Its gradient is that of a least-squares problem whose
residuals and Jacobians are multiplied by sqrt(rho'), which is how every solver here uses them (reweighting;
the second derivative of rho is left out, so the system stays positive). Each loss behaves as s near 0 and
turns where sqrt(s) = delta.

Levenberg-Marquardt: one damping loop for every problem, and a dense solver for small ones.

The loop knows nothing of the problem's structure. A problem linearises itself at a state, its linear system
answers for a damping, and the problem moves the state; the dense problem below, the sparse bundle problems
and the refinements of one camera differ in these three only. Damping follows Nielsen (IMM-REP-1999-05): it
shrinks smoothly with the quality of the predicted gain and grows ever faster while steps fail.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.numerics.losses import LOSSES, loss_code

State = TypeVar("State")
Step = TypeVar("Step")
StepOut = TypeVar("StepOut", covariant=True)

MIN_DAMPING, MAX_DAMPING = 1e-9, 1e12


class LinearSystem(Protocol[StepOut]):
    """A problem linearised at one state."""

    @property
    def cost(self) -> float:
        """1/2 sum rho at the state."""

    def solve(self, damping: float) -> tuple[StepOut, float] | None:
        """Step and the gain of cost it promises, or None where the damped system is not positive."""


class Problem(Protocol[State, Step]):
    """What the loop asks of a problem; states are never changed in place."""

    def linearize(self, state: State) -> LinearSystem[Step]:
        """The normal equations at ``state``."""

    def retract(self, state: State, step: Step) -> State:
        """``state`` moved by ``step``."""

    def cost(self, state: State) -> float:
        """1/2 sum rho at ``state``; inf or NaN refuses it."""


@dataclass(frozen=True)
class Solution(Generic[State]):
    """Where the loop ended; ``iterations`` counts linear solves, ``cost`` <= ``initial_cost`` always."""

    state: State
    cost: float
    initial_cost: float
    iterations: int
    converged: bool


def run_levenberg_marquardt(
    problem: Problem[State, Step],
    state: State,
    *,
    max_iterations: int,
    tolerance: float = 1e-7,
    initial_damping: float = 1e-4,
) -> Solution[State]:
    """Minimise a problem from ``state``; the cost never rises and nothing is raised for singular systems.

    Converged where the promised or the reached gain is below ``tolerance`` times the cost, or where no
    damping gives a better state (the numerical floor). Damping multiplies the diagonal (Marquardt 1963), so
    the answer does not depend on the units of the parameters, and gauge freedoms need no other care.
    """
    system = problem.linearize(state)
    cost = initial_cost = system.cost
    damping, growth = initial_damping, 2.0
    for iteration in range(1, max_iterations + 1):
        solved = system.solve(damping)
        gain, promised, candidate = -1.0, 1.0, state
        if solved is not None:
            promised = solved[1]
            if promised <= tolerance * 1e-3 * cost:
                return Solution(state, cost, initial_cost, iteration, True)
            candidate = problem.retract(state, solved[0])
            gain = cost - problem.cost(candidate)
        if gain > 0.0 and np.isfinite(gain):
            state, previous = candidate, cost
            damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain / promised - 1.0) ** 3), MIN_DAMPING)
            growth = 2.0
            if gain <= tolerance * previous:
                return Solution(state, cost - gain, initial_cost, iteration, True)
            cost -= gain
            if iteration < max_iterations:
                system = problem.linearize(state)
                cost = system.cost
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > MAX_DAMPING:
                return Solution(state, cost, initial_cost, iteration, True)
    return Solution(state, cost, initial_cost, max_iterations, False)


@dataclass(frozen=True)
class DenseSystem:
    """J'J and J'r of a small problem, residuals and Jacobian already weighted by sqrt(rho')."""

    cost: float
    hessian: F64
    gradient: F64

    def solve(self, damping: float) -> tuple[F64, float] | None:
        """The damped step by Cholesky; parameters without effect (zero diagonal) stay."""
        diagonal = damping * floored_diagonal(np.diag(self.hessian))
        step = solve_positive(self.hessian + np.diag(diagonal), -self.gradient)
        if step is None:
            return None
        return step, 0.5 * float(step @ (diagonal * step - self.gradient))


def floored_diagonal(diagonal: F64) -> F64:
    """Diagonal of J'J kept away from 0, so that the damped matrix is positive."""
    largest = float(diagonal.max(initial=0.0))
    return np.maximum(diagonal, 1e-12 * largest if largest > 0.0 else 1.0)


def solve_positive(A: F64, b: F64) -> F64 | None:
    """x with A x = b for a symmetric positive A (D, D), or None where Cholesky meets a pivot that is not
    positive."""
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        return None
    if len(b) == 0:
        return np.zeros_like(b)
    _, x, info = scipy.linalg.lapack.dposv(A, b, lower=1)
    return None if info != 0 or not np.isfinite(x).all() else np.asarray(x).reshape(b.shape)


def invert_information(information: F64, *, floor: float = 1e-14) -> F64:
    """Covariance of an information matrix (D, D): its inverse, with eigenvalues floored relative to the
    largest.

    Directions that the data do not determine get a huge variance instead of a failure. The matrix is first
    scaled to a unit diagonal, so that units do not decide what counts as undetermined.
    """
    if len(information) == 0:
        return np.zeros_like(information)
    if not np.isfinite(information).all():
        return np.full_like(information, np.inf)
    scale = 1.0 / np.sqrt(floored_diagonal(np.diag(information)))
    values, vectors = np.linalg.eigh(information * scale * scale[:, None])
    inverse = (vectors / np.maximum(values, floor * max(float(values[-1]), 1e-300))) @ vectors.T
    return np.asarray(inverse * scale * scale[:, None])


@dataclass(frozen=True)
class ResidualMinimum:
    """``x`` (D,), ``cost`` 1/2 sum rho, ``covariance`` (D, D) = sigma^2 (J'J)^-1 with sigma^2 = 2 cost / (M -
    D)."""

    x: F64
    cost: float
    initial_cost: float
    covariance: F64
    residual: F64
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _VectorProblem:
    residual_fn: Callable[[F64], F64]
    jacobian: Callable[[F64], F64] | None
    loss: str
    loss_scale: float

    def linearize(self, state: F64) -> DenseSystem:
        r = self.residual_fn(state)
        J = self.jacobian(state) if self.jacobian else _difference_jacobian(self.residual_fn, state, r)
        rho, weight = LOSSES[self.loss](r**2, self.loss_scale)
        return DenseSystem(0.5 * float(rho.sum()), (J.T * weight) @ J, J.T @ (weight * r))

    def retract(self, state: F64, step: F64) -> F64:
        return state + step

    def cost(self, state: F64) -> float:
        r = self.residual_fn(state)
        if not np.isfinite(r).all():
            return np.inf
        return 0.5 * float(LOSSES[self.loss](r**2, self.loss_scale)[0].sum())


def _difference_jacobian(residual_fn: Callable[[F64], F64], x: F64, residual: F64) -> F64:
    """Forward differences (M, D) with steps of sqrt(eps) (1 + |x|); columns that leave the domain are 0."""
    J = np.zeros((len(residual), len(x)))
    for d in range(len(x)):
        h = 1.5e-8 * (1.0 + abs(x[d]))
        moved = x.copy()
        moved[d] += h
        column = (residual_fn(moved) - residual) / h
        J[:, d] = np.where(np.isfinite(column), column, 0.0)
    return J


def minimize_residuals(
    residual_fn: Callable[[F64], F64],
    x0: F64,
    *,
    jacobian: Callable[[F64], F64] | None = None,
    loss: str = "squared",
    loss_scale: float = 1.0,
    max_iterations: int = 50,
    tolerance: float = 1e-10,
) -> ResidualMinimum:
    """Minimise 1/2 sum rho(r_m(x)^2) over x from ``x0`` (D,) by dense Levenberg-Marquardt.

    ``residual_fn`` (D,) -> (M,), ``jacobian`` (D,) -> (M, D) (forward differences where it is None); ``loss``
    with its turning point ``loss_scale`` in units of the residuals. States with residuals that are not finite
    are refused. Raises ``ValueError`` where x0 or its residuals are not finite.
    """
    loss_code(loss, loss_scale)
    x0 = np.array(x0, dtype=np.float64)
    if x0.ndim != 1 or not np.isfinite(x0).all() or not np.isfinite(residual_fn(x0)).all():
        raise ValueError(
            f"minimize_residuals needs a finite vector with finite residuals; got shape {x0.shape}"
        )
    problem = _VectorProblem(residual_fn, jacobian, loss, loss_scale)
    solution = run_levenberg_marquardt(
        problem, x0, max_iterations=max_iterations, tolerance=tolerance, initial_damping=1e-3
    )
    residual = residual_fn(solution.state)
    variance = 2.0 * solution.cost / max(len(residual) - len(x0), 1)
    covariance = variance * invert_information(problem.linearize(solution.state).hessian)
    return ResidualMinimum(
        solution.state,
        solution.cost,
        solution.initial_cost,
        covariance,
        residual,
        solution.iterations,
        solution.converged,
    )

"""The sparse linear system of bundle adjustment: points are eliminated, cameras are solved densely.

[[H, W], [W', V]] (a, b) = -(g, h) with V block-diagonal: (H - W V^-1 W') a = -g + W V^-1 h, then
b = -V^-1 (h + W' a). The reduced matrix is dense over the cameras, which suits a few hundred of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.optimize import kernels
from thesisrecon.optimize.levenberg_marquardt import floored_diagonal, solve_positive

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]


@dataclass(frozen=True)
class Observations:
    """What the photographs show: observation k is point ``point_index[k]`` in view ``view_index[k]`` at
    ``xy[k]`` px; (K,), (K,) and (K, 2) in any order, sorted by point is fastest."""

    view_index: I64
    point_index: I64
    xy: F64


@dataclass(frozen=True)
class SortedObservations:
    """Observations sorted by (point, view), checked; ``order`` (K,) takes the caller's order to this one.

    ``start`` (N + 1,) is where the observations of each point begin.
    """

    view_index: I64
    point_index: I64
    xy: F64
    start: I64
    order: I64

    def unsort(self, values: F64) -> F64:
        """Values per observation (K, ...) in the caller's order."""
        out = np.empty_like(values)
        out[self.order] = values
        return out


def sort_observations(
    view_index: I64, point_index: I64, xy: F64, n_views: int, n_points: int
) -> SortedObservations:
    """Check and sort observations by (point, view); raises ``ValueError`` for wrong shapes, indices or
    NaN."""
    view = np.ascontiguousarray(view_index, dtype=np.int64)
    point = np.ascontiguousarray(point_index, dtype=np.int64)
    xy = np.ascontiguousarray(xy, dtype=np.float64)
    if view.ndim != 1 or view.shape != point.shape or xy.shape != (len(view), 2):
        raise ValueError(
            f"observations need (K,), (K,) and (K, 2) arrays; got {view.shape}, {point.shape} and {xy.shape}"
        )
    if not np.isfinite(xy).all():
        raise ValueError("observations must be finite")
    if len(view) and (view.min() < 0 or view.max() >= n_views or point.min() < 0 or point.max() >= n_points):
        raise ValueError(
            f"observations name views or points beyond the {n_views} views and {n_points} points"
        )
    key = point * max(n_views, 1) + view
    order = np.arange(len(key))
    if np.any(key[1:] < key[:-1]):
        order = np.argsort(key, kind="stable")
        view, point, xy = view[order], point[order], xy[order]
    start = np.zeros(n_points + 1, dtype=np.int64)
    np.cumsum(np.bincount(point, minlength=n_points), out=start[1:])
    return SortedObservations(view, point, xy, start, order)


@dataclass(frozen=True)
class Columns:
    """Where each observation's camera parameters stand among the ``size`` columns of the reduced system.

    ``view`` and ``group`` (K,) first columns, -1 for a fixed view. ``fold`` (size,) takes every column to
    that of the unknown behind it, of which there are ``unknowns``; -1 for one that does not move. None: every
    column is its own unknown.
    """

    view: I64
    group: I64
    size: int
    fold: I64 | None = None
    unknowns: int = 0

    def sum_columns(self, values: F64) -> F64:
        """Values per column (size, ...) added up per unknown."""
        if self.fold is None:
            return values
        out = np.zeros((self.unknowns, *values.shape[1:]))
        np.add.at(out, self.fold[self.fold >= 0], values[self.fold >= 0])
        return out

    def spread_columns(self, values: F64) -> F64:
        """Values per unknown (unknowns,) put to every column."""
        return values if self.fold is None else np.where(self.fold >= 0, values[self.fold], 0.0)


@dataclass(frozen=True)
class Jacobians:
    """Buffers of one linearisation: ``residual`` (K, 2), ``A`` (K, 2, C), ``G`` (K, 2, F), ``B`` (K, 2,
    3)."""

    residual: F64
    A: F64
    G: F64
    B: F64

    @classmethod
    def allocate(cls, n_observations: int, view_width: int, group_width: int) -> Jacobians:
        """Uninitialised buffers for K observations."""
        shapes = [(2,), (2, view_width), (2, group_width), (2, 3)]
        return cls(*(np.empty((n_observations, *shape)) for shape in shapes))


@dataclass(frozen=True)
class BundleStep:
    """Steps of the camera columns (D,) and of the points (N, 3)."""

    cameras: F64
    points: F64


@dataclass(frozen=True)
class BundleSystem:
    """Normal equations of a bundle problem at one state; the Jacobian buffers belong to the latest one."""

    cost: float
    start: I64
    columns: Columns
    jacobians: Jacobians
    H: F64
    g: F64
    V: F64
    h: F64
    prior: tuple[F64, F64] | None

    def diagonal(self) -> F64:
        """(D,) diagonal of the information before elimination."""
        total = self.columns.sum_columns(np.diag(self.H))
        return total if self.prior is None else total + np.diag(self.prior[0])

    def gradient(self) -> F64:
        """(D,) gradient of the cost over the unknowns of the cameras."""
        total = self.columns.sum_columns(self.g)
        return total if self.prior is None else total + self.prior[1]

    def reduce(self, damping: float) -> tuple[F64, F64, F64]:
        """Reduced matrix S (D, D) (upper triangle), right-hand side (D,) and inverse point blocks (N, 3,
        3)."""
        S, rhs = self.H.copy(), -self.g
        inverses = np.zeros_like(self.V)
        J, c = self.jacobians, self.columns
        kernels.eliminate_points(
            self.start, c.view, c.group, J.A, J.G, J.B, self.V, self.h, damping, S, rhs, inverses
        )
        if c.fold is not None:
            S = np.triu(S) + np.triu(S, 1).T
            S, rhs = c.sum_columns(c.sum_columns(S).T), c.sum_columns(rhs)
        if self.prior is not None:
            S, rhs = S + self.prior[0], rhs - self.prior[1]
        S[np.diag_indices_from(S)] += damping * floored_diagonal(self.diagonal())
        return S, rhs, inverses

    def solve(self, damping: float) -> tuple[BundleStep, float] | None:
        """The damped step and its promised gain, or None where the reduced matrix is not positive."""
        S, rhs, inverses = self.reduce(damping)
        # Row-major upper is column-major lower: LAPACK reads the transpose without a copy.
        cameras = solve_positive(S.T, rhs)
        if cameras is None:
            return None
        points = np.empty_like(self.h)
        J, c = self.jacobians, self.columns
        step = c.spread_columns(cameras)
        kernels.substitute_points(self.start, c.view, c.group, J.A, J.G, J.B, inverses, self.h, step, points)
        if not np.isfinite(points).all():
            return None
        damped = damping * float(cameras**2 @ floored_diagonal(self.diagonal()))
        damped += damping * float(np.einsum("na,naa->", points**2, self.V))
        gain = 0.5 * (damped - float(cameras @ self.gradient()) - float(np.vdot(points, self.h)))
        return BundleStep(cameras, points), gain


def assemble_system(
    cost: float, start: I64, columns: Columns, jacobians: Jacobians, *, prior: tuple[F64, F64] | None = None
) -> BundleSystem:
    """Normal equations from weighted Jacobians; ``prior``: information (D, D) and gradient (D,) to be
    added."""
    n_points = len(start) - 1
    H, g = np.zeros((columns.size, columns.size)), np.zeros(columns.size)
    V, h = np.zeros((n_points, 3, 3)), np.zeros((n_points, 3))
    J = jacobians
    kernels.add_normal_blocks(start, columns.view, columns.group, J.A, J.G, J.B, J.residual, H, g, V, h)
    return BundleSystem(cost, start, columns, jacobians, H, g, V, h, prior)

"""The sparse linear system of bundle adjustment: points are eliminated, cameras are solved together.

[[H, W], [W', V]] (a, b) = -(g, h) with V block-diagonal: (H - W V^-1 W') a = -g + W V^-1 h, then b = -V^-1 (h
+ W' a). The reduced matrix has a block for every pair of views that observe a common point, and a border for
common unknowns. Points are eliminated in chunks whose number depends on the problem alone, summed in order:
the same bytes for any number of threads.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.numerics.elimination import (
    BlockIndex,
    PointSums,
    ReducedSums,
    eliminate_points,
    mark_pairs,
    revert_crossing_points,
    substitute_points,
)
from thesisrecon.numerics.levenberg_marquardt import floored_diagonal
from thesisrecon.numerics.observations import Jacobians, Observations, SortedObservations
from thesisrecon.numerics.reduced_solvers import ReducedSolver, ReducedSystem, add_diagonal, choose_solver

Result = TypeVar("Result")

CHUNK = 16384
# Every chunk has its own sums: few chunks if these are large.
MAX_CHUNKS, CHUNK_BYTES = 16, 128e6


@dataclass(frozen=True)
class BundleLayout:
    """Structure of one problem.

    The camera unknowns are ``width`` columns for each view's block, then ``border`` common columns.

    Attributes
    ----------
    observations : SortedObservations, observations
    index : BlockIndex, blocks of the observations
    width, border : int, columns of a block and of the border
    row, column : ndarray (n,) of int, views of each block of the reduced matrix
    chunks : tuple of (int, int), ranges of points
    solver : ReducedSolver, solver of the reduced system
    threads : int, worker threads
    """

    observations: SortedObservations
    index: BlockIndex
    width: int
    border: int
    row: I64
    column: I64
    chunks: tuple[tuple[int, int], ...]
    solver: ReducedSolver
    threads: int

    @property
    def size(self) -> int:
        """Number of camera unknowns D."""
        return len(self.index.pair) * self.width + self.border

    def over_chunks(self, work: Callable[[int, int], Result]) -> list[Result]:
        """Call a function for every range of points.

        Parameters
        ----------
        work : callable, called with the first and last + 1 point

        Returns
        -------
        list, results in the order of the ranges
        """
        if self.threads == 1 or len(self.chunks) == 1:
            return [work(*chunk) for chunk in self.chunks]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(lambda chunk: work(*chunk), self.chunks))

    def over_observations(self, work: Callable[[slice, Observations], Result]) -> list[Result]:
        """Call a function for the observations of every range of points.

        Parameters
        ----------
        work : callable, called with the slice of the observations and the observations

        Returns
        -------
        list, results in the order of the ranges
        """
        start, o = self.observations.start, self.observations
        obs = Observations(o.view_index, o.point_index, o.xy)

        def run(first: int, last: int) -> Result:
            return work(slice(start[first], start[last]), obs.part(start[first], start[last]))

        return self.over_chunks(run)

    def revert_cheirality_violations(self, before: F64, after: F64, X_before: F64, X_after: F64) -> None:
        """Undo the steps of points that cross the focal plane of a view that observes them.

        Parameters
        ----------
        before, after : ndarray (V, 4), third rows of the cameras
        X_before : ndarray (N, 4) or (N, 3), points before the step
        X_after : ndarray (N, 4) or (N, 3), points after the step, changed in place
        """
        start, view = self.observations.start, self.observations.view_index

        def work(first: int, last: int) -> None:
            rows = start[first : last + 1]
            revert_crossing_points(rows, view, before, after, X_before[first:last], X_after[first:last])

        self.over_chunks(work)

    def jacobians(self) -> Jacobians:
        """Allocate the buffers of one linearisation.

        Returns
        -------
        Jacobians, buffers
        """
        return Jacobians.empty(len(self.observations.xy), self.width, self.index.common.shape[1])

    def sums(self) -> ReducedSums:
        """Return a reduced system of zeros.

        Returns
        -------
        ReducedSums, zeros
        """
        C, b, e, D = self.width, len(self.index.pair), self.border, self.size
        shapes = [(len(self.row), C, C), (b, C, e), (e, e), (D,), (D,), (D,)]
        return ReducedSums(*(np.zeros(shape) for shape in shapes))


def build_layout(
    observations: SortedObservations,
    block: I64,
    *,
    width: int,
    common: I64,
    border: int,
    threads: int = 1,
) -> BundleLayout:
    """Find the pairs of views with common points, divide the points into chunks and choose a solver.

    Parameters
    ----------
    observations : SortedObservations, observations
    block : ndarray (V,) of int, block of each view, -1 if it does not move
    width : int, columns of a block
    common : ndarray (V, F) of int, border columns of each view, -1 for none
    border : int, number of border columns
    threads : int, worker threads

    Returns
    -------
    BundleLayout, structure
    """
    o, n = observations, int(block.max(initial=-1)) + 1
    marked = np.eye(n, dtype=bool)
    mark_pairs(o.start, o.view_index, block, marked)
    row, column = (a.astype(np.int64) for a in np.nonzero(marked))
    pair = np.full((n, n), -1, dtype=np.int64)
    pair[row, column] = np.arange(len(row))
    solver = choose_solver(row, column, n, width, border)
    bytes_each = 8.0 * (len(row) * width**2 + n * width * border + border**2)
    most = max(1, min(MAX_CHUNKS, int(CHUNK_BYTES / max(bytes_each, 1.0))))
    count = int(np.clip(len(o.xy) // CHUNK, 1, most))
    bounds = np.searchsorted(o.start, np.linspace(0, len(o.xy), count + 1)[1:-1])
    ends = [0, *bounds.tolist(), len(o.start) - 1]
    chunks = tuple(itertools.pairwise(ends))
    index = BlockIndex(o.start, o.view_index, block, pair, np.ascontiguousarray(common))
    return BundleLayout(o, index, width, border, row, column, chunks, solver, threads)


@dataclass(frozen=True)
class CameraPrior:
    """Gaussian terms between camera columns.

    Attributes
    ----------
    first, second : ndarray (L,) of int
        Columns whose difference is weighted; ``second`` is one of the border, or -1 for a number instead.
    weight : ndarray (L,), weights
    gradient : ndarray (D,), gradient of all terms
    """

    first: I64
    second: I64
    weight: F64
    gradient: F64


@dataclass(frozen=True)
class BundleStep:
    """Steps of the camera columns (D,) and of the points (N, 3)."""

    cameras: F64
    points: F64


@dataclass(frozen=True)
class BundleSystem:
    """A bundle problem linearised at one state; the Jacobian buffers belong to the latest one."""

    cost: float
    layout: BundleLayout
    jacobians: Jacobians
    prior: CameraPrior | None = None

    def reduce(self, damping: float) -> tuple[ReducedSystem, PointSums, F64]:
        """Eliminate the points for a damping.

        Parameters
        ----------
        damping : float, factor of the diagonal

        Returns
        -------
        reduced : ReducedSystem, damped system of the cameras
        points : PointSums, inverses and gradients of the points
        damped : ndarray (D,), values added to the diagonal
        """
        N, layout = len(self.layout.observations.start) - 1, self.layout
        points = PointSums(np.zeros((N, 3, 3)), np.zeros((N, 3)), np.zeros((N, 3)))

        def eliminate(first: int, last: int) -> ReducedSums:
            sums = layout.sums()
            eliminate_points(first, last, damping, self.jacobians, layout.index, sums, points)
            return sums

        total, *rest = layout.over_chunks(eliminate)
        for part in rest:
            for into, values in zip(total, part, strict=True):
                into += values
        if self.prior is not None:
            _add_prior(layout, total, self.prior)
        damped = damping * floored_diagonal(total.diagonal)
        # A column without effect does not move: any positive pivot will do.
        _add_diagonal(layout, total, np.where(total.diagonal == 0.0, 1.0, damped))
        system = ReducedSystem(layout.row, layout.column, total)
        return system, points, damped

    def solve(self, damping: float) -> tuple[BundleStep, float] | None:
        """Solve the damped system.

        Parameters
        ----------
        damping : float, factor of the diagonal

        Returns
        -------
        tuple or None, step and predicted gain of cost; None if the reduced matrix is not positive
        """
        reduced, points, damped = self.reduce(damping)
        cameras = self.layout.solver.solve(reduced)
        if cameras is None:
            return None
        moves = np.zeros_like(points.gradient)

        def substitute(first: int, last: int) -> None:
            substitute_points(first, last, cameras, self.jacobians, self.layout.index, points, moves)

        self.layout.over_chunks(substitute)
        if not np.isfinite(moves).all():
            return None
        stiff = float(damped @ cameras**2) + damping * float(np.vdot(points.diagonal, moves**2))
        slope = float(reduced.sums.gradient @ cameras) + float(np.vdot(points.gradient, moves))
        return BundleStep(cameras, moves), 0.5 * (stiff - slope)


def _add_prior(layout: BundleLayout, total: ReducedSums, prior: CameraPrior) -> None:
    """Add the information and gradient of the prior."""
    first, second, w, edge = prior.first, prior.second, prior.weight, layout.size - layout.border
    total.rhs[:] -= prior.gradient
    total.gradient[:] += prior.gradient
    both = second >= 0
    weight = np.bincount(first, w, minlength=layout.size).astype(np.float64)
    weight += np.bincount(second[both], w[both], minlength=layout.size)
    total.diagonal[:] += weight
    _add_diagonal(layout, total, weight)
    first, second, w = first[both], second[both] - edge, w[both]
    inside = first >= edge
    np.add.at(total.corner, (first[inside] - edge, second[inside]), -w[inside])
    np.add.at(total.corner, (second[inside], first[inside] - edge), -w[inside])
    flat = total.border.reshape(edge, layout.border)
    np.add.at(flat, (first[~inside], second[~inside]), -w[~inside])


def _add_diagonal(layout: BundleLayout, total: ReducedSums, values: F64) -> None:
    """Add values (D,) to the diagonal of the reduced matrix."""
    add_diagonal(total.blocks, layout.index.pair, total.corner, values)

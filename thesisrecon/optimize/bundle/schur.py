"""Schur complement of bundle adjustment: points are eliminated, cameras are solved together.

[[H, W], [W', V]] (a, b) = -(g, h) with V block-diagonal: (H - W V^-1 W') a = -g + W V^-1 h, then b = -V^-1 (h
+ W' a). Points are eliminated in chunks: the sum of their sums loses fewer digits than one long sum.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from thesisrecon._threads import ThreadPool
from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.small_matrices import floored_diagonal
from thesisrecon.optimize.bundle.elimination import (
    BlockIndex,
    PointSums,
    ReducedSums,
    eliminate_points,
    mark_pairs,
    substitute_points,
)
from thesisrecon.optimize.bundle.observations import Jacobians, Observations, SortedObservations
from thesisrecon.optimize.bundle.reduced_solvers import (
    BandedCholesky,
    ReducedSystem,
    add_diagonal,
    choose_solver,
    solve_dense,
)

CHUNK = 4096
# Every chunk has its own sums: few chunks if these are large.
MAX_CHUNKS, CHUNK_BYTES = 16, 128e6

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class BundleLayout:
    """Structure of one problem.

    The camera unknowns are ``width`` columns for each view's block, then ``border`` common columns; ``row``
    and ``column`` (n,) are the views of each block of the reduced matrix, ``chunks`` ranges of points. The
    chunks do not depend on ``threads``, so that sums are the same for any number.
    """

    observations: SortedObservations
    index: BlockIndex
    width: int
    border: int
    row: I64
    column: I64
    chunks: tuple[tuple[int, int], ...]
    solver: BandedCholesky | None
    threads: int = 1

    @property
    def size(self) -> int:
        """Number of camera unknowns D."""
        return len(self.index.pair) * self.width + self.border

    @cached_property
    def _pool(self) -> ThreadPool:
        """Threads that live as long as the problem: an iteration may take less time than their start."""
        return ThreadPool(self.threads)

    def sum_over_observations(self, work: Callable[[slice, Observations], float]) -> float:
        """Return the sum of work(rows, observations) over the observations of every range of points."""
        start, seen = self.observations.start, self.observations.seen

        def of_chunk(n: int) -> float:
            first, last = self.chunks[n]
            rows = slice(start[first], start[last])
            return work(rows, Observations(seen.view_index[rows], seen.point_index[rows], seen.xy[rows]))

        return sum(self.map_chunks(of_chunk))

    def map_chunks(self, work: Callable[[int], Answer]) -> list[Answer]:
        """Return work(n) of every chunk n."""
        chunks = range(len(self.chunks))
        if min(self.threads, len(self.chunks)) == 1:
            return [work(n) for n in chunks]
        return list(self._pool.map(work, chunks))

    def jacobians(self) -> Jacobians:
        """Allocate the buffers of one linearisation."""
        return Jacobians.empty(len(self.observations.seen.xy), self.width, self.index.common.shape[1])

    def sums(self) -> ReducedSums:
        """Return a reduced system of zeros."""
        C, b, e, D = self.width, len(self.index.pair), self.border, self.size
        shapes = [(len(self.row), C, C), (b, C, e), (e, e), (D,), (D,), (D,)]
        return ReducedSums(*(np.zeros(shape) for shape in shapes))


def build_layout(
    observations: SortedObservations, block: I64, *, width: int, common: I64, border: int, threads: int = 1
) -> BundleLayout:
    """Find the pairs of views with common points, divide the points into chunks and choose a solver."""
    seen, start, n = observations.seen, observations.start, int(block.max(initial=-1)) + 1
    marked = np.eye(n, dtype=bool)
    mark_pairs(start, seen.view_index, block, marked)
    row, column = (a.astype(np.int64) for a in np.nonzero(marked))
    pair = np.full((n, n), -1, dtype=np.int64)
    pair[row, column] = np.arange(len(row))
    bytes_each = 8.0 * (len(row) * width**2 + n * width * border + border**2)
    most = max(1, min(MAX_CHUNKS, int(CHUNK_BYTES / max(bytes_each, 1.0))))
    count = int(np.clip(len(seen.xy) // CHUNK, 1, most))
    bounds = np.searchsorted(start, np.linspace(0, len(seen.xy), count + 1)[1:-1])
    chunks = tuple(itertools.pairwise([0, *bounds.tolist(), len(start) - 1]))
    index = BlockIndex(start, seen.view_index, block, pair, np.ascontiguousarray(common))
    solver = choose_solver(row, column, n, width, border)
    return BundleLayout(observations, index, width, border, row, column, chunks, solver, threads)


# Gaussian terms between camera columns: first (L,), second (L,) of the border or -1 for a number instead,
# weight (L,), and the gradient (D,) of all terms.
CameraPrior = tuple[I64, I64, F64, F64]

# Steps of the camera columns (D,) and of the points (N, 3).
BundleStep = tuple[F64, F64]


@dataclass(frozen=True)
class BundleSystem:
    """A bundle problem linearised at one state (6.7; HZ A6.3); Jacobian buffers belong to the latest."""

    cost: float
    layout: BundleLayout
    jacobians: Jacobians
    prior: CameraPrior | None = None

    def reduce(self, damping: float) -> tuple[ReducedSystem, PointSums, F64]:
        """Eliminate the points; return the damped system, sums of the points, and the damping terms (D,)."""
        N, layout = len(self.layout.observations.start) - 1, self.layout
        points = PointSums(np.zeros((N, 3, 3)), np.zeros((N, 3)), np.zeros((N, 3)))

        def eliminate(n: int) -> ReducedSums:
            part = layout.sums()
            eliminate_points(*layout.chunks[n], damping, self.jacobians, layout.index, part, points)
            return part

        total, *others = layout.map_chunks(eliminate)
        for part in others:
            for into, values in zip(total, part, strict=True):
                into += values
        pair = layout.index.pair
        if self.prior is not None:
            _add_prior(pair, total, self.prior)
        damped = damping * floored_diagonal(total.diagonal)
        # A column without effect does not move: any positive pivot will do.
        add_diagonal(total.blocks, pair, total.corner, np.where(total.diagonal == 0.0, 1.0, damped))
        return ReducedSystem(layout.row, layout.column, total), points, damped

    def solve(self, damping: float) -> tuple[BundleStep, float, float] | None:
        """Return the damped step, its predicted gain of cost, and that of the cameras.

        None if the reduced matrix is not positive definite. The gain of the cameras, half their squared
        distance in standard deviations, is the criterion of convergence: points whose observations contradict
        each other move for many iterations without any effect on the cameras.
        """
        reduced, points, damped = self.reduce(damping)
        solver = self.layout.solver
        cameras = solve_dense(reduced) if solver is None else solver.solve(reduced)
        if cameras is None:
            return None
        moves = np.zeros_like(points.gradient)

        def substitute(n: int) -> None:
            index = self.layout.index
            substitute_points(*self.layout.chunks[n], cameras, self.jacobians, index, points, moves)

        self.layout.map_chunks(substitute)
        if not np.isfinite(moves).all():
            return None
        stiff = float(damped @ cameras**2) + damping * float(np.vdot(points.diagonal, moves**2))
        slope = float(reduced.sums.gradient @ cameras) + float(np.vdot(points.gradient, moves))
        gain = 0.5 * (stiff - slope)
        return (cameras, moves), gain, 0.5 * float(reduced.sums.rhs @ cameras) if len(cameras) else gain


def _add_prior(pair: I64, total: ReducedSums, prior: CameraPrior) -> None:
    """Add the information and gradient of the prior."""
    size, border = len(total.rhs), len(total.corner)
    (first, second, w, gradient), edge = prior, size - border
    total.rhs[:] -= gradient
    total.gradient[:] += gradient
    both = second >= 0
    weight = np.bincount(first, w, minlength=size).astype(np.float64)
    weight += np.bincount(second[both], w[both], minlength=size)
    total.diagonal[:] += weight
    add_diagonal(total.blocks, pair, total.corner, weight)
    first, second, w = first[both], second[both] - edge, w[both]
    inside = first >= edge
    np.add.at(total.corner, (first[inside] - edge, second[inside]), -w[inside])
    np.add.at(total.corner, (second[inside], first[inside] - edge), -w[inside])
    np.add.at(total.border.reshape(edge, border), (first[~inside], second[~inside]), -w[~inside])

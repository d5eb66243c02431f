"""Schur complement of bundle adjustment: points are eliminated, cameras are solved together.

[[U, W], [W', V]] (a, b) = (e_a, e_b) with V block-diagonal: (U - W V^-1 W') a = e_a - W V^-1 e_b, then b =
V^-1 (e_b - W' a) (HZ A6.3). Points are eliminated in chunks, whose sums lose fewer digits than a long sum. A
banded Cholesky factor is linear in the views if an order keeps neighbours together (streets). Others of more
than ``MANY_VIEWS`` are solved by conjugate gradients.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeVar

import numpy as np
import scipy

from thesisrecon._numba import ThreadPool
from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.small_matrices import floored_diagonal, solve_positive
from thesisrecon.optimize.bundle import elimination
from thesisrecon.optimize.bundle.projection import Jacobians, Observations, SortedObservations

CHUNK = 4096
MANY_VIEWS = 1000  # views above which a system without a band is solved by conjugate gradients
FORCING = 1e-3
"""Gain of an iteration, times their number, relative to the whole gain at which a step is accurate enough."""
EXACT, MOST = 1e-7, 600
"""That for covariances, and the bound of the iterations."""

Answer = TypeVar("Answer")


def add_diagonal(sums: elimination.ReducedSums, first: I64, values: F64) -> None:
    """Add values (D,) to the diagonal of the reduced matrix; ``first`` (b,) are the blocks on it."""
    (b, C, e), c = sums.border.shape, np.arange(sums.border.shape[1])
    sums.blocks[first[:, None], c, c] += values[: b * C].reshape(b, C)
    sums.corner[np.diag_indices(e)] += values[b * C :]


@dataclass(frozen=True)
class ReducedSystem:
    """Symmetric positive system in blocks of views ``row`` <= ``column`` (n,)."""

    row: I64
    column: I64
    sums: elimination.ReducedSums

    def dense(self) -> F64:
        """Return the upper triangle of the matrix; (D, D)."""
        (b, C, e), edge = self.sums.border.shape, len(self.sums.rhs) - len(self.sums.corner)
        views, S = np.zeros((b, C, b, C)), np.zeros((edge + e, edge + e))
        views[self.row, :, self.column] = self.sums.blocks
        S[:edge, :edge] = views.reshape(edge, edge)
        S[:edge, edge:] = self.sums.border.reshape(edge, e)
        S[edge:, edge:] = self.sums.corner
        return S

    def sparse(self) -> scipy.sparse.csc_matrix:
        """Return the matrix; (D, D)."""
        (b, C, e), blocks = self.sums.border.shape, self.sums.blocks
        rows = np.broadcast_to(C * self.row[:, None, None] + np.arange(C)[:, None], blocks.shape).ravel()
        columns = np.broadcast_to(C * self.column[:, None, None] + np.arange(C), blocks.shape).ravel()
        views = scipy.sparse.coo_matrix((blocks.ravel(), (rows, columns)), (b * C, b * C))
        border = scipy.sparse.csc_matrix(self.sums.border.reshape(b * C, e))
        S = scipy.sparse.triu(scipy.sparse.bmat([[views, border], [None, self.sums.corner]])).tocsc()
        return S + scipy.sparse.triu(S, 1).T


def solve_dense(system: ReducedSystem) -> F64 | None:
    """Return x (D,) by Cholesky, D^3 / 3 operations, or None if the system is not positive."""
    # Row-major upper is column-major lower: LAPACK reads the transpose without a copy.
    return solve_positive(system.dense().T, system.sums.rhs)


@dataclass(frozen=True)
class BandedCholesky:
    """Banded factorisation by LAPACK of the views in the order ``place`` (b,); border by Schur complement."""

    place: I64
    reach: int

    def solve(self, system: ReducedSystem) -> F64 | None:
        """Return x (D,), or None if the system is not positive."""
        s, (b, C, e) = system.sums, system.sums.border.shape
        # band[j, i - j] = S[i, j] in the order of the views.
        band, column = np.zeros((b * C, (self.reach + 1) * C)), np.arange(C)
        i = (C * self.place[system.row])[:, None, None] + column[:, None]
        j = (C * self.place[system.column])[:, None, None] + column
        band[np.minimum(i, j), np.abs(i - j)] = s.blocks
        if not np.isfinite(band).all():
            return None
        factor, info = scipy.linalg.lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        if info != 0:
            return None
        border = s.border.reshape(b * C, e)
        right = np.column_stack([s.rhs[: b * C], border]).reshape(b, C, e + 1)[np.argsort(self.place)]
        solved, _ = scipy.linalg.lapack.dpbtrs(factor, right.reshape(b * C, e + 1), lower=1)
        solved = solved.reshape(b, C, e + 1)[self.place].reshape(b * C, e + 1)
        views, moved = solved[:, 0], solved[:, 1:]
        tail = solve_positive(s.corner - border.T @ moved, s.rhs[b * C :] - border.T @ views)
        if tail is None or not np.isfinite(views).all():
            return None
        return np.concatenate([views - moved @ tail, tail])


def choose_solver(row: I64, column: I64, n_views: int, width: int, border: int) -> BandedCholesky | None:
    """Return the banded solver for blocks of ``width`` and a border, None if dense Cholesky is less work."""
    D = float(n_views * width + border)
    if D <= 600:
        return None
    banded = order_views(row, column, n_views)
    band = float((banded.reach + 1) * width)
    # An operation on narrow bands takes twice the time of one of dense Cholesky.
    return banded if 2.0 * D * band * (band + 4.0 * (border + 1)) < D**3 / 3.0 else None


def order_views(row: I64, column: I64, n_views: int) -> BandedCholesky:
    """Order the views such that neighbours stand close (reverse Cuthill-McKee)."""
    graph = scipy.sparse.coo_array((np.ones(len(row)), (row, column)), shape=(n_views, n_views)).tocsr()
    order = scipy.sparse.csgraph.reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    place = np.empty(n_views, dtype=np.int64)
    place[order] = np.arange(n_views)
    return BandedCholesky(place, int(np.abs(place[row] - place[column]).max(initial=0)))


@dataclass(frozen=True)
class Preconditioner:
    """M^-1 = sum_v S_vv^-1 + W (W' S W)^-1 W' for conjugate gradients: the reduced matrix is not formed.

    Inverse blocks (b, C, C) of single views (Schur-Jacobi; Agarwal, Snavely, Seitz and Szeliski, ECCV 2010)
    reduce noise; clusters of views (``label`` (b,)) that move as one body by ``motions`` W (b, C, m) reduce
    the long waves that those leave. ``factor`` is the Cholesky factor of W' S W; common columns are coarse
    unknowns.
    """

    inverse: F64
    motions: F64
    label: I64
    factor: F64

    def __call__(self, r: F64) -> F64:
        """Return M^-1 r; (D,)."""
        (b, C, m), n = self.motions.shape, int(self.label.max()) + 1
        views, coarse = r[: b * C].reshape(b, C), np.zeros((n, m))
        np.add.at(coarse, self.label, np.einsum("vcm,vc->vm", self.motions, views))
        x = scipy.linalg.cho_solve((self.factor, False), np.append(coarse, r[b * C :]), check_finite=False)
        moved = np.einsum("vcm,vm->vc", self.motions, x[: n * m].reshape(n, m)[self.label])
        return np.append(moved + np.einsum("vab,vb->va", self.inverse, views), x[n * m :])


def conjugate_gradients(
    multiply: Callable[[F64], F64], precondition: Callable[[F64], F64], rhs: F64, *, forcing: float = FORCING
) -> F64:
    """Solve S x = rhs until an iteration gains little (Nash and Sofer 1990); rhs is in the range of S."""
    x, r = np.zeros_like(rhs), rhs.copy()
    z = precondition(r)
    p, product, gained = z, float(r @ z), 0.0
    for i in range(1, MOST + 1):
        q = multiply(p)
        curvature = float(p @ q)
        if not (product > 0.0 and curvature > 0.0):
            break
        step = product / curvature
        x += step * p
        r -= step * q
        gained += step * product
        if i * step * product <= forcing * gained:
            break
        z = precondition(r)
        before, product = product, float(r @ z)
        p = z + (product / before) * p
    return x


@dataclass(frozen=True)
class BundleLayout:
    """Structure of one problem: ``width`` columns for each view's block, then ``border`` common columns.

    ``row`` and ``column`` (n,) are the views of each block of the reduced matrix, ``chunks`` ranges of points
    that do not depend on ``threads``, so that sums are the same for any number. With ``coarse``, the layout
    of clusters of views, the system is solved by conjugate gradients and has only the blocks of single views.
    """

    observations: SortedObservations
    index: elimination.BlockIndex
    width: int
    border: int
    row: I64
    column: I64
    chunks: tuple[tuple[int, int], ...]
    by_view: tuple[elimination.ByView, ...]
    solver: BandedCholesky | None
    threads: int = 1
    coarse: "BundleLayout | None" = None

    @property
    def views(self) -> int:
        """Number of views b, or of clusters, that move."""
        return len(self.index.row) - 1

    @property
    def size(self) -> int:
        """Number of camera unknowns D."""
        return self.views * self.width + self.border

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

    def sums(self) -> elimination.ReducedSums:
        """Return a reduced system of zeros."""
        C, b, e, D = self.width, self.views, self.border, self.size
        shapes = [(len(self.row), C, C), (b, C, e), (e, e), (D,), (D,), (D,)]
        return elimination.ReducedSums(*(np.zeros(shape) for shape in shapes))


def build_layout(
    observations: SortedObservations, block: I64, *, width: int, common: I64, border: int, threads: int = 1,
    clusters: Callable[[], I64] | None = None,
) -> BundleLayout:  # fmt: skip
    """Find the pairs of views with common points, divide the points into chunks and choose a solver.

    ``clusters`` returns the cluster (b,) of every view; without it, conjugate gradients are not used.
    """
    seen, start, n = observations.seen, observations.start, int(block.max(initial=-1)) + 1
    moves = block[seen.view_index] >= 0
    places = seen.point_index[moves], block[seen.view_index[moves]]
    points = scipy.sparse.csr_array((np.ones(len(places[0])), places), (len(start) - 1, n))
    ties = scipy.sparse.triu(points.T @ points + scipy.sparse.eye_array(n), format="csr")
    ties.sort_indices()
    column = ties.indices.astype(np.int64)
    row = np.repeat(np.arange(n), np.diff(ties.indptr))
    solver = choose_solver(row, column, n, width, border)
    coarse = None
    if solver is None and n > MANY_VIEWS and clusters is not None:
        row = column = np.arange(n)
        label = clusters()
        coarse = np.append(label, -1)[block], int(label.max()) + 1
    bytes_each = 8.0 * (len(row) * width**2 + n * width * border + border**2)
    # Every chunk has its own sums: few chunks if these are large.
    most = max(1, min(16, int(128e6 / max(bytes_each, 1.0))))
    count = int(np.clip(len(seen.xy) // CHUNK, 1, most))
    bounds = np.searchsorted(start, np.linspace(0, len(seen.xy), count + 1)[1:-1])
    chunks = tuple(itertools.pairwise([0, *bounds.tolist(), len(start) - 1]))

    def layout(block: I64, row: I64, column: I64, n: int, width: int) -> BundleLayout:
        first = np.searchsorted(row, np.arange(n + 1))
        index = elimination.BlockIndex(
            start, seen.view_index, block, first, column, np.ascontiguousarray(common)
        )
        by_view = tuple(elimination.sort_by_view(*chunk, index) for chunk in chunks)
        return BundleLayout(observations, index, width, border, row, column, chunks, by_view, solver, threads)

    found = layout(block, row, column, n, width)
    if coarse is None:
        return found
    label, m = coarse
    # The clusters of two views of a point stand in any order: blocks of both triangles.
    pairs = np.divmod(np.arange(m * m), m)
    return replace(found, coarse=layout(label, *pairs, m, width + 1))


# Rows, columns and values of the information on the camera columns, of which pairs are in the border, and
# its gradient (D,).
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
    #: (b, width, width + 1) motions of the views with their cluster, if there are any
    motions: F64 | None = None

    def eliminate(self, damping: float) -> tuple[elimination.ReducedSums, elimination.PointSums]:
        """Return the sums, without prior and damping of the cameras, and those of the points."""
        N, layout = len(self.layout.observations.start) - 1, self.layout
        points = elimination.PointSums(np.zeros((N, 3, 3)), np.zeros((N, 3)), np.zeros((N, 3)))

        def eliminate(n: int) -> elimination.ReducedSums:
            part = layout.sums()
            by_view = layout.by_view[n]
            elimination.eliminate_points(
                *layout.chunks[n], damping, self.jacobians, layout.index, by_view, part, points
            )
            return part

        total, *others = layout.map_chunks(eliminate)
        for part in others:
            for into, values in zip(total, part, strict=True):
                into += values
        return total, points

    def reduce(self, damping: float) -> tuple[ReducedSystem, elimination.PointSums, F64]:
        """Eliminate the points; return the damped system, sums of the points, and the damping terms (D,)."""
        (total, points), layout = self.eliminate(damping), self.layout
        first, edge = layout.index.row[:-1], layout.size - layout.border
        if self.prior is not None:
            i, j, w, gradient = self.prior
            total.rhs[:] -= gradient
            total.gradient[:] += gradient
            weight = np.bincount(i[i == j], w[i == j], minlength=layout.size).astype(np.float64)
            total.diagonal[:] += weight
            add_diagonal(total, first, weight)
            inside, off = i >= edge, (i != j) & (j >= edge)
            total.corner[i[off & inside] - edge, j[off & inside] - edge] += w[off & inside]
            border = total.border.reshape(edge, layout.border)
            border[i[off & ~inside], j[off & ~inside] - edge] += w[off & ~inside]
        damped = damping * floored_diagonal(total.diagonal)
        # A column without effect does not move: any positive pivot will do.
        add_diagonal(total, first, np.where(total.diagonal == 0.0, 1.0, damped))
        return ReducedSystem(layout.row, layout.column, total), points, damped

    def solve(self, damping: float) -> tuple[BundleStep, float, float] | None:
        """Return the damped step, its predicted gain of cost, and that of the cameras; None if singular.

        The gain of the cameras is the criterion: points with contradictory observations move for long without
        effect.
        """
        reduced, points, damped = self.reduce(damping)
        solver = self.layout.solver
        if self.layout.coarse is not None:
            solve = self.iterative_solver(damping, reduced, points)
            cameras = None if solve is None else solve(reduced.sums.rhs)
        else:
            cameras = solve_dense(reduced) if solver is None else solver.solve(reduced)
        if cameras is None:
            return None
        moves, _ = self._multiply(cameras, points, product=False)
        if not np.isfinite(moves).all():
            return None
        stiff = float(damped @ cameras**2) + damping * float(np.vdot(points.diagonal, moves**2))
        slope = float(reduced.sums.gradient @ cameras) + float(np.vdot(points.gradient, moves))
        gain = 0.5 * (stiff - slope)
        return (cameras, moves), gain, 0.5 * float(reduced.sums.rhs @ cameras) if len(cameras) else gain

    def _multiply(self, x: F64, points: elimination.PointSums, *, product: bool) -> tuple[F64, F64]:
        """Return the steps of the points for a step of the cameras, and its ``product`` with S."""
        layout, moves = self.layout, np.zeros_like(points.gradient)

        def substitute(n: int) -> F64:
            out = np.zeros(len(x) if product else 0)
            elimination.substitute_points(
                *layout.chunks[n], x, self.jacobians, layout.index, points, moves, out
            )
            return out

        parts = layout.map_chunks(substitute)
        return moves, np.sum(parts, axis=0)

    def iterative_solver(
        self, damping: float, reduced: ReducedSystem, points: elimination.PointSums
    ) -> Callable[..., F64] | None:
        """Return the solver of the damped system, a function of rhs and ``forcing``; None if not positive."""
        layout, coarse, W = self.layout, self.layout.coarse, self.motions
        assert coarse is not None
        assert W is not None
        sums, (b, C, m), n = reduced.sums, W.shape, coarse.views
        added, edge = np.where(sums.diagonal == 0.0, 1.0, damping * floored_diagonal(sums.diagonal)), b * C
        i, j, w, _ = self.prior or (np.zeros(0, int), np.zeros(0, int), np.zeros(0), None)
        known = scipy.sparse.csr_array((w, (i, j)), shape=(len(added),) * 2) + scipy.sparse.diags_array(added)
        diagonal = known.diagonal()[:edge].reshape(b, C)
        label = np.empty(b, dtype=np.int64)
        moves = layout.index.block >= 0
        label[layout.index.block[moves]] = coarse.index.block[moves]
        A = self.jacobians.A @ W[layout.index.block[layout.index.view_index]]
        total, _ = replace(self, layout=coarse, jacobians=self.jacobians._replace(A=A)).eliminate(damping)
        own = np.zeros((n, m, m))
        np.add.at(own, label, np.swapaxes(W, 1, 2) @ (diagonal[:, :, None] * W))
        total.blocks[coarse.row == coarse.column] += own
        total.blocks[coarse.row == coarse.column] *= 0.5
        S = ReducedSystem(coarse.row, coarse.column, total).dense()
        S[: n * m, : n * m] += S[: n * m, : n * m].T.copy()
        S[n * m :, n * m :] += known[edge:, edge:]
        try:
            factor = np.asarray(scipy.linalg.cho_factor(S)[0])
            inverse = np.asarray(np.linalg.inv(sums.blocks), dtype=np.float64)
            precondition = Preconditioner(inverse, W, label, factor)
        except (np.linalg.LinAlgError, ValueError):
            return None
        still = points._replace(gradient=np.zeros_like(points.gradient))

        def multiply(x: F64) -> F64:
            return np.asarray(self._multiply(x, still, product=True)[1] + known @ x)

        return partial(conjugate_gradients, multiply, precondition)

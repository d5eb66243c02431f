"""The distinct unknowns behind a table of intrinsics, their Gaussian prior and their columns in the bundle.

Rows of the table that share a value have the same unknown; the focal length is unknown as log f. The common
mean of a hierarchical prior is an unknown of its own, seen by no image: the prior stays sparse.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.optimize.bundle.projection import FOCAL, POSE_DOF, MetricCameras
from thesisrecon.records import IntrinsicsPrior

NONE = -1
MAX_LOG_STEP = 3.0  # larger steps of log f are rejected anyway; the bound avoids overflow


@dataclass(frozen=True)
class _PriorTerms:
    """Terms w (A x - offset)^2 / 2, each of which binds one value or the difference of two."""

    A: scipy.sparse.csr_array
    offset: F64
    weight: F64

    def cost(self, x: F64) -> float:
        """Return the sum of all terms."""
        return 0.5 * float(self.weight @ (self.A @ x - self.offset) ** 2)

    def gradient(self, x: F64) -> F64:
        """Return the derivative of the cost; (n,)."""
        return np.asarray(self.A.T @ (self.weight * (self.A @ x - self.offset)))

    def information(self) -> scipy.sparse.csr_array:
        """Return the second derivative of the cost; (n, n)."""
        return scipy.sparse.csr_array(self.A.T @ scipy.sparse.diags_array(self.weight) @ self.A)


@dataclass(frozen=True)
class IntrinsicUnknowns:
    """``number`` (G, C) is the unknown of every entry, -1 if it does not move; ``column`` (n,) its intrinsic.

    The first ``n_table`` unknowns are in the table, the rest are means of a hierarchical prior.
    """

    number: I64
    column: I64
    n_table: int
    terms: _PriorTerms

    @property
    def size(self) -> int:
        """Number of unknowns n."""
        return len(self.column)

    def write(self, intrinsics: F64, x: F64) -> F64:
        """Return the table with the unknowns put in."""
        table = intrinsics.copy()
        moves = self.number >= 0
        table[moves] = x[self.number[moves]]
        table[moves[:, FOCAL], FOCAL] = np.exp(table[moves[:, FOCAL], FOCAL])
        return table

    def step(self, x: F64, step: F64) -> F64:
        """Return the moved unknowns; a log focal length moves by ``MAX_LOG_STEP`` at most."""
        limit = np.where(self.column == FOCAL, MAX_LOG_STEP, np.inf)
        return np.asarray(x + np.clip(step, -limit, limit))


def number_unknowns(
    cameras: MetricCameras, used: B8, free: B8, prior: IntrinsicsPrior | None
) -> tuple[IntrinsicUnknowns, F64, F64]:
    """Return the unknowns, their start (n,), and the table (G, C) with known values put in.

    Starts are means of the ``used`` rows (G,) that share a value; ``free`` (C,) intrinsics move.
    """
    table = _log_focal(cameras.intrinsics)
    prior = prior or IntrinsicsPrior.unshared(cameras.intrinsics, np.full_like(table, np.inf))
    number = np.full(table.shape, NONE, dtype=np.int64)
    parts = _Parts([], [], [])
    for c in np.flatnonzero(free):
        value = np.unique(cameras.shared[:, c], return_inverse=True)[1].astype(np.int64)
        table[:, c], number[:, c] = _number_column(int(c), value, (table[:, c], used), prior, parts)
    observed = len(parts.start)
    if prior.spread is not None:
        spread = np.broadcast_to(prior.spread, table.shape)
        for c in np.flatnonzero(free):
            for kind in np.unique(prior.kind[prior.kind >= 0]):
                rows = np.flatnonzero((prior.kind == kind) & used)
                if not len(rows) or not np.isfinite(spread[rows[0], c]):
                    continue
                rows = rows[np.unique(cameras.shared[rows, c], return_index=True)[1]]
                parts.add_hierarchical_prior(
                    int(c), number[rows, c], table[rows, c], float(spread[rows[0], c])
                )
    table[:, FOCAL] = np.exp(table[:, FOCAL])
    table = np.where(np.asarray(free), table, cameras.intrinsics)
    column = np.array(parts.column, dtype=np.int64)
    return IntrinsicUnknowns(number, column, observed, parts.collect()), np.array(parts.start), table


@dataclass(frozen=True)
class _Parts:
    """Unknowns and prior terms while they are collected."""

    column: list[int]
    start: list[float]
    terms: list[tuple[I64, I64, F64, F64]]

    def add_hierarchical_prior(self, c: int, number: I64, at: F64, spread: float) -> None:
        """Add the common mean as an unknown, and a term between it and every distinct value."""
        moves = number >= 0
        if len(number) < 2 or not moves.any():
            return
        mean = len(self.start)
        first, second = np.where(moves, number, mean), np.where(moves, mean, NONE)
        offset, weight = np.where(moves, 0.0, at), np.full(len(number), spread**-2.0)
        self.terms.append((first, second, offset, weight))
        self.column.append(c)
        self.start.append(float(at.mean()))

    def collect(self) -> _PriorTerms:
        """Return all terms in one table."""
        none = (np.zeros(0, dtype=np.int64),) * 2 + (np.zeros(0),) * 2
        first, second, offset, weight = (np.concatenate(a) for a in zip(none, *self.terms, strict=True))
        both = np.flatnonzero(second >= 0)
        rows = np.concatenate([np.arange(len(first)), both])
        signs, columns = np.repeat([1.0, -1.0], [len(first), len(both)]), np.append(first, second[both])
        A = scipy.sparse.csr_array((signs, (rows, columns)), (len(first), len(self.start)))
        return _PriorTerms(A, offset, weight)


def _number_column(
    c: int, value: I64, rows: tuple[F64, B8], prior: IntrinsicsPrior, parts: _Parts
) -> tuple[F64, I64]:
    """Start and unknown of the rows of an intrinsic; equal ``value`` (G,) share the narrowest prior."""
    at, used = rows
    std = prior.std[:, c]
    tightest = np.lexsort((std, value))
    tightest = tightest[np.unique(value[tightest], return_index=True)[1]]
    width, means = std[tightest], _log_focal(prior.mean)[:, c]
    unobserved = np.bincount(value[used], minlength=len(width)) == 0
    counted = used | unobserved[value]
    # The mean of the tightest rows, as a mean of differences: equal rows keep their bytes.
    mean, tight = means[tightest], counted & np.isfinite(std) & (std == width[value])
    off = np.bincount(value[tight], (means - mean[value])[tight], minlength=len(width))
    mean = mean + off / np.maximum(np.bincount(value[tight], minlength=len(width)), 1)
    average = np.bincount(value[counted], at[counted]) / np.bincount(value[counted])
    known, fixed = width == 0.0, unobserved | (width == 0.0)
    own = np.where(fixed, NONE, len(parts.start) + np.cumsum(~fixed) - 1)
    bound = np.isfinite(width) & ~fixed
    none = np.full(np.count_nonzero(bound), NONE)
    parts.terms.append((own[bound], none, mean[bound], width[bound] ** -2.0))
    start = np.where(known, mean, average)
    parts.start.extend(start[~fixed].tolist())
    parts.column.extend([c] * int(np.count_nonzero(~fixed)))
    return start[value], own[value]


def _log_focal(intrinsics: F64) -> F64:
    """Return the table with log f; unknown focal lengths stay NaN."""
    table = np.array(intrinsics, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        table[:, FOCAL] = np.log(table[:, FOCAL])
    return table


@dataclass(frozen=True)
class IntrinsicColumns:
    """Columns of the unknowns in the reduced system.

    ``own`` intrinsics, which no two views share, join the pose in the ``block`` (V,) of a view, others
    (F,) have the columns ``border`` (V, F); both are -1 if fixed. ``pinned`` (V, C) columns do not move;
    ``place`` (n,) is the column of every unknown.
    """

    own: I64
    common: I64
    block: I64
    border: I64
    n_border: int
    pinned: B8
    place: I64


def assign_columns(values: IntrinsicUnknowns, group: I64, free: I64, observed: B8) -> IntrinsicColumns:
    """Distribute the unknowns over blocks and border; ``free`` are the intrinsics that move in some view."""
    number = np.where(observed[:, None], values.number[group], NONE)
    repeated = [len(np.unique(m)) < len(m) for m in (number[number[:, c] >= 0, c] for c in free)]
    own, common = free[np.logical_not(repeated)], free[np.array(repeated, dtype=bool)]
    own_unknowns = number[:, own]
    block = np.where(observed, np.cumsum(observed) - 1, NONE)
    pose = np.zeros((len(group), POSE_DOF), dtype=bool)
    pinned = np.concatenate([pose, own_unknowns < 0], axis=1) & observed[:, None]
    width, n_blocks = POSE_DOF + len(own), int(observed.sum())
    place = np.full(values.size, NONE, dtype=np.int64)
    for c in range(len(own)):
        v = np.flatnonzero(own_unknowns[:, c] >= 0)
        place[own_unknowns[v, c]] = width * block[v] + POSE_DOF + c
    rest = np.flatnonzero(place < 0)
    place[rest] = width * n_blocks + np.arange(len(rest))
    common_unknowns = number[:, common]
    border = np.where(common_unknowns >= 0, np.append(place, NONE)[common_unknowns] - width * n_blocks, NONE)
    return IntrinsicColumns(own, common, block, border, len(rest), pinned, place)

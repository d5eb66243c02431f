"""The distinct unknown values behind a table of intrinsics, and Gaussian knowledge about them.

The unknowns are numbered so that rows of the table that share a value name the same one; the focal is
unknown as log f. Everything that is known of them is a list of terms, w (x_a - x_b - c)^2 / 2, where either
end may be missing. The mean of a population is an unknown like the others, seen by no photograph: with it
the prior stays sparse, and marginalising it is left to the linear algebra.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.metric_cameras import FOCAL, POSE_DOF, MetricCameras

NONE = -1
# exp of more than this is never a focal; the bound only matters for steps that will be refused.
MAX_LOG_STEP = 3.0


@dataclass(frozen=True)
class _PriorTerms:
    """Terms w (x_first - x_second - offset)^2 / 2; ``second`` -1 where a term binds one value to a number."""

    first: I64
    second: I64
    offset: F64
    weight: F64

    def residual(self, x: F64) -> F64:
        """(L,) x_first - x_second - offset."""
        return np.asarray(x[self.first] - np.where(self.second >= 0, x[self.second], 0.0) - self.offset)

    def cost(self, x: F64) -> float:
        """The sum of all terms."""
        return 0.5 * float(self.weight @ self.residual(x) ** 2) if len(self.first) else 0.0

    def gradient(self, x: F64) -> F64:
        """(n,) derivative of the cost."""
        pull = self.weight * self.residual(x) if len(self.first) else np.zeros(0)
        both = self.second >= 0
        g = np.bincount(self.first, pull, minlength=len(x))
        return np.asarray(g - np.bincount(self.second[both], pull[both], minlength=len(x)))

    def information(self, n: int) -> F64:
        """(n, n) second derivative of the cost."""
        Q = np.zeros((n, n))
        a, b, w = self.first, self.second, self.weight
        both = b >= 0
        np.add.at(Q, (a, a), w)
        np.add.at(Q, (b[both], b[both]), w[both])
        np.add.at(Q, (a[both], b[both]), -w[both])
        np.add.at(Q, (b[both], a[both]), -w[both])
        return Q


@dataclass(frozen=True)
class IntrinsicUnknowns:
    """``number`` (G, C) names the unknown of every entry, -1 where it does not move; ``column`` (n,) says
    which intrinsic an unknown is; ``seen`` of the n stand in the table, the rest are means of populations."""

    number: I64
    column: I64
    n_table: int
    terms: _PriorTerms

    @property
    def size(self) -> int:
        """n."""
        return len(self.column)

    def write(self, intrinsics: F64, x: F64) -> F64:
        """The table (G, C) with the unknowns x (n,) put in their places."""
        table = intrinsics.copy()
        moves = self.number >= 0
        table[moves] = x[self.number[moves]]
        table[moves[:, FOCAL], FOCAL] = np.exp(table[moves[:, FOCAL], FOCAL])
        return table

    def step(self, x: F64, step: F64) -> F64:
        """x moved by a step; a log focal never by more than ``MAX_LOG_STEP``."""
        limit = np.where(self.column == FOCAL, MAX_LOG_STEP, np.inf)
        return np.asarray(x + np.clip(step, -limit, limit))


def number_unknowns(
    cameras: MetricCameras, used: B8, free: B8, prior: IntrinsicsPrior | None
) -> tuple[IntrinsicUnknowns, F64, F64]:
    """The unknowns of a problem, where they start (n,), and the table (G, C) with what is known put in.

    ``used`` (G,) rows that a photograph speaks of. A value starts at the mean of the used rows that share it;
    one that no photograph sees is no unknown.
    """
    table = _with_log_focal(cameras.intrinsics)
    nothing = IntrinsicsPrior.unshared(cameras.intrinsics, np.full_like(table, np.inf))
    prior = prior or nothing
    number = np.full(table.shape, NONE, dtype=np.int64)
    parts = _Parts([], [], [])
    names = np.arange(len(table))
    for c in np.flatnonzero(free):
        sharing = names if cameras.shared is None else cameras.shared[:, c]
        value = np.unique(sharing, return_inverse=True)[1].astype(np.int64)
        table[:, c], number[:, c] = _number_column(int(c), value, (table[:, c], used), prior, parts)
    seen = len(parts.start)
    if prior.spread is not None:
        spread = np.broadcast_to(prior.spread, table.shape)
        for c in np.flatnonzero(free):
            for kind in np.unique(prior.kind[prior.kind >= 0]):
                rows = np.flatnonzero((prior.kind == kind) & used)
                if not len(rows) or not np.isfinite(spread[rows[0], c]):
                    continue
                sharing = rows if cameras.shared is None else cameras.shared[rows, c]
                rows = rows[np.unique(sharing, return_index=True)[1]]
                parts.bind_population(int(c), number[rows, c], table[rows, c], float(spread[rows[0], c]))
    table[:, FOCAL] = np.exp(table[:, FOCAL])
    table = np.where(np.asarray(free), table, cameras.intrinsics)
    column = np.array(parts.column, dtype=np.int64)
    return IntrinsicUnknowns(number, column, seen, parts.collect()), np.array(parts.start), table


@dataclass(frozen=True)
class _Parts:
    """Unknowns and terms while they are gathered."""

    column: list[int]
    start: list[float]
    terms: list[tuple[I64, I64, F64, F64]]

    def bind_population(self, c: int, number: I64, at: F64, spread: float) -> None:
        """One more unknown, the population's mean, and a link from every distinct value to it."""
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
        """All terms in one table."""
        none = (np.zeros(0, dtype=np.int64),) * 2 + (np.zeros(0),) * 2
        first, second, offset, weight = (np.concatenate(a) for a in zip(none, *self.terms, strict=True))
        return _PriorTerms(first, second, offset, weight)


def _number_column(
    c: int, value: I64, rows: tuple[F64, B8], prior: IntrinsicsPrior, parts: _Parts
) -> tuple[F64, I64]:
    """Start and unknown of each row for one intrinsic; ``value`` (G,) says which share."""
    at, used = rows
    std = prior.std[:, c]
    tightest = np.lexsort((std, value))
    tightest = tightest[np.unique(value[tightest], return_index=True)[1]]
    width, mean = std[tightest], _with_log_focal(prior.mean)[tightest, c]
    silent = np.bincount(value[used], minlength=len(width)) == 0
    counted = used | silent[value]
    average = np.bincount(value[counted], at[counted]) / np.bincount(value[counted])
    known, still = width == 0.0, silent | (width == 0.0)
    own = np.where(still, NONE, len(parts.start) + np.cumsum(~still) - 1)
    bound = np.isfinite(width) & ~still
    none = np.full(np.count_nonzero(bound), NONE)
    parts.terms.append((own[bound], none, mean[bound], width[bound] ** -2.0))
    start = np.where(known, mean, average)
    parts.start.extend(start[~still].tolist())
    parts.column.extend([c] * int(np.count_nonzero(~still)))
    return start[value], own[value]


def _with_log_focal(intrinsics: F64) -> F64:
    """The table with log f; focals that are not known stay NaN."""
    table = np.array(intrinsics, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        table[:, FOCAL] = np.log(table[:, FOCAL])
    return table


@dataclass(frozen=True)
class IntrinsicColumns:
    """Where the unknowns stand among the columns of the reduced system.

    ``own`` lists the intrinsics that no two views share: they join the poses in the ``block`` (V,) of their
    view, -1 for a view that nothing moves. ``common`` lists the others, in the columns ``border`` (V, F), -1
    for one that does not move, of ``n_border`` in all. ``pinned`` (V, C) marks columns of a block that do not
    move. ``place`` (n,) is the column of every unknown.
    """

    own: I64
    common: I64
    block: I64
    border: I64
    n_border: int
    pinned: B8
    place: I64

    def of(self, number: I64) -> I64:
        """The columns of unknowns of these numbers; -1 for none."""
        return np.append(self.place, NONE)[number]


def assign_columns(
    values: IntrinsicUnknowns, group: I64, free: I64, seen: B8, free_views: B8
) -> IntrinsicColumns:
    """Share the unknowns of the views (``group`` (V,) their rows) out to blocks and border.

    ``free`` lists the intrinsics that move somewhere, ``seen`` and ``free_views`` (V,) mark views with
    observations and those whose pose moves.
    """
    number = np.where(seen[:, None], values.number[group], NONE)
    repeated = [len(np.unique(m)) < len(m) for m in (number[number[:, c] >= 0, c] for c in free)]
    own, common = free[np.logical_not(repeated)], free[np.array(repeated, dtype=bool)]
    mine = number[:, own]
    moves = free_views | (mine >= 0).any(axis=1)
    block = np.where(moves, np.cumsum(moves) - 1, NONE)
    pose = np.repeat(~free_views[:, None], POSE_DOF, axis=1)
    pinned = np.concatenate([pose, mine < 0], axis=1) & moves[:, None]
    width, n_blocks = POSE_DOF + len(own), int(moves.sum())
    place = np.full(values.size, NONE, dtype=np.int64)
    for c in range(len(own)):
        v = np.flatnonzero(mine[:, c] >= 0)
        place[mine[v, c]] = width * block[v] + POSE_DOF + c
    rest = np.flatnonzero(place < 0)
    place[rest] = width * n_blocks + np.arange(len(rest))
    theirs = number[:, common]
    border = np.where(theirs >= 0, np.append(place, NONE)[theirs] - width * n_blocks, NONE)
    return IntrinsicColumns(own, common, block, border, len(rest), pinned, place)

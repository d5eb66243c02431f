"""Analyse the rows of a study: differences from the baseline with intervals, failures, ranks and costs.

Numbers are compared on the rows where both methods succeed. A method that fails on the hard rows would win
there, so that success is compared too, on all rows: a method is better only if it does not fail on more rows
and ranks agree in which a failure is worse than any number.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from thesisrecon.arrays import F64
from validation.ablation.plan import Plan, PlannedRow, Variant
from validation.ablation.run import Row, Rows
from validation.ablation.statistics import (
    MIN_SCENES,
    Interval,
    Sample,
    holm,
    on_front,
    paired_interval,
    sign_test,
    signed_rank_test,
)
from validation.ablation.study import Measure
from validation.runs.tables import number, text_table

Verdict = Literal[
    "better",
    "worse",
    "fails less",
    "fails more",
    "better where both succeed, fails more",
    "worse where both succeed, fails less",
    "negligible",
    "no difference shown",
    "no sample",
]
GOOD: tuple[Verdict, ...] = ("better", "fails less")
BAD: tuple[Verdict, ...] = ("worse", "fails more")
SHOWN = 0.05
"""Largest adjusted p of a difference that is shown."""


@dataclass(frozen=True)
class Comparison:
    """Comparison of a variant with another under one condition, by one measure. ``interval`` holds
    differences variant - other on common rows, with ``ratio`` of the logarithms (:func:`as_reported` returns
    quotients). ``fails`` and ``succeeds`` count the rows on which only the variant or only the other fails;
    ``rank`` is the mean signed rank of all rows, failures last, positive where the variant is worse. ``p`` of
    the numbers, of success and of ranks are adjusted for all comparisons of the measure (Holm); the verdict
    follows from them, "negligible" where the whole interval is, and "no sample" where there is none.
    """

    measure: Measure
    variant: str
    against: str
    condition: str
    interval: Interval
    ratio: bool
    fails: int
    succeeds: int
    rank: float
    p: float
    p_success: float
    p_rank: float
    verdict: Verdict = "no sample"


@dataclass(frozen=True)
class Cell:
    """Summary of a variant under a condition: mean of a measure over common rows, geometric where quotients
    are compared, with its 95 % interval (scenes or draws as the sample; NaN without one); median over its own
    rows; mean rank among the variants, failures last; number of rows and of failures, median cost (s), and
    whether it is Pareto-optimal. A variant that fails on most rows has no common rows and no mean.
    """

    measure: Measure
    variant: str
    condition: str
    mean: float
    low: float
    high: float
    median: float
    rank: float
    rows: int
    failed: int
    cost_s: float
    on_front: bool


class Analysis(NamedTuple):
    """All results of a study. ``steps`` compares each step of a ladder with the one before."""

    plan: Plan
    rows: Rows
    cells: tuple[Cell, ...]
    comparisons: tuple[Comparison, ...]
    steps: tuple[Comparison, ...]
    warnings: tuple[str, ...]

    def __str__(self) -> str:
        return text_of(self)


def analyse(rows: Rows) -> Analysis:
    """Compare all variants with the baseline on the same scene, seed and condition."""
    plan, table = rows.plan, _Table(rows)
    names = [v.name for v in plan.variants]
    others = [(name, plan.baseline) for name in names if name != plan.baseline]
    steps = list(zip(names[1:], names, strict=False)) if plan.study.mode == "ladder" else []
    cells = tuple(cell for m in plan.measures for c in plan.conditions for cell in _cells(table, m, c.name))
    compared, by_step = (
        tuple(c for m in plan.measures for c in _comparisons(table, m, pairs)) for pairs in (others, steps)
    )
    return Analysis(plan, rows, cells, compared, by_step, tuple(_warnings(rows, table)))


def compare_runs(before: Rows, after: Rows) -> Analysis:
    """Compare two runs of a study, such as of two versions of a method: the variants and conditions of the
    study are the conditions, before and after are the variants.
    """
    plan, runs = after.plan, {"before": before, "after": after}
    places = {
        (v.name, c.name): Variant(
            f"{v.name}, {c.name}" if c.name else v.name, {"variant": v.name, **c.levels}, c.changes
        )
        for v in plan.variants
        for c in plan.conditions
    }
    planned, rows = list[PlannedRow](), list[Row]()
    for name, run in runs.items():
        planned += [
            p._replace(variant=name, condition=places[p.variant, p.condition].name) for p in run.plan.rows
        ]
        rows += [replace(r, variant=name, condition=places[r.variant, r.condition].name) for r in run]
    title = replace(plan.study, title=f"{plan.study.title}: before and after", mode="grid")
    compared = plan._replace(
        study=title,
        variants=tuple(Variant(name, {"run": name}, {}) for name in runs),
        conditions=tuple(places.values()),
        baseline="before",
        rows=tuple(planned),
    )
    return analyse(Rows(compared, tuple(rows)))


class _Table:
    """Rows by their place."""

    def __init__(self, rows: Rows) -> None:
        self.plan = rows.plan
        self.scenes = tuple(dict.fromkeys(r.scene for r in rows.plan.rows))
        task = rows.plan.rows[0].setting.task
        self.sample: Sample = task.sample
        scene_of = task.scene_of
        # Rows of one scene and its subsets: all of them, or their means over the seeds.
        self.groups = [
            [n for n, name in enumerate(self.scenes) if scene_of(name) == scene]
            for scene in dict.fromkeys(map(scene_of, self.scenes))
        ]
        self.by_place = {(r.variant, r.condition, r.scene, r.seed): r for r in rows}
        # Seeds have the same measures: a task may read files to answer.
        places = {(p.variant, p.condition, p.scene): p for p in rows.plan.rows}
        self.unavailable = {at: p.setting.task.unavailable(p.scene) for at, p in places.items()}
        self.known = {
            m.name: np.array(
                [r.metrics[m.name] for r in rows if math.isfinite(r.metrics.get(m.name, np.nan))]
            )
            for m in rows.plan.measures
        }
        self.smallest = {
            name: float(min(values[values > 0.0], default=1.0)) for name, values in self.known.items()
        }

    def values(self, measure: Measure, variant: str, condition: str) -> F64:
        """(scenes, seeds): the number, the worst infinity where the row failed, NaN where there is none."""
        found = np.full((len(self.scenes), len(self.plan.seeds)), np.nan)
        worst = np.inf if measure.better == "less" else -np.inf
        for i, j in np.ndindex(found.shape):
            row = self.by_place.get((variant, condition, self.scenes[i], self.plan.seeds[j]))
            if row is not None and self._expected(measure, row):
                found[i, j] = row.metrics.get(measure.name, worst)
        return found

    def _expected(self, measure: Measure, row: Row) -> bool:
        return measure.name not in self.unavailable[row.variant, row.condition, row.scene]

    def scaled(self, measure: Measure, variant: str, condition: str) -> F64:
        """Return :meth:`values`, or their logarithms where quotients are compared. A zero counts as the
        smallest positive number of the study.
        """
        values = self.values(measure, variant, condition)
        if self.by_quotients(measure):
            known = np.isfinite(values)
            values[known] = np.log(np.maximum(values[known], self.smallest[measure.name]))
        return values

    def by_quotients(self, measure: Measure) -> bool:
        """Whether quotients are compared: the measure asks for it, no number is negative, one is positive."""
        known = self.known[measure.name]
        return bool(measure.ratio and len(known) and known.min() >= 0.0 and known.max() > 0.0)

    def grouped(self, difference: F64, known: NDArray[np.bool_]) -> list[F64]:
        """The known differences (scenes, seeds) of each scene: every draw, or a mean for each subset."""
        found = []
        for group in self.groups:
            parts = [difference[n][known[n]] for n in group if known[n].any()]
            if self.sample == "scenes":
                parts = [np.array([part.mean()]) for part in parts]
            found.append(np.concatenate([*parts, np.zeros(0)]))
        return found

    def clusters(self, values: F64, known: NDArray[np.bool_]) -> list[F64]:
        """The known values of each scene, or each one alone where draws are the sample."""
        if self.sample == "draws":
            return [np.array([v]) for v in values[known]]
        found = [np.concatenate([values[n][known[n]] for n in group]) for group in self.groups]
        return [part for part in found if len(part)]

    def rows(self, variant: str, condition: str) -> list[Row]:
        return [r for (v, c, _, _), r in self.by_place.items() if (v, c) == (variant, condition)]


def _comparisons(table: _Table, measure: Measure, pairs: Sequence[tuple[str, str]]) -> list[Comparison]:
    found = [
        _compared(table, measure, variant, other, condition.name)
        for condition in table.plan.conditions
        for variant, other in pairs
    ]
    numbers, success, ranks = (
        holm([getattr(c, name) for c in found]) for name in ("p", "p_success", "p_rank")
    )
    adjusted = (
        replace(c, p=p, p_success=q, p_rank=r)
        for c, p, q, r in zip(found, numbers, success, ranks, strict=True)
    )
    return [replace(c, verdict=_verdict(c)) for c in adjusted]


def _compared(table: _Table, measure: Measure, variant: str, other: str, condition: str) -> Comparison:
    one, two = (table.scaled(measure, name, condition) for name in (variant, other))
    worst = np.inf if measure.better == "less" else -np.inf
    judged = ~np.isnan(one) & ~np.isnan(two)
    both = np.isfinite(one) & np.isfinite(two)
    interval = paired_interval(
        table.grouped(np.where(both, one, 0.0) - np.where(both, two, 0.0), both), table.sample
    )
    failed = (one == worst).astype(float) - (two == worst)
    with np.errstate(invalid="ignore"):
        loss = np.where(one == two, 0.0, one - two) * np.sign(worst)
    rank, p_rank = signed_rank_test(table.clusters(loss, judged))
    p_success = sign_test(np.array([c.mean() for c in table.clusters(failed, judged)]))
    counts = int(np.sum(failed[judged] > 0)), int(np.sum(failed[judged] < 0))
    place, all_p = (measure, variant, other, condition), (interval.p, p_success, p_rank)
    return Comparison(*place, interval, table.by_quotients(measure), *counts, rank, *all_p)


def _verdict(found: Comparison) -> Verdict:
    numbers = _verdict_of_numbers(found)
    if not (found.fails or found.succeeds):
        return numbers
    if found.fails > found.succeeds and numbers == "better":
        return "better where both succeed, fails more"
    if found.fails < found.succeeds and numbers == "worse":
        return "worse where both succeed, fails less"
    # The common rows are chosen by the failures, hence may be the easier ones: ranks of all rows decide.
    if numbers in ("better", "worse"):
        agree = found.p_rank <= SHOWN and (found.rank < 0.0) == (numbers == "better")
        return numbers if agree else "no difference shown"
    if found.p_success <= SHOWN:
        return "fails more" if found.fails > found.succeeds else "fails less"
    return "no difference shown" if numbers == "negligible" else numbers


def _verdict_of_numbers(found: Comparison) -> Verdict:
    """The verdict on common rows."""
    if not np.isfinite(found.p):
        return "no sample"
    if found.ratio and max(abs(found.interval.low), abs(found.interval.high)) <= found.measure.negligible:
        return "negligible"
    if found.p > SHOWN:
        return "no difference shown"
    return "better" if (found.interval.mean < 0.0) == (found.measure.better == "less") else "worse"


def as_reported(found: Comparison) -> tuple[float, float, float]:
    """Return mean, low and high as reported: quotients if the comparison is of quotients."""
    values = (found.interval.mean, found.interval.low, found.interval.high)
    if not found.ratio:
        return values
    # The interval of two differences can overflow.
    mean, low, high = (float(np.exp(np.clip(v, -700.0, 700.0))) for v in values)
    return mean, low, high


def _cells(table: _Table, measure: Measure, condition: str) -> list[Cell]:
    names = [v.name for v in table.plan.variants]
    blocks = np.array([table.scaled(measure, name, condition) for name in names])
    expected = ~np.isnan(blocks).any(axis=0)
    known = np.isfinite(blocks)
    mostly = [2 * (own & expected).sum() >= max(expected.sum(), 1) for own in known]
    common = known[mostly].all(axis=0) & expected
    rows = [table.rows(name, condition) for name in names]
    # The median, because the first rows of a process compile or load kernels.
    cost = np.array([np.median([r.cost_s for r in own]) if own else np.nan for own in rows])
    intervals = [
        paired_interval(table.grouped(block, common), table.sample) if enough else None
        for block, enough in zip(np.where(known, blocks, 0.0), mostly, strict=True)
    ]
    means = np.array([np.nan if i is None else i.mean for i in intervals])
    # A variant that fails on hard rows is not on the front of those that do not.
    whole = (known[:, expected]).sum(axis=1) == known[:, expected].any(axis=0).sum()
    front = on_front(cost, np.where(whole, means if measure.better == "less" else -means, np.nan))
    ranks = _mean_ranks(blocks[:, expected] if measure.better == "less" else -blocks[:, expected])
    scale = np.exp if table.by_quotients(measure) else np.asarray
    found = []
    for k, name in enumerate(names):
        values, interval = table.values(measure, name, condition), intervals[k]
        own, failed = values[np.isfinite(values)], int(np.isinf(values).sum())
        low, high = (np.nan, np.nan) if interval is None else (interval.low, interval.high)
        mean, low, high = (float(scale(v)) for v in (means[k], low, high))
        middle = float(np.median(own)) if len(own) else float("nan")
        counted, at_cost = (len(own), failed), (float(cost[k]), bool(front[k]))
        found.append(Cell(measure, name, condition, mean, low, high, middle, ranks[k], *counted, *at_cost))
    return found


def _mean_ranks(losses: F64) -> list[float]:
    """Mean rank of each method over the columns of losses (methods, rows); 1 is the best, ties share."""
    if not losses.size:
        return [float("nan")] * len(losses)
    return [float(rank) for rank in rankdata(losses, axis=0).mean(axis=1)]


def _warnings(rows: Rows, table: _Table) -> list[str]:
    plan, found = rows.plan, []
    if table.sample == "scenes" and len(table.groups) < MIN_SCENES:
        few = f"fewer than {MIN_SCENES} scenes are no sample"
        found.append(f"no intervals: {few}, and seeds and subsets of a scene add none")
    missing = len(plan.rows) - len(rows)
    if missing:
        found.append(f"{missing} of {len(plan.rows)} rows have not been computed")
    scenes = [f"{r.scene} ({r.condition})" if r.condition else r.scene for r in rows]
    for names in (scenes, [r.variant for r in rows]):
        for where in dict.fromkeys(names):
            here = [r for r, name in zip(rows, names, strict=True) if name == where]
            if all(r.failure for r in here):
                found.append(f"every row of {where} failed: {here[0].failure}")
    for measure in plan.measures:
        known = table.known[measure.name]
        if len(rows) and not len(known):
            found.append(f"no row has the metric {measure.name}")
        if measure.ratio and len(known) and not table.by_quotients(measure):
            found.append(
                f"{measure.name} is compared by differences: it has negative numbers, or zeros alone"
            )
        elif measure.ratio and (zeros := int(np.sum(known == 0.0))):
            smallest = number(table.smallest[measure.name])
            found.append(f"{zeros} zeros of {measure.name} count as its smallest positive number, {smallest}")
    return found


class Curves(NamedTuple):
    """The cells of each variant over the numbers ``x`` of one condition ``axis``, the others fixed."""

    title: str
    axis: str
    x: tuple[float, ...]
    lines: Mapping[str, tuple[Cell, ...]]
    log: bool

    @property
    def wide(self) -> bool:
        """Whether the numbers of the condition want a logarithmic axis."""
        return 0.0 < 20.0 * min(self.x) <= max(self.x)


def curves_of(analysis: Analysis, measure: Measure) -> list[Curves]:
    """Curves over the condition with the most numbers, one set for each combination of the other ones."""
    plan = analysis.plan
    numeric = Counter(
        axis
        for c in plan.conditions
        for axis, value in c.changes.items()
        if axis in c.levels and _is_number(value)
    )
    paths = [axis for axis, count in numeric.items() if count == len(plan.conditions)]
    values = {axis: {c.changes[axis] for c in plan.conditions} for axis in paths}
    axis = max(paths, key=lambda name: len(values[name]), default=None)
    if axis is None or len(values[axis]) < 2:
        return []
    at = {(c.variant, c.condition): c for c in analysis.cells if c.measure == measure}
    groups: dict[tuple[str, ...], list[Variant]] = {}
    for condition in plan.conditions:
        groups.setdefault(tuple(v for k, v in condition.levels.items() if k != axis), []).append(condition)
    found, short = [], axis.rpartition(".")[2]
    for fixed, conditions in groups.items():
        ordered = sorted(conditions, key=lambda c: float(c.changes[axis]))
        lines = {v.name: tuple(at[v.name, c.name] for c in ordered) for v in plan.variants}
        log = measure.ratio and all(not c.mean <= 0.0 for cells in lines.values() for c in cells)
        title = f"{short} ({', '.join(fixed)})" if fixed else short
        found.append(Curves(title, short, tuple(float(c.changes[axis]) for c in ordered), lines, log))
    return found


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def with_unit(text: str, unit: str) -> str:
    return f"{text} ({unit})" if unit else text


# ---------------------------------------------------------------- Markdown


def text_of(analysis: Analysis) -> str:
    """Markdown: a table for each measure, and one of the rows that failed."""
    blocks = [f"warning: {w}" for w in analysis.warnings]
    blocks += [_measure_text(analysis, measure) for measure in analysis.plan.measures]
    failed = failures_of(analysis.rows)
    return "\n\n".join([*blocks, *([text_table(["failed", "scene", "why"], failed)] if failed else [])])


def failures_of(rows: Iterable[Row]) -> list[tuple[str, str, str]]:
    """Variant, scene and reason of failed rows; those alike together, with their number."""
    found = Counter(
        (f"{r.variant} ({r.condition})" if r.condition else r.variant, r.scene, " ".join(r.failure.split()))
        for r in rows
        if r.failure
    )
    return [
        (who, f"{scene} ({count} seeds)" if count > 1 else scene, why)
        for (who, scene, why), count in found.items()
    ]


class Entry(NamedTuple):
    """A cell of a table, and the verdict that it shows."""

    text: str
    verdict: str = ""


class Table(NamedTuple):
    """The head and the rows of a table of results."""

    head: list[str]
    rows: list[list[Entry]]


def measure_tables(analysis: Analysis, measure: Measure) -> list[Table]:
    """Tables of the variants: the mean of each with its 95 % interval and its difference from the baseline
    and, in a ladder, from the step before. Under several conditions the means are a table and the differences
    another.
    """
    plan = analysis.plan
    cells = {(c.variant, c.condition): c for c in analysis.cells if c.measure == measure}
    found, steps = (
        {(c.variant, c.condition): c for c in some if c.measure == measure}
        for some in (analysis.comparisons, analysis.steps)
    )
    several = len(plan.conditions) > 1
    mean = "geometric mean" if any(c.ratio for c in found.values()) else "mean"
    columns = [mean, f"against {plan.baseline}", *(["this step alone"] if steps else [])]
    ranked = any(c.failed for c in cells.values())
    names = [v.name for v in plan.variants]
    heads, rows, long = [c.name for c in plan.conditions] if several else columns, [], []
    for name in names:
        places = [(name, condition.name) for condition in plan.conditions]
        differences = [
            [_difference(some.get(at)) for some in (found, steps)[: 1 + bool(steps)]] for at in places
        ]
        means = [_mean_text(cells[at]) for at in places]
        row = [Entry(f"{name}{' (the baseline)' * (several and name == plan.baseline)}")]
        if several:
            row += [Entry(text, by[0].verdict) for text, by in zip(means, differences, strict=True)]
        else:
            row += [Entry(means[0]), *differences[0]]
        row += [Entry(number(float(np.mean([cells[at].rank for at in places]))))] if ranked else []
        rows.append([*row, Entry(number(sum(cells[at].cost_s / len(places) for at in places)))])
        if name != plan.baseline:
            long += [
                [Entry(name), Entry(c.name), *by] for c, by in zip(plan.conditions, differences, strict=True)
            ]
    last = [*(["rank, failures last"] if ranked else []), "cost, s"]
    tables = [Table([with_unit(measure.name, measure.unit), *heads, *last], rows)]
    return [*tables, Table(["", "condition", *columns[1:]], long)] if several and long else tables


def _measure_text(analysis: Analysis, measure: Measure) -> str:
    """Entries that are shown to be better are bold, worse ones italic."""
    marks: dict[str, str] = {**dict.fromkeys(GOOD, "**"), **dict.fromkeys(BAD, "*")}
    tables = measure_tables(analysis, measure)
    return "\n\n".join(
        text_table(
            t.head, [[f"{m}{e.text}{m}" for e in r for m in [marks.get(e.verdict, "")]] for r in t.rows]
        )
        for t in tables
    )


def _mean_text(cell: Cell) -> str:
    """The mean with its interval, and how many rows failed."""
    between = f" [{number(cell.low)}, {number(cell.high)}]" if cell.high > cell.low else ""
    failed = f" ({cell.failed} of {cell.rows + cell.failed} failed)" if cell.failed else ""
    return f"{number(cell.mean)}{between}{failed}"


def _difference(found: Comparison | None) -> Entry:
    """Return the difference or quotient with its interval, adjusted p and sample, then the failures."""
    if found is None:
        return Entry("")
    parts = []
    if math.isfinite(found.interval.mean):
        mean, low, high = as_reported(found)
        sign = "x " if found.ratio else "+" if mean > 0 else ""
        parts.append(f"{sign}{number(mean)}")
        if math.isfinite(low) and high > low:
            interval = found.interval
            parts[0] += (
                f" [{number(low)}, {number(high)}], p {_p_text(found.p)}, {interval.count} {interval.sample}"
            )
    if found.fails or found.succeeds:
        parts.append(
            f"fails on {found.fails} rows more and {found.succeeds} fewer, p {_p_text(found.p_success)}"
        )
    return Entry("; ".join(parts), found.verdict)


def _p_text(p: float) -> str:
    return "< 1e-4" if p < 1e-4 else f"{p:.2g}"

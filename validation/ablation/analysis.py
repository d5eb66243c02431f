"""Analyse the rows of a study: differences from the baseline with intervals, ranks and costs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from validation.ablation.plan import Plan
from validation.ablation.run import Row, Rows
from validation.ablation.statistics import MIN_SCENES, Interval, Sample, holm, on_front, paired_interval
from validation.ablation.study import Measure
from validation.runs.tables import number, text_table

Verdict = Literal["better", "worse", "negligible", "no difference shown", "no sample"]


@dataclass(frozen=True)
class Comparison:
    """Comparison of a variant with another under one condition, by one measure. ``interval`` holds
    differences variant - other, with ``ratio`` of the logarithms (:func:`as_reported` returns quotients).
    ``p`` is adjusted for all comparisons of the measure (Holm); the verdict follows from it, "negligible"
    where the whole interval is, and "no sample" where there is no interval.
    """

    measure: Measure
    variant: str
    against: str
    condition: str
    interval: Interval
    ratio: bool
    p: float
    verdict: Verdict


@dataclass(frozen=True)
class Cell:
    """Summary of a variant under a condition: mean and median of a measure over the rows that have it, number
    of rows and failures, median cost (s), and whether it is Pareto-optimal.
    """

    measure: Measure
    variant: str
    condition: str
    mean: float
    median: float
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
    cells = tuple(cell for m in plan.measures for cell in _cells(table, m))
    compared, by_step = (
        tuple(c for m in plan.measures for c in _comparisons(table, m, pairs)) for pairs in (others, steps)
    )
    return Analysis(plan, rows, cells, compared, by_step, tuple(_warnings(rows)))


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

    def values(self, measure: Measure, variant: str, condition: str) -> F64:
        """(scenes, seeds), NaN where there is none."""
        found = np.full((len(self.scenes), len(self.plan.seeds)), np.nan)
        for i, j in np.ndindex(found.shape):
            row = self.by_place.get((variant, condition, self.scenes[i], self.plan.seeds[j]))
            found[i, j] = np.nan if row is None else row.metrics.get(measure.name, np.nan)
        return found

    def grouped(self, difference: F64, known: NDArray[np.bool_]) -> list[F64]:
        """The known differences (scenes, seeds) of each scene: every draw, or a mean for each subset."""
        found = []
        for group in self.groups:
            parts = [difference[n][known[n]] for n in group if known[n].any()]
            if self.sample == "scenes":
                parts = [np.array([part.mean()]) for part in parts]
            found.append(np.concatenate([*parts, np.zeros(0)]))
        return found

    def rows(self, variant: str, condition: str) -> list[Row]:
        return [r for (v, c, _, _), r in self.by_place.items() if (v, c) == (variant, condition)]


def _comparisons(table: _Table, measure: Measure, pairs: Sequence[tuple[str, str]]) -> list[Comparison]:
    found = [
        _compared(table, measure, variant, other, condition.name)
        for condition in table.plan.conditions
        for variant, other in pairs
    ]
    adjusted = holm([c.interval.p for c in found])
    return [replace(c, p=p, verdict=_verdict(c, p)) for c, p in zip(found, adjusted, strict=True)]


def _compared(table: _Table, measure: Measure, variant: str, other: str, condition: str) -> Comparison:
    one, two = (table.values(measure, name, condition) for name in (variant, other))
    both = np.isfinite(one) & np.isfinite(two)
    ratio = bool(measure.ratio and both.any() and np.all(one[both] > 0.0) and np.all(two[both] > 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = np.log(one) - np.log(two) if ratio else one - two
    interval = paired_interval(table.grouped(difference, both), table.sample)
    return Comparison(measure, variant, other, condition, interval, ratio, float("nan"), "no sample")


def _verdict(found: Comparison, p: float) -> Verdict:
    if not np.isfinite(p):
        return "no sample"
    if found.ratio and max(abs(found.interval.low), abs(found.interval.high)) <= found.measure.negligible:
        return "negligible"
    if p > 0.05:
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


def _cells(table: _Table, measure: Measure) -> list[Cell]:
    found = []
    names = [v.name for v in table.plan.variants]
    for condition in (c.name for c in table.plan.conditions):
        blocks = [table.values(measure, name, condition).ravel() for name in names]
        known = [values[np.isfinite(values)] for values in blocks]
        rows = [table.rows(name, condition) for name in names]
        # The median, because the first rows of a process compile or load kernels.
        cost = np.array([np.median([r.cost_s for r in own]) if own else np.nan for own in rows])
        means = np.array([np.mean(values) if len(values) else np.nan for values in known])
        # The mean of a variant that fails on hard rows is one of easier rows than the others'.
        whole = np.array([len(values) for values in known]) == np.isfinite(blocks).any(axis=0).sum()
        front = on_front(cost, np.where(whole, means if measure.better == "less" else -means, np.nan))
        for k, name in enumerate(names):
            count, middle = len(known[k]), float(np.median(known[k])) if len(known[k]) else float("nan")
            numbers = (float(means[k]), middle, count, len(rows[k]) - count, float(cost[k]))
            found.append(Cell(measure, name, condition, *numbers, bool(front[k])))
    return found


def _warnings(rows: Rows) -> list[str]:
    plan, found = rows.plan, []
    table = _Table(rows)
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
        if len(rows) and not any(measure.name in r.metrics for r in rows):
            found.append(f"no row has the metric {measure.name}")
    return found


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


def measure_table(analysis: Analysis, measure: Measure) -> tuple[list[str], list[list[Entry]]]:
    """Return the head and a row for each variant. Under one condition: its mean, its difference from the
    baseline and, in a ladder, from the step before. Under several: the means with their verdicts.
    """
    plan = analysis.plan
    cells = {(c.variant, c.condition): c for c in analysis.cells if c.measure == measure}
    found, steps = (
        {(c.variant, c.condition): c for c in some if c.measure == measure}
        for some in (analysis.comparisons, analysis.steps)
    )
    several = len(plan.conditions) > 1
    head = [f"{measure.name}, {measure.unit}" if measure.unit else measure.name]
    head += [c.name for c in plan.conditions] if several else ["mean", f"against {plan.baseline}"]
    head += ["this step alone"] if steps and not several else []
    rows = []
    for name in (v.name for v in plan.variants):
        places = [(name, condition.name) for condition in plan.conditions]
        if several:
            row = [Entry(f"{name}{' (the baseline)' * (name == plan.baseline)}")]
            row += [Entry(_mean_text(cells[at]), found[at].verdict if at in found else "") for at in places]
        else:
            row = [Entry(name), Entry(_mean_text(cells[places[0]])), _difference(found.get(places[0]))]
            row += [_difference(steps.get(places[0]))] if steps else []
        rows.append([*row, Entry(number(sum(cells[at].cost_s / len(places) for at in places)))])
    return [*head, "cost, s"], rows


def _measure_text(analysis: Analysis, measure: Measure) -> str:
    """Significant entries are bold; of means under several conditions the worse ones are italic."""
    worse = "*" if len(analysis.plan.conditions) > 1 else "**"
    head, rows = measure_table(analysis, measure)
    marks = {"better": "**", "worse": worse}
    return text_table(
        head, [[f"{m}{e.text}{m}" for e in r for m in [marks.get(e.verdict, "")]] for r in rows]
    )


def _mean_text(cell: Cell) -> str:
    """The mean, and how many rows failed."""
    failed = f" ({cell.failed} of {cell.rows + cell.failed} failed)" if cell.failed else ""
    return f"{number(cell.mean)}{failed}"


def _difference(found: Comparison | None) -> Entry:
    """Return the difference or quotient with its interval and sample."""
    if found is None or not math.isfinite(found.interval.mean):
        return Entry("")
    mean, low, high = as_reported(found)
    sign = "x " if found.ratio else "+" if mean > 0 else ""
    text = f"{sign}{number(mean)}"
    if math.isfinite(low) and high > low:
        text += f" [{number(low)}, {number(high)}] {found.interval.count} {found.interval.sample}"
    return Entry(text, found.verdict)

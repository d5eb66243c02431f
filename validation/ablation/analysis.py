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
from validation.ablation.statistics import (
    MIN_SCENES,
    Interval,
    Sample,
    holm,
    mean_ranks,
    on_front,
    paired_interval,
)
from validation.ablation.study import Measure
from validation.runs.tables import number, text_table

Verdict = Literal["better", "worse", "negligible", "no difference shown", "no sample"]


@dataclass(frozen=True)
class Comparison:
    """Comparison of a variant with another under one condition, by one measure.

    ``interval`` holds differences variant - other, with ``ratio`` of the logarithms (:func:`as_reported`
    returns quotients). ``p`` is adjusted for all comparisons of the measure (Holm); the verdict follows from
    it, "negligible" where the whole interval is, and "no sample" where there is no interval.
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
    of rows and failures, median cost (s), mean rank (1 is best) and whether it is Pareto-optimal.
    """

    measure: Measure
    variant: str
    condition: str
    mean: float
    median: float
    rows: int
    failed: int
    cost_s: float
    rank: float
    on_front: bool


@dataclass(frozen=True)
class Analysis:
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
    """Compare all variants with the baseline on the same scene, seed and condition, and rank them."""
    plan = rows.plan
    names = [v.name for v in plan.variants]
    others = [(name, plan.baseline) for name in names if name != plan.baseline]
    steps = list(zip(names[1:], names, strict=False)) if plan.study.mode == "ladder" else []
    table = _Table(rows)
    return Analysis(
        plan,
        rows,
        tuple(cell for m in plan.measures for cell in _cells(table, m)),
        tuple(c for m in plan.measures for c in _comparisons(table, m, others)),
        tuple(c for m in plan.measures for c in _comparisons(table, m, steps)),
        tuple(_warnings(rows)),
    )


class _Table:
    """Rows by their place."""

    def __init__(self, rows: Rows) -> None:
        self.plan = rows.plan
        self.scenes = tuple(dict.fromkeys(r.scene for r in rows.plan.rows))
        task = rows.plan.rows[0].setting.task
        self.sample: Sample = getattr(task, "sample", "scenes")
        scene_of = getattr(task, "scene_of", str)
        # Rows of one scene and its subsets: all of them, or their means over the seeds.
        self.groups = [
            [n for n, name in enumerate(self.scenes) if scene_of(name) == scene]
            for scene in dict.fromkeys(map(scene_of, self.scenes))
        ]
        self.by_place = {(r.variant, r.condition, r.scene, r.seed): r for r in rows}

    def value(self, measure: Measure, variant: str, condition: str, scene: str, seed: int) -> float:
        row = self.by_place.get((variant, condition, scene, seed))
        return float("nan") if row is None else row.metrics.get(measure.name, float("nan"))

    def values(self, measure: Measure, variant: str, condition: str) -> F64:
        """(scenes, seeds), NaN where there is none."""
        return np.array(
            [
                [self.value(measure, variant, condition, scene, seed) for seed in self.plan.seeds]
                for scene in self.scenes
            ]
        )

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
        blocks = np.array([table.values(measure, name, condition).ravel() for name in names]).T
        sign = 1.0 if measure.better == "less" else -1.0
        some = blocks[np.isfinite(blocks).any(axis=1)]
        ranks = mean_ranks(sign * some) if len(some) else np.full(len(names), np.nan)
        rows = [table.rows(name, condition) for name in names]
        # The first rows of a process compile or load kernels; exclude them from the cost.
        cost = np.array([float(np.median([r.cost_s for r in own])) if own else np.nan for own in rows])
        # A variant that fails on hard rows is ranked on easier rows than the others.
        whole = np.isfinite(some).all(axis=0)
        known = [column[np.isfinite(column)] for column in blocks.T]
        means = np.array([float(np.mean(values)) if len(values) else np.nan for values in known])
        front = on_front(cost, np.where(whole, sign * means, np.nan))
        for k, name in enumerate(names):
            count = len(known[k])
            middle = float(np.median(known[k])) if count else float("nan")
            numbers = (float(means[k]), middle, count, len(rows[k]) - count, float(cost[k]), float(ranks[k]))
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
    groups: dict[tuple[str, str], list[Row]] = {}
    for name in ("scene", "variant"):
        for r in rows:
            where = f"{r.scene} ({r.condition})" if name == "scene" and r.condition else getattr(r, name)
            groups.setdefault((name, where), []).append(r)
    for (_, where), here in groups.items():
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


class Failure(NamedTuple):
    """A variant that failed on a scene, for one reason."""

    variant: str
    scene: str
    why: str


def failures_of(rows: Iterable[Row]) -> list[Failure]:
    """Failed rows; those of one variant, scene and reason together, with their number."""
    found = Counter(
        (f"{r.variant} ({r.condition})" if r.condition else r.variant, r.scene, " ".join(r.failure.split()))
        for r in rows
        if r.failure
    )
    return [
        Failure(who, f"{scene} ({count} seeds)" if count > 1 else scene, why)
        for (who, scene, why), count in found.items()
    ]


def _measure_text(analysis: Analysis, measure: Measure) -> str:
    """A row for each variant. Under one condition: its mean, its difference from the baseline and, in a
    ladder, from the step before. Under several: the means, bold if significantly better, italic if worse.
    """
    plan = analysis.plan
    cells = {(c.variant, c.condition): c for c in analysis.cells if c.measure == measure}
    found = {(c.variant, c.condition): c for c in analysis.comparisons if c.measure == measure}
    steps = {(c.variant, c.condition): c for c in analysis.steps if c.measure == measure}
    several = len(plan.conditions) > 1
    head = [f"{measure.name}, {measure.unit}" if measure.unit else measure.name]
    head += [c.name for c in plan.conditions] if several else ["mean", f"against {plan.baseline}"]
    head += ["this step alone"] if steps and not several else []
    head.append("cost, s")
    lines = []
    for name in (v.name for v in plan.variants):
        places = [(name, condition.name) for condition in plan.conditions]
        if several:
            entries = [f"{name}{' (the baseline)' * (name == plan.baseline)}"]
            for at in places:
                verdict = found[at].verdict if at in found else ""
                mark = {"better": "**", "worse": "*"}.get(verdict, "")
                entries.append(f"{mark}{mean_text(cells[at])}{mark}")
        else:
            entries = [name, mean_text(cells[places[0]]), comparison_text(found.get(places[0]))]
            entries += [comparison_text(steps.get(places[0]))] if steps else []
        cost = sum(cells[at].cost_s / len(places) for at in places)
        lines.append([*entries, number(cost)])
    return text_table(head, lines)


def mean_text(cell: Cell) -> str:
    """The mean, and how many rows failed."""
    failed = f" ({cell.failed} of {cell.rows + cell.failed} failed)" if cell.failed else ""
    return f"{number(cell.mean)}{failed}"


def comparison_text(found: Comparison | None) -> str:
    """Return the difference or quotient with its interval and sample; bold if significant."""
    if found is None or not math.isfinite(found.interval.mean):
        return ""
    mean, low, high = as_reported(found)
    sign = "x " if found.ratio else "+" if mean > 0 else ""
    text = f"{sign}{number(mean)}"
    if math.isfinite(low) and high > low:
        text += f" [{number(low)}, {number(high)}] {found.interval.count} {found.interval.sample}"
    return f"**{text}**" if found.verdict in ("better", "worse") else text

"""The analysis as Markdown and CSV."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thesisrecon.io._files import write_text
from validation.ablation.analysis import Analysis, Cell, Comparison, as_reported
from validation.ablation.run import Row
from validation.ablation.study import Measure
from validation.runs.tables import number, text_table, write_csv
from validation.stamp import stamp

Record = Mapping[str, Any]


def _row_records(analysis: Analysis) -> list[Record]:
    """One flat table: a row each, with a column for every axis, condition and measure."""
    plan = analysis.plan
    levels = {v.name: v.levels for v in (*plan.variants, *plan.conditions)}
    axes = list(dict.fromkeys(axis for level in levels.values() for axis in level))
    other_names = (name for row in analysis.rows for name in row.metrics)
    names = list(dict.fromkeys([*(m.name for m in plan.measures), *other_names]))
    found: list[Record] = []
    for row in analysis.rows:
        stored = vars(row)
        entries = {**levels[row.variant], **levels[row.condition]}
        found.append(
            {name: stored[name] for name in ("variant", "condition", "scene", "seed")}
            | {f"axis:{axis}": entries.get(axis) for axis in axes}
            | {name: row.metrics.get(name) for name in names}
            | {name: stored[name] for name in ("failure", "seconds", "cost_s", "key")}
        )
    return found


def _comparison_record(c: Comparison) -> Record:
    mean, low, high = as_reported(c)
    return {
        "metric": c.measure.name,
        "unit": c.measure.unit,
        "variant": c.variant,
        "against": c.against,
        "condition": c.condition,
        "of": "quotients" if c.ratio else "differences",
        "mean": mean,
        "low": low,
        "high": high,
        "p": c.interval.p,
        "p_holm": c.p,
        "effect_size": c.interval.effect,
        "pairs": c.interval.pairs,
        "sample": c.interval.sample,
        "sample_size": c.interval.count,
        "verdict": c.verdict,
    }


def _cell_record(c: Cell) -> Record:
    own = {name: value for name, value in vars(c).items() if name != "measure"}
    return {"metric": c.measure.name, "unit": c.measure.unit, **own}


def write_tables(analysis: Analysis, out: Path) -> list[Path]:
    """Write ``rows``, ``comparisons`` and ``means`` as CSV, and the tables for people as ``tables.md``."""
    write_text(out / "tables.md", f"{stamp()}\n\n{text_of(analysis)}\n")
    comparisons = [_comparison_record(c) for c in (*analysis.comparisons, *analysis.steps)]
    tables = {
        "rows": _row_records(analysis),
        "comparisons": comparisons,
        "means": [_cell_record(c) for c in analysis.cells],
    }
    for name, records in tables.items():
        write_csv(out / f"{name}.csv", records)
    return [out / "tables.md", *(out / f"{name}.csv" for name in tables)]


# ---------------------------------------------------------------- Markdown


def text_of(analysis: Analysis) -> str:
    """Markdown: a table for each measure, and one of the rows that failed."""
    blocks = [f"warning: {w}" for w in analysis.warnings]
    blocks += [_measure_text(analysis, measure) for measure in analysis.plan.measures]
    failed = [list(vars(f).values()) for f in failures_of(analysis.rows)]
    return "\n\n".join([*blocks, *([text_table(["failed", "scene", "why"], failed)] if failed else [])])


@dataclass(frozen=True)
class Failure:
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
    ladder, from the step before. Under several: the means, bold if significantly better, italic if worse."""
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

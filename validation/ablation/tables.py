"""Write the tables of an analysis as Markdown and CSV."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from thesisrecon.io._files import write_text
from validation.ablation.analysis import Analysis, Cell, Comparison, as_reported, text_of
from validation.runs.tables import write_csv
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

"""The analysis as text, Markdown, CSV and, where pyarrow is installed, Parquet."""

from __future__ import annotations

import csv
import importlib.util
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from thesisrecon.io._files import write_atomically, write_text
from validation.ablation.analysis import Analysis, Cell, Comparison, as_reported
from validation.ablation.study import Measure

Record = Mapping[str, Any]


def row_records(analysis: Analysis) -> list[Record]:
    """One flat table: a row each, with a column for every axis, condition and measure."""
    plan = analysis.plan
    levels = {v.name: v.levels for v in plan.variants}
    conditions = {c.name: c.levels for c in plan.conditions}
    axes = list(dict.fromkeys(a for v in (*levels.values(), *conditions.values()) for a in v))
    other_names = (name for row in analysis.rows for name in row.metrics)
    names = list(dict.fromkeys([*(m.name for m in plan.measures), *other_names]))
    found: list[Record] = []
    for row in analysis.rows:
        entries = {**levels[row.variant], **conditions[row.condition]}
        found.append(
            {
                "variant": row.variant,
                "condition": row.condition,
                "scene": row.scene,
                "seed": row.seed,
                **{f"axis:{a}": entries.get(a) for a in axes},
                **{name: row.metrics.get(name) for name in names},
                "failure": row.failure,
                "seconds": row.seconds,
                "cost_s": row.cost_s,
                "key": row.key,
            }
        )
    return found


def comparison_records(comparisons: Iterable[Comparison]) -> list[Record]:
    """One row for each comparison."""
    found: list[Record] = []
    for c in comparisons:
        mean, low, high = as_reported(c)
        found.append(
            {
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
                "drawn": c.interval.unit,
                "verdict": c.verdict,
            }
        )
    return found


def cell_records(cells: Iterable[Cell]) -> list[Record]:
    """One row for each variant, condition and measure."""
    return [
        {"metric": c.measure.name, "unit": c.measure.unit}
        | {k: v for k, v in vars(c).items() if k != "measure"}
        for c in cells
    ]


def write_tables(analysis: Analysis, out: Path) -> list[Path]:
    """``rows``, ``comparisons`` and ``means`` as CSV, and as Parquet where pyarrow is installed; the tables
    for people as ``tables.md``."""
    write_text(out / "tables.md", text_of(analysis) + "\n")
    written = [out / "tables.md"]
    for name, records in (
        ("rows", row_records(analysis)),
        ("comparisons", comparison_records((*analysis.comparisons, *analysis.steps))),
        ("means", cell_records(analysis.cells)),
    ):
        written.append(_write_csv(out / f"{name}.csv", records))
        if records and importlib.util.find_spec("pyarrow") is not None:
            written.append(_write_parquet(out / f"{name}.parquet", records))
    return written


def _write_csv(path: Path, records: Sequence[Record]) -> Path:
    sink = io.StringIO(newline="")
    writer = csv.DictWriter(sink, list(records[0]) if records else [])
    writer.writeheader()
    writer.writerows({k: _cell_text(v) for k, v in r.items()} for r in records)
    write_text(path, sink.getvalue())
    return path


def _write_parquet(path: Path, records: Sequence[Record]) -> Path:
    import pyarrow
    import pyarrow.parquet

    columns = {name: [_no_nan(r[name]) for r in records] for name in records[0]}
    sink = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(columns), sink)
    write_atomically(path, sink.getvalue())
    return path


def _cell_text(value: Any) -> Any:
    return "" if _no_nan(value) is None else value


def _no_nan(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


# ---------------------------------------------------------------- Markdown


def text_of(analysis: Analysis) -> str:
    """Markdown: a table for each measure."""
    blocks = [f"warning: {w}" for w in analysis.warnings]
    several = len(analysis.plan.conditions) > 1
    table = over_conditions if several else one_condition
    blocks += [table(analysis, measure) for measure in analysis.plan.measures]
    return "\n\n".join(blocks)


def one_condition(analysis: Analysis, measure: Measure) -> str:
    """A row for each variant: its mean, how it differs from the baseline, in a ladder from the step before,
    and what it costs."""
    plan = analysis.plan
    cells = {c.variant: c for c in analysis.cells if c.measure == measure}
    found = {c.variant: c for c in analysis.comparisons if c.measure == measure}
    steps = {c.variant: c for c in analysis.steps if c.measure == measure}
    head = [_title(measure), "mean", f"against {plan.baseline}"]
    head += ["this step alone", "cost, s"] if steps else ["cost, s"]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for name in (v.name for v in plan.variants):
        entries = [name, mean_text(cells[name]), comparison_text(found.get(name))]
        entries += [comparison_text(steps.get(name))] if steps else []
        lines.append(f"| {' | '.join([*entries, number(cells[name].cost_s)])} |")
    return "\n".join(lines)


def over_conditions(analysis: Analysis, measure: Measure) -> str:
    """Means, a row for each variant and a column for each condition: bold if significantly better than the
    baseline, italic if significantly worse."""
    plan = analysis.plan
    cells = {(c.variant, c.condition): c for c in analysis.cells if c.measure == measure}
    found = {(c.variant, c.condition): c.verdict for c in analysis.comparisons if c.measure == measure}
    marks = {"better": "**", "worse": "*"}
    head = [_title(measure), *(c.name for c in plan.conditions), "cost, s"]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for name in (v.name for v in plan.variants):
        entries, cost = [], 0.0
        for condition in plan.conditions:
            at = (name, condition.name)
            mark = marks.get(found.get(at, ""), "")
            entries.append(f"{mark}{mean_text(cells[at])}{mark}")
            cost += cells[at].cost_s / len(plan.conditions)
        base = " (the baseline)" if name == plan.baseline else ""
        lines.append(f"| {' | '.join([f'{name}{base}', *entries, number(cost)])} |")
    return "\n".join(lines)


def _title(measure: Measure) -> str:
    return f"{measure.name}, {measure.unit}" if measure.unit else measure.name


def mean_text(cell: Cell) -> str:
    """The mean, and how many rows failed."""
    failed = f" ({cell.failed} of {cell.rows + cell.failed} failed)" if cell.failed else ""
    return f"{number(cell.mean)}{failed}"


def comparison_text(found: Comparison | None) -> str:
    """Return the difference or quotient with its interval; bold if significant."""
    if found is None or not math.isfinite(found.interval.mean):
        return ""
    mean, low, high = as_reported(found)
    sign = "x " if found.ratio else "+" if mean > 0 else ""
    text = f"{sign}{number(mean)}"
    if math.isfinite(low) and high > low:
        text += f" [{number(low)}, {number(high)}]"
    return f"**{text}**" if found.verdict in ("better", "worse") else text


def number(value: float | None) -> str:
    """Three significant digits, whole numbers in full, "-" for none."""
    if value is None or math.isnan(value):
        return "-"
    if math.isfinite(value) and float(value).is_integer() and abs(value) < 1e6:
        return f"{int(value)}"
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"

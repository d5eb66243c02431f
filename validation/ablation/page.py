"""HTML page of a study: question, results and uncertainties."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from thesisrecon.io._files import write_text
from thesisrecon.io._outputs import join_claim
from validation.ablation.analysis import (
    BAD,
    GOOD,
    Analysis,
    Cell,
    Comparison,
    Curves,
    Verdict,
    as_reported,
    curves_of,
    failures_of,
    measure_tables,
    text_of,
    with_unit,
)
from validation.ablation.paper import SHADES, write_figures, write_latex
from validation.ablation.study import Measure
from validation.runs.page import plot_at, write_page
from validation.runs.tables import Plot, commit, finite, plot, scatter, slug, stamp, write_csv

PAGE = "index.html"
COLOURS = ("#1f6f8b", "#c8553d", "#5b8e7d", "#8a5a9e", "#d29b2e", "#4a6fa5", "#7a7a3a", "#b05c8a")
LOGARITHMIC = {"type": "log"}
NONE = "#7b8794"
ABOUT = {
    "scenes": "The intervals generalise to similar scenes: the scenes are the sample.",
    "draws": "The intervals apply to these scenes only: the draws of data by the seed are the sample.",
}


def write_analysis(analysis: Analysis, out: str | Path) -> Path:
    """Write ``index.html`` and the tables into ``out`` and return the path of the page."""
    out = Path(out)
    with join_claim(out):
        tables, plan = [*write_tables(analysis, out), write_latex(analysis, out)], analysis.plan
        names = [t.name for t in tables] + ["figures/"] * bool(write_figures(analysis, out))
        write_page(
            out / PAGE,
            Path(__file__).parent / "page.html.j2",
            [_section(analysis, measure) for measure in plan.measures],
            title=plan.study.title,
            words=plan.study.words,
            facts=_facts(analysis),
            findings=_findings(analysis),
            warnings=analysis.warnings,
            failures=failures_of(analysis.rows),
            versions=[("commit", commit()), *plan.versions.items()],
            tables=names,
            good=GOOD,
            bad=BAD,
        )
    return out / PAGE


def _facts(analysis: Analysis) -> list[tuple[str, str]]:
    plan = analysis.plan
    scenes = list(dict.fromkeys(r.scene for r in plan.rows))
    return [
        ("Variants", str(len(plan.variants))),
        ("Conditions", str(len(plan.conditions))),
        ("Scenes", ", ".join(scenes) if len(scenes) <= 4 else str(len(scenes))),
        ("Seeds", str(len(plan.seeds))),
        ("Rows", f"{len(analysis.rows)} of {len(plan.rows)}"),
        ("Failed", str(sum(bool(r.failure) for r in analysis.rows))),
        ("Processor time", f"{sum(r.cost_s for r in analysis.rows):.0f} s"),
    ]


def _findings(analysis: Analysis) -> list[str]:
    """Summarise each measure: variants that differ from the baseline."""
    count, found = len(analysis.plan.conditions), []
    for measure in analysis.plan.measures:
        sentences = []
        for verdict in get_args(Verdict)[:6]:
            where = Counter(
                c.variant for c in analysis.comparisons if (c.measure, c.verdict) == (measure, verdict)
            )
            names = [v if count == 1 else f"{v} (under {n} of {count} conditions)" for v, n in where.items()]
            sentences += [f"{verdict}: {'; '.join(names)}"] if names else []
        summary = ". ".join(sentences) or "no difference from the baseline is shown"
        found.append(f"{measure.name} {summary}.")
    return found


def _section(analysis: Analysis, measure: Measure) -> dict[str, Any]:
    plan, name = analysis.plan, slug(measure.name.lower())
    cells = [c for c in analysis.cells if c.measure == measure]
    comparisons = [c for c in analysis.comparisons if c.measure == measure]
    plots = {
        **{f"over-{n}": _over_conditions(measure, c) for n, c in enumerate(curves_of(analysis, measure))},
        "forest": _forest(measure, comparisons, plan.baseline),
        "cost": _cost(measure, cells),
    }
    drawn = {c.interval.sample for c in comparisons if c.interval.pairs}
    return {
        "id": name,
        "measure": measure,
        "tables": measure_tables(analysis, measure),
        "baseline": plan.baseline,
        "about": " ".join(ABOUT[sample] for sample in sorted(drawn)),
        "plots": [plot_at(f"{name}-{kind}", p) for kind, p in plots.items() if p is not None],
    }


# ---------------------------------------------------------------- plots


def _over_conditions(measure: Measure, curves: Curves) -> Plot:
    """The means with their 95 % intervals, a line for each variant."""
    traces = []
    for k, (name, cells) in enumerate(curves.lines.items()):
        line = {"color": COLOURS[k % len(COLOURS)], "dash": ("solid", "dash", "dot")[k // len(COLOURS) % 3]}
        errors = _errors([(c.mean, c.low, c.high) for c in cells])
        y = [finite(c.mean) for c in cells]
        traces.append(scatter(name, curves.x, y, "lines+markers", line=line, error_y=errors))
    title = f"{measure.name} over {curves.title}"
    layout: dict[str, Any] = {"height": 420, "xaxis": LOGARITHMIC if curves.wide else {}}
    yaxis = LOGARITHMIC if curves.log else {}
    return plot(title, traces, curves.axis, with_unit(measure.name, measure.unit), yaxis=yaxis, **layout)


def _errors(values: Sequence[tuple[float, float, float]]) -> dict[str, Any]:
    """Error bars from (mean, low, high)."""
    return {
        "type": "data",
        "symmetric": False,
        "array": [finite(high - mean) for mean, _, high in values],
        "arrayminus": [finite(mean - low) for mean, low, _ in values],
        "thickness": 1,
    }


def _forest(measure: Measure, comparisons: Sequence[Comparison], baseline: str) -> Plot | None:
    shown = [c for c in comparisons if math.isfinite(c.interval.mean)]
    if not shown or len(shown) > 40:
        return None
    ratio = all(c.ratio for c in shown)
    shown = [c for c in shown if c.ratio == ratio]
    values = [as_reported(c) for c in shown]
    errors = _errors(values) | {"color": "#55636f"}
    marker = {"color": [SHADES.get(c.verdict, NONE) for c in shown], "size": 9}
    whole = [f"{c.variant} ({c.condition})" if c.condition else c.variant for c in shown]
    names = ["<br>".join(textwrap.wrap(name, 24)) for name in whole]
    means = [finite(mean) for mean, _, _ in values]
    trace = scatter("", means, names, error_x=errors, marker=marker, showlegend=False)
    stroke = {"color": "#1b2733", "width": 1}
    line = {"type": "line", "xref": "x", "yref": "paper", "y0": 0, "y1": 1, "line": stroke}
    x = f"times {baseline}" if ratio else with_unit(f"difference from {baseline}", measure.unit)
    layout: dict[str, Any] = {
        "xaxis": LOGARITHMIC if ratio else {"zeroline": False},
        "yaxis": {"autorange": "reversed", "automargin": True},
        "shapes": [line | {"x0": int(ratio), "x1": int(ratio)}],
        "height": 140 + 14 * sum(2 + name.count("<br>") for name in names),
    }
    return plot(f"{measure.name} against {baseline}", [trace], x, "", **layout)


def _cost(measure: Measure, cells: Sequence[Cell]) -> Plot | None:
    if len({c.variant for c in cells}) < 2 or len({c.condition for c in cells}) > 1:
        return None
    known = [c for c in cells if math.isfinite(c.mean) and math.isfinite(c.cost_s)]
    front = sorted((c for c in known if c.on_front), key=lambda c: c.cost_s)
    dots, hidden = {"color": "#9fabb5", "dash": "dot"}, {"hoverinfo": "skip", "showlegend": False}
    traces = [scatter("", [c.cost_s for c in front], [c.mean for c in front], "lines", line=dots, **hidden)]
    for k, c in enumerate(known):
        symbol = "circle" if c.on_front else "circle-open"
        marker = {"size": 11, "color": COLOURS[k % len(COLOURS)], "symbol": symbol}
        traces.append(scatter(c.variant, [c.cost_s], [c.mean], marker=marker))
    layout: dict[str, Any] = {
        "xaxis": {"rangemode": "tozero"},
        "yaxis": LOGARITHMIC if measure.ratio and all(c.mean > 0 for c in known) else {},
        "height": 420 + 10 * len(known),
    }
    caption = "Filled: Pareto-optimal (no variant is both better and cheaper)."
    title, x = f"{measure.name} against cost", "processor time of a row (s)"
    return plot(title, traces, x, with_unit(measure.name, measure.unit), caption, **layout)


# ---------------------------------------------------------------- tables


def _row_records(analysis: Analysis) -> list[Mapping[str, Any]]:
    """One flat table: a row each, with a column for every axis, condition and measure."""
    plan = analysis.plan
    levels = {v.name: v.levels for v in (*plan.variants, *plan.conditions)}
    axes = list(dict.fromkeys(axis for level in levels.values() for axis in level))
    names = list(
        dict.fromkeys([*(m.name for m in plan.measures), *(n for r in analysis.rows for n in r.metrics)])
    )
    found: list[Mapping[str, Any]] = []
    for row in analysis.rows:
        stored, entries = vars(row), {**levels[row.variant], **levels[row.condition]}
        found.append(
            {name: stored[name] for name in ("variant", "condition", "scene", "seed")}
            | {f"axis:{axis}": entries.get(axis) for axis in axes}
            | {name: row.metrics.get(name) for name in names}
            | {name: stored[name] for name in ("failure", "seconds", "cost_s", "key")}
        )
    return found


def _comparison_record(c: Comparison) -> Mapping[str, Any]:
    mean, low, high = as_reported(c)
    head = {"metric": c.measure.name, "unit": c.measure.unit, "variant": c.variant, "against": c.against}
    head |= {"condition": c.condition, "of": "quotients" if c.ratio else "differences"}
    reported = {"mean": mean, "low": low, "high": high, "p_holm": c.p, "verdict": c.verdict}
    return {**head, **vars(c.interval), **reported}


def write_tables(analysis: Analysis, out: Path) -> list[Path]:
    """Write ``rows``, ``comparisons`` and ``means`` as CSV, and the tables for people as ``tables.md``."""
    write_text(out / "tables.md", f"{stamp()}\n\n{text_of(analysis)}\n")
    tables: dict[str, list[Mapping[str, Any]]] = {
        "rows": _row_records(analysis),
        "comparisons": [_comparison_record(c) for c in (*analysis.comparisons, *analysis.steps)],
        "means": [{**vars(c), "measure": c.measure.name, "unit": c.measure.unit} for c in analysis.cells],
    }
    for name, records in tables.items():
        write_csv(out / f"{name}.csv", records)
    return [out / "tables.md", *(out / f"{name}.csv" for name in tables)]

"""Tables and figures of a study for a paper: LaTeX with booktabs; PDF and SVG as wide as a column."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thesisrecon.io._files import write_text
from validation.ablation.analysis import (
    BAD,
    GOOD,
    Analysis,
    Comparison,
    Curves,
    Table,
    as_reported,
    curves_of,
    measure_tables,
    with_unit,
)
from validation.ablation.study import Measure
from validation.runs.tables import slug, stamp

COLUMN_IN = 3.35
STYLE: dict[Any, Any] = {
    "font.size": 7,
    "axes.labelsize": 7,
    "legend.fontsize": 6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.0,
    "lines.markersize": 3,
    "svg.hashsalt": "thesisrecon",
    "pdf.fonttype": 42,
}
SHADES = {**dict.fromkeys(GOOD, "#2e7d4f"), **dict.fromkeys(BAD, "#b3372b")}
SPECIAL = {c: rf"\{c}" for c in "&%$#_{}"} | {
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
    "<": "$<$",
    ">": "$>$",
    "×": r"$\times$",
}


def latex(text: str) -> str:
    """Return text with the special characters of LaTeX escaped."""
    return re.sub(r"\bx (?=[0-9])", r"$\\times$ ", "".join(SPECIAL.get(c, c) for c in text))


def write_latex(analysis: Analysis, out: Path) -> Path:
    """Write ``tables.tex``, a table for each measure."""
    parts = [f"% {stamp()}", r"% \usepackage{booktabs}"]
    for measure in analysis.plan.measures:
        caption = latex(": ".join(filter(None, (measure.name, measure.definition))))
        label = slug(measure.name.lower())
        for n, table in enumerate(measure_tables(analysis, measure)):
            words = f"{caption}, against {latex(analysis.plan.baseline)}" if n else caption
            if any(entry.verdict in (*GOOD, *BAD) for entries in table.rows for entry in entries):
                words += f". Bold: better than {latex(analysis.plan.baseline)}; italic: worse"
            parts += _tabular(table, words, f"{label}-{n}" if n else label)
    write_text(out / "tables.tex", "\n".join(parts) + "\n")
    return out / "tables.tex"


def _tabular(table: Table, caption: str, label: str) -> list[str]:
    rows = [[_marked(latex(entry.text), entry.verdict) for entry in row] for row in table.rows]
    return [
        r"\begin{table}",
        rf"\caption{{{caption}.}}",
        rf"\label{{tab:{label}}}",
        rf"\begin{{tabular}}{{l{'r' * (len(table.head) - 1)}}}",
        r"\toprule",
        " & ".join(map(latex, table.head)) + r" \\",
        r"\midrule",
        *(" & ".join(cells) + r" \\" for cells in rows),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]


def _marked(text: str, verdict: str) -> str:
    command = "textbf" if verdict in GOOD else "textit" if verdict in BAD else ""
    return rf"\{command}{{{text}}}" if command and text else text


def write_figures(analysis: Analysis, out: Path) -> list[Path]:
    """Write ``figures/*.pdf`` and ``*.svg``: differences from the baseline, and curves over conditions. Needs
    matplotlib; without it nothing is written.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError:
        return []
    folder, found = out / "figures", []
    folder.mkdir(exist_ok=True)
    with mpl.rc_context(STYLE):
        for measure in analysis.plan.measures:
            figures: dict[str, Any] = {}
            comparisons = [c for c in analysis.comparisons if c.measure == measure]
            if any(math.isfinite(c.interval.mean) for c in comparisons):
                figures["differences"] = _differences(Figure, measure, comparisons, analysis.plan.baseline)
            for curves in curves_of(analysis, measure):
                if not any(math.isfinite(c.mean) for cells in curves.lines.values() for c in cells):
                    continue
                figures[slug(f"over {curves.title}")] = _curves(Figure, measure, curves)
            for name, figure in figures.items():
                for kind in ("pdf", "svg"):
                    path = folder / f"{slug(measure.name.lower())}-{name}.{kind}"
                    date = {"CreationDate": None} if kind == "pdf" else {"Date": None}
                    figure.savefig(path, metadata=date)
                    found.append(path)
    return found


def _differences(make: Any, measure: Measure, comparisons: Sequence[Comparison], baseline: str) -> Any:
    """Points with 95 % intervals, a line for no difference."""
    shown = [c for c in comparisons if math.isfinite(c.interval.mean)]
    figure = make(figsize=(COLUMN_IN, 0.55 + 0.16 * len(shown)), layout="constrained")
    axes, ratio = figure.subplots(), shown[0].ratio
    for place, c in enumerate(shown):
        mean, low, high = as_reported(c)
        colour = SHADES.get(c.verdict, "#55636f")
        if math.isfinite(low):
            axes.plot([low, high], [place, place], color=colour)
        axes.plot([mean], [place], "o", color=colour)
    axes.axvline(1.0 if ratio else 0.0, color="#1b2733", linewidth=0.6)
    names = [f"{c.variant} ({c.condition})" if c.condition else c.variant for c in shown]
    axes.set_yticks(range(len(shown)), names)
    axes.set_ylim(len(shown) - 0.5, -0.5)
    if ratio:
        axes.set_xscale("log")
    what = f"times {baseline}" if ratio else f"difference from {baseline}"
    axes.set_xlabel(with_unit(f"{measure.name}, {what}", "" if ratio else measure.unit))
    return figure


def _curves(make: Any, measure: Measure, curves: Curves) -> Any:
    figure = make(figsize=(COLUMN_IN, 0.75 * COLUMN_IN), layout="constrained")
    axes = figure.subplots()
    for k, (name, cells) in enumerate(curves.lines.items()):
        known = [(x, c) for x, c in zip(curves.x, cells, strict=True) if math.isfinite(c.mean)]
        if not known:
            continue
        x, y = [at for at, _ in known], [c.mean for _, c in known]
        style = ("-", "--", ":")[k // 8 % 3]
        spread = [
            [max(c.mean - c.low, 0.0) if math.isfinite(c.low) else 0.0 for _, c in known],
            [max(c.high - c.mean, 0.0) if math.isfinite(c.high) else 0.0 for _, c in known],
        ]
        axes.errorbar(x, y, spread, fmt="o", linestyle=style, label=name, color=f"C{k % 8}", capsize=1.5)
    if curves.log:
        axes.set_yscale("log")
    if curves.wide:
        axes.set_xscale("log")
    axes.set_xlabel(curves.axis)
    axes.set_ylabel(with_unit(measure.name, measure.unit))
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure

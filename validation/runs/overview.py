"""The first screen of a report: ours over the best reference, and what changed since the last run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from thesisrecon.errors import counted
from validation.runs.records import scatter
from validation.runs.results import Results, Row
from validation.runs.tables import number

ROW_PX, FRAME_PX = 17, 90
BETTER, WORSE = "#2166ac", "#c2571a"
DEFINITION = (
    "Each dot is a number of ours over that of the best reference, inverted where more is better: left of "
    "the line we are better. Diamonds are geometric means of a stage on a scene; the worst are on top."
)


def cost_ratio(row: Row) -> float | None:
    """Return ours over the best reference, inverted where more is better; None where neither side is."""
    best = _best_reference(row)
    if row.value is None or best is None:
        return None
    over, under = (best, row.value) if row.direction == "at least" else (row.value, best)
    return over / under if over > 0.0 and under > 0.0 else None


def _best_reference(row: Row) -> float | None:
    others = [v for name, v in row.reference.items() if v is not None and not name.startswith("ours")]
    if not others or not row.ranked:
        return None
    return max(others) if row.direction == "at least" else min(others)


def overview(results: Results, earlier: Results | None) -> dict[str, Any]:
    """Return the first section of the report."""
    ratios = dict[str, list[tuple[float, str]]]()
    for row in results.rows:
        where, name = row.key.rsplit("/", 1)
        if (ratio := cost_ratio(row)) is not None:
            ratios.setdefault(where, []).append((ratio, name))
    means = {key: float(np.exp(np.mean(np.log([r for r, _ in found])))) for key, found in ratios.items()}
    # Plotly draws the first row at the bottom.
    order = sorted(means, key=lambda key: (means[key], key))
    dots = [(key, ratio, name) for key in order for ratio, name in ratios[key]]
    mean_dots = [(key, means[key], "geometric mean") for key in order]
    plots = []
    if order:
        traces = [_trace(dots, 6, "circle", 0.45), _trace(mean_dots, 10, "diamond", 1.0)]
        figure = {"data": traces, "layout": _layout(len(order))}
        plots.append(
            {"id": "plot-overview", "title": "Worst first", "figure": figure, "caption": "", "solid": False}
        )
    better = sum(mean < 1.0 for mean in means.values())
    where = f"{better} of {len(means)} combinations of stage and scene"
    notes = [f"In {where} we are better than the best reference (geometric mean)."]
    lacking = sum(row.value is None and _best_reference(row) is not None for row in results.rows)
    if lacking:
        notes.append(f"{counted(lacking, 'number')} of a reference without one of ours: not in the plot.")
    return {
        "id": "overview",
        "title": "Ours over the best reference",
        "definition": DEFINITION,
        "rows": [],
        "references": [],
        "plots": plots,
        "pictures": (),
        "notes": [*notes, *changes(results, earlier)],
    }


def changes(results: Results, earlier: Results | None) -> list[str]:
    """Sentences on the limits that broke or were reached again since an earlier run."""
    if earlier is None:
        return ["There is no earlier run in this folder to compare with."]
    before = {row.key: row for row in earlier.rows}
    both = [(row, before[row.key]) for row in results.rows if row.limit is not None and row.key in before]
    sentences = []
    for change, now in (("Broken since the last run", "missed"), ("Reached again", "reached")):
        changed = [(row, old) for row, old in both if row.verdict == now != old.verdict != "reported"]
        sentences += [
            f"{change}: {row.key}, {number(old.value)} before, {number(row.value)} now."
            for row, old in changed
        ]
    return sentences or [f"No limit of {len(both)} changed its verdict since the last run."]


def _trace(dots: Sequence[tuple[str, float, str]], size: int, symbol: str, opacity: float) -> dict[str, Any]:
    colours = [BETTER if ratio <= 1.0 else WORSE for _, ratio, _ in dots]
    marker = {"size": size, "symbol": symbol, "opacity": opacity, "color": colours}
    text = [f"{name}: {number(ratio)}" for _, ratio, name in dots]
    x, y = [ratio for _, ratio, _ in dots], [label for label, _, _ in dots]
    return scatter("", x, y, text=text, hoverinfo="text+y", showlegend=False, marker=marker)


def _layout(rows: int) -> dict[str, Any]:
    stroke = {"color": "#444", "width": 1}
    line = {"type": "line", "x0": 1, "x1": 1, "y0": 0, "y1": 1, "yref": "paper", "line": stroke}
    y = {"automargin": True, "tickfont": {"size": 10}, "gridcolor": "#f0f3f5", "dtick": 1}
    return {
        "height": ROW_PX * rows + FRAME_PX,
        "margin": {"l": 10, "r": 10, "t": 30, "b": 40},
        "xaxis": {"type": "log", "side": "top", "dtick": 1, "gridcolor": "#e3e8ec"},
        "yaxis": y | {"range": [-1, rows]},
        "shapes": [line],
    }

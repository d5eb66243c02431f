"""Rows, saved arrays and plots, as every stage makes them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from validation.runs.records import Outcome, Plot
from validation.runs.tables import Metric

Result = TypeVar("Result")
Values = dict[str, float | None]
OURS = "ours"


def row(
    scene: str,
    name: str,
    unit: str,
    values: Mapping[str, float | None] | float | None,
    definition: str = "",
    *,
    more: bool = False,
    ranked: bool = True,
    judged: str = OURS,
) -> Metric:
    """Return a number by method, or of ``judged`` alone.

    A smaller one is better, with ``more`` a larger one, and neither if it is not ``ranked``.
    """
    table = values if isinstance(values, Mapping) else {judged: values}
    return Metric(scene, name, unit, table, judged, at_most=not more, definition=definition, ranked=ranked)


def each(results: Mapping[str, Result | None], read: Callable[[Result], Any]) -> Values:
    """Return a number of each result, None for a method without one."""
    return {name: None if result is None else float(read(result)) for name, result in results.items()}


def ratio(a: float | None, b: float | None) -> float | None:
    """Return a / b if both are known."""
    return a / b if a is not None and b else None


def read_arrays(outcome: Outcome | None, file: str) -> dict[str, Any] | None:
    """Return the arrays that a task saved, None if it failed."""
    if outcome is None or not outcome.ok:
        return None
    with np.load(Path(outcome.folder) / file) as stored:
        return dict(stored)


def scatter(
    name: str, x: Iterable[Any], y: Iterable[Any], mode: str = "markers", **more: Any
) -> dict[str, Any]:
    """Return a trace for plotly.js."""
    return {"type": "scatter", "mode": mode, "name": name, "x": list(x), "y": list(y), **more}


def plot(title: str, traces: list[dict[str, Any]], x: str, y: str, caption: str = "", **layout: Any) -> Plot:
    """Return a plot with axis titles ``x`` and ``y``; ``layout`` adds to that of plotly.js."""
    for axis, text in (("xaxis", x), ("yaxis", y)):
        layout[axis] = {"title": {"text": text}} | layout.get(axis, {})
    layout["margin"] = {"l": 70, "r": 10, "t": 10, "b": 50}
    return Plot(title, {"data": traces, "layout": layout}, caption)

"""Measured numbers with references, targets and verdicts; their tables (Markdown, CSV, JSON) and plots."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import platform
import re
import subprocess
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeVar

from thesisrecon.io._files import write_text

Verdict = Literal["reached", "missed", "reported"]
T = TypeVar("T")


@dataclass(frozen=True)
class Metric:
    """One row of a table: a number on a scene, by ours and the references, with its target. ``values`` maps
    methods to numbers or None. ``target`` is the bound for the method ``judged``, an upper one with
    ``at_most``; without it the row is only reported. ``definition`` states the number in one line. Neither
    side of a number that is not ``ranked`` is better, such as a count of faces.
    """

    scene: str
    name: str
    unit: str
    values: Mapping[str, float | None]
    judged: str
    target: float | None = None
    at_most: bool = True
    definition: str = ""
    ranked: bool = True

    @property
    def verdict(self) -> Verdict:
        """Return whether the judged method reached the target; a number that is missing has not."""
        if self.target is None:
            return "reported"
        value = self.values.get(self.judged)
        if value is None:
            return "missed"
        return "reached" if (value <= self.target if self.at_most else value >= self.target) else "missed"


@dataclass(frozen=True)
class Plot:
    """An interactive plot on a page: ``figure`` for plotly.js (data, layout)."""

    title: str
    figure: Mapping[str, Any]
    caption: str = ""


def markdown_table(metrics: Sequence[Metric]) -> str:
    """Return the rows of one scene as a Markdown table, one column per method."""
    methods = list(dict.fromkeys(method for metric in metrics for method in metric.values))
    lines = []
    for metric in metrics:
        sign = "<=" if metric.at_most else ">="
        target = "" if metric.target is None else f"{sign} {number(metric.target)}"
        name = f"{metric.name}, {metric.unit}" if metric.unit else metric.name
        numbers = [number(metric.values.get(method)) for method in methods]
        lines.append([name, *numbers, target, metric.verdict])
    return text_table(["", *methods, "target", "verdict"], lines)


def number(value: float | None) -> str:
    """Return three significant digits, whole numbers in full, "-" for none."""
    if value is None or math.isnan(value):
        return "-"
    if abs(value) < 1e9 and float(value).is_integer():
        return str(int(value))
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


class Rows(list[Metric]):
    """Rows of one scene; the numbers of one ``judged`` method are held against the bounds."""

    def __init__(self, scene: str, judged: str) -> None:
        super().__init__()
        self.scene, self.judged = scene, judged

    def add(
        self,
        name: str,
        values: Mapping[str, float | None] | float,
        unit: str = "",
        at_most: float | None = None,
        at_least: float | None = None,
    ) -> None:
        """Append one row; a plain number belongs to the judged method."""
        given = values if isinstance(values, Mapping) else {self.judged: float(values)}
        bound = at_most if at_least is None else at_least
        self.append(Metric(self.scene, name, unit, given, self.judged, bound, at_least is None))


def slug(text: str) -> str:
    """Return a name for files and keys: letters, digits, dots and single dashes."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-")


def key_of(stage: str, metric: Metric) -> str:
    """Return the gate key of a number."""
    return f"{stage}/{metric.scene}/{slug(metric.name)}"


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
    """Return a number by method, or of ``judged`` alone. A smaller one is better, with ``more`` a larger one,
    and neither if it is not ``ranked``.
    """
    table = values if isinstance(values, Mapping) else {judged: values}
    return Metric(scene, name, unit, table, judged, at_most=not more, definition=definition, ranked=ranked)


def each(results: Mapping[str, T | None], read: Callable[[T], Any]) -> Values:
    """Return a number of each result, None for a method without one."""
    found = {name: None if result is None else read(result) for name, result in results.items()}
    return {name: None if value is None else float(value) for name, value in found.items()}


def finite(value: float | None) -> float | None:
    """Return a number, or None where there is none."""
    return None if value is None or not math.isfinite(value) else float(value)


def ratio(a: float | None, b: float | None) -> float | None:
    """Return a / b if both are known."""
    return a / b if a is not None and b else None


def scatter(
    name: str, x: Iterable[Any], y: Iterable[Any], mode: str = "markers", **more: Any
) -> dict[str, Any]:
    """Return a trace for plotly.js."""
    return {"type": "scatter", "mode": mode, "name": name, "x": list(x), "y": list(y), **more}


def plot(title: str, traces: list[dict[str, Any]], x: str, y: str, caption: str = "", **layout: Any) -> Plot:
    """Return a plot with axis titles ``x`` and ``y``; ``layout`` adds to that of plotly.js. The legend is
    below the plot, the buttons are above it.
    """
    for axis, text in (("xaxis", x), ("yaxis", y)):
        name = {"text": "<br>".join(textwrap.wrap(text, 34)), "font": {"size": 12}}
        usual = {"title": name, "automargin": True, "zeroline": axis == "yaxis"}
        layout[axis] = usual | layout.get(axis, {})
        if layout[axis].get("type") == "log":
            layout[axis] |= log_ticks([v for trace in traces for v in _reach(trace, axis[0])])
    layout["margin"] = {"l": 70, "r": 10, "t": 36, "b": 50}
    layout.setdefault("legend", {"orientation": "h", "yanchor": "top", "y": -0.2})
    return Plot(title, {"data": traces, "layout": layout}, caption)


def _reach(trace: Mapping[str, Any], axis: str) -> list[float]:
    """The numbers of a trace along an axis, and the ends of their error bars."""
    values, bars = trace[axis], trace.get(f"error_{axis}", {})
    known = [(k, v) for k, v in enumerate(values) if isinstance(v, int | float)]
    ends = [
        v + sign * (bars[name][k] or 0.0)
        for name, sign in (("array", 1.0), ("arrayminus", -1.0))
        if name in bars
        for k, v in known
    ]
    return [*(v for _, v in known), *ends]


def log_ticks(values: Iterable[float]) -> dict[str, Any]:
    """Ticks of a logarithmic axis: round numbers, three at least; plotly's own are powers of ten."""
    positive = [v for v in values if 0.0 < v < math.inf]
    if not positive or max(positive) > 300.0 * min(positive):
        return {"dtick": 1}
    low, high = min(positive), max(positive)
    if high > 4.0 * low:
        return {"dtick": "D2"}
    fourth = max(high - low, 0.05 * high) / 4.0
    unit = 10.0 ** math.floor(math.log10(fourth))
    step = min((unit, 2.0 * unit, 5.0 * unit, 10.0 * unit), key=lambda size: abs(size - fourth))
    first, last = math.floor(low / step) - 1, math.ceil(high / step) + 1
    return {"tickvals": [float(f"{k * step:.12g}") for k in range(max(first, 1), last + 1)]}


def text_table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table of cells that are printed as they are."""
    lines = [[*map(str, head)], ["---"] * len(head), *([*map(str, row)] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write_csv(path: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Write records with the same keys; None and NaN become empty cells."""
    sink = io.StringIO(newline="")
    writer = csv.DictWriter(sink, list(records[0]) if records else [])
    writer.writeheader()
    writer.writerows({k: "" if v is None or v != v else v for k, v in r.items()} for r in records)
    write_text(path, sink.getvalue())


def write_metrics(path: Path, metrics: Sequence[Metric]) -> None:
    """Write metrics with their verdicts as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [{**asdict(metric), "verdict": metric.verdict} for metric in metrics]
    write_text(path, json.dumps(rows, indent=1) + "\n")


def commit() -> str:
    """Return the commit of this clone, with ``-dirty`` if files have changed since; the version if this is no
    clone, whatever repository an installed package lies in.
    """
    command, root = ["git", "describe", "--always", "--dirty", "--abbrev=10"], Path(__file__).parents[2]
    try:
        if (root / ".git").exists():
            return subprocess.run(
                command, cwd=root, capture_output=True, text=True, check=True
            ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        pass
    return f"of version {version('thesisrecon')}"


def machine() -> str:
    """Return processor, cores and system of this machine."""
    return f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"


def stamp() -> str:
    """Return the first line of a file of tables."""
    return f"Commit {commit()}; {machine()}; Python {platform.python_version()}."

"""A measured number with its references, target and verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["reached", "missed", "reported"]


@dataclass(frozen=True)
class Metric:
    """One row of a table: a number on a scene, by ours and the references, with its target.

    ``values`` maps methods to numbers or None. ``target`` is the bound for the method ``judged``, an upper
    one with ``at_most``; without it the row is only reported. ``definition`` states the number in one line.
    Neither side of a number that is not ``ranked`` is better, such as a count of faces.
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


def markdown_table(metrics: list[Metric]) -> str:
    """The rows of one scene as a Markdown table, one column per method."""
    methods = list(dict.fromkeys(method for metric in metrics for method in metric.values))
    lines = [f"| | {' | '.join(methods)} | target | verdict |", f"| --- |{' --- |' * (len(methods) + 2)}"]
    for metric in metrics:
        numbers = " | ".join(number(metric.values.get(method)) for method in methods)
        target = (
            "" if metric.target is None else f"{'<=' if metric.at_most else '>='} {number(metric.target)}"
        )
        name = f"{metric.name}, {metric.unit}" if metric.unit else metric.name
        lines.append(f"| {name} | {numbers} | {target} | {metric.verdict} |")
    return "\n".join(lines)


def number(value: float | None) -> str:
    """Return three significant digits, whole numbers in full, "-" for none."""
    if value is None or math.isnan(value):
        return "-"
    if abs(value) < 1e9 and float(value).is_integer():
        return str(int(value))
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"

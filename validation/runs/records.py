"""Records of a report: options, tasks, outcomes and judgements."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from validation.runs.tables import Metric


@dataclass(frozen=True)
class ReportOptions:
    """Options of a report.

    ``out``: output folder. ``scenes``, ``stages``: names in order. ``folders``: folder of each user scene.
    ``quick``: reduced scenes and repetitions. ``gates_only``: skip slow references and pictures that no gate
    needs. ``seed``: random seed. ``threads``: number of cores. ``limit_s``: time limit of a task (s).
    ``side_px``: long side of depth maps, 0 for the default. ``resume``: folder of an earlier run whose
    references are reused, or empty.
    ``stages_from``: module of ``STAGES``.
    """

    out: Path
    scenes: tuple[str, ...]
    stages: tuple[str, ...]
    folders: Mapping[str, str] = field(default_factory=dict)
    quick: bool = False
    gates_only: bool = False
    seed: int = 0
    threads: int = 2
    limit_s: float = 300.0
    resume: str = ""
    side_px: int = 0
    stages_from: str = "validation.stages"

    def folder(self, stage: str, scene: str, method: str = "") -> Path:
        """Return the folder of a task, or of all tasks of a stage on a scene."""
        folder = self.out / "data" / stage / scene
        return folder / slug(method) if method else folder

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"out": str(self.out)}

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> ReportOptions:
        tuples = {name: tuple(record.get(name, ())) for name in ("scenes", "stages")}
        return cls(**{**record, **tuples, "out": Path(record["out"])})


@dataclass(frozen=True)
class Task:
    """One method of one stage on one scene."""

    stage: str
    scene: str
    method: str


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task: its result folder and resources; ``failure`` is empty or the error message."""

    folder: Path
    failure: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0

    @property
    def ok(self) -> bool:
        return not self.failure


@dataclass(frozen=True)
class Picture:
    """A figure on the page of a scene: a PNG or JPEG ``file`` in the folder of the judgement."""

    file: str
    title: str
    caption: str = ""


@dataclass(frozen=True)
class Plot:
    """An interactive plot on a page: ``figure`` for plotly.js (data, layout)."""

    title: str
    figure: Mapping[str, Any]
    caption: str = ""


@dataclass(frozen=True)
class Judgement:
    """Evaluation of a stage on a scene: numbers first, then plots and figures."""

    metrics: Sequence[Metric]
    notes: Sequence[str] = ()
    plots: Sequence[Plot] = ()
    pictures: Sequence[Picture] = ()


class Stage(Protocol):
    """A stage of the library and its references.

    ``definition`` states the comparison in one sentence. ``takes`` returns whether the stage can work on a
    scene; ``methods`` the methods there; ``needs`` the (stage, method) results that a method, or the
    judgement (empty ``method``), reads. ``run`` computes a task and saves its result; ``judge`` reads all
    results and recomputes every number.
    """

    name: str
    title: str
    definition: str
    scenes: tuple[str, ...] = ()

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return scene in self.scenes

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]: ...

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        return ()

    def run(self, task: Task, options: ReportOptions) -> None: ...

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement: ...


def slug(text: str) -> str:
    """Return a name for files and keys: letters, digits, dots and single dashes."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-")


def key_of(stage: str, metric: Metric) -> str:
    """Return the gate key of a number."""
    return f"{stage}/{metric.scene}/{slug(metric.name)}"


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

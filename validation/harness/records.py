"""What travels through the harness: wishes, tasks, what came of them, and what is told of it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from validation.metrics.record import Metric


@dataclass(frozen=True)
class Wishes:
    """What a report is asked for.

    ``out`` : its folder. ``scenes``, ``stages`` : their names, in order. ``folders`` : scene -> folder, of
    scenes that the user brought. ``quick`` : less of everything that can be less. ``gates_only`` : no
    reference that takes long and that no gate needs. ``seed`` : of all random steps. ``threads`` : cores that
    may be used at once. ``limit_s`` : seconds a single task may take. ``side_px`` : long side of depth maps,
    0 for what a report has time for. ``resume`` : the folder of another run, whose references are taken as
    they are; empty for none. ``methods`` : those of ours that run again where a run is resumed; empty for
    all. ``stages_from`` : the module whose ``STAGES`` hold the stages.
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
    methods: tuple[str, ...] = ()
    side_px: int = 0
    stages_from: str = "validation.harness.stages"

    def place(self, stage: str, scene: str, method: str = "") -> Path:
        """The folder of a task, or of all tasks of a stage on a scene."""
        place = self.out / "data" / stage / scene
        return place / slug(method) if method else place

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"out": str(self.out)}

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> Wishes:
        tuples = {name: tuple(told.get(name, ())) for name in ("scenes", "stages", "methods")}
        return cls(**{**told, **tuples, "out": Path(told["out"])})


@dataclass(frozen=True)
class Task:
    """One method of one stage on one scene."""

    stage: str
    scene: str
    method: str


@dataclass(frozen=True)
class Outcome:
    """What came of a task: the folder where it saved its results, and what it used; ``failure`` is empty
    where it ended well, else the sentence that says why not."""

    place: Path
    failure: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0

    @property
    def ok(self) -> bool:
        return not self.failure


@dataclass(frozen=True)
class Picture:
    """A picture on the page of a scene: a PNG or JPEG ``file`` in the folder of the judgement."""

    file: str
    title: str
    words: str = ""


@dataclass(frozen=True)
class Plot:
    """An interactive plot on the page of a scene: ``figure`` as plotly.js takes it (data, layout)."""

    title: str
    figure: Mapping[str, Any]
    words: str = ""


@dataclass(frozen=True)
class Judgement:
    """What is told of a stage on a scene: numbers first, then plots and pictures."""

    metrics: Sequence[Metric]
    plots: Sequence[Plot] = ()
    pictures: Sequence[Picture] = ()
    notes: Sequence[str] = ()


class Stage(Protocol):
    """A stage of the library beside its references.

    ``name`` and ``title`` say what it is, ``definition`` what is compared, in one sentence. ``takes`` says
    whether it can work on a scene; ``methods`` what runs there; ``needs`` the (stage, method) whose results
    on the same scene a method starts from, and the judgement where ``method`` is empty. ``run`` does the work
    of a task and saves what came of it in its place; ``judge`` reads all of it, recomputes every number and
    may write pictures into its own place.
    """

    name: str
    title: str
    definition: str

    def takes(self, scene: str, wishes: Wishes) -> bool: ...

    def methods(self, scene: str, wishes: Wishes) -> tuple[str, ...]: ...

    def needs(self, method: str) -> tuple[tuple[str, str], ...]: ...

    def run(self, task: Task, wishes: Wishes) -> None: ...

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], wishes: Wishes) -> Judgement: ...


def slug(text: str) -> str:
    """A name for files and keys: letters, digits, dots and single dashes."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-")


def key_of(stage: str, metric: Metric) -> str:
    """What a gate calls this number."""
    return f"{stage}/{metric.scene}/{slug(metric.name)}"

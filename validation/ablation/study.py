"""Definition of a study: axes, scenes, seeds and measures."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError
from validation.ablation.statistics import Sample

Mode = Literal["one-at-a-time", "grid", "ladder"]
Changes = Mapping[str, Any]
"""Dotted path -> value: ``epipolar.threshold_px`` -> 0.5, ``features`` -> a variant."""
Axis = Sequence[Any] | Mapping[str, Changes]
"""Values of the dotted path in its name, or named levels that change several paths."""


@dataclass(frozen=True)
class Measure:
    """A number that rows report.

    ``better`` is "less" or "more". With ``ratio`` values are compared by quotients, for errors of different
    magnitude above zero; a quotient within ``negligible`` of 1 is called negligible.
    """

    name: str
    unit: str = ""
    better: Literal["less", "more"] = "less"
    ratio: bool = False
    definition: str = ""
    negligible: float = 0.005


class Task(Protocol):
    """Work of a row: a frozen dataclass whose fields are the parameters ``task.…``.

    ``measures`` are its numbers. ``check`` raises ``UsageError`` for an unknown or missing scene;
    ``scene_key`` identifies the content of a scene; ``unavailable`` names the measures that a scene cannot
    have. ``run`` works with a random seed in an empty folder ``place``, which is removed afterwards, and
    returns numbers by measure name. ``StageFailure`` means that the data could not be processed.

    A task whose first steps may be shared by many rows also has ``steps(config, scene, seed)``, which names
    the steps in order with a key each (equal keys mean equal results), and ``prepare(config, scene, seed,
    place, *, step)``, which runs a row up to and including that step and stores the result in
    ``place.shared``.
    """

    measures: ClassVar[Sequence[Measure]]
    sample: ClassVar[Sample] = "scenes"
    """What is sampled: "draws" if the seed draws the data (noise, points, cameras), else the scenes."""

    def scene_of(self, scene: str) -> str:
        """The scene that a subset belongs to."""
        return scene

    def subsets(self, scene: str, count: int) -> list[str]:
        """Names of subsets of a scene, which ``run`` accepts as scenes."""
        raise UsageError(f"the task {type(self).__name__} has no subsets of scenes; leave subsets out")

    def check(self, scene: str) -> None: ...

    def scene_key(self, scene: str) -> str:
        return scene

    def unavailable(self, scene: str) -> Collection[str]:
        return ()

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]: ...


@dataclass(frozen=True)
class Place:
    """Folders of a row: ``own`` is empty at the beginning, ``shared`` is common to all rows."""

    own: Path
    shared: Path


TaskFunction = Callable[[PipelineConfig, str, int], Mapping[str, float]]


@dataclass(frozen=True)
class FunctionTask(Task):
    """A task of a plain ``function(config, scene, seed)`` that returns numbers by name."""

    function: TaskFunction
    measures: ClassVar[Sequence[Measure]] = ()

    def check(self, scene: str) -> None: ...

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        return self.function(config, scene, seed)


@dataclass(frozen=True)
class Study:
    """A question to the library and its experimental design.

    Parameters
    ----------
    axes : compared settings: dotted path -> values, or any name -> {level -> changes}. A path begins with a
        stage of :class:`PipelineConfig` or with ``task``. A value is a number, a word (the kind of a variant,
        or ``file.py:Class`` for one of your own), a table (``kind`` and fields; ``preset`` for what that
        preset has there), or the object itself.
    scenes : the names of the scenes; a task may also take folders.
    seeds : of the random steps, or how many (then 0, 1, ...); a sample only where the task draws its data.
    subsets : how many subsets of the images of each scene are run in addition to the whole scene.
    conditions : axes that are not compared, such as the noise of all variants.
    mode : "one-at-a-time" changes one setting of the start at a time, "ladder" keeps each change and adds the
        next, "grid" takes every combination.
    baseline : the name of the variant that the others are compared with; the first where empty.
    start : the name of the unchanged configuration in the modes that begin with it.
    metrics : the task's numbers to analyse, all if empty. A plain function as a task lists its numbers here.
    title, words : the heading of the page and a sentence below it.
    folder : the folder of files that values name.
    task : what a row runs, a :class:`Task` or a function (config, scene, seed) -> {metric: number}; the
        reconstruction of images if None.
    config : the configuration to change.
    """

    axes: Mapping[str, Axis]
    scenes: Sequence[str]
    seeds: int | Sequence[int] = 1
    subsets: int = 0
    conditions: Mapping[str, Axis] = field(default_factory=dict)
    mode: Mode = "one-at-a-time"
    baseline: str = ""
    start: str = "unchanged"
    metrics: Sequence[str | Measure] = ()
    task: Task | TaskFunction | None = None
    config: PipelineConfig = field(default_factory=PipelineConfig)
    title: str = "Ablation"
    words: str = ""
    folder: Path = Path()
    """Folder of files named in values."""


SHARE = 2 / 3
"""Enough images for self-calibration where the scene has eight; neighbours by name mostly overlap."""


def window_names(scene: str, count: int) -> list[str]:
    return [f"{scene}#{k}/{count}" for k in range(1, count + 1)]


def window_parts(scene: str) -> tuple[str, int, int]:
    """Name of the scene, and number k of n windows; 0 of 0 for the whole scene."""
    name, mark, place = scene.rpartition("#")
    k, _, n = place.partition("/")
    if not mark or not (k.isdecimal() and n.isdecimal()):
        return scene, 0, 0
    if not 1 <= int(k) <= int(n):
        raise UsageError(f"a subset is NAME#k/n with k from 1 to n; got {scene!r}")
    return name, int(k), int(n)


def window_slice(scene: str, length: int) -> slice:
    """``SHARE`` of ``length`` images or rows; all of them for a whole scene."""
    _, k, n = window_parts(scene)
    if not n:
        return slice(0, length)
    size = math.ceil(SHARE * length)
    first = round((k - 1) * (length - size) / max(n - 1, 1))
    return slice(first, first + size)

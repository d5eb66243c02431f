"""Definition of a study: axes, scenes, seeds and measures."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError, unknown_word
from validation.ablation.statistics import Sample

Mode = Literal["one-at-a-time", "grid", "ladder"]
Changes = Mapping[str, Any]
"""Dotted path -> value: ``epipolar.threshold_px`` -> 0.5, ``features`` -> a variant."""
Axis = Sequence[Any] | Mapping[str, Changes]
"""Values of the dotted path in its name, or named levels that change several paths."""


@dataclass(frozen=True)
class Measure:
    """A number that rows report. ``better`` is "less" or "more". With ``ratio`` values are compared by
    quotients, for errors of different magnitude above zero; a quotient within ``negligible`` of 1 is called
    negligible. One that is ``extra`` is analysed only if a study names it.
    """

    name: str
    unit: str = ""
    better: Literal["less", "more"] = "less"
    ratio: bool = False
    definition: str = ""
    negligible: float = 0.005
    extra: bool = False


class Task:
    """Work of a row: a frozen dataclass whose fields are the parameters ``task.…``. ``measures`` are its
    numbers. ``check`` raises ``UsageError`` for a scene that is not one of ``scenes`` or is missing;
    ``scene_key`` identifies its content; ``unavailable`` names the measures that it cannot have. ``run``
    works with a random seed in an empty folder ``place``, which is removed afterwards, and returns numbers by
    measure name. ``steps`` names the first steps that rows may share, in order, with a key each (equal keys
    mean equal results); ``prepare`` runs a row up to and including a step and stores the result in
    ``place.shared``.
    """

    measures: ClassVar[Sequence[Measure]] = ()
    scenes: ClassVar[Sequence[str]] = ()
    sample: ClassVar[Sample] = "scenes"
    """What is sampled: "draws" if the seed draws the data (noise, points, cameras), else the scenes."""

    def expand(self, scene: str) -> Sequence[str]:
        """The scenes that a word of a study means, such as all pairs of a list."""
        return [scene]

    def scene_of(self, scene: str) -> str:
        """The scene that a subset belongs to."""
        return scene

    def subsets(self, scene: str, count: int) -> list[str]:
        """Names of subsets of a scene, which ``run`` accepts as scenes."""
        raise UsageError(f"the task {type(self).__name__} has no subsets of scenes; leave subsets out")

    def check(self, scene: str) -> None:
        if self.scenes and scene not in self.scenes:
            raise UsageError(unknown_word("scene", scene, self.scenes))

    def names_of_scenes(self) -> Sequence[str]:
        """The scenes with a name, for messages and pages; others may be accepted too."""
        return self.scenes

    def scene_key(self, scene: str) -> str:
        return scene

    def unavailable(self, scene: str) -> Collection[str]:
        return ()

    def steps(self, config: PipelineConfig, scene: str, seed: int) -> Sequence[tuple[str, str]]:
        return ()

    def prepare(self, config: PipelineConfig, scene: str, seed: int, place: Place, *, step: str) -> None: ...

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        raise NotImplementedError


class Place(NamedTuple):
    """Folders of a row: ``own`` is empty at the beginning, ``shared`` is common to all rows."""

    own: Path
    shared: Path


TaskFunction = Callable[[PipelineConfig, str, int], Mapping[str, float]]


@dataclass(frozen=True)
class FunctionTask(Task):
    """A task of a plain ``function(config, scene, seed)`` that returns numbers by name."""

    function: TaskFunction

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        return self.function(config, scene, seed)


@dataclass(frozen=True)
class Study:
    """A question to the library and its experimental design. ``axes``: compared settings, dotted path ->
    values, or any name -> {level -> changes}. A path begins with a stage of :class:`PipelineConfig` or with
    ``task``. A value is a number, a word (a kind, or ``file.py:Class`` for one of your own), a table
    (``kind`` and fields; ``preset`` for what that preset has there), or the object itself. ``conditions``:
    axes that are not compared. ``scenes``: names, or folders if the task takes them. ``seeds``: of the random
    steps, or how many. ``subsets``: how many of each scene are run in addition. ``mode``: "one-at-a-time",
    "ladder" (each change is kept) or "grid" (all combinations). ``baseline``: name of the variant that the
    others are compared with; the first if empty. ``start``: name of the unchanged configuration. ``metrics``:
    the numbers to analyse, all if empty; a function as a task lists its numbers here. ``task``: a
    :class:`Task` or a function (config, scene, seed) -> {metric: number}; the reconstruction of images if
    None. ``folder``: of the files that values name.
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

"""What a study is: what is varied, on which scenes, how often, and what is measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

from thesisrecon.config import PipelineConfig

Mode = Literal["one-at-a-time", "grid", "ladder"]
Changes = Mapping[str, Any]
"""Dotted path -> value: ``epipolar.threshold_px`` -> 0.5, ``features`` -> a variant."""
Axis = Sequence[Any] | Mapping[str, Changes]
"""The values of the dotted path that is its name, or named levels that change several paths each."""


@dataclass(frozen=True)
class Measure:
    """A number that rows tell.

    ``better`` says on which side the good lies. With ``ratio`` values are compared by their quotients, which
    suits errors of very different sizes: so long as all are above zero.
    """

    name: str
    unit: str = ""
    better: Literal["less", "more"] = "less"
    ratio: bool = False
    definition: str = ""


class Task(Protocol):
    """What a row runs: a frozen dataclass, its fields the parameters that paths ``task.…`` change.

    ``measures`` are the numbers it tells. ``check`` raises :class:`UsageError` for a scene that it does not
    know or that is not on this machine; ``scene_key`` names what the scene holds. ``run`` does the work with
    a random seed, in an empty folder ``place`` that is removed after it; it tells its numbers by the names of
    the measures. ``StageFailure`` says that the data could not be worked with.

    A task that cannot tell each of its numbers everywhere has also a method ``untold(scene)`` that names
    those it cannot tell of a scene. Tasks that begin alike for several rows have also the methods of
    :class:`SharingTask`.
    """

    measures: ClassVar[Sequence[Measure]]

    def check(self, scene: str) -> None: ...

    def scene_key(self, scene: str) -> str: ...

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]: ...


class SharingTask(Task, Protocol):
    """A task of several steps, the first of which may be alike for many rows.

    ``steps`` names the steps in order with a key each: where two rows have equal keys, the step finds the
    same. ``prepare`` carries a row out up to and with that step, and leaves what it found in
    ``place.shared``, from where ``run`` takes it.
    """

    def steps(self, config: PipelineConfig, scene: str, seed: int) -> Sequence[tuple[str, str]]: ...

    def prepare(self, config: PipelineConfig, scene: str, seed: int, place: Place, *, step: str) -> None: ...


@dataclass(frozen=True)
class Place:
    """Where a row may write: ``own`` is an empty folder of its own, ``shared`` that of all rows."""

    own: Path
    shared: Path


TaskFunction = Callable[[PipelineConfig, str, int], Mapping[str, float]]


@dataclass(frozen=True)
class Study:
    """A question to the library, and how it is asked.

    Parameters
    ----------
    axes : what is compared: dotted path -> values, or any name -> {level -> changes}. A path begins with a
        stage of :class:`PipelineConfig` or with ``task``. A value is a number, a word (the kind of a variant,
        or ``file.py:Class`` for one of your own), a table (``kind`` and fields; ``preset`` for what that
        preset has there), or the object itself.
    scenes : the names of the scenes; a task may also take folders.
    seeds : of the random steps, or how many (then 0, 1, ...).
    conditions : axes along which nothing is compared, as the noise that all variants meet.
    mode : "one-at-a-time" changes one thing of the start at a time, "ladder" keeps each change and adds the
        next, "grid" takes every combination.
    baseline : the name of the variant that the others are compared with; the first where empty.
    start : the name of the unchanged configuration in the modes that begin with it.
    metrics : which of the task's numbers are analysed, all where empty. A plain function as a task says here
        what it tells.
    task : what a row runs, a :class:`Task` or a function (config, scene, seed) -> {metric: number}; the
        reconstruction of photographs where None.
    config : what the changes start from.
    """

    axes: Mapping[str, Axis]
    scenes: Sequence[str]
    seeds: int | Sequence[int] = 5
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
    """From where files named in values are sought."""

"""Plan a study before anything runs: variants, conditions and rows; report what is invalid."""

from __future__ import annotations

import hashlib
import itertools
import platform
import tomllib
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import thesisrecon
from thesisrecon._numba import code_digest
from thesisrecon.config import KINDS, preset
from thesisrecon.config.text import (
    config_from_tables,
    dataclass_from_table,
    table_from_dataclass,
    tables_from_config,
)
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.io._files import read_bytes
from thesisrecon.runtime._executors import package_key
from thesisrecon.runtime._run_folder import key_of
from validation.ablation.changes import STAGES, TASK, Setting, changed, level_name
from validation.ablation.own_files import PREFIX, is_own, load_own
from validation.ablation.study import Axis, Changes, FunctionTask, Measure, Mode, Study, Task
from validation.ablation.tasks import TASKS, Reconstruction

ROOT = Path(__file__).resolve().parents[1]
STUDIES = ROOT / "ablation" / "studies"
RUN_BY_ROWS = ("scenes", "metrics", "references", "runs", "stages", "studies", "ablation/tasks")
"""Folders of the code that the rows run, without that of the library."""
Levels = Mapping[str, str]


class Variant(NamedTuple):
    """A variant or a condition: the level of every axis, and its changes of configuration and task."""

    name: str
    levels: Levels
    changes: Changes


class PlannedRow(NamedTuple):
    """A planned row; ``key`` identifies the setting, scene, seed and versions."""

    key: str
    variant: str
    condition: str
    scene: str
    seed: int
    setting: Setting


class Plan(NamedTuple):
    """Plan of a study; its rows in execution order, seed by seed."""

    study: Study
    measures: tuple[Measure, ...]
    variants: tuple[Variant, ...]
    conditions: tuple[Variant, ...]
    seeds: tuple[int, ...]
    baseline: str
    rows: tuple[PlannedRow, ...]
    versions: Mapping[str, str]

    def wanted(self, row: PlannedRow) -> list[str]:
        """Return the measures of a row."""
        missing = row.setting.task.unavailable(row.scene)
        return [m.name for m in self.measures if m.name not in missing]


def plan_study(study: Study) -> Plan:
    """Return the plan of a study."""
    task, variants = _task_of(study), _variants(study)
    start, installed = Setting(study.config, task), versions()
    conditions = tuple(_combined(_axes(study.conditions, "condition"))) or (Variant("", {}, {}),)
    settings = {
        (v.name, c.name): _applied(start, v, c, study.folder)
        for v, c in itertools.product(variants, conditions)
    }
    identities = {at: identity(setting) for at, setting in settings.items()}
    variants = _different(variants, conditions, identities)
    scenes, seeds = _scenes(study, task), _seeds(study)
    baseline = study.baseline or variants[0].name
    if baseline not in [v.name for v in variants]:
        raise UsageError(unknown_word("baseline", baseline, [v.name for v in variants]))
    scene_keys, rows = {scene: task.scene_key(scene) for scene in scenes}, list[PlannedRow]()
    for seed, scene, c, v in itertools.product(seeds, scenes, conditions, variants):
        at = v.name, c.name
        key = key_of("row", identities[at], scene_keys[scene], seed, installed)
        rows.append(PlannedRow(key, *at, scene, seed, settings[at]))
    measures = _available_measures(study, _measures(study, task), rows)
    return Plan(study, measures, variants, conditions, seeds, baseline, tuple(rows), installed)


def _available_measures(
    study: Study, measures: tuple[Measure, ...], rows: Sequence[PlannedRow]
) -> tuple[Measure, ...]:
    """Return the measures available in some row; reject requested unavailable ones."""
    never = set.intersection(*(set(row.setting.task.unavailable(row.scene)) for row in rows))
    if study.metrics and (wrong := [m.name for m in measures if m.name in never]):
        why = "it has no ground truth, or the task ends before that step"
        raise UsageError(f"no scene of this study has the metric {wrong[0]}: {why}")
    return tuple(m for m in measures if m.name not in never)


def _applied(start: Setting, variant: Variant, condition: Variant, folder: Path) -> Setting:
    """Return the setting of a variant under a condition; errors name both."""
    for part in (variant, condition):
        try:
            for path, value in part.changes.items():
                start = changed(start, path, value, folder)
        except UsageError as error:
            raise UsageError(f"{part.name}: {error}") from None
    return start


def _task_of(study: Study) -> Task:
    task = Reconstruction() if study.task is None else study.task
    if isinstance(task, Task):
        return task
    if not callable(task):
        raise UsageError(f"a task is a Task or a function (config, scene, seed); got {task!r}")
    return FunctionTask(task)


def _measures(study: Study, task: Task) -> tuple[Measure, ...]:
    known = {m.name: m for m in task.measures}
    asked: Sequence[str | Measure] = study.metrics or tuple(m for m in known.values() if not m.extra)
    if isinstance(asked, str):
        raise UsageError(f"metrics are a list of names; got {asked!r}")
    for metric in asked:
        if isinstance(metric, str) and known and metric not in known:
            raise UsageError(unknown_word("metric", metric, known))
    if not asked:
        raise UsageError("a function as a task needs metrics: the names of the numbers it returns")
    return tuple(m if isinstance(m, Measure) else known.get(m, Measure(m)) for m in asked)


def _seeds(study: Study) -> tuple[int, ...]:
    count: Any = range(study.seeds) if type(study.seeds) is int else study.seeds
    seeds: list[Any] = list(count) if isinstance(count, list | tuple | range) else []
    if not seeds or any(type(s) is not int or s < 0 for s in seeds) or len(set(seeds)) < len(seeds):
        wanted = "seeds are different whole numbers of at least 0, or how many (at least 1)"
        raise UsageError(f"{wanted}; got {study.seeds!r}")
    return tuple(seeds)


def _scenes(study: Study, task: Task) -> tuple[str, ...]:
    scenes = study.scenes
    if isinstance(scenes, str) or not scenes or not all(isinstance(s, str) for s in scenes):
        raise UsageError(f"scenes are a list of at least one name; got {scenes!r}")
    found = dict[str, None]()
    for scene in scenes:
        try:
            for one in task.expand(scene):
                task.check(one)
                found[one] = None
        except UsageError as error:
            names = ", ".join(task.names_of_scenes())
            raise UsageError(f"{error} (scenes are {names})" if names else str(error)) from None
    count = study.subsets
    if type(count) is not int or count < 0:
        raise UsageError(f"subsets is the number of subsets of each scene, 0 for none; got {count!r}")
    parts = [[scene, *(task.subsets(scene, count) if count else ())] for scene in found]
    return tuple(itertools.chain.from_iterable(parts))


# ---------------------------------------------------------------- axes


def _axes(axes: Mapping[str, Axis], what: str) -> list[list[Variant]]:
    if not isinstance(axes, Mapping):
        raise UsageError(f"the {what}es are a table: path or name -> levels; got {axes!r}")
    return [_levels(name, axis, what) for name, axis in axes.items()]


def _levels(name: str, axis: Axis, what: str) -> list[Variant]:
    if isinstance(axis, str) or not isinstance(axis, Mapping | Sequence):
        raise UsageError(f"the {what} {name} takes a list of values or a table of levels; got {axis!r}")
    if not axis:
        raise UsageError(f"the {what} {name} has no values; give it at least one")
    if isinstance(axis, Mapping):
        for level, changes in axis.items():
            if not isinstance(changes, Mapping):
                raise UsageError(
                    f"the level {level!r} of the {what} {name} takes a table of changes, path -> value; "
                    f"got {changes!r} (to vary one path, give the {what} that path and a list of values)"
                )
        return [Variant(level, {name: level}, dict(changes)) for level, changes in axis.items()]
    if (head := name.partition(".")[0]) not in (TASK, *STAGES):
        known = unknown_word("stage", head, [*STAGES, TASK])
        raise UsageError(f"the {what} {name} names no path of the configuration: {known}")
    found = {level: Variant(level, {name: level}, {name: v}) for v in axis for level in [level_name(name, v)]}
    if len(found) < len(axis):
        names = [level_name(name, value) for value in axis]
        doubled = next(level for n, level in enumerate(names) if level in names[:n])
        raise UsageError(f"the {what} {name} has the level {doubled!r} twice")
    return list(found.values())


def _combined(axes: Sequence[Sequence[Variant]]) -> Iterator[Variant]:
    for parts in itertools.product(*axes) if axes else ():
        levels = {axis: level for part in parts for axis, level in part.levels.items()}
        changes = {path: value for part in parts for path, value in part.changes.items()}
        yield Variant(", ".join(part.name for part in parts), levels, changes)


def _variants(study: Study) -> tuple[Variant, ...]:
    axes = _axes(study.axes, "axis")
    if study.mode not in typing.get_args(Mode):
        raise UsageError(unknown_word("mode", str(study.mode), typing.get_args(Mode)))
    if study.mode == "grid":
        if not axes:
            raise UsageError("a study has at least one axis")
        return tuple(_combined(axes))
    found = [Variant(study.start, {}, {})]
    for level in itertools.chain.from_iterable(axes):
        if study.mode == "one-at-a-time":
            found.append(level)
            continue
        # A ladder keeps earlier changes; replacing a stage discards those inside it.
        new = tuple(f"{path}." for path in level.changes)
        kept = {path: v for path, v in found[-1].changes.items() if not f"{path}.".startswith(new)}
        found.append(Variant(level.name, {"step": level.name}, {**kept, **level.changes}))
    return tuple(found)


def _different(
    variants: Sequence[Variant], conditions: Sequence[Variant], identities: Mapping[tuple[str, str], Any]
) -> tuple[Variant, ...]:
    """Remove repeated variants; reject one name for two settings."""
    kept: dict[str, Variant] = {}
    seen = list[Any]()
    for variant in variants:
        found = [identities[variant.name, c.name] for c in conditions]
        if variant.name in kept:
            raise UsageError(f"two variants are called {variant.name!r}; name the levels in a table")
        if found not in seen:
            kept[variant.name] = variant
            seen.append(found)
    return tuple(kept.values())


# ---------------------------------------------------------------- row identity


def identity(setting: Setting) -> list[Any]:
    """Return plain values that identify a setting."""
    config, task = setting.config, setting.task
    subject = task.function if isinstance(task, FunctionTask) else type(task)
    table = table_from_dataclass(task) if subject is type(task) else {}
    kinds = [type(getattr(config, stage)) for stage in KINDS]
    return [tables_from_config(config), table, *map(_code_of, [*kinds, subject])]


def _code_of(subject: Any) -> list[str]:
    """Return its name, and a digest of code that :func:`versions` does not hold."""
    known = subject.__module__.startswith(("thesisrecon.", "validation.", PREFIX))
    name = getattr(subject, "__qualname__", type(subject).__qualname__)
    return [subject.__module__, name, "" if known else code_digest(subject)]


@cache
def versions() -> dict[str, str]:
    """Return the installed versions and a key of the code that rows run."""
    content = hashlib.sha256(package_key().encode())
    for root in (ROOT / part for part in RUN_BY_ROWS):
        for path in sorted(root.rglob("*.py")):
            content.update(f"{path.relative_to(root)}".encode() + path.read_bytes())
    return {
        "thesisrecon": thesisrecon.__version__,
        "code": content.hexdigest()[:16],
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "scipy", "numba")},
    }


_TEXTS = ("title", "words", "mode", "baseline", "start")
_TABLES = ("axes", "conditions", "config")
_MADE = ("config", "preset", "task", "metrics")
_KEYS = (*_TEXTS, *_TABLES, "task", "preset", "scenes", "seeds", "subsets", "metrics")


def read_study(path: str | Path) -> Study:
    """Read the study of a file."""
    path = Path(path)
    try:
        table = tomllib.loads(read_bytes(path).decode("utf-8"))
    except OSError as error:
        raise UsageError(f"the study {path} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise UsageError(f"the study {path} is not TOML: {error}") from None
    try:
        return study_from_table(table, path.parent)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def study_from_table(table: Mapping[str, Any], folder: Path = Path()) -> Study:
    """Return the study of a table; its files are relative to ``folder``."""
    for key, value in table.items():
        if key not in _KEYS:
            raise UsageError(unknown_word("key of a study", key, _KEYS))
        if key in _TEXTS and not isinstance(value, str):
            raise UsageError(f"{key} takes text; got {value!r}")
        if key in _TABLES and not isinstance(value, Mapping):
            raise UsageError(f"{key} takes a table; got {value!r}")
    for key in ("scenes", "axes"):
        if key not in table:
            raise UsageError(f"a study needs {key}")
    plain = {key: table[key] for key in _KEYS if key in table and key not in _MADE}
    return Study(
        **plain,
        metrics=_metrics(table.get("metrics", [])),
        task=_task(table.get("task", "reconstruction"), folder),
        config=config_from_tables(table.get("config", {}), preset(table.get("preset", "default"))),
        folder=folder,
    )


def _task(value: Any, folder: Path) -> Any:
    """Return a task by kind or user file; a table also gives parameters."""
    table = {"kind": value} if isinstance(value, str) else value
    if not isinstance(table, Mapping) or not isinstance(table.get("kind"), str):
        raise UsageError(f"task takes a kind, or a table with its kind and parameters; got {value!r}")
    kind, fields = table["kind"], {k: v for k, v in table.items() if k != "kind"}
    if not is_own(kind):
        if kind not in TASKS:
            raise UsageError(unknown_word("task", kind, TASKS))
        return dataclass_from_table(TASKS[kind], fields, "task")
    found = load_own(kind, "task", folder)
    if isinstance(found, type):
        return dataclass_from_table(found, fields, "task")
    if fields:
        raise UsageError(f"the task {kind} is a function and has no parameters; got {', '.join(fields)}")
    return found


def _metrics(names: Any) -> list[str | Measure]:
    if not isinstance(names, list):
        raise UsageError(f"metrics take a list; got {names!r}")
    for item in names:
        if not isinstance(item, str) and (not isinstance(item, Mapping) or "name" not in item):
            raise UsageError(f"a metric is a name or a table with one; got {item!r}")
    return [
        item if isinstance(item, str) else dataclass_from_table(Measure, item, "metrics") for item in names
    ]

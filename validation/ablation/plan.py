"""Plan a study before anything runs: variants, conditions and rows; report what is invalid."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import platform
import tomllib
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import thesisrecon
from thesisrecon._numba import code_digest
from thesisrecon.config import KINDS, PipelineConfig, preset
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
from validation.ablation.changes import (
    PREFIX,
    STAGES,
    TASK,
    Setting,
    apply_changes,
    is_own,
    level_name,
    load_own,
)
from validation.ablation.study import Axis, Changes, FunctionTask, Measure, Mode, Study
from validation.ablation.tasks import TASKS, Reconstruction

ROOT = Path(__file__).resolve().parents[1]
RUN_BY_ROWS = ("scenes", "metrics", "references", "runs", "stages", "studies", "ablation/tasks")
"""Folders of the code that the rows run, without that of the library."""
Levels = Mapping[str, str]


@dataclass(frozen=True)
class Variant:
    """A variant or a condition: the level of every axis, and its changes of configuration and task."""

    name: str
    levels: Levels
    changes: Changes


@dataclass(frozen=True)
class PlannedRow:
    """A planned row; ``key`` identifies the setting, scene, seed and versions."""

    key: str
    variant: str
    condition: str
    scene: str
    seed: int
    setting: Setting


@dataclass(frozen=True)
class Plan:
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
        missing = unavailable(row.setting.task, row.scene)
        return [m.name for m in self.measures if m.name not in missing]


def plan_study(study: Study) -> Plan:
    """Return the plan of a study."""
    task = _task_of(study)
    start = Setting(study.config, task)
    variants = _variants(study)
    conditions = tuple(_combined(_axes(study.conditions, "condition"))) or (Variant("", {}, {}),)
    settings = {
        (v.name, c.name): _applied(start, v, c, study.folder)
        for v, c in itertools.product(variants, conditions)
    }
    variants = _different(variants, conditions, settings)
    scenes, seeds = _scenes(study, task), _seeds(study)
    baseline = study.baseline or variants[0].name
    if baseline not in [v.name for v in variants]:
        raise UsageError(unknown_word("baseline", baseline, [v.name for v in variants]))
    installed = versions()
    scene_keys = {scene: task.scene_key(scene) for scene in scenes}
    identities = {at: identity(setting) for at, setting in settings.items()}
    rows = tuple(
        PlannedRow(
            key_of("row", identities[v.name, c.name], scene_keys[scene], seed, installed),
            v.name,
            c.name,
            scene,
            seed,
            settings[v.name, c.name],
        )
        for seed, scene, c, v in itertools.product(seeds, scenes, conditions, variants)
    )
    measures = _available_measures(study, _measures(study, task), rows)
    return Plan(study, measures, variants, conditions, seeds, baseline, rows, installed)


def unavailable(task: Any, scene: str) -> Collection[str]:
    """Return the measures that a task cannot compute on a scene."""
    found: Collection[str] = task.unavailable(scene) if hasattr(task, "unavailable") else ()
    return found


def _available_measures(
    study: Study, measures: tuple[Measure, ...], rows: Sequence[PlannedRow]
) -> tuple[Measure, ...]:
    """Return the measures available in some row; reject requested unavailable ones."""
    missing = [set(unavailable(row.setting.task, row.scene)) for row in rows]
    never = set.intersection(*missing)
    if study.metrics and (wrong := [m.name for m in measures if m.name in never]):
        raise UsageError(
            f"no scene of this study has the metric {wrong[0]}: "
            "it has no ground truth, or the task ends before that step"
        )
    return tuple(m for m in measures if m.name not in never)


def _applied(start: Setting, variant: Variant, condition: Variant, folder: Path) -> Setting:
    """Return the setting of a variant under a condition; errors name both."""
    for part in (variant, condition):
        try:
            start = apply_changes(start, part.changes, folder)
        except UsageError as error:
            raise UsageError(f"{part.name}: {error}") from None
    return start


def _task_of(study: Study) -> Any:
    task = Reconstruction() if study.task is None else study.task
    if hasattr(task, "run") and hasattr(task, "measures"):
        return task
    if not callable(task):
        raise UsageError(f"a task is a Task or a function (config, scene, seed); got {task!r}")
    return FunctionTask(task)


def _measures(study: Study, task: Any) -> tuple[Measure, ...]:
    known = {m.name: m for m in task.measures}
    asked: Sequence[str | Measure] = study.metrics or tuple(known.values())
    if isinstance(asked, str):
        raise UsageError(f"metrics are a list of names; got {asked!r}")
    for metric in asked:
        if isinstance(metric, str) and known and metric not in known:
            raise UsageError(unknown_word("metric", metric, known))
    if not asked:
        raise UsageError("a function as a task needs metrics: the names of the numbers it returns")
    return tuple(m if isinstance(m, Measure) else known.get(m, Measure(m)) for m in asked)


def _seeds(study: Study) -> tuple[int, ...]:
    count = study.seeds
    if isinstance(count, int) and not isinstance(count, bool):
        seeds: list[Any] = list(range(count))
    else:
        seeds = list(count) if isinstance(count, list | tuple | range) else []
    if not seeds or any(type(s) is not int or s < 0 for s in seeds) or len(set(seeds)) < len(seeds):
        raise UsageError(
            f"seeds are different whole numbers of at least 0, or how many (at least 1); got {count!r}"
        )
    return tuple(seeds)


def _scenes(study: Study, task: Any) -> tuple[str, ...]:
    scenes = study.scenes
    if isinstance(scenes, str) or not scenes or not all(isinstance(s, str) for s in scenes):
        raise UsageError(f"scenes are a list of at least one name; got {scenes!r}")
    for scene in scenes:
        task.check(scene)
    count = study.subsets
    if type(count) is not int or count < 0:
        raise UsageError(f"subsets is the number of subsets of each scene, 0 for none; got {count!r}")
    parts = [[scene, *(task.subsets(scene, count) if count else ())] for scene in dict.fromkeys(scenes)]
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
    if not isinstance(axis, Mapping):
        _check_path(name, what)
        levels = [(level_name(name, value), {name: value}) for value in axis]
    else:
        levels = []
        for level, changes in axis.items():
            if not isinstance(changes, Mapping):
                raise UsageError(
                    f"the level {level!r} of the {what} {name} takes a table of changes, path -> value; "
                    f"got {changes!r} (to vary one path, give the {what} that path and a list of values)"
                )
            levels.append((level, dict(changes)))
    doubled = [level for n, (level, _) in enumerate(levels) if level in [x for x, _ in levels[:n]]]
    if doubled:
        raise UsageError(f"the {what} {name} has the level {doubled[0]!r} twice")
    return [Variant(level, {name: level}, changes) for level, changes in levels]


def _check_path(path: str, what: str) -> None:
    head = path.partition(".")[0]
    if head not in (TASK, *STAGES):
        known = unknown_word("stage", head, [*STAGES, TASK])
        raise UsageError(f"the {what} {path} names no path of the configuration: {known}")


def _combined(axes: Sequence[Sequence[Variant]]) -> Iterator[Variant]:
    for levels in itertools.product(*axes) if axes else ():
        yield _joined(levels, ", ".join(v.name for v in levels))


def _joined(parts: Sequence[Variant], name: str) -> Variant:
    levels = {axis: level for part in parts for axis, level in part.levels.items()}
    changes = {path: value for part in parts for path, value in part.changes.items()}
    return Variant(name, levels, changes)


def _variants(study: Study) -> tuple[Variant, ...]:
    axes = _axes(study.axes, "axis")
    if study.mode not in typing.get_args(Mode):
        raise UsageError(unknown_word("mode", str(study.mode), typing.get_args(Mode)))
    if study.mode == "grid":
        if not axes:
            raise UsageError("a study has at least one axis")
        return tuple(_combined(axes))
    start = Variant(study.start, {}, {})
    levels = [level for axis in axes for level in axis]
    if study.mode == "one-at-a-time":
        return (start, *levels)
    steps = [_laid(levels[: n + 1], level.name) for n, level in enumerate(levels)]
    return (start, *steps)


def _laid(parts: Sequence[Variant], name: str) -> Variant:
    """Return the changes of a ladder in step order; later changes of a path win."""
    changes: dict[str, Any] = {}
    for part in parts:
        for path, value in part.changes.items():
            changes.pop(path, None)
            # Replacing a stage discards earlier changes inside it.
            changes = {k: v for k, v in changes.items() if not k.startswith(f"{path}.")}
            changes[path] = value
    return Variant(name, {"step": name}, changes)


def _different(
    variants: Sequence[Variant], conditions: Sequence[Variant], settings: Mapping[tuple[str, str], Setting]
) -> tuple[Variant, ...]:
    """Remove repeated variants; reject one name for two settings."""
    kept: dict[str, Variant] = {}
    seen: list[list[Any]] = []
    for variant in variants:
        found = [identity(settings[variant.name, c.name]) for c in conditions]
        if variant.name in kept:
            raise UsageError(f"two variants are called {variant.name!r}; name the levels in a table")
        if found not in seen:
            kept[variant.name] = variant
            seen.append(found)
    return tuple(kept.values())


# ---------------------------------------------------------------- row identity


def identity(setting: Setting) -> list[Any]:
    """Return plain values that identify a setting."""
    return [_config_identity(setting.config), _task_identity(setting.task)]


def _config_identity(config: PipelineConfig) -> dict[str, Any]:
    tables: dict[str, Any] = tables_from_config(config)
    for stage in KINDS:
        kind = type(getattr(config, stage))
        tables[stage] = [kind.__module__, kind.__qualname__, _own_code(getattr(config, stage)), tables[stage]]
    return tables


def _task_identity(task: Any) -> list[Any]:
    subject = task.function if isinstance(task, FunctionTask) else type(task)
    table = table_from_dataclass(task) if dataclasses.is_dataclass(task) and subject is type(task) else {}
    name = getattr(subject, "__qualname__", type(subject).__qualname__)
    return [subject.__module__, name, _own_code(subject), table]


def _own_code(subject: Any) -> str:
    module = getattr(subject, "__module__", type(subject).__module__)
    ours = module.split(".")[0] in ("thesisrecon", "validation")
    return "" if ours or module.startswith(PREFIX) else code_digest(subject)


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
    plain = {
        key: table[key]
        for key in (*_TEXTS, "axes", "conditions", "scenes", "seeds", "subsets")
        if key in table
    }
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

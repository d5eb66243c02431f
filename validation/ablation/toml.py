"""Read a study from a TOML file; report invalid entries before anything runs."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from thesisrecon.config import preset
from thesisrecon.config.text import config_from_tables, dataclass_from_table
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.io._files import read_bytes
from validation.ablation.own import is_own, load_own
from validation.ablation.study import Measure, Study
from validation.ablation.tasks import TASKS

_TEXTS = ("title", "words", "mode", "baseline", "start")
_TABLES = ("axes", "conditions", "config")
_KEYS = (*_TEXTS, *_TABLES, "task", "preset", "scenes", "seeds", "subsets", "metrics")


def read_study(path: str | Path) -> Study:
    """Read the study of a file.

    Raises :class:`UsageError` naming the file if it is missing, not TOML, or has an unknown key (naming the
    nearest) or a wrong type. Paths, scenes and metrics are checked by ``plan_study``.
    """
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
    """Return names of measures, or measures described by tables."""
    if not isinstance(names, list):
        raise UsageError(f"metrics take a list; got {names!r}")
    for item in names:
        if not isinstance(item, str) and (not isinstance(item, Mapping) or "name" not in item):
            raise UsageError(f"a metric is a name or a table with one; got {item!r}")
    return [
        item if isinstance(item, str) else dataclass_from_table(Measure, item, "metrics") for item in names
    ]

"""Apply dotted paths and values to a configuration and a task; report invalid ones."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from thesisrecon.config import KINDS, PipelineConfig, preset
from thesisrecon.config.text import config_from_tables, dataclass_from_table
from thesisrecon.errors import UsageError, unknown_word
from validation.ablation.own_files import is_own, load_own
from validation.ablation.study import FunctionTask

TASK = "task"
STAGES = tuple(f.name for f in dataclasses.fields(PipelineConfig))


@dataclasses.dataclass(frozen=True)
class Setting:
    """Configuration and task of one row."""

    config: PipelineConfig
    task: Any


def changed(setting: Setting, path: str, value: Any, folder: Path) -> Setting:
    """Return ``setting`` with a value at a dotted path."""
    head, *rest = path.split(".")
    if head not in (TASK, *STAGES):
        raise UsageError(f"{path}: {unknown_word('stage', head, [*STAGES, TASK])}")
    if head == TASK:
        return dataclasses.replace(setting, task=_changed_task(setting.task, path, rest, value))
    if not rest:
        return dataclasses.replace(setting, config=_whole_stage(setting.config, head, value, folder))
    tables = {head: _nested(rest, value)}
    return dataclasses.replace(setting, config=config_from_tables(tables, setting.config))


def _nested(keys: list[str], value: Any) -> Any:
    return {keys[0]: _nested(keys[1:], value)} if keys else value


def _changed_task(task: Any, path: str, rest: list[str], value: Any) -> Any:
    if isinstance(task, FunctionTask) or not _is_object(task):
        raise UsageError(f"{path}: the task of this study is a function and has no parameters")
    if not rest:
        raise UsageError(f"{path}: a change of the task names a parameter, as task.noise_px")
    return dataclass_from_table(type(task), _nested(rest, value), TASK, task)


def _whole_stage(config: PipelineConfig, stage: str, value: Any, folder: Path) -> PipelineConfig:
    if isinstance(value, str):
        value = _own_variant(value, {}, stage, folder) if is_own(value) else {"kind": value}
    elif isinstance(value, Mapping) and is_own(str(value.get("kind", ""))):
        fields = {k: v for k, v in value.items() if k != "kind"}
        value = _own_variant(value["kind"], fields, stage, folder)
    elif isinstance(value, Mapping) and set(value) == {"preset"}:
        value = getattr(preset(str(value["preset"])), stage)
    if isinstance(value, Mapping):
        return config_from_tables({stage: value}, config)
    _check_variant(stage, value)
    return dataclasses.replace(config, **{stage: value})


def _own_variant(word: str, fields: Mapping[str, Any], stage: str, folder: Path) -> Any:
    kind = load_own(word, stage, folder)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise UsageError(f"{stage}: {word} is not a frozen dataclass, as a variant must be")
    return dataclass_from_table(kind, fields, stage)


def _check_variant(stage: str, value: Any) -> None:
    """Raise :class:`UsageError` unless an object is a dataclass with the methods of its stage."""
    if not _is_object(value):
        raise UsageError(f"{stage} takes a variant: a kind, a table or a frozen dataclass; got {value!r}")
    wanted = typing.get_type_hints(PipelineConfig)[stage]
    if stage not in KINDS:
        if not isinstance(value, wanted):
            raise UsageError(f"{stage} takes {wanted.__name__}; got {type(value).__name__}")
        return
    methods = [n for n, v in vars(wanted).items() if not n.startswith("_") and callable(v)]
    missing = [n for n in methods if not callable(getattr(value, n, None))]
    if missing:
        raise UsageError(
            f"{stage}: a {wanted.__name__} must have the method {missing[0]}; {type(value).__name__} has none"
        )


def _is_object(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def level_name(path: str, value: Any) -> str:
    """Return the name of an axis value in tables: the kind of a variant, a number with its field."""
    field = path.rpartition(".")[2]
    if isinstance(value, Mapping):
        fields = [f"{k} = {_text(v)}" for k, v in value.items() if k not in ("kind", "preset")]
        head = str(value.get("kind", value.get("preset", ""))).rpartition(":")[2]
        return ", ".join([head, *fields] if head else fields) or field
    if _is_object(value):
        fields = [f"{k} = {_text(v)}" for k, v in _non_default_fields(value).items()]
        return ", ".join([type(value).__name__, *fields])
    if isinstance(value, str):
        return value.rpartition(":")[2] if is_own(value) else value
    return f"{field} = {_text(value)}"


def _non_default_fields(value: Any) -> dict[str, Any]:
    found = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    try:
        usual = type(value)()
    except TypeError:
        return found
    return {name: own for name, own in found.items() if own != getattr(usual, name)}


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    return type(value).__name__ if _is_object(value) else str(value)

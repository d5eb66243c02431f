"""The configuration as text: TOML, ``--set stage.field=value`` and plain tables, with checked types.

A stage is a table: ``kind`` selects the method, the other keys are its fields: numbers, text, tuples of these
or dataclasses. ``None`` is written as the word ``none``, since TOML has no null.
"""

import dataclasses
import difflib
import json
import math
import tomllib
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from thesisrecon.config import KINDS, PRESETS, PipelineConfig, word_of
from thesisrecon.config import preset as _preset
from thesisrecon.config.plug_ins import NOT_IN_A_FILE, is_reference, load_reference, text_of
from thesisrecon.errors import Notice, UsageError, in_words, unknown_word
from thesisrecon.io._files import read_pairs, read_text

T = TypeVar("T")
Table = dict[str, Any]
Config = PipelineConfig | str | Path
"""A configuration, the name of a preset, or a TOML file."""
Pairs = str | Path | Sequence[Sequence[str]]
"""The words of ``--pairs``, a file of pairs, or pairs of file names."""
Settings = Mapping[str, Any] | Sequence[str]
"""``{"stage.field": value}``, or texts ``stage.field=value``."""
_NONE, _KIND = "none", "kind"


def build_config(
    config: Config | None = None, *, preset: str | None = None, max_size: int | None = None,
    cameras: str | None = None, pairs: Pairs | None = None, settings: Settings = (),
) -> PipelineConfig:  # fmt: skip
    """Build a configuration from the preset (given, or of the file), the file, the options, the settings."""
    options: dict[str, Table] = {
        "intrinsics": {} if cameras is None else {"cameras": cameras},
        "images": {} if max_size is None else {"max_size_px": max_size},
        "pairs": {} if pairs is None else _pairs_table(pairs),
    }
    options = {stage: table for stage, table in options.items() if table}
    over = tables_from_settings(settings)
    for stage, word in (("intrinsics", "cameras"), ("images", "max_size"), ("pairs", "pairs")):
        given = over.get(stage, {})
        for key, value in options.get(stage, {}).items():
            if isinstance(given, Mapping) and key in given and given[key] != value:
                raise UsageError(Notice("contradicting-setting", word, stage, key, value, given[key]))
    text, base = "", None
    if isinstance(config, PipelineConfig):
        base = config
    elif isinstance(config, Path) or (isinstance(config, str) and Path(config).is_file()):
        text = read_text(Path(config))
    elif isinstance(config, str) and config in PRESETS:
        base = PRESETS[config]
    elif isinstance(config, str):
        message = f"{unknown_word('preset', config, PRESETS)}; there is no TOML file of this name either"
        raise UsageError(message)
    elif config is not None:
        raise UsageError(Notice("no-configuration", in_words(config)))
    chosen = None if preset is None else _preset(preset)
    if base is not None and chosen not in (None, base):
        raise UsageError(f"preset={preset!r} and config contradict each other; give one of them")
    return config_from_toml(text, base or chosen, fixed_preset=chosen is not None, changes=(options, over))


def as_config(config: Config | None) -> PipelineConfig:
    """Return a configuration given as such, as a preset name or as a TOML file; None: preset ``default``."""
    return config if isinstance(config, PipelineConfig) else build_config(config)


def _pairs_table(value: Pairs) -> Table:
    """Return the settings for the option ``pairs``; a file takes precedence over the word "window"."""
    if not isinstance(value, str | Path):
        try:
            listed = [(one, two) for one, two in value]
        except (TypeError, ValueError):
            raise UsageError(f"pairs takes pairs of file names; got {in_words(value)}") from None
        return {_KIND: "listed-pairs", "listed": listed}
    words = {"all": "all-pairs", "overlap": "overlap-estimate"}
    if str(value) in words:
        return {_KIND: words[str(value)]}
    word, colon, number = str(value).partition(":")
    if word == "window" and (colon or not Path(value).is_file()):
        try:
            return {_KIND: "sequence-window", "window": int(number)}
        except ValueError:
            raise UsageError(f"pairs=window:N takes a whole number of images; got {str(value)!r}") from None
    if not Path(value).is_file():
        raise UsageError(Notice("no-pairs-file", str(value)))
    return {_KIND: "listed-pairs", "listed": read_pairs(Path(value))}


def config_from_toml(
    text: str, base: PipelineConfig | None = None, *, fixed_preset: bool = False,
    changes: Sequence[Mapping[str, Any]] = (),
) -> PipelineConfig:  # fmt: skip
    """Read a TOML configuration; a line ``preset = "thesis"`` selects the base, unless ``fixed_preset``.

    ``changes`` are further tables, later ones override; settings that need each other may come from several.
    """
    try:
        tables = tomllib.loads(text)
    except ValueError as error:
        raise UsageError(f"the configuration is not TOML: {error}") from None
    except RecursionError:
        raise UsageError("the configuration is nested too deeply") from None
    name = tables.pop("preset", None)
    if name is not None and not fixed_preset:
        base = _preset(name)
    base = base or PipelineConfig()
    for change in changes:
        for stage, table in change.items():
            old = tables.get(stage)
            if stage in KINDS and isinstance(old, Mapping) and isinstance(table, Mapping):
                kind = old.get(_KIND, _kind_of(stage, getattr(base, stage)))
                # The settings of another kind are dropped.
                tables[stage] = {} if table.get(_KIND, kind) != kind else old
        tables = _merged(tables, change)
    return config_from_tables(tables, base)


def _merged(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``over`` merged into ``under``, table by table."""
    merged = dict(under)
    for key, value in over.items():
        old = merged.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        merged[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return merged


def config_from_tables(tables: Mapping[str, Any], base: PipelineConfig | None = None) -> PipelineConfig:
    """Change a configuration by plain tables."""
    config = base or PipelineConfig()
    stages = [item.name for item in dataclasses.fields(config)]
    for stage, table in tables.items():
        if stage not in stages:
            raise UsageError(unknown_word("stage", stage, ["preset", *stages]))
        if not isinstance(table, Mapping):
            raise UsageError(f"{stage} takes a table of settings; got {in_words(table)}")
        method = _stage_from_table(stage, table, getattr(config, stage))
        config = dataclasses.replace(config, **{stage: method})
    return config


def _stage_from_table(stage: str, table: Mapping[str, Any], current: Any) -> Any:
    if stage not in KINDS:
        return dataclass_from_table(type(current), table, stage, current)
    fields = {key: value for key, value in table.items() if key != _KIND}
    own = _kind_of(stage, current)
    kind = table.get(_KIND, own)
    method = current if kind == own else _method_of_kind(stage, kind)
    if isinstance(method, type) and not dataclasses.is_dataclass(method) and not fields:
        return method()
    variant = method if isinstance(method, type) else type(method)
    if not dataclasses.is_dataclass(variant):
        if fields:
            raise UsageError(f"{stage}.kind={kind} has no settings; got {stage}.{next(iter(fields))}")
        return method
    names = _settings_of(variant)
    for key in fields:
        if key not in names:
            raise _unknown_setting(stage, key, [_KIND, *names])
    return dataclass_from_table(variant, fields, stage, None if isinstance(method, type) else method)


def _method_of_kind(stage: str, kind: Any) -> Any:
    """The class of a kind, or the object of ``file.py:name``."""
    if is_reference(kind):
        return load_reference(kind, f"{stage}.{_KIND}")
    if isinstance(kind, str) and kind.endswith(NOT_IN_A_FILE):
        raise UsageError(Notice("function-not-in-file", stage, kind.removesuffix(NOT_IN_A_FILE)))
    if not isinstance(kind, str) or kind not in KINDS[stage]:
        known = unknown_word(f"kind of {stage}", kind, KINDS[stage])
        raise UsageError(f"{known}; code in a file is path/to/file.py:name")
    return KINDS[stage][kind]


def tables_from_settings(settings: Settings) -> Table:
    """Parse settings, ``{"stage.field": value}`` or texts ``stage.field=value``; later ones override."""
    if isinstance(settings, str):
        raise UsageError(f"set takes a mapping or a list of stage.field=value; got {in_words(settings)}")
    tables: Table = {}
    items = settings.items() if isinstance(settings, Mapping) else map(_parse_setting, settings)
    for place, value in items:
        path = place.strip().split(".") if isinstance(place, str) else []
        if not 2 <= len(path) <= 16 or not all(path):
            raise UsageError(
                Notice("no-setting", "set" if isinstance(settings, Mapping) else "--set", in_words(place))
            )
        for key in reversed(path):
            value = {key: value}
        tables = _merged(tables, value)
    return tables


def _parse_setting(setting: Any) -> tuple[str, Any]:
    place, equals, text = setting.partition("=") if isinstance(setting, str) else ("", "", "")
    return (place, _parse(text)) if equals else (setting, None)


def _parse(text: str) -> Any:
    """Parse the value of ``--set``: true, false, a number, a flat list ``[a, b]``, else text."""
    text = text.strip()
    if text.startswith("[") and text.endswith("]"):
        # No setting is a list of lists.
        return [_parse_plain(part.strip()) for part in text[1:-1].split(",") if part.strip()]
    return _parse_plain(text)


def _parse_plain(text: str) -> Any:
    if text in ("true", "false"):
        return text == "true"
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    return text.strip("\"'")


def _kind_of(stage: str, variant: Any) -> str:
    """The word for a method in text: that of ``KINDS``, else its file and name."""
    return next((k for k, cls in KINDS[stage].items() if cls is type(variant)), None) or text_of(variant)


def tables_from_config(config: PipelineConfig) -> dict[str, Table]:
    """Return the complete configuration as plain tables."""
    stages = {item.name: getattr(config, item.name) for item in dataclasses.fields(config)}
    kinds = {stage: {_KIND: _kind_of(stage, stages[stage])} for stage in KINDS}
    return {stage: kinds.get(stage, {}) | table_from_dataclass(value) for stage, value in stages.items()}


def table_from_dataclass(value: Any) -> Table:
    """A dataclass as a table, with ``kind`` if the field takes several classes; {} for other objects."""
    if not dataclasses.is_dataclass(value):
        return {}
    hints = _hints(type(value))
    table = {}
    for name in _settings_of(type(value)):
        content, several = getattr(value, name), _alternatives(typing.get_args(hints[name]))
        table[name] = _plain(content)
        if type(content) in several.values():
            table[name] = {_KIND: word_of(type(content)), **table[name]}
    return table


def _hints(kind: type[Any]) -> dict[str, Any]:
    """Types of the fields, or the text of each where it cannot be evaluated, as at a prompt."""
    try:
        return typing.get_type_hints(kind)
    except NameError:
        return {item.name: item.type for item in dataclasses.fields(kind)}


def _settings_of(kind: type[Any]) -> list[str]:
    """Names of the fields without those that the pipeline fills with data (metadata ``given``)."""
    return [f.name for f in dataclasses.fields(kind) if not f.metadata.get("given")]


def _alternatives(union: Iterable[Any]) -> dict[str, type[Any]]:
    """Word -> class of the dataclasses among the members of a union, if there are several."""
    classes = [a for a in union if isinstance(a, type) and dataclasses.is_dataclass(a)]
    return {word_of(a): a for a in classes} if len(classes) > 1 else {}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return table_from_dataclass(value)
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str | list | dict):
        return _NONE if value is None else value
    return type(value).__name__


def dataclass_from_table(kind: type[T], table: Mapping[str, Any], where: str, base: T | None = None) -> T:
    """Build a dataclass from a table; ``where`` is its name in messages, ``base`` supplies other fields."""
    hints = _hints(kind)
    names = _settings_of(kind)
    changes = {}
    for key, value in table.items():
        if key not in names:
            raise _unknown_setting(where, key, names)
        current = None if base is None else getattr(base, key)
        changes[key] = _coerce(value, hints[key], f"{where}.{key}", current)
    try:
        return kind(**changes) if base is None else dataclasses.replace(base, **changes)  # type: ignore[type-var]
    except (ValueError, TypeError) as error:
        raise UsageError(f"[{where}] {error}") from None


def _unknown_setting(where: str, key: str, names: Sequence[str]) -> UsageError:
    near = difflib.get_close_matches(key, names, n=3, cutoff=0.6)
    known = " or ".join(f"{where}.{name}" for name in near)
    hint = f"did you mean {known}?" if near else f"{where} has {', '.join(names) or 'no settings'}"
    old = "delete it if an earlier version wrote it"
    return UsageError(f"unknown setting {in_words(f'{where}.{key}')}; {hint} ({old})")


def _coerce(value: Any, annotation: Any, where: str, current: Any = None) -> Any:
    """Convert a plain value to an annotated type (an int to a float, never text to a number)."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        if value is None or value == _NONE:
            return None
        if several := _alternatives(arguments):
            return _coerce_alternative(value, several, where, current)
        return _coerce(value, next(a for a in arguments if a is not type(None)), where, current)
    if origin is Literal:
        if value in arguments and isinstance(value, str):
            return value
        raise UsageError(unknown_word(f"value of {where}", value, [str(a) for a in arguments]))
    if origin is tuple and isinstance(value, list | tuple):
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            arguments = (arguments[0],) * len(value)
        if len(value) != len(arguments):
            raise UsageError(f"{where} takes a list of {len(arguments)} values; got {len(value)}")
        return tuple(_coerce(v, arguments[n], f"{where}[{n}]") for n, v in enumerate(value))
    if dataclasses.is_dataclass(annotation) and isinstance(annotation, type) and isinstance(value, Mapping):
        return dataclass_from_table(annotation, value, where, current)
    whole = type(value) is int and abs(value) < 2**63
    if annotation is float and (whole or (type(value) is float and not math.isnan(value))):
        return float(value)
    if type(value) is annotation and (annotation in (str, bool) or whole):
        return value
    words = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    needed = words.get(annotation, "a list" if origin is tuple else "a table of settings")
    raise UsageError(f"{where} takes {needed}; got {in_words(value)}")


def _coerce_alternative(value: Any, several: Mapping[str, type[Any]], where: str, current: Any) -> Any:
    """One of several dataclasses from its word, or from a table with ``kind`` (default: unchanged)."""
    table = {_KIND: value} if isinstance(value, str) else value
    if not isinstance(table, Mapping):
        raise UsageError(Notice("no-alternative", where, ", ".join(several), in_words(value)))
    kind = table.get(_KIND, word_of(type(current)))
    if not isinstance(kind, str) or kind not in several:
        raise UsageError(unknown_word(f"kind of {where}", kind, several))
    fields = {key: v for key, v in table.items() if key != _KIND}
    base = current if type(current) is several[kind] else None
    return dataclass_from_table(several[kind], fields, where, base)


def toml_from_config(config: PipelineConfig) -> str:
    """Return the configuration as TOML, which :func:`config_from_toml` reads back."""
    return "\n".join(_toml_lines(tables_from_config(config), ())).strip() + "\n"


def _toml_lines(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    plain = {k: v for k, v in table.items() if not isinstance(v, Mapping)}
    lines = ["", f"[{'.'.join(path)}]"] if path and (plain or not table) else []
    lines += [f"{key} = {_toml_value(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, Mapping):
            lines += _toml_lines(value, (*path, key))
    return lines


def _toml_value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, str | bool):
        # JSON has the same words; TOML wants one character more escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)

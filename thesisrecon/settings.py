"""Frozen dataclasses as plain tables and TOML text: types checked, unknown keys refused with a sentence.

Nothing here knows a stage: a variant is any frozen dataclass whose fields are numbers, words, tuples of
those or further dataclasses. ``None`` is written as the word ``none``, since TOML has no empty value.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypeVar

from thesisrecon.errors import UsageError

T = TypeVar("T")
Table = dict[str, Any]
NONE = "none"
KIND = "kind"
LONGEST_WORDS = 120
"""Characters of a value that a sentence repeats."""
GIVEN = {"given": True}
"""Metadata of a field that the composer fills with data: it is no setting."""


def table_from_dataclass(value: Any) -> Table:
    """The fields of a dataclass as a table of plain values (numbers, text, lists, tables).

    Where a field may hold one of several dataclasses, its table begins with the ``kind``.
    """
    hints = typing.get_type_hints(type(value))
    table = {}
    for name in _settings_of(type(value)):
        content, several = getattr(value, name), alternatives(typing.get_args(hints[name]))
        head = {KIND: word_of(type(content))} if type(content) in several.values() else {}
        table[name] = head | _plain(content) if head else _plain(content)
    return table


def _settings_of(kind: type[Any]) -> list[str]:
    return [f.name for f in dataclasses.fields(kind) if not f.metadata.get("given")]


def word_of(kind: type[Any]) -> str:
    """The word of a class in text: ``ModulusConstraint`` is "modulus-constraint"."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", kind.__name__).lower()


def alternatives(union: Iterable[Any]) -> dict[str, type[Any]]:
    """Word -> class where several members of a union are dataclasses, else nothing."""
    classes = [a for a in union if isinstance(a, type) and dataclasses.is_dataclass(a)]
    return {word_of(a): a for a in classes} if len(classes) > 1 else {}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return table_from_dataclass(value)
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return NONE if value is None else value


def dataclass_from_table(kind: type[T], table: Mapping[str, Any], where: str, base: T | None = None) -> T:
    """A ``kind`` whose fields are those of ``table`` and, for the rest, of ``base`` (or the defaults).

    ``where`` is the dotted place of the table, for the sentence. Raises :class:`UsageError` for an unknown
    key, a value of another type, and whatever the dataclass itself refuses.
    """
    hints = typing.get_type_hints(kind)
    names = _settings_of(kind)
    changes = {}
    for key, value in table.items():
        place = f"{where}.{key}"
        if key not in names:
            raise unknown_setting(where, key, names)
        changes[key] = coerce(value, hints[key], place, None if base is None else getattr(base, key))
    try:
        return kind(**changes) if base is None else dataclasses.replace(base, **changes)  # type: ignore[type-var]
    except (ValueError, TypeError) as error:
        raise UsageError(f"[{where}] {error}") from None


def coerce(value: Any, annotation: Any, where: str, current: Any = None) -> Any:
    """``value`` as the annotated type: bool, int, float, str, Literal, tuple, dataclass, or one of those or
    None.

    An int stands for a float, never the other way round, and text is never taken for a number. ``current``
    is the value a dataclass' table starts from. Raises :class:`UsageError` that names the place and what it
    takes.
    """
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return _coerce_optional(value, arguments, where, current)
    if origin is Literal:
        if value in arguments and isinstance(value, str):
            return value
        raise UsageError(unknown_word(f"value of {where}", value, [str(a) for a in arguments]))
    if origin is tuple and isinstance(value, list | tuple):
        return _coerce_tuple(value, arguments, where)
    if dataclasses.is_dataclass(annotation) and isinstance(annotation, type) and isinstance(value, Mapping):
        return dataclass_from_table(annotation, value, where, current)
    if annotation is float and _is_number(value):
        return float(value)
    if annotation in (str, bool) and type(value) is annotation:
        return value
    if annotation is int and type(value) is int and _fits(value):
        return value
    raise UsageError(f"{where} takes {_type_words(annotation)}; got {in_words(value)}")


def _fits(number: int) -> bool:
    """Whether arrays can hold it."""
    return abs(number) < 2**63


def _is_number(value: Any) -> bool:
    if type(value) is int:
        return _fits(value)
    return type(value) is float and not math.isnan(value)


def _coerce_optional(value: Any, arguments: tuple[Any, ...], where: str, current: Any) -> Any:
    if value is None or value == NONE:
        return None
    if several := alternatives(arguments):
        return _coerce_alternative(value, several, where, current)
    rest = [a for a in arguments if a is not type(None)]
    return coerce(value, rest[0], where, current)


def _coerce_alternative(value: Any, several: Mapping[str, type[Any]], where: str, current: Any) -> Any:
    """One of several dataclasses: its word alone, or a table whose ``kind`` is the word (else as before)."""
    table = {KIND: value} if isinstance(value, str) else value
    if not isinstance(table, Mapping):
        one_of = f"one of {', '.join(several)} or a table of settings"
        raise UsageError(f"{where} takes {one_of}; got {in_words(value)}")
    kind = table.get(KIND, word_of(type(current)))
    if not isinstance(kind, str) or kind not in several:
        raise UsageError(unknown_word(f"kind of {where}", kind, several))
    fields = {key: v for key, v in table.items() if key != KIND}
    base = current if type(current) is several[kind] else None
    return dataclass_from_table(several[kind], fields, where, base)


def _coerce_tuple(
    value: list[Any] | tuple[Any, ...], arguments: tuple[Any, ...], where: str
) -> tuple[Any, ...]:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(value) != len(arguments):
        raise UsageError(f"{where} takes a list of {len(arguments)} values; got {len(value)}")
    return tuple(coerce(v, a, f"{where}[{n}]") for n, (v, a) in enumerate(zip(value, arguments, strict=True)))


def _type_words(annotation: Any) -> str:
    words = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    if annotation in words:
        return words[annotation]
    return "a list" if typing.get_origin(annotation) is tuple else "a table of settings"


def in_words(value: Any) -> str:
    """A value as it was written, or how it begins where that is long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        # Python prints no number of thousands of digits and no endless nest of tables.
        text = f"{type(value).__name__} beyond measure"
    return text if len(text) <= LONGEST_WORDS else text[: LONGEST_WORDS - 3] + "..."


def unknown_setting(where: str, key: str, names: Iterable[str]) -> UsageError:
    """The refusal of a key that the table at ``where`` does not have; it names the nearest of ``names``."""
    near = difflib.get_close_matches(key, names := list(names), n=3, cutoff=0.6)
    known = " or ".join(f"{where}.{name}" for name in near)
    hint = f"did you mean {known}?" if near else f"{where} has {', '.join(names)}"
    return UsageError(f"unknown setting {in_words(f'{where}.{key}')}; {hint}")


def unknown_word(what: str, word: Any, known: Iterable[str]) -> str:
    """'unknown <what> <word>; did you mean ...?': the nearest known words, or all where none is near."""
    known = list(known)
    near = difflib.get_close_matches(word, known, n=3, cutoff=0.6) if isinstance(word, str) else []
    hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(known)}"
    return f"unknown {what} {in_words(word)}; {hint}"


def parse_word(text: str) -> Any:
    """The value of ``--set key=value``: true, false, a number, a list ``[a, b]``, else the text itself."""
    text = text.strip()
    if text.startswith("[") and text.endswith("]"):
        # Lists of lists are no settings.
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


def toml_from_tables(tables: Mapping[str, Any]) -> str:
    """TOML text of nested tables; ``tomllib`` reads back the same tables."""
    return "\n".join(_toml_lines(tables, ())).strip() + "\n"


def _toml_lines(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    plain = {k: v for k, v in table.items() if not isinstance(v, Mapping)}
    lines = ["", f"[{'.'.join(path)}]"] if path and (plain or not table) else []
    lines += [f"{key} = {_toml_value(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, Mapping):
            lines += _toml_lines(value, (*path, key))
    return lines


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'
    return repr(value)

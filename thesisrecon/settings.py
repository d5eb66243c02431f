"""Frozen dataclasses as plain tables and TOML: types are checked, unknown keys refused.

Fields are numbers, text, tuples of these or dataclasses. ``None`` is written as the word ``none``, since TOML
has no null.
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
MAX_SHOWN = 120
"""Maximum length of a value in a message."""


def table_from_dataclass(value: Any) -> Table:
    """Convert a dataclass to a table of plain values.

    Parameters
    ----------
    value : dataclass

    Returns
    -------
    dict
        Field -> number, text, list or table; a table of one of several dataclasses begins with ``kind``.
    """
    hints = typing.get_type_hints(type(value))
    table = {}
    for name in _settings_of(type(value)):
        content, several = getattr(value, name), alternatives(typing.get_args(hints[name]))
        head = {KIND: word_of(type(content))} if type(content) in several.values() else {}
        table[name] = head | _plain(content) if head else _plain(content)
    return table


def _settings_of(kind: type[Any]) -> list[str]:
    """Names of the fields without those that the pipeline fills with data (metadata ``given``)."""
    return [f.name for f in dataclasses.fields(kind) if not f.metadata.get("given")]


def word_of(kind: type[Any]) -> str:
    """Return the word of a class in text.

    Parameters
    ----------
    kind : type

    Returns
    -------
    str
        Its name in kebab case: "modulus-constraint" for ``ModulusConstraint``.
    """
    return re.sub(r"(?<!^)(?=[A-Z])", "-", kind.__name__).lower()


def alternatives(union: Iterable[Any]) -> dict[str, type[Any]]:
    """Return the dataclasses among the members of a union, if there are several.

    Parameters
    ----------
    union : iterable
        Members of the union.

    Returns
    -------
    dict
        Word -> class; empty with fewer than two.
    """
    classes = [a for a in union if isinstance(a, type) and dataclasses.is_dataclass(a)]
    return {word_of(a): a for a in classes} if len(classes) > 1 else {}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return table_from_dataclass(value)
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return NONE if value is None else value


def dataclass_from_table(kind: type[T], table: Mapping[str, Any], where: str, base: T | None = None) -> T:
    """Build a dataclass from a table.

    Parameters
    ----------
    kind : type
    table : mapping
        Field -> plain value.
    where : str
        Dotted name of the table, for messages.
    base : dataclass, optional
        Supplies the other fields; None: the defaults.

    Returns
    -------
    dataclass
        An instance of ``kind``.

    Raises
    ------
    UsageError
        If a key is unknown, or a value has the wrong type or is refused by the dataclass.
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
    """Convert a plain value to an annotated type.

    An int is accepted for a float, never the reverse; text is never accepted for a number.

    Parameters
    ----------
    value : object
        Plain value.
    annotation : type
        bool, int, float, str, Literal, tuple, dataclass, or an optional of these.
    where : str
        Dotted name of the setting, for messages.
    current : object, optional
        Base of a dataclass.

    Returns
    -------
    object

    Raises
    ------
    UsageError
        If the value has the wrong type.
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
    """Whether it fits in 64 bits."""
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
    """One of several dataclasses from its word, or from a table with ``kind`` (default: unchanged)."""
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
    words = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    if annotation in words:
        return words[annotation]
    return "a list" if typing.get_origin(annotation) is tuple else "a table of settings"


def in_words(value: Any) -> str:
    """Return a value as text for a message, shortened to ``MAX_SHOWN``.

    Parameters
    ----------
    value : object

    Returns
    -------
    str
        Its ``repr``.
    """
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        # Python refuses to print numbers of thousands of digits and infinite nesting.
        text = f"{type(value).__name__} too large to print"
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 3] + "..."


def unknown_setting(where: str, key: str, names: Iterable[str]) -> UsageError:
    """Return the error for an unknown key, with the nearest known ones.

    Parameters
    ----------
    where : str
        Dotted name of the table.
    key : str
        The unknown key.
    names : iterable of str
        Its known keys.

    Returns
    -------
    UsageError
    """
    near = difflib.get_close_matches(key, names := list(names), n=3, cutoff=0.6)
    known = " or ".join(f"{where}.{name}" for name in near)
    hint = f"did you mean {known}?" if near else f"{where} has {', '.join(names)}"
    return UsageError(f"unknown setting {in_words(f'{where}.{key}')}; {hint}")


def unknown_word(what: str, word: Any, known: Iterable[str]) -> str:
    """Return a message about an unknown word with the nearest known ones, or all.

    Parameters
    ----------
    what : str
        Kind of word.
    word : object
        The unknown word.
    known : iterable of str
        Known words.

    Returns
    -------
    str

    Examples
    --------
    >>> unknown_word("preset", "tesis", ["default", "thesis"])
    "unknown preset 'tesis'; did you mean thesis?"
    """
    known = list(known)
    near = difflib.get_close_matches(word, known, n=3, cutoff=0.6) if isinstance(word, str) else []
    hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(known)}"
    return f"unknown {what} {in_words(word)}; {hint}"


def parse_word(text: str) -> Any:
    """Parse the value of ``--set key=value``.

    Parameters
    ----------
    text : str

    Returns
    -------
    bool, int, float, list or str
        true, false, a number, a flat list ``[a, b]``, else the text.

    Examples
    --------
    >>> parse_word("[1, 2.5, none]"), parse_word("true")
    ([1, 2.5, 'none'], True)
    """
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


def toml_from_tables(tables: Mapping[str, Any]) -> str:
    """Write nested tables as TOML, which ``tomllib`` reads back.

    Parameters
    ----------
    tables : mapping
        Nested tables of plain values.

    Returns
    -------
    str
        TOML text.
    """
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

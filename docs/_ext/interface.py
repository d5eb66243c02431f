"""Pages of the command line and of every setting, made from the code."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import typing
from itertools import takewhile
from pathlib import Path
from typing import Any

import typer
from numpydoc.docscrape import NumpyDocString

from _ext.code import write
from thesisrecon import config
from thesisrecon.cli.commands import app as command_line
from thesisrecon.config import text


def cell(text: Any) -> str:
    """Text for a cell of a table, names in plain backticks instead of Sphinx roles."""
    plain = re.sub(r":[a-z]+:`~?(?:thesisrecon\.(?:\w+\.)*)?([^`]+)`", r"`\1`", " ".join(str(text).split()))
    return plain.replace("``", "`").replace("|", r"\|")


def command_page() -> str:
    """Return the page of all commands with their arguments and options."""
    lines = [
        "# Command line",
        "",
        "This page is made from the code. `thesisrecon COMMAND --help` prints the same. Exit codes: 0 done,",
        "2 wrong command or settings, 3 the images cannot be reconstructed, 4 a limit of `compare` exceeded",
        "or an exercise not solved, 130 and 143 interrupted, 1 internal error.",
        "",
    ]
    for info in command_line.registered_commands:
        function = info.callback
        lines += [f"## {function.__name__}", "", (inspect.getdoc(function) or "").replace("\f", ""), ""]
        lines += ["| argument or option | default | meaning |", "| --- | --- | --- |"]
        hints = typing.get_type_hints(function, include_extras=True)
        for name, parameter in inspect.signature(function).parameters.items():
            kind, option = typing.get_args(hints[name])[:2]
            # Within Annotated, typer takes the first name for a default.
            words = (
                *([option.default] if isinstance(option.default, str) else []),
                *(option.param_decls or ()),
            )
            names = ", ".join(f"`{word}`" for word in words)
            names = names or (f"`--{name.replace('_', '-')}`" if is_option(option) else f"`{name.upper()}`")
            values = option.metavar or value_words(kind)
            shown = names + (f" {cell(values)}" if is_option(option) and values else "")
            default = parameter.default
            empty = default is inspect.Parameter.empty or default in (None, False, ...)
            lines.append(f"| {shown} | {'' if empty else f'`{default}`'} | {cell(option.help or '')} |")
        lines.append("")
    return "\n".join(lines)


def is_option(option: Any) -> bool:
    """Is a parameter an option and no argument?"""
    return isinstance(option, typer.models.OptionInfo)


def value_words(kind: Any) -> str:
    """Words for the values of an option of a type."""
    members = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Literal:
        return "|".join(map(str, members))
    plain = [m for m in members if m is not type(None)] or [kind]
    if typing.get_origin(plain[0]) is typing.Literal:
        return value_words(plain[0])
    return {bool: "", int: "N", float: "X", Path: "PATH"}.get(plain[0], "TEXT")


def settings_page() -> str:
    """Return the page of all settings by stage and method."""
    lines = [
        "# Settings",
        "",
        "This page is made from the code. `--set stage.field=value` sets one value and",
        "`--set stage.kind=METHOD` selects a method. In a TOML file each stage is a table.",
        "Each run writes its settings as `config.toml`. The methods of the presets are marked.",
        "",
    ]
    for item in dataclasses.fields(config.PipelineConfig):
        stage, used = item.name, getattr(config.PRESETS["default"], item.name)
        thesis = getattr(config.PRESETS["thesis"], stage)
        lines += [f"## {stage}", ""]
        for word, kind in config.KINDS.get(stage, {"": type(used)}).items():
            value = next((v for v in (used, thesis) if type(v) is kind), None)
            marks = [m for m, v in (("default", used), ("thesis", thesis)) if type(v) is kind]
            title = f"### `{stage}.kind={word}`" + (f" ({', '.join(marks)})" if marks else "")
            lines += ([title, ""] if word else []) + class_lines(stage, kind, value)
    return "\n".join(lines)


def class_lines(path: str, kind: type[Any], value: Any) -> list[str]:
    """Return the description and the settings of one class, and those of the objects within it."""
    doc = NumpyDocString(inspect.getdoc(kind) or "")
    lines = [reference(kind) + cell(" ".join(doc["Summary"])), ""]
    value = kind() if value is None and not required(kind) else value
    names, inner = text._settings_of(kind), []
    rows: dict[int, list[str]] = {}  # names that are described together stand in one row
    hints, notes = text._hints(kind), field_notes(kind)
    described = {name.strip(): p for p in doc["Parameters"] + doc["Attributes"] for name in p.name.split(",")}
    for name in names:
        default = getattr(value, name, None)
        several = text._alternatives(typing.get_args(hints[name]))
        classes = list(several.items()) or (
            [("", type(default))] if dataclasses.is_dataclass(default) else []
        )
        if classes:
            inner.append((name, default, classes))
        parameter = described.get(name)
        shown = "see below" if classes else f"`{toml(default)}`"
        meaning = cell(" ".join(parameter.desc) if parameter is not None else notes.get(name, ""))
        meaning = meaning or ("Method." if classes else "")
        row = rows.setdefault(id(parameter) if parameter is not None else id(name), ["", "", meaning])
        row[0] += f"<br>`{name}`" if row[0] else f"`{name}`"
        row[1] += f"<br>{shown}" if row[1] else shown
    if rows:
        lines += ["| setting | default | meaning |", "| --- | --- | --- |"]
        lines += [*(f"| {' | '.join(row)} |" for row in rows.values()), ""]
    for name, default, classes in inner:
        for word, alternative in classes:
            given = default if type(default) is alternative else None
            mark = " (default)" if word and given is not None else ""
            lines += [f"`{path}.{name}" + (f".kind={word}`{mark}:" if word else "`:"), ""]
            lines += class_lines(f"{path}.{name}", alternative, given)
    return lines


def field_notes(kind: type[Any]) -> dict[str, str]:
    """Return what stands beside or above (#:) or below the fields of a class in its source."""
    source = inspect.getsource(kind)
    body, lines = ast.parse(source).body[0].body, source.splitlines()
    notes = {}
    for node, below in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign):
            beside = lines[node.end_lineno - 1].partition("#: ")[2]
            before = map(str.strip, lines[node.lineno - 2 :: -1])
            above = [line[3:] for line in takewhile(lambda line: line.startswith("#: "), before)]
            beside = beside or " ".join(above[::-1])
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                beside = beside or str(below.value.value)
            notes[node.target.id] = beside[:1].upper() + beside[1:]
    return notes


def reference(kind: type[Any]) -> str:
    """Return a link to the class, if its module has a page."""
    internal = any(part.startswith("_") for part in kind.__module__.split("."))
    return "" if internal else f"{{py:class}}`~{kind.__module__}.{kind.__name__}`: "


def required(kind: type[Any]) -> bool:
    """Has a class fields without a default?"""
    missing = dataclasses.MISSING
    return any(f.default is missing and f.default_factory is missing for f in dataclasses.fields(kind))


def toml(value: Any) -> str:
    """Return a value as it is written in a TOML file."""
    try:
        return text._toml_value(text._plain(value))
    except (TypeError, ValueError):
        return str(value)


def setup(app):
    """Write both pages before the sources are read."""

    def write_pages(app) -> None:
        folder = Path(app.srcdir) / "reference"
        write(folder / "command-line.md", command_page())
        write(folder / "settings.md", settings_page())

    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

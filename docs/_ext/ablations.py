"""Page of what an ablation varies and measures, and of what own studies import, made from the code."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from types import ModuleType

import validation.metrics
import validation.scenes
from _ext.code import write
from _ext.interface import cell, toml
from validation.ablation.tasks import TASKS
from validation.scenes.layout import SETS

HEAD = """# Tasks, scenes and metrics of ablations

This page is made from the code. [Add a variant or an ablation](../development/ablations.md) shows how a
study names them. A metric marked * is analysed only if the study names it.
"""


def page() -> str:
    """Return the page."""
    lines = [HEAD]
    for word, task in TASKS.items():
        lines += [f"## {word}", "", cell(inspect.getdoc(task)), ""]
        lines += [f"Scenes: {', '.join(f'`{name}`' for name in task().names_of_scenes())}.", ""]
        lines += ["| parameter | default |", "| --- | --- |"]
        lines += [f"| `task.{f.name}` | `{toml(f.default)}` |" for f in dataclasses.fields(task)]
        lines += ["", "| metric | unit | better | definition |", "| --- | --- | --- | --- |"]
        lines += [
            f"| `{m.name}`{'*' * m.extra} | {m.unit} | {m.better} | {cell(m.definition)} |"
            for m in task.measures
        ]
        lines += [""]
    command = "`python -m validation layout strecha FOLDER -o OUT` lays out a download of this set."
    lines += ["## Public data sets", "", command, ""]
    lines += ["| set | the download |", "| --- | --- |"]
    lines += [f"| `{name}` | {cell(one.about)} |" for name, one in SETS.items()]
    for module in (validation.scenes, validation.metrics):
        lines += ["", f"## {module.__name__}", "", cell(inspect.getdoc(module)), "", *_names(module)]
    return "\n".join(lines) + "\n"


def _names(module: ModuleType) -> list[str]:
    """A table of the public names of a module: signature and summary."""
    lines = ["| name | meaning |", "| --- | --- |"]
    for name in module.__all__:
        found = getattr(module, name)
        summary = (inspect.getdoc(found) or "").split("\n\n")[0]
        given = "" if inspect.isclass(found) else f"({', '.join(inspect.signature(found).parameters)})"
        lines.append(f"| `{name}{given}` | {cell(summary)} |")
    return lines


def setup(app):
    """Write the page before the sources are read."""
    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "reference" / "ablations.md", page()))
    return {"parallel_read_safe": True, "parallel_write_safe": True}

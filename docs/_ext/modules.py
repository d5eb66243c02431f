"""One page for each public module of the package, so that every algorithm of a chapter can be linked to."""

from __future__ import annotations

import inspect
import re
import typing
from pathlib import Path

from sphinx.util.nodes import make_refnode

import thesisrecon
from _ext.code import PACKAGE, summary, write
from _ext.examples import RETURNED_BY

LEFT_OUT = ("cli", "report", "runtime")
"""Folders without functions for callers."""
PUBLIC = """# Public functions and records

Each name is `thesisrecon.NAME` and has a page with its parameters, shapes, units and an example that runs.
[Plain arrays](../recipes/plain-arrays.md) shows them side by side; the [modules](modules/index) behind them
hold the algorithms of each chapter.
"""


def public_modules() -> list[Path]:
    """Files of the package whose name does not begin with an underscore, in the order of folders."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py"), key=lambda p: (len(p.relative_to(PACKAGE).parts), p)):
        parts = path.relative_to(PACKAGE).parts
        public = not path.name.startswith("_") or parts == ("config", "__init__.py")
        if public and parts[0] not in LEFT_OUT:
            found.append(path)
    return found


def write_pages(folder: Path) -> None:
    """Write a page for each module and an index of them by folder."""
    folder.mkdir(parents=True, exist_ok=True)
    groups: dict[str, list[str]] = {}
    for path in public_modules():
        relative = path.relative_to(PACKAGE).with_suffix("")
        name = ("thesisrecon." + ".".join(relative.parts)).removesuffix(".__init__")
        title = name.removeprefix("thesisrecon.")
        text = f"{title}\n{'=' * len(title)}\n\n.. automodule:: {name}\n   :members:\n"
        write(folder / f"{name}.rst", text)
        groups.setdefault(relative.parts[0] if len(relative.parts) > 1 else "", []).append(name)
    lines = [
        "# Modules",
        "",
        "The algorithms of each chapter, beyond the functions of `thesisrecon` itself.",
        "",
    ]
    for group, names in groups.items():
        title = f"{group}/" if group else "The package itself"
        about = summary(PACKAGE / group / "__init__.py") if group else ""
        lines += [f"## {title}", "", about, "", "```{toctree}", ":maxdepth: 1", "", *names, "```", ""]
    write(folder / "index.md", "\n".join(lines))


def write_public_names(path: Path) -> None:
    """Write the page of the public names, in the groups and the order of ``thesisrecon/__init__.pyi``."""
    lines = [PUBLIC]
    for group in (PACKAGE / "__init__.pyi").read_text(encoding="utf-8").split("\n# ")[1:]:
        title, names = group.partition("\n")[0], re.findall(r" as (\w+)$", group, re.MULTILINE)
        lines += [f"## {title}", "", "```{eval-rst}", ".. currentmodule:: thesisrecon", ".. autosummary::"]
        lines += ["   :toctree: generated", "   :nosignatures:", "", *(f"   {name}" for name in names)]
        lines += ["```", ""]
    write(path, "\n".join(lines))


def skip_aliases(app, what, name, obj, skip, options):
    """Leave out names of types such as ``tuple[int, int]``, whose docstrings are those of Python."""
    origin = typing.get_origin(obj)
    return True if origin not in (None, typing.Literal) or isinstance(obj, typing.TypeVar) else None


def escape_bars(app, what, name, obj, options, lines) -> None:
    """Absolute values such as |x| are no substitutions, except in examples; "R. Hartley" is no list."""
    inside = False
    for k, line in enumerate(lines):
        inside = line.lstrip().startswith(">>>") or (inside and bool(line.strip()))
        lines[k] = line = re.sub(r"^(\s*\.\. \[\d\] \w)\. ", r"\1\\. ", line)
        if not inside and "|" in line:
            pieces = re.split(r"(``.+?``|`.+?`)", line)
            pieces[::2] = [piece.replace("|", r"\|") for piece in pieces[::2]]
            lines[k] = "".join(pieces)


def add_example(app, what, name, obj, options, lines) -> None:
    """Show the example of a function on the page of the record that it returns or takes."""
    short = name.rpartition(".")[2]
    if what == "class" and name == f"thesisrecon.{short}" and short in RETURNED_BY:
        text = inspect.getdoc(getattr(thesisrecon, RETURNED_BY[short])) or ""
        example = text.partition("Examples\n--------\n")[2].splitlines()
        role = f"Of :func:`thesisrecon.{RETURNED_BY[short]}`:"
        lines += ["", "Examples", "--------", role, "", *example, ""]


def resolve(app, env, node, contnode):
    """Find the one documented object that a short name such as ``Matches`` or ``Camera.std`` means."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py" or not target:
        return None
    if re.match(r"thesisrecon\.(\w+\.)*_|collections\.abc|concurrent\.|numpy\.", target):
        return contnode  # internal, or of another project
    domain = env.get_domain("py")
    for name in (f"thesisrecon.{target}", target.rpartition(".")[0]):
        if name in domain.objects:
            break
    else:
        found = [name for name in domain.objects if name.endswith(f".{target}")]
        if len(found) != 1:
            return None
        name = found[0]
    entry = domain.objects[name]
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, contnode, name)


def setup(app):
    """Write the pages before the sources are read, and connect what reads docstrings."""
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir) / "reference" / "modules"))
    # Before the sources are listed, which autosummary makes pages for.
    names = Path(app.srcdir) / "reference" / "api.md"
    app.connect("config-inited", lambda *_: write_public_names(names))
    app.connect("autodoc-skip-member", skip_aliases)
    app.connect("autodoc-process-docstring", add_example, priority=300)
    app.connect("autodoc-process-docstring", escape_bars, priority=400)
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

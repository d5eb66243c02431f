"""Every failure, warning and failed check of the package, with cause and remedy.

Warnings, failed checks and reasons stand in `thesisrecon/messages.toml`. Failures with their own advice are
read from the source.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path

from _ext.code import PACKAGE, summary, tree_of, write

TABLES = tomllib.loads((PACKAGE / "messages.toml").read_text(encoding="utf-8"))
"""Heading -> code -> text and remedy."""
CALLS: dict[str, str] = TABLES.pop("Wrong calls")
"""Code -> text, which contains the remedy."""
PLACES: dict[str, str] = TABLES.pop("Places that cannot be written")
"""Name of the error -> remedy."""
EXPLAINED = "Failures of several stages"
FOLDERS = (
    "api", "pipeline", "io", "matching", "epipolar", "geometry", "optimize", "projective", "selfcalibration",
    "metric", "stereo", "surface", "views", "",
)  # fmt: skip


def assigned(scope: ast.AST) -> dict[str, list[ast.expr]]:
    """Names and the expressions that are assigned to them, also of tuples."""
    found: dict[str, list[ast.expr]] = {}
    for node in (n for n in ast.walk(scope) if isinstance(n, ast.Assign)):
        target, value = node.targets[0], node.value
        several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
        for name, one in zip(target.elts, value.elts, strict=True) if several else [(target, value)]:
            found.setdefault(ast.unparse(name), []).append(one)
    return found


def template(node: ast.expr | None, names: dict[str, list[ast.expr]]) -> str:
    """The text of an expression; "…" for a value, and variants between slashes."""
    if node is None or isinstance(node, ast.Constant):
        return "" if node is None else str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(template(part, {}) for part in node.values)
    if isinstance(node, ast.BinOp):
        return template(node.left, names) + template(node.right, names)
    if isinstance(node, ast.IfExp):
        variants = [template(node.body, names), template(node.orelse, names)]
    else:
        variants = [template(value, {}) for value in names.get(ast.unparse(node), [])]
    return " / ".join(dict.fromkeys(filter(None, variants))) or "…"


def stage_failures() -> dict[str, list[tuple[str, str, str]]]:
    """Reason, evidence and advice of every failure by folder; one that is only passed on is left out."""
    found: dict[str, list[tuple[str, str, str]]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        folder = path.relative_to(PACKAGE).parent.parts[:1] or ("",)
        constants = assigned(ast.Module([n for n in tree_of(path).body if isinstance(n, ast.Assign)], []))
        for function in (n for n in ast.walk(tree_of(path)) if isinstance(n, ast.FunctionDef)):
            for call in (n for n in ast.walk(function) if isinstance(n, ast.Call)):
                if ast.unparse(call.func) == "StageFailure":
                    given = dict(zip(("reason", "evidence", "advice"), call.args, strict=False))
                    given |= {word.arg: word.value for word in call.keywords}
                    names = constants | assigned(function)
                    row = tuple(template(given.get(k), names) for k in ("reason", "evidence", "advice"))
                    if any(c.isalpha() for c in row[0]):
                        found.setdefault(folder[0], []).append(row)
    return {folder: sorted(set(rows)) for folder, rows in found.items()}


def page() -> str:
    """Return the page of all failures and warnings."""
    lines = [HEAD]
    for title, messages in TABLES.items():
        rows = [(f"`{code}`", re.sub("{[^}]*}", "…", text), why) for code, (text, why) in messages.items()]
        lines += [FAILURES] if title == EXPLAINED else []
        lines += table(title, ("code", "message", "cause and remedy"), rows)
    for folder, rows in sorted(stage_failures().items(), key=lambda found: FOLDERS.index(found[0])):
        title = summary(PACKAGE / folder / "__init__.py").rstrip(".") if folder else "Functions of arrays"
        lines += table(title, ("reason", "evidence", "what to do"), rows)
    calls = [(f"`{code}`", re.sub("{[^}]*}", "…", text)) for code, text in CALLS.items()]
    lines += table("Wrong calls", ("code", "message"), calls)
    lines += table("Places that cannot be written", ("error", "what to do"), PLACES.items())
    return "\n".join(lines)


def table(title: str, head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    """Lines of a table."""
    cells = [[" ".join(text.split()).replace("|", r"\|") for text in row] for row in rows]
    return [
        f"### {title}",
        "",
        *(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *cells]),
        "",
    ]


HEAD = """# When a run fails or warns

This page is made from the code, so it holds every message; "…" stands for a value. Search it for a
few words of your message, or for its code: a warning of `result.warnings` is a `str` with the attribute
`code`, unless it was read from a file.

A run ends in one of four ways:

- `"trusted": true` in `summary.json`: all checks passed. Read the warnings all the same.
- `"trusted": false`: cameras and points are written, and `failed_checks` names what is wrong with them.
- A failure, exit code 3: the images cannot be reconstructed. The report and `summary.json` are written up to
  the last stage that finished, and the message says what was measured and what to do. In Python it is a
  {py:class}`~thesisrecon.StageFailure` with `reason`, `evidence` and `advice`.
- Wrong options or settings, exit code 2 ({py:class}`~thesisrecon.UsageError`): the message names the rule and
  what to do; nothing was computed.

Most failures are caused by the images: too little overlap, no sideways motion, or one of the {term}`critical
motions <critical motion>` of [how to take good images](photographing.md).

**Why one image is missing**: see `report.html`, table "Images", or in Python `result.refused` (name ->
reason). An image is *left out* if it cannot be read or used at all ([reasons](#images-that-are-left-out)),
and *not registered* if it was read but has no camera in the model
([reasons](#images-that-are-not-registered)). This does not affect the rest of the model.

## Warnings and failed checks
"""
FAILURES = """## Failures

A failure says what happened (reason), what was measured (evidence) and what to do. "/" separates variants.
Two different images suffice for matching; a calibration needs three
([why](photographing.md#why-three-views)). Functions of two images (`rectify`, `draw_epipolar_lines` and
others) refuse a file that cannot be read with the reasons of the first table.

"""


def setup(app):
    """Write the page before the sources are read."""
    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "start" / "failures.md", page()))
    return {"parallel_read_safe": True, "parallel_write_safe": True}

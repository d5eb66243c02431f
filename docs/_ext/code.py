"""Reading the source of the package, and writing pages."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "thesisrecon"


@cache
def tree_of(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def summary(path: Path) -> str:
    """First line of the docstring of a module, with names in plain backticks instead of Sphinx roles."""
    first = (ast.get_docstring(tree_of(path)) or "").split("\n")[0]
    return re.sub(r":[a-z]+:`~?([^`]+)`", r"`\1`", first).replace("``", "`")


def write(path: Path, text: str) -> None:
    """Write a file unless it has this text already."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")

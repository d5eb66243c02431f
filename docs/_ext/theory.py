"""The rows of the tables from the thesis to the code, read from the docstrings and the tests.

A row is a function or class whose docstring, or else whose module, names an equation, section, figure or
table of the thesis: the reference, the name, the first sentence of the docstring, and the two tests that use
it most directly.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = {
    "views": "1.",
    "stereo": "2.5.",
    "surfaces": "2.6.",
    "geometry": "3.",
    "features": "4.",
    "fundamental-matrix": "5.",
    "bundle-adjustment": "6.7.",
    "projective": "6.",
    "self-calibration": "7.",
}
"""Page of docs/theory -> the beginning of the numbers of its chapter or section."""

_WORDS = r"sections?|figures?|tables?|theorem|proposition|definition|algorithm|chapters?"
_NUMBER = r"[1-7]\.\d+(?:\.\d+)?"
_LIST = rf"{_NUMBER}(?:(?:, | and | to | ?- ?|; ){_NUMBER})*"
_REFERENCE = re.compile(rf"(?:\b({_WORDS}) ({_LIST})|\((?:thesis, )?({_LIST})(?=[),;: ]))", re.I)
_CHAPTER = re.compile(r"\bchapter ([1-7])\b", re.I)
_HZ = re.compile(r"\bHZ,? ((?:section |algorithm |result |table )?A?\d+(?:\.\d+)+)")
# Chapters whose equations are numbered; elsewhere two numbers are a section.
_EQUATIONS = {"3": 42, "4": 1, "5": 6}


# Folders and files that hold no theory, in the package and in the tests.
_OTHER = ("cli", "config", "bad_input", "io", "pipeline", "report", "runtime", "validation")


@dataclass(frozen=True)
class Reference:
    """A place in the thesis: its kind ("equation", "section", "figure", ...) and its number."""

    kind: str
    number: str

    @property
    def label(self) -> str:
        if self.kind in ("equation", "section"):
            return f"({self.number})" if self.kind == "equation" else self.number
        return f"{self.kind} {self.number}"

    @property
    def order(self) -> tuple[int, ...]:
        rank = {"equation": 0, "section": 1, "chapter": 3}.get(self.kind, 2)
        return rank, *map(int, self.number.split("."))


@dataclass(frozen=True)
class Row:
    references: tuple[Reference, ...]
    hartley_zisserman: tuple[str, ...]
    name: str  #: dotted, without the package
    summary: str
    tests: tuple[tuple[str, str], ...]  #: file and function


def references_of(doc: str) -> tuple[Reference, ...]:
    """The places of the thesis that a docstring names; its examples do not count."""
    text = re.split(r"\n\s*Examples\n\s*-+", doc)[0]
    text = re.sub(r"(?:HZ|Hirschm\w+ 2008|IJCV 56, 2004|methods)[^();]*", "", text)
    found: dict[Reference, None] = {}
    for word, listed, bare in _REFERENCE.findall(text):
        kind = (word or "equation").lower().rstrip("s")
        numbers = re.findall(_NUMBER, listed or bare)
        if re.search(r" to |-", listed or bare) and len(numbers) == 2:
            chapter, first = numbers[0].rsplit(".", 1)
            numbers = [f"{chapter}.{k}" for k in range(int(first), int(numbers[1].rsplit(".", 1)[1]) + 1)]
        for number in numbers:
            parts = number.split(".")
            if "0" in parts:
                continue
            numbered = len(parts) == 2 and int(parts[1]) <= _EQUATIONS.get(parts[0], 0)
            found[
                Reference(("equation" if numbered else "section") if kind == "equation" else kind, number)
            ] = None
    if not found:
        found = {Reference("chapter", f"{n}"): None for n in _CHAPTER.findall(text)}
    return tuple(found)


def page_of(reference: Reference) -> str:
    """The page of docs/theory that a reference belongs to; empty for the overview."""
    number = reference.number + "."
    return next((page for page, start in PAGES.items() if number.startswith(start)), "")


def _files(folder: str, pattern: str) -> list[Path]:
    root = ROOT / folder
    return [path for path in sorted(root.rglob(pattern)) if path.relative_to(root).parts[0] not in _OTHER]


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def exported() -> dict[str, str]:
    """Exported name -> the module that it comes from, without the package."""
    stub = (ROOT / "thesisrecon" / "__init__.pyi").read_text(encoding="utf-8")
    listed = re.findall(r"^from thesisrecon\.(\S+) import (\w+) as", stub, re.MULTILINE)
    return {name: module for module, name in listed}


def _full(dotted: str) -> str:
    """The dotted name where it is defined, of a name in the package."""
    name = dotted.removeprefix("thesisrecon").lstrip(".")
    return f"{exported()[name]}.{name}" if name in exported() else name


def _dotted(node: ast.Attribute) -> tuple[str, str]:
    """The first name and the rest of a chain of attributes; ("", "") of anything else."""
    parts: list[str] = []
    found: ast.expr = node
    while isinstance(found, ast.Attribute):
        parts.append(found.attr)
        found = found.value
    return (found.id, ".".join(reversed(parts))) if isinstance(found, ast.Name) else ("", "")


@cache
def _uses() -> dict[str, tuple[tuple[str, str, int], ...]]:
    """Dotted name -> (test file, test, number of names that the test uses), helpers of the file included."""
    found: dict[str, list[tuple[str, str, int]]] = {}
    for path in _files("tests", "test_*.py"):
        tree, alias = _tree(path), {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("thesisrecon"):
                alias |= {name.asname or name.name: f"{node.module}.{name.name}" for name in node.names}
            elif isinstance(node, ast.Import):
                names = [name for name in node.names if name.name.startswith("thesisrecon")]
                alias |= {
                    one.asname or "thesisrecon": one.name if one.asname else "thesisrecon" for one in names
                }
        # Tests, helpers, and names of the file that parametrize them.
        parts: dict[str, ast.stmt] = {
            node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)
        }
        for node in tree.body:
            if isinstance(node, ast.Assign):
                parts |= {target.id: node for target in node.targets if isinstance(target, ast.Name)}
        direct: dict[str, tuple[set[str], set[str]]] = {}
        for name, part in parts.items():
            used, called = set(), set()
            for node in ast.walk(part):
                if isinstance(node, ast.Attribute):
                    root, rest = _dotted(node)
                    used |= {_full(f"{alias[root]}.{rest}")} if root in alias else set()
                elif isinstance(node, ast.Name | ast.arg):
                    word = node.id if isinstance(node, ast.Name) else node.arg
                    used |= {_full(alias[word])} if word in alias else set()
                    called |= {word} & parts.keys()
            direct[name] = used, called - {name}
        for name in parts:
            if name.startswith("test_"):
                used = direct[name][0].union(*(direct[helper][0] for helper in direct[name][1]))
                for one in used:
                    place = str(path.relative_to(ROOT / "tests"))
                    # Names that only a helper uses are farther away.
                    found.setdefault(one, []).append(
                        (place, name, len(used) + 20 * (one not in direct[name][0]))
                    )
    return {name: tuple(tests) for name, tests in found.items()}


def _tests(name: str, references: tuple[Reference, ...]) -> tuple[tuple[str, str], ...]:
    numbers = [reference.number.replace(".", "_") + "_" for reference in references]
    package = name.partition(".")[0]

    def rank(test: tuple[str, str, int]) -> tuple[float, str]:
        named = any(number in test[1] for number in numbers)
        refused = (
            re.search("refus|value_error|reject|wrong_(calls|settings|input)|invalid|named", test[1])
            is not None
        )
        return test[2] - 100 * named - 30 * test[0].startswith(package) + 60 * refused, test[1]

    best = [(file, test) for file, test, _ in sorted(_uses().get(name, ()), key=rank)]
    near = [one for one in best if one[0].startswith(package)]
    return tuple((near or best[:1])[:2])


@cache
def rows() -> tuple[Row, ...]:
    """All rows, in the order of modules."""
    found = []
    for path in _files("thesisrecon", "*.py"):
        tree = _tree(path)
        parts = path.relative_to(ROOT / "thesisrecon").with_suffix("").parts
        module = ".".join(part for part in parts if part != "__init__")
        inherited = references_of(ast.get_docstring(tree) or "")
        for node in tree.body:
            if not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                continue
            doc = ast.get_docstring(node) or ""
            own, hidden = references_of(doc), "_" in (node.name[0], parts[-1][0])
            references = own or (() if hidden else inherited)
            if references:
                name = f"{module}.{node.name}"
                summary = re.sub(r":\w+:`~?([^`]*)`", r"\1", re.sub(r"\s+", " ", doc.split("\n\n")[0]))
                hz = tuple(dict.fromkeys(_HZ.findall(doc)))
                row = Row(references, hz, name, summary, _tests(name, references))
                # A record or an internal helper that no test uses by name explains nothing.
                found += [row] if row.tests or (own and not hidden) else []
    return tuple(found)


def table(page: str) -> list[Row]:
    """The rows of a page, equations first, in the order of the thesis; a row can be on several pages."""
    here = [
        (tuple(r for r in row.references if page_of(r) == page), row)
        for row in rows()
        if any(page_of(reference) == page for reference in row.references)
    ]
    order = sorted(here, key=lambda item: (min(r.order for r in item[0]), item[1].name))
    return [Row(mine, row.hartley_zisserman, row.name, row.summary, row.tests) for mine, row in order]


def row_of(name: str) -> Row | None:
    """The row of an exported or dotted name, without the package."""
    full = _full(name)
    return next((row for row in rows() if row.name == full), None)


@cache
def _named_on_pages() -> dict[str, set[str]]:
    texts = {page: (ROOT / "docs" / "theory" / f"{page}.md").read_text(encoding="utf-8") for page in PAGES}
    return {page: set(re.findall(r"`thesisrecon\.([\w.]+)`", text)) for page, text in texts.items()}


def chapters_of(name: str) -> list[str]:
    """The pages that a docstring refers to, and those that link to the name."""
    row = row_of(name)
    referred = {page_of(reference) for reference in row.references} if row else set()
    return [page for page in PAGES if page in referred or name in _named_on_pages()[page]]

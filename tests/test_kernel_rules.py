"""The rule of compiled functions that keeps every run the same to the last bit, read from the source itself.

Where sums may be reordered (``fastmath``), a function that several kernels link may be optimised anew in
each, and which copy a process calls depends on which of them it loads first: a run that compiles and one that
reads the cache differ in the last digits. Inlined, such a function has no copy that could be chosen.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "thesisrecon"


@dataclass(frozen=True)
class Kernel:
    """A compiled function: where it stands, what it calls by name, and how it is compiled."""

    place: str
    calls: frozenset[str]
    reorders: bool
    inlined: bool


def is_named_call(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name)


def kernels_of(source: str, place: str) -> dict[str, Kernel]:
    """All functions of a module under ``@njit(...)``, by name."""
    found = {}
    for node in ast.parse(source).body:
        if not isinstance(node, ast.FunctionDef):
            continue
        for mark in node.decorator_list:
            if is_named_call(mark) and mark.func.id == "njit":
                options = {option.arg for option in mark.keywords}
                calls = (call.func.id for call in ast.walk(node) if is_named_call(call))
                found[node.name] = Kernel(
                    f"{place}:{node.name}", frozenset(calls), "fastmath" in options, "forceinline" in options
                )
    return found


def rule_breakers(kernels: dict[str, list[Kernel]]) -> list[str]:
    """Functions that reorder sums, or inline one that does, are called by another kernel and not inlined."""
    every = [kernel for named in kernels.values() for kernel in named]
    reordering = {name for name, named in kernels.items() if any(k.reorders for k in named)}
    while True:
        more = {
            name for name, named in kernels.items() if any(k.calls & reordering for k in named)
        } - reordering
        if not more:
            break
        reordering |= more
    called = {name for kernel in every for name in kernel.calls}
    return sorted(k.place for name in reordering & called for k in kernels[name] if not k.inlined)


def all_kernels() -> dict[str, list[Kernel]]:
    kernels: dict[str, list[Kernel]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        found = kernels_of(path.read_text(encoding="utf-8"), str(path.relative_to(PACKAGE)))
        for name, kernel in found.items():
            kernels.setdefault(name, []).append(kernel)
    return kernels


def test_functions_that_reorder_sums_are_inlined_into_the_kernels_that_call_them() -> None:
    kernels = all_kernels()
    assert sum(k.reorders for named in kernels.values() for k in named) > 10
    assert rule_breakers(kernels) == []


def test_the_rule_finds_what_breaks_it() -> None:
    source = """
@njit(cache=True, fastmath=True{0})
def total(a): ...

@njit(cache=True{1})
def between(a):
    return total(a)

@njit(cache=True)
def outer(a):
    return between(a)
"""

    def broken(first: str, second: str) -> list[str]:
        found = kernels_of(source.format(first, second), "a.py")
        return rule_breakers({name: [kernel] for name, kernel in found.items()})

    inlined = ", forceinline=True"
    assert broken("", inlined) == ["a.py:total"]
    assert broken(inlined, "") == ["a.py:between"]
    assert broken(inlined, inlined) == []

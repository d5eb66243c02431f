"""Mutation testing: ``python -m validation.mutants -o OUT [--sample 25] [--packages ...]``.

Draws random faults from all single changes in the functions of a package: an operator, comparison, condition,
number, an opposite function, or a removed statement. Each is planted in a copy of the tree. The tests of its
package run first, then those of modules that import it. Constants of modules and classes are not changed. OUT
gets ``mutants.md`` and ``mutants.json``; the exit code is 1 if fewer than 85 % are caught. ``--again``
repeats the uncaught faults of OUT.
"""

from __future__ import annotations

import argparse
import ast
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from thesisrecon.errors import counted
from thesisrecon.runtime._signals import install_signal_handlers
from validation.harness.planting import CopiedTree, imports_of
from validation.harness.process import own_cores, run_process
from validation.scenes.real import ROOT

PACKAGES = ("geometry", "epipolar", "selfcalibration", "numerics")
MIN_SCORE = 0.85
LIMIT_S = 420.0
"""Time limit of a test run (s)."""
COLD_S = 3600.0
"""Time limit without a fault, when all kernels are compiled (s)."""
SIGNS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "*"),
    ast.Pow: ("**", "*"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
    ast.LShift: ("<<", ">>"),
    ast.RShift: (">>", "<<"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.In: ("in", "not in"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}
BORDERS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
}
"""Opposites of integer comparisons; equality of floats is too rare to test."""
OPPOSITES = {
    a: b
    for pair in (
        ("min", "max"), ("minimum", "maximum"), ("argmin", "argmax"), ("any", "all"), ("sin", "cos"),
        ("zeros", "ones"), ("zeros_like", "ones_like"), ("floor", "ceil"),
    )
    for a, b in (pair, pair[::-1])
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """A fault: in ``file``, the characters from ``start`` to ``end`` become ``new``."""

    file: str
    line: int
    old: str
    new: str
    start: int
    end: int

    def apply(self, text: str) -> str:
        """Return the text with the fault."""
        return text[: self.start] + self.new + text[self.end :]


@dataclass(frozen=True)
class Verdict:
    """Result of a fault: ``by`` names the failing test, empty if it was not caught."""

    mutant: Mutant
    by: str
    seconds: float


def mutants_of(root: Path, package: str) -> list[Mutant]:
    """Return all faults of a package, file by file."""
    found = []
    for path in sorted((root / "thesisrecon" / package).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        finder = _Finder(path.relative_to(root).as_posix(), text)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                for statement in node.body:
                    finder.visit(statement)
        found += sorted(set(finder.found), key=lambda m: (m.start, m.end, m.new))
    return found


class _Finder(ast.NodeVisitor):
    """Faults of one file."""

    def __init__(self, file: str, text: str) -> None:
        self.file, self.text = file, text
        self.found: list[Mutant] = []
        starts = [0]
        for line in text.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self._starts, self._lines = starts, text.splitlines()

    def _place(self, line: int, column: int) -> int:
        """Return the character offset of a byte position of a line."""
        return self._starts[line - 1] + len(self._lines[line - 1].encode()[:column].decode())

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self._place(node.lineno, node.col_offset), self._place(node.end_lineno, node.end_col_offset)

    def _add(self, start: int, end: int, new: str) -> None:
        line = self.text.count("\n", 0, start) + 1
        self.found.append(Mutant(self.file, line, self.text[start:end], new, start, end))

    def _between(self, left: ast.expr, right: ast.expr, signs: tuple[str, str]) -> None:
        """Add the operator between two operands, ignoring brackets and line ends."""
        start, end = self._span(left)[1], self._span(right)[0]
        at = self.text.find(signs[0], start, end)
        if at >= 0 and "#" not in self.text[start:end]:
            self._add(at, at + len(signs[0]), signs[1])

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if type(node.op) in SIGNS:
            self._between(node.left, node.right, SIGNS[type(node.op)])
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for left, right in zip(node.values, node.values[1:], strict=False):
            self._between(left, right, SIGNS[type(node.op)])
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        operands = [node.left, *node.comparators]
        for left, right, sign in zip(operands, operands[1:], node.ops, strict=False):
            if type(sign) in SIGNS:
                self._between(left, right, SIGNS[type(sign)])
            if type(sign) in BORDERS and (_is_whole(left) or _is_whole(right)):
                self._between(left, right, BORDERS[type(sign)])
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub | ast.Not):
            start = self._span(node)[0]
            self._add(start, start + (1 if isinstance(node.op, ast.USub) else 4), "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        start, end = self._span(node)
        value = node.value
        if isinstance(value, bool):
            self._add(start, end, str(not value))
        elif isinstance(value, int):
            self._add(start, end, str(value + 1))
        elif isinstance(value, float):
            self._add(start, end, repr(2.0 * value if value else 1.0))

    def visit_Name(self, node: ast.Name) -> None:
        if node.id in OPPOSITES and isinstance(node.ctx, ast.Load):
            start, end = self._span(node)
            self._add(start, end, OPPOSITES[node.id])

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if node.attr in OPPOSITES:
            end = self._span(node)[1]
            self._add(end - len(node.attr), end, OPPOSITES[node.attr])
        self.generic_visit(node)

    def _condition(self, node: ast.If | ast.While | ast.IfExp) -> None:
        start, end = self._span(node.test)
        self._add(start, end, f"(not ({self.text[start:end]}))")
        self.generic_visit(node)

    visit_If = visit_While = visit_IfExp = _condition

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if type(node.op) in SIGNS:
            self._between(node.target, node.value, SIGNS[type(node.op)])
        self._leave_out(node)
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        if isinstance(node.targets[0], ast.Subscript):
            self._leave_out(node)
        self.generic_visit(node)

    def _leave_out(self, node: ast.stmt) -> None:
        start, end = self._span(node)
        self._add(start, end, "pass")

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        """Skip nested functions; they are visited separately."""

    def visit_Raise(self, node: ast.Raise) -> None:
        """Skip error messages."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """Skip assertions for types."""


def _is_whole(node: ast.expr) -> bool:
    """Return whether an operand is certainly an integer."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int)
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "len"


def draw(root: Path, package: str, count: int, seed: int) -> list[Mutant]:
    """Draw ``count`` faults of a package (or all) in file order."""
    everything = mutants_of(root, package)
    rng = np.random.default_rng([seed, PACKAGES.index(package)])
    chosen = rng.permutation(len(everything))[:count]
    return [everything[k] for k in sorted(chosen)]


@dataclass(frozen=True)
class Bench(CopiedTree):
    """A copy of the library with its tests."""

    copied: tuple[str, ...] = ("thesisrecon", "validation", "tests", "fixtures", "pyproject.toml")

    def judges(self, file: str) -> list[list[str]]:
        """Return two lists of test files: those of the module's package, then those of its importers."""
        package = Path(file).parts[1]
        tests = sorted((self.tree / "tests").rglob("test_*.py"))
        own = [t for t in tests if (self.tree / "tests" / package) in t.parents]
        near = {_module(file)}
        modules = sorted((self.tree / "thesisrecon").rglob("*.py"))
        users = {_module(str(m.relative_to(self.tree))) for m in modules if imports_of(m) & near}
        own.sort(key=lambda t: not imports_of(t) & near)
        others = [t for t in tests if t not in own and "validation" not in t.parts]
        others = [t for t in others if imports_of(t) & (near | users)]
        others.sort(key=lambda t: not imports_of(t) & near)
        return [[str(t.relative_to(self.tree)) for t in chosen] for chosen in (own, others) if chosen]

    def run_tests(
        self, files: Sequence[str], kernels: Path, name: str, *, limit_s: float = LIMIT_S
    ) -> tuple[int, float, str]:
        """Return the exit code of pytest (99 on time-out), seconds and the first failed test."""
        log = self.out / "logs" / f"{name}.log"
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no"]
        command += ["-m", "not slow and not browser and not real", *files]
        environment = {"PYTHONPATH": str(self.tree), "NUMBA_CACHE_DIR": str(kernels)}
        environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        process = run_process(
            command,
            log=log,
            cores=own_cores(),
            environment=environment,
            limit_s=limit_s,
            cwd=self.tree,
        )
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        failed = [line.split()[1] for line in lines if line.startswith(("FAILED", "ERROR")) and " " in line]
        return 99 if process.timed_out else process.code, process.wall_s, failed[0] if failed else ""


def _module(file: str) -> str:
    return ".".join(Path(file).with_suffix("").parts).removesuffix(".__init__")


def judge_all(bench: Bench, mutants: Sequence[Mutant], *, warm: bool) -> Iterator[Verdict]:
    """Yield the verdict of each fault in order.

    Raises ``ValueError`` if a test fails without a fault.
    """
    bench.set_up()
    judges = {file: bench.judges(file) for file in dict.fromkeys(m.file for m in mutants)}
    if not warm:
        everything = sorted({test for lists in judges.values() for files in lists for test in files})
        code, _, failed = bench.run_tests(everything, bench.kernels, "sound", limit_s=COLD_S)
        if code == 99:
            raise ValueError(f"the tests take more than {COLD_S / 60:.0f} min without any fault")
        if code != 0:
            raise ValueError(f"{failed or 'a test'} fails without any fault")
    for number, mutant in enumerate(mutants):
        text = mutant.apply((bench.tree / mutant.file).read_text(encoding="utf-8"))
        by, seconds = "", 0.0
        with bench.planted(mutant.file, text, number) as kernels:
            for files in judges[mutant.file]:
                code, spent, failed = bench.run_tests(files, kernels, f"{number:03d}")
                seconds += spent
                if code not in (0, 5):
                    by = failed or ("time-out" if code == 99 else f"pytest ended with {code}")
                    break
        yield Verdict(mutant, by, seconds)


def table(verdicts: Sequence[Verdict]) -> str:
    """Return Markdown: the score of each package, then every fault."""
    lines = ["| package | faults | caught | score |", "| --- | --- | --- | --- |"]
    for package in PACKAGES:
        own = [v for v in verdicts if Path(v.mutant.file).parts[1] == package]
        if own:
            caught = sum(bool(v.by) for v in own)
            lines.append(f"| {package} | {len(own)} | {caught} | {100.0 * caught / len(own):.0f} % |")
    lines += ["", "| file | line | was | became | caught by |", "| --- | --- | --- | --- | --- |"]
    for v in verdicts:
        words = [" ".join(text.split()).replace("|", "\\|")[:60] for text in (v.mutant.old, v.mutant.new)]
        by = v.by.replace("|", "\\|") or "**not caught**"
        lines.append(f"| {v.mutant.file} | {v.mutant.line} | `{words[0]}` | `{words[1]}` | {by} |")
    return "\n".join(lines)


def read_verdicts(path: Path) -> list[Verdict]:
    """Read the verdicts written by :func:`main`."""
    return [
        Verdict(Mutant(**found["mutant"]), found["by"], found["seconds"])
        for found in json.loads(path.read_text(encoding="utf-8"))
    ]


def main(arguments: list[str] | None = None) -> int:
    """Run; exit code 0: enough faults were caught, 1: too few, or a test fails without a fault."""
    parser = argparse.ArgumentParser(prog="python -m validation.mutants", description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/mutants"))
    parser.add_argument("--packages", nargs="+", choices=PACKAGES, default=PACKAGES)
    parser.add_argument("--sample", type=int, default=25, help="number of faults of each package")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--warm", action="store_true", help="skip the test run without faults")
    parser.add_argument("--again", action="store_true", help="repeat the uncaught faults of OUT")
    parsed = parser.parse_args(arguments)
    parsed.out.mkdir(parents=True, exist_ok=True)
    results: dict[Mutant, Verdict] = {}
    if parsed.again:
        results = {v.mutant: v for v in read_verdicts(parsed.out / "mutants.json")}
        everything = {m for package in PACKAGES for m in mutants_of(ROOT, package)}
        mutants = [m for m, verdict in results.items() if not verdict.by and m in everything]
    else:
        mutants = [m for package in parsed.packages for m in draw(ROOT, package, parsed.sample, parsed.seed)]
    try:
        for count, verdict in enumerate(judge_all(Bench(parsed.out.resolve()), mutants, warm=parsed.warm)):
            results[verdict.mutant] = verdict
            print(f"{count + 1} of {len(mutants)}: {table([verdict]).splitlines()[-1]}", flush=True)
            verdicts = list(results.values())
            (parsed.out / "mutants.md").write_text(table(verdicts) + "\n", encoding="utf-8")
            (parsed.out / "mutants.json").write_text(json.dumps([asdict(v) for v in verdicts], indent=1))
    except ValueError as error:
        print(f"mutants: {error}", file=sys.stderr)
        return 1
    score = sum(bool(v.by) for v in results.values()) / max(len(results), 1)
    faults = counted(len(results), "fault")
    print(f"{faults}, {100.0 * score:.0f} % caught; the table is {parsed.out / 'mutants.md'}")
    return int(score < MIN_SCORE)


if __name__ == "__main__":
    install_signal_handlers("mutants")
    raise SystemExit(main())

"""Mutation testing: ``python -m validation.mutants -o OUT [--sample 25] [--packages ...]``.

Draws random faults from all single changes in the functions of a package: an operator, comparison, condition,
number, opposite function, or removed statement. Each is planted in a copy of the tree. The tests of its
package run first, then those of modules that import it. OUT gets ``mutants.md`` and ``mutants.json``; the
exit code is 1 if fewer than 85 % are caught. ``--again`` repeats the uncaught faults of OUT. ``--list FILE``
plants the named faults of a TOML file instead, each judged by the tests and then the gates that it names.
"""

from __future__ import annotations

import argparse
import ast
import itertools
import json
import os
import re
import shutil
import sys
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.errors import counted
from thesisrecon.io._files import write_text
from thesisrecon.io._outputs import clear_folder, join_claim
from thesisrecon.runtime._signals import install_signal_handlers
from validation.runs.processes import own_cores, run_process
from validation.runs.tables import text_table
from validation.scenes.real import ROOT

READ_CAMERAS = {"bundle", "clouds", "depth", "surface", "views"}  # Stages of models
PACKAGES = ("geometry", "epipolar", "selfcalibration", "optimize")
_FAILURES = ("FAILED", "ERROR", "missed")  # First words of pytest and of a check
LIMIT_S, COLD_S = 420.0, 3600.0
"""Time limits of a test run (s), and of the one without a fault, when all kernels are compiled."""
OPPOSITE: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE,
    ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.In: ast.NotIn,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
BORDER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
}  # fmt: skip
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
    """The fault ``number`` of ``file``: in ``line``, the code ``old`` becomes ``new``. A fault of a list has
    a ``name`` and ``judges``: test files, and stage/scene of gates.
    """

    file: str
    line: int
    old: str
    new: str
    number: int
    name: str = ""
    judges: tuple[str, ...] = ()

    def apply(self, text: str) -> str:
        """Return the text with the fault, one drawn without comments."""
        if self.name:
            if text.count(self.old) != 1:
                raise ValueError(f"the fault {self.name} replaces a text that {self.file} does not have once")
            return text.replace(self.old, self.new)
        tree = ast.parse(text)
        next(itertools.islice(_faults(tree), self.number, None))
        return ast.unparse(tree)


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
        file = path.relative_to(root).as_posix()
        for number, (line, old, new) in enumerate(_faults(ast.parse(path.read_text(encoding="utf-8")))):
            found.append(Mutant(file, line, old, new, number))
    return found


def _faults(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Yield line, old and new code of each fault; the tree has it until the next one is asked for."""
    for function in [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]:
        for parent in _inside(function):
            for name, value in ast.iter_fields(parent):
                if name == "annotation" or (parent is function and name != "body"):
                    continue
                for k, node in enumerate(value if isinstance(value, list) else [value]):
                    for new in _changes(node):
                        text = ast.unparse(node), ast.unparse(new)
                        for put in (new, node):
                            whole = [*value[:k], put, *value[k + 1 :]] if isinstance(value, list) else put
                            setattr(parent, name, whole)
                            if put is new:
                                yield node.lineno, *text


def _inside(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a function and the nodes in it, without nested functions, messages and assertions."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.Raise | ast.Assert | ast.arguments):
            yield from _inside(child)


def _changes(node: Any) -> Iterator[ast.AST]:

    def changed(**fields: Any) -> ast.AST:
        found: ast.AST = type(node)(**{**dict(ast.iter_fields(node)), **fields})
        return found

    match node:
        case ast.BinOp() | ast.BoolOp() | ast.AugAssign():
            if type(node.op) in OPPOSITE:
                yield changed(op=OPPOSITE[type(node.op)]())
        case ast.Compare():
            operands = [node.left, *node.comparators]
            for k, op in enumerate(node.ops):
                whole = _is_whole(operands[k]) or _is_whole(operands[k + 1])
                for table in (OPPOSITE, BORDER) if whole else (OPPOSITE,):
                    if type(op) in table:
                        yield changed(ops=[*node.ops[:k], table[type(op)](), *node.ops[k + 1 :]])
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            yield node.operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield ast.Constant(value + 1)
        case ast.Constant(value=float(value)):
            yield ast.Constant(2.0 * value if value else 1.0)
        case ast.Name(id=name, ctx=ast.Load()) if name in OPPOSITES:
            yield changed(id=OPPOSITES[name])
        case ast.Attribute(attr=name) if name in OPPOSITES:
            yield changed(attr=OPPOSITES[name])
        case ast.If() | ast.While() | ast.IfExp():
            yield changed(test=ast.UnaryOp(ast.Not(), node.test))
    if isinstance(node, ast.AugAssign) or (
        isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript)
    ):
        yield ast.Pass()


def _is_whole(node: ast.expr) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int)
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "len"


def imports_of(path: Path) -> set[str]:
    """Return the imports of a file: modules and names in them."""
    found = set[str]()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def draw(root: Path, package: str, count: int, seed: int) -> list[Mutant]:
    """Draw ``count`` faults of a package (or all) in file order."""
    everything = mutants_of(root, package)
    rng = np.random.default_rng([seed, PACKAGES.index(package)])
    chosen = rng.permutation(len(everything))[:count]
    return [everything[k] for k in sorted(chosen)]


def read_faults(path: Path, names: Sequence[str] = ()) -> list[Mutant]:
    """Read the faults of a list, or those of some ``names``."""
    faults = []
    for name, entry in tomllib.loads(path.read_text(encoding="utf-8")).items():
        if not names or name in names:
            file = f"thesisrecon/{entry['file']}"
            line = (ROOT / file).read_text(encoding="utf-8").partition(entry["old"])[0].count("\n") + 1
            given = file, line, entry["old"], entry["new"], 0, name, tuple(entry["judges"])
            faults.append(Mutant(*given))
    if unknown := sorted(set(names) - {fault.name for fault in faults}):
        raise ValueError(f"{path} has no fault called {unknown[0]!r}")
    return faults


@dataclass(frozen=True)
class Bench:
    """A copy of the library with its tests in the folder ``out``; one fault at a time is planted."""

    out: Path

    @property
    def tree(self) -> Path:
        return self.out / "tree"

    def set_up(self) -> None:
        clear_folder(self.tree)
        for name in ("thesisrecon", "validation", "tests", "fixtures", "examples", "docs"):
            shutil.copytree(ROOT / name, self.tree / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy2(ROOT / "pyproject.toml", self.tree)

    @contextmanager
    def planted(self, file: str, text: str) -> Iterator[None]:
        """Replace ``file`` by the faulty ``text`` for a while."""
        path = self.tree / file
        sound, before = path.read_text(encoding="utf-8"), path.stat().st_mtime
        path.write_text(text, encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(sound, encoding="utf-8")
            os.utime(path, (before, before))

    def judges(self, file: str) -> list[list[str]]:
        """Return two lists of test files: those of the module's package, then those of its importers.

        Public functions of importers, and of importers of these, are called as attributes of ``thesisrecon``.
        """
        near, package = {_module(file)}, self.tree / "tests" / Path(file).parts[1]
        modules = {
            _module(str(m.relative_to(self.tree))): m for m in (self.tree / "thesisrecon").rglob("*.py")
        }
        users = {name for name, m in modules.items() if imports_of(m) & near}
        doors = [m for m in modules.values() if m.parent.name == "api" and imports_of(m) & (near | users)]
        calls = {name for m in doors for name in re.findall(r"^def ([a-z]\w+)", m.read_text(), re.MULTILINE)}
        called = re.compile(rf"\b({'|'.join(calls)})\(" if calls else "(?!)")
        tests = sorted((self.tree / "tests").rglob("test_*.py"), key=lambda t: (not imports_of(t) & near, t))
        own = [t for t in tests if package in t.parents]
        others = [t for t in tests if t not in own and "validation" not in t.parts]
        others = [t for t in others if imports_of(t) & (near | users) or called.search(t.read_text())]
        return [[str(t.relative_to(self.tree)) for t in chosen] for chosen in (own, others) if chosen]

    def run_tests(
        self, files: Sequence[str], name: str, *, limit_s: float = LIMIT_S
    ) -> tuple[int, float, str]:
        """Return the exit code of pytest (99 on time-out), seconds and the first failed test.

        Of gates, stage/scene instead of files, those of ``check --quick``.
        """
        log = self.out / "logs" / f"{name}.log"
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no"]
        command += ["-m", "not slow and not browser and not real", *files]
        if not files[0].endswith(".py"):
            # The gates of a stage alone may read the cameras.
            stages, scenes = (sorted(set(part)) for part in zip(*(f.split("/") for f in files), strict=True))
            stages += [s for s in ("cameras",) if {*stages} & READ_CAMERAS and s not in stages]
            command = [sys.executable, "-m", "validation", "check", "--quick", "-o", str(self.out / "gates")]
            command += ["--threads", "1", "--stages", *stages, "--scenes", *scenes]
        # The kernels outlive the copy.
        environment = {"PYTHONPATH": str(self.tree), "NUMBA_CACHE_DIR": str(self.out / "kernels")}
        environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        where: Any = {"cores": own_cores(), "environment": environment, "cwd": self.tree}
        process = run_process(command, log=log, limit_s=limit_s, **where)
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        failed = [
            line.split()[1]
            for line in lines
            if line.startswith(("FAILED", "ERROR", "missed ")) and " " in line
        ]
        return (
            99 if process.timed_out else process.code,
            process.wall_s,
            failed[0].rstrip(":") if failed else "",
        )


def _module(file: str) -> str:
    return ".".join(Path(file).with_suffix("").parts).removesuffix(".__init__")


def judge_all(bench: Bench, mutants: Sequence[Mutant]) -> Iterator[Verdict]:
    """Yield the verdict of each fault in order."""
    bench.set_up()
    judges = {m: _kinds(m.judges) or bench.judges(m.file) for m in mutants}
    everything = sorted({judge for lists in judges.values() for files in lists for judge in files})
    for files in _kinds(everything):
        code, _, failed = bench.run_tests(files, "sound", limit_s=COLD_S)
        if code:
            raise ValueError(f"{failed or files[0]} fails or takes too long without any fault")
    for number, mutant in enumerate(mutants):
        text = mutant.apply((bench.tree / mutant.file).read_text(encoding="utf-8"))
        by, seconds = "", 0.0
        with bench.planted(mutant.file, text):
            for files in judges[mutant]:
                code, spent, failed = bench.run_tests(files, mutant.name or f"{number:03d}")
                seconds += spent
                if code not in (0, 5):
                    by = failed or ("time-out" if code == 99 else f"pytest ended with {code}")
                    break
        yield Verdict(mutant, by, seconds)


def _kinds(judges: Sequence[str]) -> list[list[str]]:
    """Return test files and gates, without an empty list."""
    tests = [judge for judge in judges if judge.endswith(".py")]
    gates = [judge for judge in judges if judge not in tests]
    return [files for files in (tests, gates) if files]


def table(verdicts: Sequence[Verdict]) -> str:
    """Return Markdown: the score of each package, then every fault."""
    scores, faults = list[list[object]](), list[list[object]]()
    for package in sorted({Path(v.mutant.file).parts[1] for v in verdicts}):
        own = [bool(v.by) for v in verdicts if Path(v.mutant.file).parts[1] == package]
        if own:
            scores.append([package, len(own), sum(own), f"{100.0 * sum(own) / len(own):.0f} %"])
    for v in verdicts:
        texts = [f"`{' '.join(text.split())[:60]}`" for text in (v.mutant.old, v.mutant.new)]
        cells = [text.replace("|", "\\|") for text in (*texts, v.by or "**not caught**")]
        faults.append([v.mutant.file, v.mutant.line, *cells])
    head = text_table(["package", "faults", "caught", "score"], scores)
    return f"{head}\n\n{text_table(['file', 'line', 'was', 'became', 'caught by'], faults)}"


def read_verdicts(path: Path) -> list[Verdict]:
    """Read the verdicts written by :func:`main`."""
    found = json.loads(path.read_text(encoding="utf-8"))
    mutants = [one.pop("mutant") for one in found]
    mutants = [Mutant(**m | {"judges": tuple(m.get("judges", ()))}) for m in mutants]
    return [Verdict(mutant, **one) for mutant, one in zip(mutants, found, strict=True)]


def main(arguments: list[str] | None = None) -> int:
    """Run; exit code 0: enough faults were caught, 1: too few, or a test fails without a fault."""
    parser = argparse.ArgumentParser(prog="python -m validation.mutants", description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/mutants"))
    parser.add_argument("--packages", nargs="+", choices=PACKAGES, default=PACKAGES)
    parser.add_argument("--sample", type=int, default=25, help="number of faults of each package")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", type=Path, metavar="FILE", help="own faults, as validation/faults.toml")
    parser.add_argument("--names", nargs="+", default=(), help="some faults of the list (default: all)")
    parser.add_argument("--gates", action="store_true", help="judge faults of the list by gates alone")
    parser.add_argument("--again", action="store_true", help="repeat the uncaught faults of OUT")
    parsed = parser.parse_args(arguments)
    results: dict[Mutant, Verdict] = {}
    if parsed.again:
        results = {v.mutant: v for v in read_verdicts(parsed.out / "mutants.json")}
        everything = {m for package in PACKAGES for m in mutants_of(ROOT, package)}
        everything |= set(read_faults(parsed.list)) if parsed.list else set()
        mutants = [m for m, verdict in results.items() if not verdict.by and m in everything]
    elif parsed.list:
        mutants = read_faults(parsed.list, parsed.names)
        if parsed.gates:
            gates = [tuple(judge for judge in m.judges if not judge.endswith(".py")) for m in mutants]
            mutants = [replace(m, judges=g) for m, g in zip(mutants, gates, strict=True) if g]
    else:
        mutants = [m for package in parsed.packages for m in draw(ROOT, package, parsed.sample, parsed.seed)]
    try:
        with join_claim(parsed.out):
            judged = judge_all(Bench(parsed.out.resolve()), mutants)
            for count, verdict in enumerate(judged):
                results[verdict.mutant] = verdict
                print(f"{count + 1} of {len(mutants)}: {table([verdict]).splitlines()[-1]}", flush=True)
                verdicts = list(results.values())
                write_text(parsed.out / "mutants.md", table(verdicts) + "\n")
                write_text(parsed.out / "mutants.json", json.dumps([asdict(v) for v in verdicts], indent=1))
    except ValueError as error:
        print(f"mutants: {error}", file=sys.stderr)
        return 1
    score = sum(bool(v.by) for v in results.values()) / max(len(results), 1)
    faults = counted(len(results), "fault")
    print(f"{faults}, {100.0 * score:.0f} % caught; the table is {parsed.out / 'mutants.md'}")
    return int(score < 0.85)


if __name__ == "__main__":
    install_signal_handlers("mutants")
    raise SystemExit(main())

"""Fault injection for the gates: ``python -m validation.mutations -o OUT [--only NAME ...]``.

``mutations.toml`` lists planted faults. The tree is copied and checked once; then each fault is planted in
the copy and ``python -m validation check`` runs on its stages and scenes with the references of the first
check. OUT gets ``mutations.md`` and ``mutations.json``; the exit code is 1 if a fault survives or the tree
breaks a gate, 2 if the list is invalid.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from thesisrecon.errors import counted
from thesisrecon.io._files import write_text
from thesisrecon.io._outputs import clear_folder, join_claim
from thesisrecon.runtime._signals import install_signal_handlers
from validation.harness.gates import Gate, read_gates
from validation.harness.process import last_words, own_cores, run_process
from validation.harness.records import slug
from validation.harness.results import Results, read_results
from validation.harness.stages import STAGES, available_scenes
from validation.scenes.real import ROOT, data_root

MUTATIONS_FILE = Path(__file__).with_suffix(".toml")
FIELDS = ("name", "file", "old", "new", "check")
TASK_LIMIT_S = 900
COPIED = ("thesisrecon", "validation", "fixtures", "pyproject.toml")


@dataclass(frozen=True)
class Mutation:
    """A planted fault: in ``file``, ``old`` (present exactly once) becomes ``new``; a gate of ``check``
    ("stage/scene") must fail when ``methods`` of ours (all if empty) run again."""

    name: str
    file: str
    old: str
    new: str
    check: tuple[str, ...]
    methods: tuple[str, ...] = ()

    @property
    def stages(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(where.split("/")[0] for where in self.check))

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(where.split("/")[1] for where in self.check))

    def apply(self, root: Path) -> str:
        """Return the text with the fault.

        Raises ``ValueError`` if ``old`` is not in the file exactly once.
        """
        path = root / self.file
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        found = text.count(self.old)
        if found != 1:
            raise ValueError(
                f'"{self.name}": its old text must occur in {self.file} once, it occurs {found} times; '
                "quote more of the text around it"
            )
        return text.replace(self.old, self.new)


@dataclass(frozen=True)
class Fate:
    """Result of a fault: the gates that ``caught`` it, the wall seconds of the check, the failures of methods
    (``ended``), and why it was ``skipped``."""

    name: str
    file: str
    caught: tuple[str, ...]
    seconds: float
    ended: tuple[str, ...] = ()
    skipped: str = ""

    @property
    def survived(self) -> bool:
        return not (self.caught or self.skipped)


def read_mutations(path: Path = MUTATIONS_FILE) -> list[Mutation]:
    """Read the list of faults in order.

    Raises ``ValueError`` for missing fields, no change, a repeated name, or a stage and scene without gates.
    """
    judged = {key.rsplit("/", 1)[0] for key in read_gates()}
    found: list[Mutation] = []
    for entry in tomllib.loads(path.read_text(encoding="utf-8"))["mutation"]:
        entry.setdefault("methods", [])
        whole = set(entry) == {*FIELDS, "methods"} and all(entry[name] for name in FIELDS if name != "new")
        if not whole or entry["old"] == entry["new"]:
            raise ValueError(f"a mutation has {', '.join(FIELDS)}, and old differs from new; one has {entry}")
        wrong = [where for where in entry["check"] if where not in judged]
        if wrong:
            raise ValueError(f'"{entry["name"]}": no gate is called {wrong[0]}/...')
        found.append(Mutation(**{**entry, **{name: tuple(entry[name]) for name in ("check", "methods")}}))
    twice = [m.name for n, m in enumerate(found) if m.name in {other.name for other in found[:n]}]
    if twice:
        raise ValueError(f'two mutations are called "{twice[0]}"')
    return found


@dataclass(frozen=True)
class CopiedTree:
    """The parts ``copied`` from the repository, in the folder ``out``; one fault at a time is planted."""

    out: Path
    copied: tuple[str, ...] = COPIED

    @property
    def tree(self) -> Path:
        return self.out / "tree"

    @property
    def environment(self) -> dict[str, str]:
        """Environment of a process that imports the copy; its kernels outlive the copy."""
        return {"PYTHONPATH": str(self.tree), "NUMBA_CACHE_DIR": str(self.out / "kernels")}

    def set_up(self) -> None:
        clear_folder(self.tree)
        self.tree.mkdir(parents=True)
        for name in self.copied:
            source, target = ROOT / name, self.tree / name
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(source, target)

    @contextmanager
    def planted(self, file: str, text: str) -> Iterator[None]:
        """Replace ``file`` by the faulty ``text`` for a while.

        Kernels are cached by the code they are made from, bytecode by the time of the file.
        """
        path = self.tree / file
        sound, before = path.read_text(encoding="utf-8"), path.stat().st_mtime
        path.write_text(text, encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(sound, encoding="utf-8")
            os.utime(path, (before, before))


class Bench(CopiedTree):
    """A copy of the tree and its checks."""

    def check(self, name: str, wanted: Sequence[Mutation], resume: str = "") -> Checked:
        """Run ``python -m validation check`` in the tree for these faults.

        Raises ``ValueError`` if it ends without results.
        """
        stages = _all(m.stages for m in wanted)
        if not resume:
            stages = tuple(s for s in STAGES if s in {*stages, *_needed(stages)})
        out, log = self.out / name, self.out / f"{name}.log"
        command = [sys.executable, "-m", "validation", "check", "--quick", "--threads", "1", "-o", str(out)]
        command += ["--time-limit", str(TASK_LIMIT_S), "--stages", *stages]
        command += ["--scenes", *_all(m.scenes for m in wanted)]
        command += ["--resume", str(self.out / resume)] if resume else []
        methods = _all(m.methods for m in wanted)
        command += ["--methods", *methods] if resume and methods else []
        environment = self.environment
        root = data_root()
        if root is not None:
            environment["THESISRECON_DATA"] = str(root.resolve())
        cores = own_cores()[-1:]
        process = run_process(command, log=log, cores=cores, environment=environment, cwd=self.tree)
        try:
            return Checked(read_results(out), _all(m.check for m in wanted), process.wall_s)
        except ValueError:
            raise ValueError(f"the check ended without results: {last_words(log)}") from None


@dataclass(frozen=True)
class Checked:
    """Result and seconds of a check of the ``asked`` "stage/scene" items."""

    results: Results
    asked: tuple[str, ...]
    seconds: float

    @property
    def ended(self) -> tuple[str, ...]:
        """Return the failures of our methods."""
        found = self.results.failures.items()
        return tuple(dict.fromkeys(words for key, words in found if key.split("/")[2].startswith("ours")))

    def broken(self, gates: Mapping[str, Gate]) -> tuple[str, ...]:
        """Return the gates whose number misses the limit or is missing."""
        found = {row.key: row.value for row in self.results.rows}
        judged = {*self.asked, *(key.rsplit("/", 1)[0] for key in found)}
        return tuple(
            key
            for key, gate in gates.items()
            if key.rsplit("/", 1)[0] in judged and not gate.holds(found.get(key))
        )


def _all(parts: Iterable[Iterable[str]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for part in parts for name in part))


def _needed(stages: Sequence[str]) -> set[str]:
    """Stages that these start from."""
    methods = {"", "ours"}
    return {stage for name in stages for method in methods for stage, _ in STAGES[name].needs(method)}


def plant_all(bench: Bench, mutations: Sequence[Mutation], *, sound: bool = False) -> Iterator[Fate]:
    """Yield the result of each fault in order; ``sound`` reuses the first check of an earlier run.

    Raises ``ValueError`` if the tree without faults breaks a gate.
    """
    here, gates = available_scenes(quick=False), read_gates()
    possible = [m for m in mutations if set(m.scenes) <= set(here)]
    bench.set_up()
    if not sound:
        broken = bench.check("sound", possible).broken(gates)
        if broken:
            raise ValueError(f"the tree breaks gates without any fault: {', '.join(broken)}")
    for mutation in mutations:
        if mutation not in possible:
            absent = f"{mutation.scenes[0]} is not on this machine"
            yield Fate(mutation.name, mutation.file, (), 0.0, skipped=absent)
            continue
        with bench.planted(mutation.file, mutation.apply(bench.tree)):
            found = bench.check(slug(mutation.name), [mutation], resume="sound")
        yield Fate(mutation.name, mutation.file, found.broken(gates), found.seconds, found.ended)


def table(fates: Sequence[Fate]) -> str:
    """Return Markdown: a row for each fault."""
    lines = ["| fault | file | caught by | s |", "| --- | --- | --- | --- |"]
    for fate in fates:
        caught = ", ".join(fate.caught) or (f"not planted: {fate.skipped}" if fate.skipped else "**nothing**")
        caught += f" (ended: {'; '.join(fate.ended)})" if fate.ended else ""
        lines.append(f"| {fate.name} | {fate.file} | {caught} | {fate.seconds:.0f} |")
    return "\n".join(lines)


def write_fates(out: Path, fates: Sequence[Fate]) -> None:
    """Write ``mutations.md`` and ``mutations.json`` into ``out``."""
    write_text(out / "mutations.md", table(fates) + "\n")
    write_text(out / "mutations.json", json.dumps([asdict(f) for f in fates], indent=1))


def main(arguments: list[str] | None = None) -> int:
    """Run; exit code 0: all faults caught, 1: one survives or the tree breaks a gate, 2: invalid list."""
    parser = argparse.ArgumentParser(prog="python -m validation.mutations", description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/mutations"))
    parser.add_argument("--only", nargs="+", metavar="NAME", help="default: all of mutations.toml")
    parser.add_argument("--sound", action="store_true", help="reuse the first check of an earlier run in OUT")
    parsed = parser.parse_args(arguments)
    try:
        mutations = _chosen({m.name: m for m in read_mutations()}, parsed.only)
        for mutation in mutations:
            mutation.apply(ROOT)
    except ValueError as error:
        print(f"mutations: {error}", file=sys.stderr)
        return 2
    fates: list[Fate] = []
    try:
        with join_claim(parsed.out):
            for fate in plant_all(Bench(parsed.out.resolve()), mutations, sound=parsed.sound):
                fates.append(fate)
                print(table([fate]).splitlines()[-1], flush=True)
                write_fates(parsed.out, fates)
    except ValueError as error:
        print(f"mutations: {error}", file=sys.stderr)
        return 1
    survived = sum(fate.survived for fate in fates)
    print(f"{counted(len(fates), 'fault')}, {survived} survived; the table is {parsed.out / 'mutations.md'}")
    return int(survived > 0)


def _chosen(mutations: Mapping[str, Mutation], only: Sequence[str] | None) -> list[Mutation]:
    unknown = [name for name in only or () if name not in mutations]
    if unknown:
        raise ValueError(f'no mutation is called "{unknown[0]}"; there are {", ".join(mutations)}')
    return [mutations[name] for name in only or mutations]


if __name__ == "__main__":
    install_signal_handlers("mutations")
    raise SystemExit(main())

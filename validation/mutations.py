"""Proof that the gates notice: ``python -m validation.mutations -o OUT [--only NAME ...]``.

``mutations.toml`` lists planted faults. The tree is copied once and checked as it is; then one fault at a
time is put into the copy and ``python -m validation check`` runs on the stages and scenes that it says, from
the references of the first check. OUT gets ``mutations.md`` and ``mutations.json``; the exit code is 1 where
a fault survives or the tree itself breaks a gate, 2 where the list is wrong.
"""

from __future__ import annotations

import argparse
import json
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from thesisrecon.errors import counted
from thesisrecon.runtime.signals import install_signal_handlers
from validation.harness.gates import Gate, read_gates
from validation.harness.planting import CopiedTree
from validation.harness.process import last_words, own_cores, run_process
from validation.harness.records import slug
from validation.harness.results import Results, read_results
from validation.harness.stages import STAGES, available_scenes
from validation.scenes.real import ROOT, data_root

MUTATIONS_FILE = Path(__file__).with_suffix(".toml")
FIELDS = ("name", "file", "old", "new", "check")
TASK_LIMIT_S = 900


@dataclass(frozen=True)
class Mutation:
    """A planted fault: in ``file``, ``old`` (which stands there once) becomes ``new``; the gates of one of
    ``check`` ("stage/scene") must notice, of ``methods`` of ours (all where it is empty)."""

    name: str
    file: str
    old: str
    new: str
    check: tuple[str, ...]
    methods: tuple[str, ...] = ()

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages whose gates should notice."""
        return tuple(dict.fromkeys(where.split("/")[0] for where in self.check))

    @property
    def scenes(self) -> tuple[str, ...]:
        """The scenes on which they should."""
        return tuple(dict.fromkeys(where.split("/")[1] for where in self.check))

    def apply(self, root: Path) -> str:
        """The text of the file with the fault.

        Raises ``ValueError`` where ``old`` does not stand in the file exactly once.
        """
        path = root / self.file
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        found = text.count(self.old)
        if found != 1:
            raise ValueError(
                f'"{self.name}": its old text must stand in {self.file} once, it stands there {found} times; '
                "name more of the text around it"
            )
        return text.replace(self.old, self.new)


@dataclass(frozen=True)
class Fate:
    """What became of a fault: the gates that ``caught`` it, and the seconds (wall) of the check; ``ended``
    says why methods of ours did not end well, which leaves their numbers untold; ``skipped`` why it was not
    planted."""

    name: str
    file: str
    caught: tuple[str, ...]
    seconds: float
    ended: tuple[str, ...] = ()
    skipped: str = ""

    @property
    def survived(self) -> bool:
        """Whether no gate noticed."""
        return not (self.caught or self.skipped)


def read_mutations(path: Path = MUTATIONS_FILE) -> list[Mutation]:
    """The list of faults, in order.

    Raises ``ValueError`` for one that lacks a field, changes nothing, has a name twice, or names a stage and
    scene that no gate judges.
    """
    judged = {key.rsplit("/", 1)[0] for key in read_gates()}
    found: list[Mutation] = []
    for told in tomllib.loads(path.read_text(encoding="utf-8"))["mutation"]:
        told.setdefault("methods", [])
        whole = set(told) == {*FIELDS, "methods"} and all(told[name] for name in FIELDS if name != "new")
        if not whole or told["old"] == told["new"]:
            raise ValueError(f"a mutation has {', '.join(FIELDS)}, old unlike new; one has {told}")
        wrong = [where for where in told["check"] if where not in judged]
        if wrong:
            raise ValueError(f'"{told["name"]}": no gate is called {wrong[0]}/...')
        found.append(Mutation(**{**told, **{name: tuple(told[name]) for name in ("check", "methods")}}))
    twice = [m.name for n, m in enumerate(found) if m.name in {other.name for other in found[:n]}]
    if twice:
        raise ValueError(f'two mutations are called "{twice[0]}"')
    return found


@dataclass(frozen=True)
class Bench(CopiedTree):
    """The copied tree and the checks in it."""

    def check(self, name: str, wanted: Sequence[Mutation], kernels: Path, resume: str = "") -> Checked:
        """``python -m validation check`` in the tree, on what these faults ask for.

        Raises ``ValueError`` where it ends without results.
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
        environment = {"PYTHONPATH": str(self.tree), "NUMBA_CACHE_DIR": str(kernels)}
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
    """What a check found where ("stage/scene") it was asked, and the seconds it took."""

    results: Results
    asked: tuple[str, ...]
    seconds: float

    @property
    def ended(self) -> tuple[str, ...]:
        """Why methods of ours did not end well."""
        found = self.results.failures.items()
        return tuple(dict.fromkeys(words for key, words in found if key.split("/")[2].startswith("ours")))

    def broken(self, gates: Mapping[str, Gate]) -> tuple[str, ...]:
        """The gates whose number is on the wrong side, or was told by nobody."""
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
    """The fate of each fault, in order; where ``sound``, the first check stands there of an earlier run.

    Raises ``ValueError`` where the tree without faults breaks a gate.
    """
    here, gates = available_scenes(quick=False), read_gates()
    possible = [m for m in mutations if set(m.scenes) <= set(here)]
    bench.set_up()
    if not sound:
        broken = bench.check("sound", possible, bench.kernels).broken(gates)
        if broken:
            raise ValueError(f"the tree breaks gates without any fault: {', '.join(broken)}")
    for number, mutation in enumerate(mutations):
        if mutation not in possible:
            absent = f"{mutation.scenes[0]} is not on this machine"
            yield Fate(mutation.name, mutation.file, (), 0.0, skipped=absent)
            continue
        with bench.planted(mutation.file, mutation.apply(bench.tree), number) as kernels:
            found = bench.check(slug(mutation.name), [mutation], kernels, resume="sound")
        yield Fate(mutation.name, mutation.file, found.broken(gates), found.seconds, found.ended)


def table(fates: Sequence[Fate]) -> str:
    """Markdown: a row for each fault."""
    lines = ["| fault | file | caught by | s |", "| --- | --- | --- | --- |"]
    for fate in fates:
        caught = ", ".join(fate.caught) or (f"not planted: {fate.skipped}" if fate.skipped else "**nothing**")
        caught += f" (ended: {'; '.join(fate.ended)})" if fate.ended else ""
        lines.append(f"| {fate.name} | {fate.file} | {caught} | {fate.seconds:.0f} |")
    return "\n".join(lines)


def write_fates(out: Path, fates: Sequence[Fate]) -> None:
    """``mutations.md`` and ``mutations.json`` in ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "mutations.md").write_text(table(fates) + "\n", encoding="utf-8")
    (out / "mutations.json").write_text(json.dumps([asdict(f) for f in fates], indent=1), encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """0: all faults were caught; 1: one survives, or the tree breaks a gate without any; 2: a wrong list."""
    parser = argparse.ArgumentParser(prog="python -m validation.mutations", description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/mutations"))
    parser.add_argument("--only", nargs="+", metavar="NAME", help="by default all of mutations.toml")
    parser.add_argument("--sound", action="store_true", help="keep the first check of an earlier run in OUT")
    told = parser.parse_args(arguments)
    try:
        mutations = _chosen({m.name: m for m in read_mutations()}, told.only)
        for mutation in mutations:
            mutation.apply(ROOT)
    except ValueError as error:
        print(f"mutations: {error}", file=sys.stderr)
        return 2
    fates: list[Fate] = []
    try:
        for fate in plant_all(Bench(told.out.resolve()), mutations, sound=told.sound):
            fates.append(fate)
            print(table([fate]).splitlines()[-1], flush=True)
            write_fates(told.out, fates)
    except ValueError as error:
        print(f"mutations: {error}", file=sys.stderr)
        return 1
    survived = sum(fate.survived for fate in fates)
    print(f"{counted(len(fates), 'fault')}, {survived} survived; the table is {told.out / 'mutations.md'}")
    return int(survived > 0)


def _chosen(mutations: Mapping[str, Mutation], only: Sequence[str] | None) -> list[Mutation]:
    unknown = [name for name in only or () if name not in mutations]
    if unknown:
        raise ValueError(f'no mutation is called "{unknown[0]}"; there are {", ".join(mutations)}')
    return [mutations[name] for name in only or mutations]


if __name__ == "__main__":
    install_signal_handlers("mutations")
    raise SystemExit(main())

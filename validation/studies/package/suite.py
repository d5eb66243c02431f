"""The quick suite in an environment of its own, one part of ``tests/`` after the other."""

from __future__ import annotations

import re
import resource
import subprocess
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from validation.studies.package.environments import (
    bare,
    dependencies,
    install,
    installed_versions,
    make_environment,
)
from validation.scenes.real import ROOT

TOOLS = ("pytest>=8.2", "hypothesis>=6.100", "pytest-benchmark>=4.0")
QUICK = ("-m", "not slow and not real and not browser")
COUNTED = re.compile(r"(\d+) (passed|failed|skipped|xfailed|errors?)\b")
NOTHING_TO_RUN = 5
"""pytest's exit code where the marks leave out every test."""


@dataclass(frozen=True)
class Part:
    """What pytest said of a part: its counts by word, its exit code, its processor seconds."""

    name: str
    counts: Mapping[str, int]
    code: int
    seconds: float

    def __str__(self) -> str:
        ended = "nothing to run" if self.code == NOTHING_TO_RUN else f"ended with code {self.code}"
        counts = ", ".join(f"{n} {word}" for word, n in self.counts.items()) or ended
        return f"{self.name}: {counts}; {self.seconds:.0f} s"


def quick_parts(tests: Path = ROOT / "tests") -> dict[str, list[str]]:
    """pytest's arguments for each part of the quick suite by its name: every folder of tests but that of
    ``validation/``, whose references are no dependencies, and the files that stand in none."""
    folders = sorted(p for p in tests.iterdir() if p.is_dir() and any(p.rglob("test_*.py")))
    parts = {f"tests/{f.name}": [str(f), *QUICK] for f in folders if f.name != "validation"}
    return parts | {"tests/*.py": [*map(str, sorted(tests.glob("test_*.py"))), *QUICK]}


def suite_environment(out: Path, name: str, python: str, constraints: Sequence[str]) -> Path:
    """The folder of an environment of that Python, made where no earlier run finished it."""
    version = subprocess.run([python, "-V"], check=True, capture_output=True, text=True).stdout.split()[-1]
    place = out / f"{name}-{version}"
    interpreter, finished = place / "bin" / "python", place / "finished"
    if not finished.exists():
        make_environment(place, python)
        install(interpreter, *dependencies(), *TOOLS, constraints=constraints)
        finished.touch()
    print(f"{name}: {installed_versions(interpreter)}", flush=True)
    return place


def run_part(place: Path, name: str, arguments: Sequence[str]) -> Part:
    """Run pytest in the environment of ``place``; what it says stands in ``logs/`` there, and what failed is
    printed too."""
    log = place / "logs" / f"{re.sub(r'[^A-Za-z0-9]+', '-', name).strip('-')[-80:]}.log"
    log.parent.mkdir(exist_ok=True)
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}
    environment = bare(PYTHONPATH=str(ROOT), NUMBA_CACHE_DIR=str(place / "kernels"), **threads)
    before = _children_seconds()
    with log.open("w", encoding="utf-8") as told:
        code = subprocess.run(
            [str(place / "bin" / "python"), "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments],
            cwd=ROOT,
            env=environment,
            stdout=told,
            stderr=subprocess.STDOUT,
            check=False,
        ).returncode
    lines = log.read_text(encoding="utf-8").splitlines()
    part = Part(name, counted(lines), code, _children_seconds() - before)
    print(
        "\n".join([line for line in lines if line.startswith(("FAILED", "ERROR"))] + [str(part)]), flush=True
    )
    return part


def counted(lines: Sequence[str]) -> dict[str, int]:
    """Tests by what became of them, as the last line of pytest tells; nothing where it never came so far."""
    return {word: int(n) for n, word in COUNTED.findall(lines[-1] if lines else "")}


def suite_faults(parts: Sequence[Part]) -> list[str]:
    """What is wrong with a suite of these parts; prints how many tests there were in all."""
    total: Counter[str] = Counter()
    for part in parts:
        total.update(part.counts)
    counts = ", ".join(f"{n} {word}" for word, n in total.items())
    print(f"{counts or 'nothing'} in {sum(p.seconds for p in parts) / 60:.0f} processor minutes")
    faults = [f"{p.name} ended with code {p.code}" for p in parts if p.code not in (0, NOTHING_TO_RUN)]
    return faults if faults or total["passed"] else ["no test ran"]


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime

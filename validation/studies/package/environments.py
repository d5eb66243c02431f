"""Virtual environments of the package checks, and the quick suite in them, one part of ``tests/`` after the
other.
"""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from validation.scenes.real import ROOT

BOUND = re.compile(r"(?P<name>[A-Za-z0-9_.-]+)>=(?P<lowest>[0-9.]+)")


def dependencies() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [str(line) for line in project["dependencies"]]


def lowest_versions(needed: Sequence[str]) -> list[str]:
    """Return constraints to the lowest version of each; ``ValueError`` for a line without a bound."""
    lines = []
    for line in needed:
        found = BOUND.fullmatch(line.replace(" ", ""))
        if found is None:
            raise ValueError(f"a dependency is written NAME>=VERSION; got {line!r}")
        lines.append(f"{found['name']}=={found['lowest']}")
    return lines


def make_environment(folder: Path, python: str = sys.executable) -> Path:
    """Make the virtual environment in ``folder`` if it is absent; return its interpreter."""
    interpreter = folder / "bin" / "python"
    if not interpreter.exists():
        # Each Python version must make its own virtual environments.
        subprocess.run([python, "-m", "venv", str(folder)], check=True, env=clean_environment())
    return interpreter


def install(interpreter: Path, *packages: str, constraints: Sequence[str] = ()) -> None:
    """Install packages or wheels with pip, under constraints such as ``numpy==1.26``."""
    command = [str(interpreter), "-m", "pip", "install", "-q", "--disable-pip-version-check", *packages]
    if constraints:
        file = interpreter.parent.parent / "constraints.txt"
        file.write_text("\n".join(constraints) + "\n", encoding="utf-8")
        command += ["-c", str(file)]
    subprocess.run(command, check=True, env=clean_environment())


def installed_versions(interpreter: Path) -> str:
    """Return the versions of Python and of each dependency in one line."""
    names = [re.split("[>=<]", line)[0].strip() for line in dependencies()]
    asked = "import sys, platform, importlib.metadata as found\n"
    asked += "print(platform.python_version(), *(f'{n} {found.version(n)}' for n in sys.argv[1:]), sep=', ')"
    command = [str(interpreter), "-c", asked, *names]
    run = subprocess.run(command, check=True, env=clean_environment(), capture_output=True, text=True)
    return f"Python {run.stdout.strip()}"


def clean_environment(**more: str) -> Mapping[str, str]:
    """Return this environment without paths to the source tree, with ``more`` variables."""
    left = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")}
    return {**left, **more}


TOOLS = ("pytest>=8.2", "hypothesis>=6.100", "pytest-benchmark>=4.0")
QUICK = ("-m", "not slow and not real and not browser")
COUNTED = re.compile(r"(\d+) (passed|failed|skipped|xfailed|errors?)\b")
NOTHING_TO_RUN = 5
"""Exit code of pytest if the marks exclude every test."""


@dataclass(frozen=True)
class Part:
    """Result of pytest on one part: counts by word, exit code, processor seconds."""

    name: str
    counts: Mapping[str, int]
    code: int
    seconds: float

    def __str__(self) -> str:
        ended = "nothing to run" if self.code == NOTHING_TO_RUN else f"ended with code {self.code}"
        counts = ", ".join(f"{n} {word}" for word, n in self.counts.items()) or ended
        return f"{self.name}: {counts}; {self.seconds:.0f} s"


def quick_parts(tests: Path = ROOT / "tests") -> dict[str, list[str]]:
    """Return the arguments of pytest for each part of the quick suite.

    A part is a folder of tests; the files of ``tests/`` are one more. ``tests/validation`` is left out,
    because its references are no dependencies.
    """
    folders = sorted(p for p in tests.iterdir() if p.is_dir() and any(p.rglob("test_*.py")))
    parts = {f"tests/{f.name}": [str(f), *QUICK] for f in folders if f.name != "validation"}
    return parts | {"tests/*.py": [*map(str, sorted(tests.glob("test_*.py"))), *QUICK]}


def suite_environment(out: Path, name: str, python: str, constraints: Sequence[str]) -> Path:
    """Return the folder of an environment with the test tools, made if it is not finished."""
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
    """Run pytest in the environment of ``place``; its output is kept in ``logs/`` there."""
    log = place / "logs" / f"{re.sub(r'[^A-Za-z0-9]+', '-', name).strip('-')[-80:]}.log"
    log.parent.mkdir(exist_ok=True)
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}
    environment = clean_environment(PYTHONPATH=str(ROOT), NUMBA_CACHE_DIR=str(place / "kernels"), **threads)
    before = _children_seconds()
    with log.open("w", encoding="utf-8") as log_file:
        code = subprocess.run(
            [str(place / "bin" / "python"), "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments],
            cwd=ROOT,
            env=environment,
            stdout=log_file,
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
    return {word: int(n) for n, word in COUNTED.findall(lines[-1] if lines else "")}


def suite_faults(parts: Sequence[Part]) -> list[str]:
    """Return the faults of a suite, and print its counts."""
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

"""Virtual environments of the package checks, and the quick suite in them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
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


def captured(
    command: Sequence[object], folder: str, *, check: bool = False, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run a program in ``folder`` in a clean environment with these variables, and keep what it prints."""
    words, environment = [str(word) for word in command], clean_environment(**variables)
    return subprocess.run(words, cwd=folder, env=environment, check=check, capture_output=True, text=True)


TOOLS = ("pytest>=8.2", "hypothesis>=6.100", "pytest-benchmark>=4.0", "numpydoc>=1.8")
QUICK = ("-m", "not (real or slow or references or browser)")


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


def run_suite(place: Path, tests: Sequence[str]) -> list[str]:
    """Run the quick suite, or these ``tests``, in the environment of ``place``; return its faults.

    ``tests/validation`` is left out, because its references are no dependencies. The output is kept.
    """
    log = place / "log"
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}
    environment = clean_environment(PYTHONPATH=str(ROOT), NUMBA_CACHE_DIR=str(place / "kernels"), **threads)
    chosen = tests or [str(ROOT / "tests"), "--ignore", str(ROOT / "tests" / "validation"), *QUICK]
    with log.open("w", encoding="utf-8") as log_file:
        code = subprocess.run(
            [str(place / "bin" / "python"), "-m", "pytest", "-q", "-p", "no:cacheprovider", *chosen],
            cwd=ROOT, env=environment, stdout=log_file, stderr=subprocess.STDOUT, check=False,
        ).returncode  # fmt: skip
    lines = log.read_text(encoding="utf-8").splitlines()
    print("\n".join([*(x for x in lines if x.startswith(("FAILED", "ERROR"))), *lines[-1:]]), flush=True)
    return [f"pytest ended with code {code}"] if code else []

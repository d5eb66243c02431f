"""Virtual environments of the checks, and the versions of the dependencies that ``pyproject.toml`` allows."""

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
    """What the package needs at least, as ``pyproject.toml`` writes it: ``NAME>=VERSION``."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [str(line) for line in project["dependencies"]]


def lowest_versions(needed: Sequence[str]) -> list[str]:
    """The constraints that allow the lowest version of each alone.

    Raises ``ValueError`` where a line is no ``NAME>=VERSION``: without a lower bound there is no lowest.
    """
    lines = []
    for line in needed:
        found = BOUND.fullmatch(line.replace(" ", ""))
        if found is None:
            raise ValueError(f"a dependency is written NAME>=VERSION; got {line!r}")
        lines.append(f"{found['name']}=={found['lowest']}")
    return lines


def make_environment(folder: Path, python: str = sys.executable) -> Path:
    """The interpreter of the virtual environment in ``folder``, which is made where it is absent."""
    interpreter = folder / "bin" / "python"
    if not interpreter.exists():
        # A virtual environment of another version must be made by that version itself.
        subprocess.run([python, "-m", "venv", str(folder)], check=True, env=bare())
    return interpreter


def install(interpreter: Path, *what: str, constraints: Sequence[str] = ()) -> None:
    """Install packages or wheels with pip, under constraints such as ``numpy==1.26``."""
    command = [str(interpreter), "-m", "pip", "install", "-q", "--disable-pip-version-check", *what]
    if constraints:
        file = interpreter.parent.parent / "constraints.txt"
        file.write_text("\n".join(constraints) + "\n", encoding="utf-8")
        command += ["-c", str(file)]
    subprocess.run(command, check=True, env=bare())


def installed_versions(interpreter: Path) -> str:
    """The version of Python and of each dependency, as one line."""
    names = [re.split("[>=<]", line)[0].strip() for line in dependencies()]
    asked = "import sys, platform, importlib.metadata as found\n"
    asked += "print(platform.python_version(), *(f'{n} {found.version(n)}' for n in sys.argv[1:]), sep=', ')"
    command = [str(interpreter), "-c", asked, *names]
    run = subprocess.run(command, check=True, env=bare(), capture_output=True, text=True)
    return f"Python {run.stdout.strip()}"


def bare(**more: str) -> Mapping[str, str]:
    """This environment without what leads Python to the source tree, with what is given."""
    left = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")}
    return {**left, **more}

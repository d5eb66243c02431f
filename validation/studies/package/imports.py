"""What importing costs: the package, its front doors and the command, in processor seconds of processes."""

from __future__ import annotations

import subprocess
import tempfile
from collections import Counter
from pathlib import Path

from validation.studies.package.environments import bare

LIMIT_S = 0.6
"""Of the package and of the command's own words."""
TIMES_NUMBA = 2.5
"""A front door that may run any stage imports numba and all kernels: so many times what numba takes alone."""
DOORS = ("triangulate", "render", "PipelineConfig", "estimate_fundamental", "reconstruct", "match_pair")
COMMANDS = ("--version", "--help", "reconstruct --help")
EMPTY = "pass"
TIMED = """
import resource, sys
{code}
spent = resource.getrusage(resource.RUSAGE_SELF)
print(f"{{spent.ru_utime + spent.ru_stime:.3f}}", file=sys.stderr)
"""
COMMAND = """
import contextlib, io
from thesisrecon.cli import run_command
with contextlib.redirect_stdout(io.StringIO()):
    run_command({!r})
"""


def statements() -> dict[str, str]:
    """What is timed, by its name on the table."""
    doors = {f"thesisrecon.{door}": f"import thesisrecon; thesisrecon.{door}" for door in DOORS}
    commands = {f"thesisrecon {words}": COMMAND.format(words.split()) for words in COMMANDS}
    others = {name: f"import {name}" for name in ("numpy", "numba", "scipy.stats")}
    return {"Python alone": EMPTY, "import thesisrecon": "import thesisrecon", **commands, **doors, **others}


def processor_seconds(interpreter: Path, code: str, repeats: int) -> float:
    """The least of several new processes: what stands in its way only ever adds."""
    with tempfile.TemporaryDirectory() as empty:
        command = [str(interpreter), "-c", TIMED.format(code=code)]
        runs = [
            subprocess.run(command, cwd=empty, env=bare(), check=True, capture_output=True, text=True)
            for _ in range(repeats + 1)
        ]
    # The first one writes bytecode.
    return min(float(run.stderr.split()[-1]) for run in runs[1:])


def shares(interpreter: Path, code: str, most: int = 10) -> list[tuple[str, float]]:
    """Milliseconds that the modules of each package take of an import, by ``-X importtime``."""
    command = [str(interpreter), "-X", "importtime", "-c", code]
    told = subprocess.run(command, env=bare(), check=True, capture_output=True, text=True).stderr
    found: Counter[str] = Counter()
    for line in told.splitlines():
        own, _, name = line.removeprefix("import time:").split("|") if line.count("|") == 2 else ("", "", "")
        if own.strip().isdigit():
            parts = name.strip().split(".")
            found[".".join(parts[:2]) if parts[0] in ("scipy", "thesisrecon") else parts[0]] += int(own)
    return [(name, micro / 1000.0) for name, micro in found.most_common(most)]


def check_imports(interpreter: Path, repeats: int = 5) -> list[str]:
    """Print the table; what the command and the package take too long for."""
    taken = {name: processor_seconds(interpreter, code, repeats) for name, code in statements().items()}
    print("| | processor s |", "| --- | --- |", sep="\n")
    for name, seconds in taken.items():
        print(f"| {name} | {seconds:.2f} |")
    largest = shares(interpreter, "import thesisrecon; thesisrecon.reconstruct")
    print("of thesisrecon.reconstruct, ms:", ", ".join(f"{name} {ms:.0f}" for name, ms in largest))
    bound = ["import thesisrecon", *(f"thesisrecon {words}" for words in COMMANDS)]
    faults = [f"{n} takes {taken[n]:.2f} s, at most {LIMIT_S}" for n in bound if taken[n] > LIMIT_S]
    most = max(TIMES_NUMBA * taken["numba"], LIMIT_S)
    slow = [f"thesisrecon.{door}" for door in DOORS if taken[f"thesisrecon.{door}"] > most]
    return faults + [f"{name} takes {taken[name]:.2f} s, at most {most:.2f}" for name in slow]

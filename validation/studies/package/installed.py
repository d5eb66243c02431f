"""Import times and side effects of the installed package.

An audit hook logs every file that Python opens for writing, makes, renames or removes, and refuses network
connections. The home, temporary and current folders are watched for files that C code writes.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from validation.studies.package.environments import captured
from validation.studies.runner import text_table

LIMIT_S = 0.6
"""Bound of the package and of the help texts of the command."""
TIMES_NUMBA = 2.5
"""Bound of functions that may run any stage, over the import time of numba, which they need."""
DOORS = ("triangulate", "render", "PipelineConfig", "estimate_fundamental", "reconstruct", "match_pair")
COMMANDS = ("--version", "--help", "reconstruct --help")
REPEATS = 5
EMPTY = "pass"
TIMED = """
import resource, sys
{code}
spent = resource.getrusage(resource.RUSAGE_SELF)
print(f"{{spent.ru_utime + spent.ru_stime:.3f}}", file=sys.stderr)
"""
COMMAND = """
import contextlib, io
from thesisrecon.cli.main import run_command
with contextlib.redirect_stdout(io.StringIO()):
    run_command({!r})
"""


def statements() -> dict[str, str]:
    doors = {f"thesisrecon.{door}": f"import thesisrecon; thesisrecon.{door}" for door in DOORS}
    commands = {f"thesisrecon {words}": COMMAND.format(words.split()) for words in COMMANDS}
    others = {name: f"import {name}" for name in ("numpy", "numba", "scipy.stats")}
    return {"Python alone": EMPTY, "import thesisrecon": "import thesisrecon", **commands, **doors, **others}


def processor_seconds(interpreter: Path, code: str) -> float:
    """Return the least processor seconds of several new processes."""
    with tempfile.TemporaryDirectory() as empty:
        command = [interpreter, "-c", TIMED.format(code=code)]
        runs = [captured(command, empty, check=True) for _ in range(REPEATS + 1)]
    # The first one writes bytecode.
    return min(float(run.stderr.split()[-1]) for run in runs[1:])


def check_imports(interpreter: Path) -> list[str]:
    """Print the import times; return those above their bounds."""
    taken = {name: processor_seconds(interpreter, code) for name, code in statements().items()}
    print(text_table(["", "processor s"], ([name, f"{s:.2f}"] for name, s in taken.items())))
    bound = ["import thesisrecon", *(f"thesisrecon {words}" for words in COMMANDS)]
    faults = [f"{n} takes {taken[n]:.2f} s, at most {LIMIT_S}" for n in bound if taken[n] > LIMIT_S]
    most = max(TIMES_NUMBA * taken["numba"], LIMIT_S)
    slow = [f"thesisrecon.{door}" for door in DOORS if taken[f"thesisrecon.{door}"] > most]
    return faults + [f"{name} takes {taken[name]:.2f} s, at most {most:.2f}" for name in slow]


AUDIT = """
import os, sys
log = os.open(sys.argv.pop(1), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
PLACES = {"os.mkdir": 1, "os.rename": 2, "os.link": 2, "os.symlink": 2, "os.remove": 1, "os.rmdir": 1,
          "os.truncate": 1, "os.chmod": 1, "os.chown": 1, "os.utime": 1}
TALK = ("socket.connect", "socket.bind", "socket.sendto", "socket.getaddrinfo", "socket.gethostbyname",
        "socket.gethostbyaddr", "urllib.Request", "webbrowser.open")
def say(kind, text):
    os.write(log, f"{kind}\\t{text}\\n".encode(errors="replace"))
def log_event(event, given):
    if event == "open" and not isinstance(given[0], int) and given[2] & WRITING:
        say("write", os.path.abspath(os.fsdecode(given[0])))
    elif event in PLACES:
        for path in given[:PLACES[event]]:
            if not isinstance(path, int):
                say("write", os.path.abspath(os.fsdecode(path)))
    elif event in TALK:
        say("network", f"{event} {given[1:]}")
        raise PermissionError(f"{event} is forbidden here")
    elif event in ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn"):
        if given[0] != sys.executable:  # the first run compiles kernels in processes of Python
            say("process", f"{event} {given[0]}")
sys.addaudithook(log_event)
from thesisrecon.cli.main import main
sys.argv[0] = "thesisrecon"
main()
"""
"""Program that logs what a command does; its first argument is the log file."""


@dataclass(frozen=True)
class Watched:
    """A watched run.

    ``code``, ``said``: exit code and output; ``written``: written files; ``network``, ``processes``:
    network calls and started programs; ``left``: files in the watched folders after the run.
    """

    code: int
    written: frozenset[Path]
    network: tuple[str, ...]
    processes: tuple[str, ...]
    left: tuple[Path, ...]
    said: str

    def outside(self, *allowed: Path) -> list[Path]:
        homes = [folder.resolve() for folder in allowed]
        return sorted(p for p in self.written if not any(p.resolve().is_relative_to(h) for h in homes))


def watch(program: str, arguments: Sequence[str], place: Path, **variables: str) -> Watched:
    """Run the command with the interpreter ``program`` and new, empty home, temporary and current folders."""
    homes = {name: place / name.lower() for name in ("HOME", "TMPDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")}
    current = place / "current"
    for folder in (*homes.values(), current):
        folder.mkdir(parents=True)
    log = place / "audit.log"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment |= {name: str(folder) for name, folder in homes.items()}
    # Installers compile bytecode; it is not written by the run.
    environment |= {"PYTHONDONTWRITEBYTECODE": "1", **variables}
    ended = subprocess.run(
        [program, "-c", AUDIT, str(log), *arguments],
        cwd=current,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    logged = [line.split("\t", 1) for line in log.read_text(encoding="utf-8").splitlines() if "\t" in line]
    said = {kind: [text for k, text in logged if k == kind] for kind in ("write", "network", "process")}
    return Watched(
        ended.returncode,
        frozenset(Path(path) for path in said["write"]),
        tuple(said["network"]),
        tuple(said["process"]),
        tuple(sorted(p for folder in (*homes.values(), current) for p in folder.rglob("*"))),
        ended.stdout + ended.stderr,
    )


def trespasses(run: Watched, *allowed: Path) -> list[str]:
    faults = [] if run.code == 0 else [f"the run ended with code {run.code}: {run.said.strip()}"]
    faults += [f"{path} was written" for path in run.outside(*allowed, Path(os.devnull))]
    faults += [f"{path} was left behind" for path in run.left]
    faults += [f"network call: {words}" for words in run.network]
    return faults + [f"it started a program: {words}" for words in run.processes]

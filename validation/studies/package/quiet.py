"""Where a run writes, and that it speaks to nobody.

Every file that Python opens for writing, makes, renames or removes is told by an audit hook, connections are
refused, and the folders where programs leave things unasked (home, temporary, current) are watched for what C
code writes.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

AUDIT = """
import os, sys
log = os.open(sys.argv.pop(1), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
PLACES = {"os.mkdir": 1, "os.rename": 2, "os.link": 2, "os.symlink": 2, "os.remove": 1, "os.rmdir": 1,
          "os.truncate": 1, "os.chmod": 1, "os.chown": 1, "os.utime": 1}
TALK = ("socket.connect", "socket.bind", "socket.sendto", "socket.getaddrinfo", "socket.gethostbyname",
        "socket.gethostbyaddr", "urllib.Request", "webbrowser.open")
def say(kind, what):
    os.write(log, f"{kind}\\t{what}\\n".encode(errors="replace"))
def hear(event, given):
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
        say("process", f"{event} {given[0]}")
sys.addaudithook(hear)
from thesisrecon.cli import main
sys.argv[0] = "thesisrecon"
main()
"""
"""A program that notes in the file of its first argument what the command of the others does."""


@dataclass(frozen=True)
class Watched:
    """A run and what it did: its exit code, the files it wrote, what it said to whom, programs it started,
    and what stands in the watched folders afterwards."""

    code: int
    written: frozenset[Path]
    network: tuple[str, ...]
    processes: tuple[str, ...]
    left: tuple[Path, ...]
    said: str

    def outside(self, *allowed: Path) -> list[Path]:
        """Files written under none of these folders."""
        homes = [folder.resolve() for folder in allowed]
        return sorted(p for p in self.written if not any(p.resolve().is_relative_to(h) for h in homes))


def watch(program: str, arguments: Sequence[str], place: Path, **variables: str) -> Watched:
    """Run the command with ``arguments`` by the interpreter ``program``, with every folder for things unasked
    a new and empty one of ``place``."""
    homes = {name: place / name.lower() for name in ("HOME", "TMPDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")}
    current = place / "current"
    for folder in (*homes.values(), current):
        folder.mkdir(parents=True)
    log = place / "audit.log"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment |= {name: str(folder) for name, folder in homes.items()}
    # Bytecode is Python's own business, and installers compile it.
    environment |= {"PYTHONDONTWRITEBYTECODE": "1", **variables}
    ended = subprocess.run(
        [program, "-c", AUDIT, str(log), *arguments],
        cwd=current,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    heard = [line.split("\t", 1) for line in log.read_text(encoding="utf-8").splitlines() if "\t" in line]
    said = {kind: [what for k, what in heard if k == kind] for kind in ("write", "network", "process")}
    return Watched(
        ended.returncode,
        frozenset(Path(path) for path in said["write"]),
        tuple(said["network"]),
        tuple(said["process"]),
        tuple(sorted(p for folder in (*homes.values(), current) for p in folder.rglob("*"))),
        ended.stdout + ended.stderr,
    )


def trespasses(run: Watched, *allowed: Path) -> list[str]:
    """What a run did that it should not, in words."""
    faults = [] if run.code == 0 else [f"the run ended with code {run.code}: {run.said.strip()}"]
    faults += [f"{path} was written" for path in run.outside(*allowed, Path(os.devnull))]
    faults += [f"{path} was left behind" for path in run.left]
    faults += [f"it spoke: {words}" for words in run.network]
    return faults + [f"it started a program: {words}" for words in run.processes]

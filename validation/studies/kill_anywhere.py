"""Runs killed anywhere, resumed and compared: ``python -m validation.studies.kill_anywhere``.

One run of the courtyard is left alone. Others are killed (SIGKILL) when a given share of its time has
passed, or in the middle of a given write to the disk, and started again; every output must have the bytes of
the first (times aside). ``--kills`` and ``--writes`` say how many of either; the exit code is 1 where one
differs.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from validation.scenes.real import ROOT

COURTYARD = ROOT / "fixtures" / "courtyard"
CLEAN = ("seconds", "elapsed_seconds", "resumed", "peak_memory_mb", "threads", "executor")
"""Of a summary: what may differ between runs of one answer."""
TRIES = 3
"""Runs begun for one kill, where they end before it comes."""
TORN = """
import os, signal, sys
left = int(sys.argv.pop(1))
sync = os.fsync
def torn(descriptor):
    global left
    left -= 1
    if left == 0:
        os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)
        os.kill(os.getpid(), signal.SIGKILL)
    sync(descriptor)
os.fsync = torn
from thesisrecon.cli import run_command
sys.exit(run_command(sys.argv[1:]))
"""
"""A program that cuts its n-th file in half before it is whole and dies."""


@dataclass(frozen=True)
class Kill:
    """One killed run: ``when`` in words, the files it had finished, what differs after its resume."""

    when: str
    died: bool
    kept: int
    different: tuple[str, ...]


def outputs(out: Path) -> dict[str, bytes]:
    """Every file of a finished run by its name, the summary and the manifests without their times; the page,
    which shows times, is left out."""
    found = {}
    for path in sorted(p for p in out.rglob("*") if p.is_file() and p.name not in (".lock", "report.html")):
        content = path.read_bytes()
        if path.suffix == ".json" and path.name in ("summary.json", "manifest.json"):
            content = json.dumps(_timeless(json.loads(content)), sort_keys=True).encode()
        found[str(path.relative_to(out))] = content
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if k not in CLEAN}
    return [_timeless(v) for v in value] if isinstance(value, list) else value


def different(one: dict[str, bytes], other: dict[str, bytes]) -> tuple[str, ...]:
    """Names of files that only one holds or whose bytes differ."""
    return tuple(sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name)))


class Runs:
    """Runs of one set of photographs with one command, in folders of ``place``."""

    def __init__(self, place: Path, options: list[str], images: Path = COURTYARD / "images") -> None:
        self.place, self.options, self.images = place, options, images
        self.environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}

    def arguments(self, out: Path) -> list[str]:
        """The command line but for the program."""
        return ["reconstruct", str(self.images), "-o", str(out), *self.options]

    def whole(self, out: Path) -> float:
        """Run to the end; returns the seconds it took."""
        start = time.perf_counter()
        program = [sys.executable, "-m", "thesisrecon", *self.arguments(out)]
        subprocess.run(program, env=self.environment, check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - start

    def killed(self, name: str, after_s: float) -> tuple[Path, bool]:
        """A run that is killed; its folder, and whether it was still running."""
        out = self.place / name
        program = [sys.executable, "-m", "thesisrecon", *self.arguments(out)]
        process = subprocess.Popen(program, env=self.environment, stdout=subprocess.DEVNULL)
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            process.kill()
        return out, process.wait() == -signal.SIGKILL

    def torn(self, name: str, write: int) -> tuple[Path, bool]:
        """A run that dies in the middle of its ``write``-th file."""
        out = self.place / name
        program = [sys.executable, "-c", TORN, str(write), *self.arguments(out)]
        ended = subprocess.run(program, env=self.environment, check=False, stdout=subprocess.DEVNULL)
        return out, ended.returncode == -signal.SIGKILL

    def resumed(self, when: str, out: Path, died: bool, wanted: dict[str, bytes]) -> Kill:
        """What the second start of a killed run leaves, beside what it should."""
        kept = sum(1 for _ in out.glob("0*/*.npz"))
        self.whole(out)
        return Kill(when, died, kept, different(outputs(out), wanted))


def measure(place: Path, options: list[str], kills: int, writes: int) -> list[Kill]:
    """The uninterrupted run, and all killed ones; each is told as it ends."""
    runs, rows = Runs(place, options), []
    runs.whole(place / "first")
    seconds = runs.whole(place / "whole")
    wanted = outputs(place / "whole")
    rows.append(Kill("two runs left alone", False, 0, different(outputs(place / "first"), wanted)))
    files = len(wanted)
    for k in range(kills):
        share = (k + 0.5) / kills
        for again in range(TRIES):
            begun = time.perf_counter()
            out, died = runs.killed(f"kill-{k}-{again}", share * seconds)
            if died:
                break
            # The machine was busier when the whole run was timed.
            seconds = time.perf_counter() - begun
        rows.append(runs.resumed(f"after {100 * share:.0f} % of the time", out, died, wanted))
        print(rows[-1], flush=True)
    for k in range(writes):
        write = 1 + k * (files - 1) // max(writes - 1, 1)
        out, died = runs.torn(f"write-{k}", write)
        rows.append(runs.resumed(f"in the middle of file {write}", out, died, wanted))
        print(rows[-1], flush=True)
    return rows


def table(rows: list[Kill]) -> str:
    """Every kill in Markdown."""
    lines = ["| killed | stage files kept | outputs that differ after the resume |", "| --- | --- | --- |"]
    for row in rows:
        late = "" if row.died or not row.kept else " (had ended)"
        lines.append(f"| {row.when}{late} | {row.kept} | {', '.join(row.different) or 'none'} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and say whether every output came out the same."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.kill_anywhere", description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--writes", type=int, default=5)
    parser.add_argument("--max-size", default="640")
    parser.add_argument("--until", default="model")
    parser.add_argument("--threads", default="2")
    wishes = parser.parse_args(arguments)
    options = ["--max-size", wishes.max_size, "--until", wishes.until, "--threads", wishes.threads]
    with tempfile.TemporaryDirectory() as place:
        rows = measure(Path(place), options, wishes.kills, wishes.writes)
    print(table(rows))
    return int(any(row.different for row in rows))


if __name__ == "__main__":
    sys.exit(main())

"""Runs told to stop anywhere, resumed and compared: ``python -m validation.studies.stop_anywhere``.

Runs of the courtyard are sent SIGINT (``--signal TERM``: SIGTERM), they and all their processes as a terminal
does, when a given share of their time has passed. Each must end within two seconds, with the exit code of the
signal, one sentence that says how to go on, and no process left behind; started again, it must come to the
bytes of a run left alone (times aside). ``--cold`` begins each with no kernel compiled. The exit code is 1
where one does not.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from thesisrecon.runtime.signals import CODES
from validation.studies.kill_anywhere import COURTYARD, Runs, different, outputs

LIMIT_S, POLL_S = 2.0, 0.005
GRACE_S = 0.5
"""How long a process that was told that its parent is gone may take to go."""


@dataclass(frozen=True)
class Stop:
    """One stopped run: when, how long it took, how it ended and what it said, how many processes it left, how
    many files of stages it had finished, and what differs after its resume."""

    when: str
    seconds: float
    code: int
    said: str
    left: int
    kept: int
    different: tuple[str, ...] = ()

    def wrong(self, asked: signal.Signals) -> str:
        """What is not as it should be, in a few words; empty where all is well, and where the run had ended
        by itself."""
        if self.code == 0:
            return f"differs: {', '.join(self.different)}" if self.different else ""
        found = {
            f"took {self.seconds:.1f} s": self.seconds > LIMIT_S,
            f"exit code {self.code}": self.code != CODES[asked],
            "not one sentence": self.said.count("\n") != 1 or "Traceback" in self.said,
            f"{self.left} processes left": self.left > 0,
            f"differs: {', '.join(self.different)}": bool(self.different),
        }
        return "; ".join(words for words, here in found.items() if here)


def stopped(
    program: list[str],
    ready: Callable[[], bool],
    asked: signal.Signals,
    *,
    environment: dict[str, str] | None = None,
) -> Stop:
    """A program that is told to stop when it is ``ready``; its own end where that comes before."""
    begun = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-c", _LISTEN, *program],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    assert process.stderr is not None
    while process.poll() is None and not ready():
        time.sleep(POLL_S)
    start = time.perf_counter()
    if process.poll() is None:
        os.killpg(process.pid, asked)
    try:
        process.wait(60.0)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
    seconds = time.perf_counter() - start
    time.sleep(GRACE_S)
    left = _of_session(process.pid)
    for number in left:
        os.kill(number, signal.SIGKILL)
    with process.stderr as said:
        return Stop(f"{start - begun:.1f} s", seconds, process.wait(), said.read(), len(left), 0)


_LISTEN = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""
"""A program does not hear Ctrl-C where whoever started it was told not to."""


def _of_session(leader: int) -> list[int]:
    """The processes of a session that are alive."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] not in "ZX":
            found.append(int(path.parent.name))
    return found


def _is_past(moment: float) -> bool:
    return time.perf_counter() > moment


def measure(runs: Runs, moments: int, asked: signal.Signals, *, cold: bool) -> list[Stop]:
    """All stopped runs; each is told as it ends."""
    rows = []
    runs.whole(runs.place / "first")
    if cold:
        runs.environment["NUMBA_CACHE_DIR"] = str(runs.place / "kernels")
    seconds = runs.whole(runs.place / "whole")
    wanted = outputs(runs.place / "whole")
    for k in range(moments):
        share, out = (k + 0.5) / moments, runs.place / f"stop-{k}"
        environment = {**runs.environment}
        if cold:
            environment["NUMBA_CACHE_DIR"] = str(runs.place / f"kernels-{k}")
        program = [sys.executable, "-m", "thesisrecon", *runs.arguments(out)]
        end = time.perf_counter() + share * seconds
        stop = stopped(program, partial(_is_past, end), asked, environment=environment)
        kept = sum(1 for _ in out.glob("0*/*.npz"))
        runs.whole(out)
        changed = different(outputs(out), wanted)
        rows.append(replace(stop, when=f"{100 * share:.0f} % ({stop.when})", kept=kept, different=changed))
        print(rows[-1], flush=True)
    return rows


def table(rows: list[Stop], asked: signal.Signals) -> str:
    """Every stop in Markdown."""
    lines = ["| stopped at | seconds to stop | exit code | stage files kept | wrong |", "| --- " * 5 + "|"]
    for row in rows:
        wrong = row.wrong(asked) or ("nothing" if row.code else "nothing (had ended)")
        lines.append(f"| {row.when} | {row.seconds:.2f} | {row.code} | {row.kept} | {wrong} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and say whether every run stopped as it should."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.stop_anywhere", description=__doc__)
    parser.add_argument("--signal", choices=["INT", "TERM"], default="INT")
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--images", type=Path, default=COURTYARD / "images")
    parser.add_argument("--max-size", default="640")
    parser.add_argument("--until", default="model")
    parser.add_argument("--threads", default="2")
    parser.add_argument("--executor", default="local")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.FIELD=VALUE")
    parser.add_argument("--cold", action="store_true", help="begin each run with no kernel compiled")
    wishes = parser.parse_args(arguments)
    asked = signal.Signals[f"SIG{wishes.signal}"]
    options = ["--max-size", wishes.max_size, "--until", wishes.until, "--threads", wishes.threads]
    options += ["--executor", wishes.executor, *(word for wish in wishes.set for word in ("--set", wish))]
    with tempfile.TemporaryDirectory() as place:
        runs = Runs(Path(place), options, wishes.images)
        rows = measure(runs, wishes.moments, asked, cold=wishes.cold)
    print(table(rows, asked))
    return int(any(row.wrong(asked) for row in rows))


if __name__ == "__main__":
    sys.exit(main())

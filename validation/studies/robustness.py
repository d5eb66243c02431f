"""Runs of the courtyard that are killed, interrupted or out of disk space, and resumed.

``kill-anywhere``: runs are killed (SIGKILL) at a share of their time or in the middle of a write.
``stop-anywhere``: runs and all their processes get SIGINT or SIGTERM; each must end within two seconds with
the exit code of the signal, one sentence on how to continue and no process left behind.
``full-disk``: from every file on that a small run writes, the disk is full or read-only; each run must end
with exit code 2 and one sentence with place, cause and advice, and leave no foreign file.
Resumed, all must give the bytes of an undisturbed run, times aside.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from thesisrecon.cli.commands import run_command
from thesisrecon.errors import NOT_MADE, remedies
from thesisrecon.runtime._signals import CODES
from validation.runs.study import Part, report_progress
from validation.runs.tables import Rows, text_table
from validation.scenes.real import ROOT

COURTYARD = ROOT / "fixtures" / "courtyard"
CLEAN = ("seconds", "elapsed_seconds", "resumed", "peak_memory_mb", "threads", "executor")
"""Fields of the summary that may differ between equal runs."""
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
from thesisrecon.cli.commands import run_command
sys.exit(run_command(sys.argv[1:]))
"""  # Program that kills itself with its n-th file half written


@dataclass(frozen=True)
class Ended:
    """How a disturbed run ended: exit code and error stream, seconds from the signal on, processes ``left``,
    finished stage files ``kept``, files that are ``strange`` to a whole run; and outputs that are
    ``different`` after the resume.
    """

    when: str
    code: int
    message: str = ""
    seconds: float = 0.0
    left: int = 0
    kept: int = 0
    strange: tuple[str, ...] = ()
    different: tuple[str, ...] = ()

    def faults(self, code: int | None = None, more: Mapping[str, bool] | None = None) -> str:
        """Name what is wrong: exit code (if one is given) and error stream, ``more``, and the outputs."""
        sentence = self.message.count("\n") == 1 and "Traceback" not in self.message
        end = {f"exit code {self.code}": self.code != code, "not one sentence": not sentence}
        found = ({} if code is None else end) | dict(more or {})
        found |= {f"differs: {', '.join(self.different)}": bool(self.different)}
        return "; ".join(fault for fault, present in found.items() if present)

    def faults_of_stop(self, asked: signal.Signals) -> str:
        if self.code == 0:
            return self.faults()
        slow = {f"took {self.seconds:.1f} s": self.seconds > 2.0}
        return self.faults(CODES[asked], slow | {f"{self.left} processes left": self.left > 0})

    def faults_of_refusal(self) -> str:
        # Once cameras and summary are there, the run ends well, with warnings.
        complete = self.code == 0 and NOT_MADE in self.message
        more = {
            "names no place": " cannot be written: " not in self.message,
            "does not say what to do": not any(words in self.message for words in remedies().values()),
            f"strange files: {', '.join(self.strange)}": bool(self.strange),
        }
        return self.faults(None if complete else 2, more)


def outputs(out: Path) -> dict[str, bytes]:
    """Read every file of a finished run by name, without times and without the HTML report."""
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
    """Return the names of files that are missing on one side or differ."""
    return tuple(sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name)))


# ---------------------------------------------------------------- killed runs


class Runs:
    """Runs of the courtyard with one command line, in folders of ``place``."""

    def __init__(self, place: Path, max_size: int, until: str, executor: str = "local") -> None:
        self.place = place
        self.options = ["--max-size", str(max_size), "--until", until, "--executor", executor]
        self.environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}

    def program(self, out: Path, *start: str) -> list[str]:
        arguments = ["reconstruct", str(COURTYARD / "images"), "-o", str(out), "--threads", "2"]
        return [sys.executable, *(start or ("-m", "thesisrecon")), *arguments, *self.options]

    def whole(self, out: Path) -> float:
        start = time.perf_counter()
        subprocess.run(self.program(out), env=self.environment, check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - start

    def stopped(self, out: Path, after_s: float, asked: signal.Signals, **environment: str) -> Ended:
        """Signal a run and its processes after some seconds."""
        end = time.perf_counter() + after_s
        given = self.environment | environment
        return stopped(self.program(out), lambda: time.perf_counter() > end, asked, environment=given)

    def torn(self, name: str, write: int) -> tuple[Path, int]:
        """Run a program that dies while it writes its ``write``-th file."""
        out = self.place / name
        program = self.program(out, "-c", TORN, str(write))
        ended = subprocess.run(program, env=self.environment, check=False, stdout=subprocess.DEVNULL)
        return out, ended.returncode

    def resumed(self, ended: Ended, out: Path, wanted: dict[str, bytes]) -> Ended:
        """Resume a run; add the stage files that it had, and its outputs that differ."""
        kept = sum(1 for _ in out.glob("0*/*.npz"))
        self.whole(out)
        return replace(ended, kept=kept, different=different(outputs(out), wanted))


def kill_runs(runs: Runs, kills: int, writes: int) -> Iterator[Ended]:
    runs.whole(runs.place / "first")
    seconds = runs.whole(runs.place / "whole")
    wanted = outputs(runs.place / "whole")
    yield Ended("two undisturbed runs", 0, different=different(outputs(runs.place / "first"), wanted))
    for k in range(kills):
        share, out = (k + 0.5) / kills, runs.place / f"kill-{k}"
        code = runs.stopped(out, share * seconds, signal.SIGKILL).code
        yield runs.resumed(Ended(f"after {100 * share:.0f} % of the time", code), out, wanted)
    for k in range(writes):
        write = 1 + k * (len(wanted) - 1) // max(writes - 1, 1)
        out, code = runs.torn(f"write-{k}", write)
        yield runs.resumed(Ended(f"in the middle of file {write}", code), out, wanted)


# ---------------------------------------------------------------- interrupted runs


def stopped(
    program: list[str],
    ready: Callable[[], bool],
    asked: signal.Signals,
    *,
    environment: dict[str, str] | None = None,
) -> Ended:
    """Signal a program and its process group when ``ready``, and record how it ends."""
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
        time.sleep(0.005)
    start = time.perf_counter()
    if process.poll() is None:
        os.killpg(process.pid, asked)
    try:
        process.wait(60.0)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
    seconds = time.perf_counter() - start
    time.sleep(0.5)  # for processes to end after their parent
    left = _of_session(process.pid)
    for number in left:
        os.kill(number, signal.SIGKILL)
    with process.stderr as stream:
        return Ended(f"{start - begun:.1f} s", process.wait(), stream.read(), seconds, len(left))


_LISTEN = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""  # Restores the default action of SIGINT, which a background shell ignores


def _of_session(leader: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] not in "ZX":
            found.append(int(path.parent.name))
    return found


def stop_runs(runs: Runs, moments: int, asked: signal.Signals, *, cold: bool) -> Iterator[Ended]:
    runs.whole(runs.place / "first")
    if cold:
        runs.environment["NUMBA_CACHE_DIR"] = str(runs.place / "kernels")
    seconds = runs.whole(runs.place / "whole")
    wanted = outputs(runs.place / "whole")
    for k in range(moments):
        share, out = (k + 0.5) / moments, runs.place / f"stop-{k}"
        kernels = {"NUMBA_CACHE_DIR": str(runs.place / f"kernels-{k}")} if cold else {}
        stop = runs.stopped(out, share * seconds, asked, **kernels)
        yield runs.resumed(replace(stop, when=f"{100 * share:.0f} % ({stop.when})"), out, wanted)


# ---------------------------------------------------------------- full and read-only disks


@contextlib.contextmanager
def disk_ends(first: int, number: int) -> Iterator[list[int]]:
    """Let the ``first``-th file (from 1) and all later ones fail with the error ``number``."""
    written, sync = [0], os.fsync

    def synced(descriptor: int) -> None:
        written[0] += 1
        if first and written[0] >= first:
            os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)
            raise OSError(number, os.strerror(number))
        sync(descriptor)

    os.fsync = synced  # type: ignore[assignment]
    try:
        yield written
    finally:
        os.fsync = sync


class SmallRuns:
    """Runs of the same few images in this process."""

    def __init__(self, place: Path, views: int, size_px: int, until: str) -> None:
        self.place, self.images = place, place / "images"
        self.images.mkdir()
        for path in sorted((COURTYARD / "images").iterdir())[:views]:
            (self.images / path.name).symlink_to(path)
        # Coarse depth maps: every stage writes its files quickly.
        coarse = ["--set", "dense.max_side=160", "--set", "dense.match_side=160"]
        self.options = ["--max-size", str(size_px), "--until", until, "--threads", "1", *coarse]

    def run(self, out: Path) -> tuple[int, str]:
        errors, printed = io.StringIO(), io.StringIO()
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(printed):
            code = run_command(["reconstruct", str(self.images), "-o", str(out), *self.options])
        warnings = [line for line in printed.getvalue().splitlines() if NOT_MADE in line]
        return code, errors.getvalue() + "\n".join(warnings)

    def whole(self, out: Path) -> dict[str, bytes]:
        code, message = self.run(out)
        if code:
            raise RuntimeError(f"a run with room ended with {code}: {message}")
        return outputs(out)


def refused_at(runs: SmallRuns, write: int, number: int, wanted: dict[str, bytes]) -> Ended:
    """Run with the ``write``-th file and all later ones unwritable, then resume."""
    out = runs.place / f"write-{write}"
    with disk_ends(write, number):
        ended = runs.run(out)
    strange = tuple(name for name, content in outputs(out).items() if wanted.get(name) != content)
    changed = different(runs.whole(out), wanted)
    return Ended(f"file {write}: {os.strerror(number)}", *ended, strange=strange, different=changed)


def refuse_runs(runs: SmallRuns, every: int) -> Iterator[Ended]:
    """Run undisturbed, then with every n-th file unwritable."""
    runs.whole(runs.place / "first")
    with disk_ends(0, 0) as written:
        wanted = runs.whole(runs.place / "whole")
    for k, write in enumerate(range(1, written[0] + 1, every)):
        yield refused_at(runs, write, errno.ENOSPC if k % 2 == 0 else errno.EROFS, wanted)


# ---------------------------------------------------------------- the studies


def _report(scene: str, found: Iterable[Ended], wrong: Callable[[Ended], str]) -> Iterator[Part]:
    ended = []
    for one in found:
        ended.append(one)
        report_progress(one)
    head = ["disturbed", "exit code", "seconds to stop", "stage files kept", "message", "wrong"]
    cells = ([r.when, r.code, f"{r.seconds:.2f}", r.kept, r.message.strip(), wrong(r) or "-"] for r in ended)
    yield text_table(head, cells)
    rows = Rows(scene, "ours")
    rows.add(f"runs with faults, of {len(ended)}", sum(bool(wrong(one)) for one in ended), at_most=0.0)
    yield rows


def kill_anywhere_study(
    kills: int = 20, writes: int = 5, max_size: int = 640, until: str = "model"
) -> Iterator[Part]:
    """Kill runs anywhere, resume them and compare all bytes with an undisturbed run."""
    with TemporaryDirectory() as place:
        found = kill_runs(Runs(Path(place), max_size, until), kills, writes)
        yield from _report("killed runs", found, Ended.faults)


def stop_anywhere_study(
    signal_: Literal["INT", "TERM"] = "INT",
    moments: int = 20,
    max_size: int = 640,
    until: str = "model",
    executor: str = "local",
    cold: bool = False,
) -> Iterator[Part]:
    """Interrupt runs anywhere; each must end in 2 s with one sentence and resume to the same bytes."""
    asked = signal.Signals[f"SIG{signal_}"]
    with TemporaryDirectory() as place:
        runs = Runs(Path(place), max_size, until, executor)
        found = stop_runs(runs, moments, asked, cold=cold)
        yield from _report("interrupted runs", found, lambda one: one.faults_of_stop(asked))


def full_disk_study(
    every: int = 1, views: int = 3, max_size: int = 320, until: str = "model"
) -> Iterator[Part]:
    """Fill the disk or make it read-only at every file; each run must say so and resume."""
    with TemporaryDirectory() as place:
        found = refuse_runs(SmallRuns(Path(place), views, max_size, until), every)
        yield from _report("runs without room", found, Ended.faults_of_refusal)

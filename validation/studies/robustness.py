"""Runs of the courtyard that are killed, interrupted or out of disk space, and resumed.

``kill-anywhere``: runs are killed (SIGKILL) at a share of their time or in the middle of a write and resumed;
every output must have the bytes of an undisturbed run, times aside.
``stop-anywhere``: runs and all their processes get SIGINT or SIGTERM, as from a terminal. Each must end
within two seconds with the exit code of the signal, one sentence on how to continue and no process left
behind; resumed, it must give the same bytes.
``full-disk``: for every file that a small run writes, the disk is full or read-only from that file on.
Each must end with exit code 2 and one sentence with place, cause and advice, leave no foreign file, and
resume to the same bytes.
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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

from thesisrecon.cli.main import run_command
from thesisrecon.errors import NOT_MADE, REMEDIES
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
from thesisrecon.cli.main import run_command
sys.exit(run_command(sys.argv[1:]))
"""
"""Program that kills itself with its n-th file half written."""


# ---------------------------------------------------------------- killed runs


class Kill(NamedTuple):
    """A killed run: when, whether it died, finished stage files, outputs that differ after the resume."""

    when: str
    died: bool
    kept: int
    different: tuple[str, ...]


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


class Runs:
    """Runs of one image set with one command line, in folders of ``place``."""

    def __init__(self, place: Path, options: list[str], images: Path = COURTYARD / "images") -> None:
        self.place, self.options, self.images = place, options, images
        self.environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}

    def program(self, out: Path, *start: str) -> list[str]:
        arguments = ["reconstruct", str(self.images), "-o", str(out), *self.options]
        return [sys.executable, *(start or ("-m", "thesisrecon")), *arguments]

    def whole(self, out: Path) -> float:
        start = time.perf_counter()
        subprocess.run(self.program(out), env=self.environment, check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - start

    def killed(self, name: str, after_s: float) -> tuple[Path, bool]:
        """Kill a run after some seconds; return its folder and whether it was still running."""
        out = self.place / name
        process = subprocess.Popen(self.program(out), env=self.environment, stdout=subprocess.DEVNULL)
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            process.kill()
        return out, process.wait() == -signal.SIGKILL

    def torn(self, name: str, write: int) -> tuple[Path, bool]:
        """Run a program that dies while it writes its ``write``-th file."""
        out = self.place / name
        program = self.program(out, "-c", TORN, str(write))
        ended = subprocess.run(program, env=self.environment, check=False, stdout=subprocess.DEVNULL)
        return out, ended.returncode == -signal.SIGKILL

    def compared(self, out: Path, wanted: dict[str, bytes]) -> tuple[int, tuple[str, ...]]:
        """Resume a run; return the stage files that it had, and its outputs that differ."""
        kept = sum(1 for _ in out.glob("0*/*.npz"))
        self.whole(out)
        return kept, different(outputs(out), wanted)


def kill_runs(runs: Runs, kills: int, writes: int) -> Iterator[Kill]:
    runs.whole(runs.place / "first")
    seconds = runs.whole(runs.place / "whole")
    wanted = outputs(runs.place / "whole")
    yield Kill("two undisturbed runs", False, 0, different(outputs(runs.place / "first"), wanted))
    for k in range(kills):
        share = (k + 0.5) / kills
        # The run may end before it is killed.
        for again in range(3):
            begun = time.perf_counter()
            out, died = runs.killed(f"kill-{k}-{again}", share * seconds)
            if died:
                break
            # The whole run was slower, because of other load.
            seconds = time.perf_counter() - begun
        yield Kill(f"after {100 * share:.0f} % of the time", died, *runs.compared(out, wanted))
    for k in range(writes):
        write = 1 + k * (len(wanted) - 1) // max(writes - 1, 1)
        out, died = runs.torn(f"write-{k}", write)
        yield Kill(f"in the middle of file {write}", died, *runs.compared(out, wanted))


def kill_table(rows: Sequence[Kill]) -> str:
    late = ["" if row.died or not row.kept else " (had ended)" for row in rows]
    cells = [
        [r.when + end, r.kept, ", ".join(r.different) or "none"] for r, end in zip(rows, late, strict=True)
    ]
    return text_table(["killed", "stage files kept", "outputs that differ after the resume"], cells)


# ---------------------------------------------------------------- interrupted runs


@dataclass(frozen=True)
class Stop:
    """An interrupted run.

    ``seconds``: from the signal to the end; ``code``, ``message``: exit code and error stream; ``left``:
    processes left behind; ``kept``: finished stage files; ``different``: outputs that differ after the
    resume.
    """

    when: str
    seconds: float
    code: int
    message: str
    left: int
    kept: int
    different: tuple[str, ...] = ()

    def wrong(self, asked: signal.Signals) -> str:
        if self.code == 0:
            return f"differs: {', '.join(self.different)}" if self.different else ""
        slow = [f"took {self.seconds:.1f} s"] * (self.seconds > 2.0)
        more = _faults(self, CODES[asked], {f"{self.left} processes left": self.left > 0})
        return "; ".join([*slow, *([more] if more else [])])


def _faults(ended: Stop | Refusal, code: int | None, more: dict[str, bool]) -> str:
    """Name the faults of exit code (if one is given) and error stream, ``more``, and outputs that differ."""
    sentence = ended.message.count("\n") == 1 and "Traceback" not in ended.message
    end = {f"exit code {ended.code}": ended.code != code, "not one sentence": not sentence}
    found = {} if code is None else end
    found |= more | {f"differs: {', '.join(ended.different)}": bool(ended.different)}
    return "; ".join(fault for fault, present in found.items() if present)


def stopped(
    program: list[str],
    ready: Callable[[], bool],
    asked: signal.Signals,
    *,
    environment: dict[str, str] | None = None,
) -> Stop:
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
        return Stop(f"{start - begun:.1f} s", seconds, process.wait(), stream.read(), len(left), 0)


_LISTEN = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""
"""Restores the default action of SIGINT, which a background shell ignores."""


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


def _is_past(moment: float) -> bool:
    return time.perf_counter() > moment


def stop_runs(runs: Runs, moments: int, asked: signal.Signals, *, cold: bool) -> Iterator[Stop]:
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
        end = time.perf_counter() + share * seconds
        stop = stopped(runs.program(out), partial(_is_past, end), asked, environment=environment)
        kept, changed = runs.compared(out, wanted)
        yield replace(stop, when=f"{100 * share:.0f} % ({stop.when})", kept=kept, different=changed)


def stop_table(rows: Sequence[Stop], asked: signal.Signals) -> str:
    none = {True: "nothing (had ended)", False: "nothing"}
    cells = [
        [row.when, f"{row.seconds:.2f}", row.code, row.kept, row.wrong(asked) or none[row.code == 0]]
        for row in rows
    ]
    return text_table(["stopped at", "seconds to stop", "exit code", "stage files kept", "wrong"], cells)


# ---------------------------------------------------------------- full and read-only disks


@dataclass(frozen=True)
class Refusal:
    """A run that could not write.

    ``when``: where the disk was full or read-only; ``code``, ``message``: exit code and error stream;
    ``strange``: files that a whole run does not have; ``different``: outputs that differ after the resume.
    """

    when: str
    code: int
    message: str
    strange: tuple[str, ...]
    different: tuple[str, ...]

    @property
    def wrong(self) -> str:
        # Once cameras and summary are there, the run ends well, with warnings.
        complete = self.code == 0 and NOT_MADE in self.message
        more = {
            "names no place": " cannot be written: " not in self.message,
            "does not say what to do": not any(words in self.message for words in REMEDIES.values()),
            f"strange files: {', '.join(self.strange)}": bool(self.strange),
        }
        return _faults(self, None if complete else 2, more)


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


def refused_at(runs: SmallRuns, write: int, number: int, wanted: dict[str, bytes]) -> Refusal:
    """Run with the ``write``-th file and all later ones unwritable, then resume."""
    out = runs.place / f"write-{write}"
    with disk_ends(write, number):
        ended = runs.run(out)
    strange = tuple(name for name, content in outputs(out).items() if wanted.get(name) != content)
    changed = different(runs.whole(out), wanted)
    return Refusal(f"file {write}: {os.strerror(number)}", *ended, strange, changed)


def refuse_runs(runs: SmallRuns, every: int) -> Iterator[Refusal]:
    """Run undisturbed, then with every n-th file unwritable."""
    runs.whole(runs.place / "first")
    with disk_ends(0, 0) as written:
        wanted = runs.whole(runs.place / "whole")
    for k, write in enumerate(range(1, written[0] + 1, every)):
        yield refused_at(runs, write, errno.ENOSPC if k % 2 == 0 else errno.EROFS, wanted)


def refusal_table(rows: Sequence[Refusal]) -> str:
    cells = ([r.when, r.code, r.message.strip(), r.wrong or "nothing"] for r in rows)
    return text_table(["the run could not write", "exit code", "message", "wrong"], cells)


# ---------------------------------------------------------------- the studies


def _printed(rows: Iterable[Any]) -> list[Any]:
    found = []
    for row in rows:
        found.append(row)
        report_progress(row)
    return found


def _count(scene: str, name: str, wrong: Sequence[object]) -> Rows:
    rows = Rows(scene, "ours")
    rows.add(f"{name}, of {len(wrong)}", sum(map(bool, wrong)), at_most=0.0)
    return rows


def kill_anywhere_study(
    kills: int = 20,
    writes: int = 5,
    images: Path = COURTYARD / "images",
    max_size: int = 640,
    until: str = "model",
    threads: int = 2,
) -> Iterator[Part]:
    """Kill runs anywhere, resume them and compare all bytes with an undisturbed run."""
    options = ["--max-size", str(max_size), "--until", until, "--threads", str(threads)]
    with TemporaryDirectory() as place:
        runs = Runs(Path(place), options, images)
        rows = _printed(kill_runs(runs, kills, writes))
    yield kill_table(rows)
    yield _count("killed runs", "runs that differ", [r.different for r in rows])


def stop_anywhere_study(
    signal_: Literal["INT", "TERM"] = "INT",
    moments: int = 20,
    images: Path = COURTYARD / "images",
    max_size: int = 640,
    until: str = "model",
    threads: int = 2,
    executor: str = "local",
    set_: Sequence[str] = (),
    cold: bool = False,
) -> Iterator[Part]:
    """Interrupt runs anywhere; each must end in 2 s with one sentence and resume to the same bytes."""
    asked = signal.Signals[f"SIG{signal_}"]
    options = ["--max-size", str(max_size), "--until", until, "--threads", str(threads)]
    options += ["--executor", executor, *(word for value in set_ for word in ("--set", value))]
    with TemporaryDirectory() as place:
        rows = _printed(stop_runs(Runs(Path(place), options, images), moments, asked, cold=cold))
    yield stop_table(rows, asked)
    yield _count("interrupted runs", "runs with faults", [r.wrong(asked) for r in rows])


def full_disk_study(
    every: int = 1, views: int = 3, max_size: int = 320, until: str = "model"
) -> Iterator[Part]:
    """Fill the disk or make it read-only at every file; each run must say so and resume."""
    with TemporaryDirectory() as place:
        runs = SmallRuns(Path(place), views, max_size, until)
        rows = _printed(refuse_runs(runs, every))
    yield refusal_table(rows)
    yield _count("runs without room", "runs with faults", [r.wrong for r in rows])

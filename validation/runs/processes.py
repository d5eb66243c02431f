"""Jobs, child processes on given cores with a time limit, and measured calls.

A child ends with the thread that started it (``prctl(PR_SET_PDEATHSIG)``).
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from functools import partial
from importlib import import_module
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple, TypeVar

from thesisrecon.io._files import write_text
from thesisrecon.runtime._signals import kill_on_exit
from validation.scenes.real import ROOT

Job = TypeVar("Job")
Answer = TypeVar("Answer")


def run_jobs(
    waiting: list[Job],
    submit: Callable[[Job], Future[Answer]],
    is_ready: Callable[[Job, Collection[Job]], bool],
    most: int,
) -> Iterator[list[tuple[Job, Future[Answer]]]]:
    """Submit jobs in order as soon as they are ready, at most ``most`` at a time; yield those that ended."""
    running: dict[Future[Answer], Job] = {}
    while waiting or running:
        for job in tuple(waiting):
            if len(running) < most and is_ready(job, running.values()):
                waiting.remove(job)
                running[submit(job)] = job
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        yield [(running.pop(future), future) for future in done]


PATIENCE = 10.0
"""Time limits in seconds of the clock over those in processor seconds."""
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
_PIN = (
    "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); "
    "os.sched_setaffinity(0, {int(c) for c in sys.argv[1].split(',')}); "
    "os.execv(sys.argv[2], sys.argv[2:])"
)


class Process(NamedTuple):
    """How a child ended: exit ``code`` (negative: signal), seconds, memory, and whether it timed out."""

    code: int
    wall_s: float
    peak_mb: float
    cpu_s: float
    timed_out: bool = False


def own_cores() -> list[int]:
    """Return the cores this process may use."""
    return sorted(os.sched_getaffinity(0))


def run_process(
    command: Sequence[str],
    *,
    log: Path,
    cores: Sequence[int],
    environment: Mapping[str, str],
    limit_s: float | None = None,
    cwd: Path = ROOT,
    stop: Event | None = None,
    loaded: Path | None = None,
) -> Process:
    """Run ``command`` on these cores and wait; its output goes to the file ``log``. The child and its
    children are killed if ``stop`` is set, or after ``limit_s`` seconds of processor time (a busy machine is
    no failure), or :data:`PATIENCE` times as long without them; these count from when the child writes the
    file ``loaded`` if there is one.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    start, begun_s, timed_out = time.perf_counter(), 0.0, False
    with log.open("wb") as sink:
        child = subprocess.Popen(
            # The child sets its own affinity, so that its threads inherit it.
            [sys.executable, "-c", _PIN, ",".join(map(str, cores)), *command],
            stdout=sink,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **environment},
            cwd=cwd,
            start_new_session=True,
        )
        kill = partial(os.killpg, child.pid, signal.SIGKILL)
        try:
            with kill_on_exit(kill):
                while True:
                    pid, status, usage = os.wait4(child.pid, os.WNOHANG)
                    if pid:
                        break
                    used_s = _processor_s(child.pid)
                    if loaded is not None and not loaded.is_file():
                        start, begun_s = time.perf_counter(), used_s
                    waited_s = (time.perf_counter() - start) / PATIENCE
                    late = limit_s is not None and max(used_s - begun_s, waited_s) > limit_s
                    if (stop is not None and stop.is_set()) or (late and not timed_out):
                        timed_out = late
                        kill()
                    time.sleep(0.02)
        except BaseException:
            kill()
            raise
    child.returncode = os.waitstatus_to_exitcode(status)
    wall_s, cpu_s = time.perf_counter() - start, usage.ru_utime + usage.ru_stime
    return Process(child.returncode, wall_s, usage.ru_maxrss / 1024.0, cpu_s, timed_out)


def _processor_s(number: int) -> float:
    """Processor seconds of a running process and of its children that ended."""
    fields = Path(f"/proc/{number}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def last_line(log: Path) -> str:
    """Return the last line of a log."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        return ""
    return lines[-1].strip() if lines else ""


def failure_of(process: Process, message: str, limit_s: float) -> str:
    """Return the failure of a process, or an empty string; ``message`` is the last line of its log."""
    if process.timed_out:
        return f"exceeded the time limit of {limit_s:.0f} processor seconds"
    if process.code < 0:
        return f"crashed with signal {-process.code}"
    if process.code:
        return message or f"ended with exit code {process.code}"
    return ""


# ---------------------------------------------------------------- measured calls


def timed(work: Callable[[], Any]) -> tuple[Any, float, float]:
    """Return the answer of a call, its wall seconds and its processor seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    answer = work()
    return answer, time.perf_counter() - wall, time.process_time() - cpu


def peak_mb() -> float:
    """Return the highest memory of this process (MB) since :func:`reset_peak`."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return float(status.split("VmHWM:")[1].split()[0]) / 1024.0


def reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def call_apart(
    function: Callable[..., Any], *arguments: Any, cores: int = 2, environment: Mapping[str, str] = ONE_THREAD
) -> tuple[Any, Process]:
    """Call a module-level function in a new process on its own cores."""
    with tempfile.TemporaryDirectory() as folder:
        answer, log = Path(folder) / "answer.json", Path(folder) / "log"
        name = f"{function.__module__}:{function.__name__}"
        command = [sys.executable, "-m", "validation.runs.processes", name]
        command += [json.dumps(arguments, default=str), str(answer)]
        process = run_process(command, log=log, cores=own_cores()[:cores], environment=environment)
        if process.code != 0:
            raise RuntimeError(log.read_text(encoding="utf-8")[-2000:])
        return json.loads(answer.read_text(encoding="utf-8")), process


def _main() -> None:
    module, _, function = sys.argv[1].partition(":")
    found = getattr(import_module(module), function)(*json.loads(sys.argv[2]))
    write_text(Path(sys.argv[3]), json.dumps(found))


if __name__ == "__main__":
    _main()

"""Run tasks as forks of a process that has imported everything once.

Importing the library takes two seconds, as long as many tasks. Each task is still its own process, which
may crash, hang or be killed, with its own time and memory.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import IO

from thesisrecon.io._files import write_text
from validation.runs.processes import Process
from validation.scenes.real import ROOT

KILLED = -int(signal.SIGKILL)


class Template:
    """A process on the core ``core`` that has imported ``modules``, the first of which has a ``main`` that
    takes arguments and returns an exit code; it lives until :meth:`close`."""

    def __init__(self, modules: Sequence[str], core: int, environment: Mapping[str, str]) -> None:
        command = [sys.executable, "-m", "validation.runs.process_pool", str(core), *modules]
        self._child = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **environment},
            cwd=ROOT,
            start_new_session=True,
            text=True,
        )

    def close(self) -> None:
        """End the process, and the task that runs in it."""
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self._child.wait()

    def run(self, arguments: Sequence[str], *, log: Path, limit_s: float) -> Process:
        """Run ``main`` in a fork, killed with its children after ``limit_s``; output goes to ``log``.

        Raises ``RuntimeError`` if the template has ended.
        """
        log.parent.mkdir(parents=True, exist_ok=True)
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        start = time.perf_counter()
        try:
            print(json.dumps([str(log), limit_s, *arguments]), file=self._child.stdin, flush=True)
            line = self._child.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise RuntimeError(f"the template process of the tasks ended with {self._child.wait()}")
        code, peak_mb, cpu_s, timed_out = json.loads(line)
        return Process(code, time.perf_counter() - start, peak_mb, cpu_s, timed_out)


class ProcessPool:
    """Idle templates, one per core; that of the core which has been idle longest comes first."""

    def __init__(self, modules: Sequence[str], cores: Sequence[int], environment: Mapping[str, str]) -> None:
        self._modules, self._environment = modules, environment
        self._stack, self._closed = ExitStack(), False
        self._idle: SimpleQueue[tuple[int, Template]] = SimpleQueue()
        for core in cores:
            self._idle.put((core, self._start(core)))

    def __enter__(self) -> ProcessPool:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closed = True
        self._stack.__exit__(kind, error, trace)

    def _start(self, core: int) -> Template:
        return self._stack.enter_context(closing(Template(self._modules, core, self._environment)))

    def run(self, arguments: Sequence[str], *, log: Path, limit_s: float) -> Process:
        """Run one task as :meth:`Template.run`; a template that has ended is replaced."""
        core, template = self._idle.get()
        try:
            return template.run(arguments, log=log, limit_s=limit_s)
        except RuntimeError as error:
            if self._closed:
                raise
            write_text(log, f"{error}\n")
            template = self._start(core)
            return Process(1, 0.0, 0.0, 0.0)
        finally:
            self._idle.put((core, template))


def serve(main: Callable[[list[str]], int], orders: IO[str], answers: IO[str]) -> None:
    """Run JSON orders [log, seconds, *arguments] one by one; kill the running task if ``orders`` closes."""
    for order in orders:
        log, limit_s, *arguments = json.loads(order)
        child = os.fork()
        if child == 0:
            _become(main, arguments, log)
        ended = _wait(child, limit_s, orders)
        if ended is None:
            return
        print(json.dumps(ended), file=answers, flush=True)


def _wait(child: int, limit_s: float, orders: IO[str]) -> tuple[int, float, float, bool] | None:
    """Return exit code, peak memory (MB), processor seconds and time-out; None if ``orders`` is closed."""
    ended = os.pidfd_open(child)
    either = select.poll()
    either.register(ended, select.POLLIN)
    # A closed pipe is always reported.
    either.register(orders, 0)
    ready = {source for source, _ in either.poll(limit_s * 1000.0)}
    if ended not in ready:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
            os.killpg(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    os.close(ended)
    if ready - {ended}:
        return None
    code = os.waitstatus_to_exitcode(status)
    return code, usage.ru_maxrss / 1024.0, usage.ru_utime + usage.ru_stime, not ready and code == KILLED


def _become(main: Callable[[list[str]], int], arguments: list[str], log: str) -> None:
    """Run the task in this fork and exit."""
    code = 1
    try:
        os.setsid()
        nothing, sink = (
            os.open(os.devnull, os.O_RDONLY),
            os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644),
        )
        for descriptor, file in ((0, nothing), (1, sink), (2, sink)):
            os.dup2(file, descriptor)
        code = main(arguments)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:  # never return to the loop of the template
        traceback.print_exc()
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    os.sched_setaffinity(0, {int(sys.argv[1])})
    # Imports may print; answers use a separate descriptor.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    modules = [import_module(name) for name in sys.argv[2:]]
    serve(modules[0].main, sys.stdin, answers)

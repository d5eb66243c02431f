"""Compile the kernels of a run on all cores before its first stage, once for each version of the code.

``kernels.txt`` lists them by stage, with the types of their arguments: ``float64[:, ::1]`` is an array in C
order, ``tuple_of("module.Class", ...)`` a named tuple. A kernel that it lacks is compiled when it is called.
"""

import importlib
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import wait
from contextlib import suppress
from pathlib import Path
from platform import node
from typing import Any

import numba
from numba import types

from thesisrecon._numba import ThreadPool, cache_folder, copy_to
from thesisrecon.runtime._executors import package_key
from thesisrecon.runtime._run_folder import key_of
from thesisrecon.runtime._signals import kill_on_exit, starting_processes

PACKAGE = Path(__file__).parent.parent
LIST = PACKAGE / "kernels.txt"
WORKER = f"""import sys
sys.path.insert(0, {str(PACKAGE.parent)!r})
from {__name__} import compile_requested
compile_requested()
"""
COMPILED = "compiled\n"


def listed_kernels(until: str) -> list[str]:
    """Lines of ``kernels.txt`` up to a stage: ``module.function(types of the arguments)``."""
    lines, stage = list[str](), ""
    for line in filter(None, LIST.read_text(encoding="utf-8").splitlines()):
        if not line.startswith("["):
            lines.append(line)
        elif stage == until:
            break
        else:
            stage = line.strip("[]")
    return lines


def kernel_and_types(line: str) -> tuple[Any, tuple[Any, ...]]:
    """Kernel of a line of the list, and the types of its arguments."""
    name, _, arguments = line.partition("(")

    def tuple_of(kind: str, *parts: Any) -> Any:
        named = _named(kind) if kind else None
        return types.BaseTuple.from_types(parts, named)  # type: ignore[no-untyped-call]

    return _named(name), eval(f"({arguments}", vars(types) | {"tuple_of": tuple_of, "__builtins__": {}})


def _named(name: str) -> Any:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(f"{PACKAGE.name}.{module}"), attribute)


def precompile(until: str, workers: int, progress: Callable[[str, int, int], None]) -> int:
    """Compile the kernels of the stages up to one in several processes, unless done before; their number."""
    lines = listed_kernels(until)
    dispatcher: Any = copy_to
    processor = dispatcher.targetctx.codegen().magic_tuple()
    key = key_of(lines, processor, node(), sys.version, numba.__version__, package_key())
    done = cache_folder() / f"complete-{key}"
    if done.exists() or not lines or vars(numba.config)["DISABLE_JIT"]:
        return 0
    progress("kernels", 0, len(lines))
    finished = _compile_in_processes(lines, workers, progress)
    # An unwritable folder or a failing worker costs time only: each kernel is compiled when it is called.
    if finished == len(lines):
        with suppress(OSError):
            done.touch()
    return finished


def _compile_in_processes(lines: Sequence[str], count: int, progress: Callable[[str, int, int], None]) -> int:
    waiting, taking, finished = iter(lines), threading.Lock(), list[str]()

    def feed(worker: subprocess.Popen[str]) -> None:
        assert worker.stdin is not None
        assert worker.stdout is not None
        with suppress(OSError):
            while True:
                with taking:
                    line = next(waiting, None)
                if line is None:
                    break
                worker.stdin.write(line + "\n")
                worker.stdin.flush()
                if not (answer := worker.stdout.readline()):
                    return
                if answer == COMPILED:
                    finished.append(line)
            worker.stdin.close()

    workers = list[subprocess.Popen[str]]()
    # An embedded Python has no executable, and processes and threads may be limited. A worker takes a second
    # to start and 150 MB, a kernel on average less than a second to compile.
    with suppress(OSError), starting_processes():
        for _ in range(min(count, -(-len(lines) // 8))):
            workers.append(_started())

    def kill() -> None:
        for worker in workers:
            worker.kill()

    with kill_on_exit(kill), ThreadPool(len(workers)) as threads:
        try:
            feeding = [threads.submit(feed, worker) for worker in workers]
            while wait(feeding, 0.1).not_done:
                progress("kernels", len(finished), len(lines))
            progress("kernels", len(finished), len(lines))
        finally:
            kill()
            for worker in workers:
                with suppress(OSError), worker:  # closes its pipes
                    pass
    return len(finished)


def _started() -> subprocess.Popen[str]:
    # multiprocessing would import the script of the user again. In a session of its own the process does not
    # get the Ctrl-C of the terminal; without its input it ends. -P: no imports from the current folder.
    pipe, command = subprocess.PIPE, [sys.executable or "python3", "-P", "-c", WORKER]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=quiet, text=True, start_new_session=True)


def compile_requested() -> None:
    """In a worker: compile the kernels that are named on standard input, and answer with one line each."""
    for line in sys.stdin:
        answer = "failed\n"
        with suppress(Exception):
            kernel, arguments = kernel_and_types(line.strip())
            kernel.compile(arguments)
            answer = COMPILED
        print(answer, end="", flush=True)

"""Compile the kernels of a run on all cores before its first stage, once for each version of the code.

``kernels.txt`` lists them by stage, with the types of their arguments: ``float64[:, ::1]`` is an array in C
order, ``tuple_of("module.Class", ...)`` a named tuple. A kernel that it lacks is compiled when it is called.
"""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from platform import node
from typing import Any

import numba
from numba import types

from thesisrecon._numba import cache_folder, copy_to
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
    """Compile lines in processes, which take numbers from one pipe and answer in another; those done."""
    # A worker takes a second to start and 150 MB, a kernel on average less than a second to compile.
    count, finished = min(count, -(-len(lines) // 8)), 0
    workers, (waiting, numbers), (answers, answer) = list[subprocess.Popen[bytes]](), os.pipe(), os.pipe()
    os.write(numbers, bytes(range(len(lines))))
    # An embedded Python has no executable, and processes and threads may be limited.
    with suppress(OSError), starting_processes():
        workers += (_started(lines, waiting, answer) for _ in range(count))
    for end in (waiting, numbers, answer):
        os.close(end)

    def kill() -> None:
        for worker in workers:
            worker.kill()

    with kill_on_exit(kill), os.fdopen(answers) as answered:
        try:
            for said in answered:
                finished += said == COMPILED
                progress("kernels", finished, len(lines))
        finally:
            kill()
            for worker in workers:
                worker.wait()
    return finished


def _started(lines: Sequence[str], waiting: int, answer: int) -> subprocess.Popen[bytes]:
    # multiprocessing would import the script of the user again. In a session of its own the process does not
    # get the Ctrl-C of the terminal; without its pipe it ends. -P: no imports from the current folder.
    command, quiet = [sys.executable or "python3", "-P", "-c", WORKER, *lines], subprocess.DEVNULL
    return subprocess.Popen(command, stdin=waiting, stdout=answer, stderr=quiet, start_new_session=True)


def compile_requested() -> None:
    """In a worker: compile kernels of its arguments by their numbers, and answer with one line each."""
    while number := os.read(0, 1):
        answer = "failed\n"
        with suppress(Exception):
            kernel, arguments = kernel_and_types(sys.argv[1 + number[0]])
            kernel.compile(arguments)
            answer = COMPILED
        print(answer, end="", flush=True)

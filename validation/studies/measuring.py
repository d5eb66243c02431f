"""Measure calls in this process or in a process of their own."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.io._files import write_text
from validation.harness.process import Process, own_cores, run_process

ONE_BLAS_THREAD = {"OPENBLAS_NUM_THREADS": "1"}


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
    function: Callable[..., Any],
    *arguments: Any,
    cores: int = 2,
    environment: Mapping[str, str] = ONE_BLAS_THREAD,
) -> tuple[Any, Process]:
    """Call a module-level function in a new process on its own cores.

    Arguments and answer are written as JSON. Return the answer and what the process used; ``RuntimeError``
    with the end of its output if it fails.
    """
    with tempfile.TemporaryDirectory() as place:
        answer, log = Path(place) / "answer.json", Path(place) / "log"
        name = f"{function.__module__}:{function.__name__}"
        command = [sys.executable, "-m", "validation.studies.measuring", name]
        command += [json.dumps(arguments, default=str), str(answer)]
        process = run_process(command, log=log, cores=own_cores()[:cores], environment=environment)
        if process.code != 0:
            raise RuntimeError(log.read_text(encoding="utf-8")[-2000:])
        return json.loads(answer.read_text(encoding="utf-8")), process


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Fit the slope of log cost against log size by least squares; NaN if all sizes are equal."""
    if min(sizes) == max(sizes):
        return float("nan")
    return float(np.polyfit(np.log(np.maximum(sizes, 1e-9)), np.log(np.maximum(costs, 1e-9)), 1)[0])


def _main() -> None:
    module, _, function = sys.argv[1].partition(":")
    found = getattr(import_module(module), function)(*json.loads(sys.argv[2]))
    write_text(Path(sys.argv[3]), json.dumps(found))


if __name__ == "__main__":
    _main()

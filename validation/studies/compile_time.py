"""Compile time of the kernels in a run on the demo images with an empty cache, by module and function."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from thesisrecon.errors import StageFailure
from validation.metrics.record import Metric
from validation.studies.runner import Part, text_table

OURS = "ours"
RUN = """
import collections, json, sys, threading, time
from numba.core import event

seconds, versions, stacks = collections.Counter(), collections.Counter(), threading.local()


class Compilation(event.Listener):
    def on_start(self, started):
        stack = stacks.__dict__.setdefault("stack", [])
        stack.append([time.thread_time(), 0.0])

    def on_end(self, ended):
        begin, inside = stacks.stack.pop()
        elapsed = time.thread_time() - begin
        function = ended.data["dispatcher"].py_func
        name = f"{function.__module__}.{function.__qualname__}"
        seconds[name] += elapsed - inside
        versions[name] += 1
        if stacks.stack:
            stacks.stack[-1][1] += elapsed


event.register("numba:compile", Compilation())
from thesisrecon import reconstruct
from thesisrecon.io._images import demo_images
from thesisrecon.pipeline import _steps

_steps.precompile = lambda *_: None  # this process compiles
out, until, report = sys.argv[1:]
reconstruct(demo_images(), out, until=until, threads=1)
with open(report, "w") as file:
    json.dump({"seconds": seconds, "versions": versions}, file)
"""


def compile_time_study(until: str = "model", functions: int = 25) -> Iterator[Part]:
    """Measure the processor seconds that numba takes, and how many versions of a function it compiles."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "compiled.json"
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(Path(folder) / "kernels")}
        command = [sys.executable, "-c", RUN, str(Path(folder) / "out"), until, str(report)]
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
        measured = json.loads(report.read_text(encoding="utf-8"))
    seconds: dict[str, float] = measured["seconds"]
    if not seconds:
        raise StageFailure("no kernel was compiled in the process that was measured")
    versions: dict[str, int] = measured["versions"]
    modules: dict[str, float] = {}
    for name, value in seconds.items():
        module = name.split(".<locals>")[0].rpartition(".")[0]
        modules[module] = modules.get(module, 0.0) + value
    yield [
        Metric("demo", "compile time", "processor s", {OURS: sum(seconds.values())}, OURS),
        Metric("demo", "functions compiled", "", {OURS: float(len(versions))}, OURS),
        Metric("demo", "versions compiled", "", {OURS: float(sum(versions.values()))}, OURS),
    ]
    yield text_table(["module", "s"], [[name, f"{s:.2f}"] for name, s in _largest(modules, functions)])
    rows = [[name, str(versions[name]), f"{s:.2f}"] for name, s in _largest(seconds, functions)]
    yield text_table(["function", "versions", "s"], rows)


def _largest(values: dict[str, float], count: int) -> list[tuple[str, float]]:
    return sorted(values.items(), key=lambda item: -item[1])[:count]

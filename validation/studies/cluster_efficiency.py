"""Efficiency of a cluster, simulated from the tasks of a run with one worker.

Tasks are scheduled in the order in which they are submitted: a task goes to the first free worker, and at
most twice as many tasks as workers are under way. Pairs are batched as for that number of workers; each batch
prepares its views again. With a gigabit line each way, arguments leave one after another, and so do results.
Everything else counts as serial, also pickling and saving, which in fact run during the tasks.

Seconds are those of the processor. The efficiency is the work of one worker by workers x critical path.
"""

from __future__ import annotations

import heapq
import math
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.pipeline import large_sets, matching, stages
from thesisrecon.pipeline.matching import PreparedViews, batch_pairs
from thesisrecon.pipeline.run import Until
from thesisrecon.runtime._executors import AHEAD
from validation.runs.processes import call_apart
from validation.runs.study import Part
from validation.runs.tables import text_table
from validation.studies.growth_of_cost import write_scene

STAGES: Mapping[Callable[..., Any], str] = {
    matching._detect: "features",
    large_sets.reconstruct_part: "parts",
    stages._depths: "depth maps",
}  # Function of a task -> stage
PREPARATIONS = {"prepare": "matches", "_prepare_share": "first matches", "prepare_oblique": "oblique matches"}
"""Function that prepares the views of a batch -> stage."""
LINE = 125e6  # Bytes per second of a gigabit line


class Task(NamedTuple):
    """Processor seconds of a task, and pickled bytes of its arguments and of its result."""

    seconds: float
    sent: int
    received: int


@dataclass
class Matching:
    """The tasks of batches of pairs in pieces: each view (sent and prepared) and each pair. ``corners``:
    their number in each view, which bounds the batches.
    """

    views: dict[int, Task] = field(default_factory=dict)
    pairs: dict[tuple[int, int], Task] = field(default_factory=dict)
    corners: dict[int, int] = field(default_factory=dict)

    def run(
        self, config: Any, views: PreparedViews, pairs: Sequence[tuple[int, int]], seed: int
    ) -> list[Any]:
        """Match the pairs of a batch and measure them one by one."""
        found = []
        for pair in pairs:
            for view in pair:
                start = time.process_time()
                views[view]
                used = time.process_time() - start
                if view not in self.views:
                    self.views[view] = Task(used, len(pickle.dumps(views.subset([view]), 5)), 0)
                    self.corners[view] = len(views._given[view][1].xy)
            start = time.process_time()
            one = matching._match_all(config, views, [pair], seed)
            self.pairs[pair] = Task(time.process_time() - start, 0, len(pickle.dumps(one, 5)))
            found += one
        return found

    def tasks(self, workers: int) -> list[Task]:
        """The batches for a number of workers."""
        pairs = list(self.pairs)
        corners = [self.corners.get(view, 0) for view in range(max(self.corners) + 1)]
        batches = batch_pairs(pairs, range(len(pairs)), workers, corners)
        found = []
        for batch in batches:
            some = [pairs[n] for n in batch]
            parts = [self.views[view] for view in sorted({view for pair in some for view in pair})]
            parts += [self.pairs[pair] for pair in some]
            seconds = math.fsum(part.seconds for part in parts)
            sent, received = sum(part.sent for part in parts), sum(part.received for part in parts)
            found.append(Task(seconds, sent, received))
        return found


@dataclass
class TaskMeter(Executor):
    """An executor that runs each task when it is submitted, and measures it."""

    simple: dict[str, list[Task]] = field(default_factory=dict)
    matching: dict[str, Matching] = field(default_factory=dict)
    used_s: float = 0.0  #: of all calls of :meth:`submit`

    def submit(self, fn: Callable[..., Any], /, *args: Any, **_: Any) -> Future[Any]:
        """Run ``fn(key, pickled task)``, as :class:`thesisrecon.runtime._executors.Workers` submits it."""
        start, answer = time.process_time(), Future[Any]()
        function, given = pickle.loads(args[1])
        if function is matching._match_all:
            prepare = given[1]._prepare
            stage = PREPARATIONS[getattr(prepare, "func", prepare).__name__]
            answer.set_result(pickle.dumps(self.matching.setdefault(stage, Matching()).run(*given), 5))
        else:
            begin = time.process_time()
            answer.set_result(fn(*args))
            used = Task(time.process_time() - begin, len(args[1]), len(answer.result()))
            self.simple.setdefault(STAGES.get(function, function.__name__), []).append(used)
        self.used_s += time.process_time() - start
        return answer

    def tasks(self, workers: int) -> dict[str, list[Task]]:
        """Stage -> tasks as they are submitted to a number of workers."""
        return self.simple | {stage: matching.tasks(workers) for stage, matching in self.matching.items()}


def critical_path(tasks: Sequence[Task], workers: int, bytes_per_s: float = math.inf) -> float:
    """Return the seconds until the last result arrives, by list scheduling in the order of the tasks."""
    free, under_way = [0.0] * workers, list[tuple[float, int]]()
    sent = received = 0.0
    for task in tasks:
        if len(under_way) == AHEAD * workers:
            end, size = heapq.heappop(under_way)
            received = max(received, end) + size / bytes_per_s
            sent = max(sent, received)
        sent += task.sent / bytes_per_s
        end = max(heapq.heappop(free), sent) + task.seconds
        heapq.heappush(free, end)
        heapq.heappush(under_way, (end, task.received))
    for end, size in sorted(under_way):
        received = max(received, end) + size / bytes_per_s
    return received


def measure_tasks(images: str, count: int, until: Until, settings: Sequence[str]) -> dict[str, Any]:
    """Reconstruct with one worker in this process, its kernels loaded before."""
    paths = sorted(Path(images).glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        reconstruct(paths[:4], Path(place) / "warm", until=until, threads=1)
        meter, start = TaskMeter(), time.process_time()
        options = {"until": until, "set": list(settings), "threads": 1}
        reconstruct(paths, Path(place) / "run", executor=meter, **options)  # type: ignore[arg-type]
        serial_s = time.process_time() - start - meter.used_s
    found = {str(workers): meter.tasks(workers) for workers in (1, 2, 4, 8, 16)}
    return {"serial_s": serial_s, "tasks": found}


def efficiency_table(serial_s: float, by_workers: Mapping[int, Mapping[str, Sequence[Task]]]) -> str:
    """Return work, critical path and efficiency of each stage and of the whole run by number of workers."""
    first = by_workers[min(by_workers)]
    work = {stage: math.fsum(task.seconds for task in tasks) for stage, tasks in first.items()}
    rows, whole = list[list[object]](), {workers: [serial_s, serial_s] for workers in by_workers}

    def timed(paths: Sequence[float], work_s: float, workers: int) -> list[str]:
        return [cell for s in paths for cell in (f"{s:.1f}", f"{work_s / max(workers * s, 1e-9):.2f}")]

    for stage, work_s in work.items():
        for workers, found in by_workers.items():
            tasks = found[stage]
            paths = [critical_path(tasks, workers, speed) for speed in (math.inf, LINE)]
            whole[workers] = [total + s for total, s in zip(whole[workers], paths, strict=True)]
            most = max(t.sent for t in tasks), max(t.received for t in tasks)
            largest = [f"{size / 1e6:.2f}" for size in most]
            longest = f"{max(task.seconds for task in tasks):.2f}"
            head = [stage, workers, len(tasks), f"{work_s:.1f}", longest, *largest]
            rows.append(head + timed(paths, work_s, workers))
    all_s = serial_s + math.fsum(work.values())
    for workers, paths in whole.items():
        rows.append(["whole run", workers, "", f"{all_s:.1f}", "", "", "", *timed(paths, all_s, workers)])
    head = ["", "workers", "tasks", "work s", "longest s", "largest sent MB", "largest result MB"]
    return text_table([*head, "path s", "efficiency", "with line s", "efficiency"], rows)


def cluster_efficiency_study(
    out: Path,
    sizes: Sequence[int] = (48,),
    scene: str = "place",
    long_side: int = 480,
    until: Until = "metric",
    set_: Sequence[str] = (),
) -> Iterator[Part]:
    """Simulate the efficiency of 1 to 16 workers from the tasks of a run with one."""
    images = write_scene(out, scene, max(sizes), long_side, threads=1)
    for count in sorted(sizes):
        found, _ = call_apart(measure_tasks, images, count, until, list(set_), cores=1)
        by_workers = {
            int(workers): {stage: [Task(*task) for task in tasks] for stage, tasks in stages.items()}
            for workers, stages in found["tasks"].items()
        }
        head = f"{count} images, {scene}, long side {long_side} px, {found['serial_s']:.1f} s serial"
        yield f"{head}\n\n{efficiency_table(found['serial_s'], by_workers)}"

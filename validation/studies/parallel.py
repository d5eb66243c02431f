"""What workers are worth: ``python -m validation.studies.parallel``.

Features and matches of the same photographs by one thread, two threads and two processes, each run in a
process of its own, the kinds taking turns. Told are wall seconds and the processor seconds of the run and of
all its workers, started processes and loaded kernels and all. Two figures for the efficiency of two workers:
by the clock, T1 / (2 T2), which other work on the machine disturbs; and by work, the processor seconds of one
worker over those of two, which says what distribution adds to the work and which the clock reaches where the
work is dealt out evenly and two cores are free.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thesisrecon.pipeline.reconstruction import reconstruct
from validation.harness.process import own_cores, run_process
from validation.metrics.record import Metric, markdown_table
from validation.scenes.many_views import write_views

KINDS = {"one thread": (1, "local"), "two threads": (2, "local"), "two processes": (2, "processes")}
LEAST = 0.85
Seconds = tuple[float, float]
"""Wall and processor seconds."""


def measure_here(images: Path, kind: str, count: int) -> Seconds:
    """The front end of the first ``count`` photographs, this process' kernels loaded before."""
    threads, executor = KINDS[kind]
    paths = sorted(images.glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        reconstruct(paths[:3], Path(place) / "warm", until="matches", threads=1)
        start, before = time.perf_counter(), _processor_s()
        reconstruct(paths, Path(place) / "run", until="matches", threads=threads, executor=executor)
        return time.perf_counter() - start, _processor_s() - before


def _processor_s() -> float:
    """Processor seconds of this process and of the children that have ended."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in used)


def measure(images: Path, kind: str, count: int) -> Seconds:
    """One run in a process of its own, on two cores."""
    with tempfile.TemporaryDirectory() as place:
        log = Path(place) / "log"
        command = [
            sys.executable,
            "-m",
            "validation.studies.parallel",
            "--child",
            str(images),
            kind,
            str(count),
        ]
        environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        process = run_process(command, log=log, cores=own_cores()[:2], environment=environment)
        if process.code != 0:
            raise RuntimeError(log.read_text(encoding="utf-8")[-2000:])
        wall, cpu = json.loads(log.read_text(encoding="utf-8").splitlines()[-1])
    return float(wall), float(cpu)


def rows(name: str, found: dict[str, Sequence[Seconds]]) -> list[Metric]:
    """Medians over the repeats, and the efficiencies."""
    wall, cpu = ({k: float(np.median([s[c] for s in v])) for k, v in found.items()} for c in (0, 1))
    one, judged = "one thread", "two processes"
    others = [kind for kind in found if kind != one]
    clock = {kind: wall[one] / (2.0 * wall[kind]) for kind in others}
    work = {kind: cpu[one] / cpu[kind] for kind in others}
    return [
        Metric(name, "wall", "s", wall, judged),
        Metric(name, "processor", "s", cpu, judged),
        Metric(name, "efficiency by the clock", "", clock, judged),
        Metric(name, "efficiency by work", "", work, judged, LEAST, at_most=False),
    ]


def main(arguments: list[str] | None = None) -> int:
    """Print the table; exit code 1 where two processes do more than ``1 / LEAST`` of the work of one."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.parallel", description=__doc__)
    parser.add_argument("--images", type=Path, help="where the photographs are kept (a temporary folder)")
    parser.add_argument("--photographs", type=int, default=30)
    parser.add_argument("--long-side", type=int, default=480)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    wishes = parser.parse_args(arguments)
    if wishes.child:
        print(json.dumps(measure_here(Path(wishes.child[0]), wishes.child[1], int(wishes.child[2]))))
        return 0
    with tempfile.TemporaryDirectory() as place:
        images = wishes.images or Path(place)
        write_views(images, wishes.photographs, size=(wishes.long_side, wishes.long_side * 3 // 4))
        found: dict[str, list[Seconds]] = {kind: [] for kind in KINDS}
        for _ in range(wishes.repeats):
            for kind, told in found.items():
                told.append(measure(images, kind, wishes.photographs))
    metrics = rows(f"{wishes.photographs} photographs", dict(found))
    print(markdown_table(metrics))
    return int(any(metric.verdict == "missed" for metric in metrics))


if __name__ == "__main__":
    sys.exit(main())

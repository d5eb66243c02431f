"""What each stage costs at 10, 30, 100 and 300 photographs: ``python -m validation.studies.growth_of_cost``.

The first n photographs of a long walk about the courtyard (:mod:`validation.scenes.many_views`) are taken to
metric cameras, each n in a process of its own. Of each stage are told the processor time, which other work on
the machine changes little, and the highest memory while it ran; the exponents are slopes of straight lines
through the logarithms. All sizes show the same yard, so each photograph overlaps with ever more others: sets
that grow while their overlaps do not are in :mod:`validation.studies.growth`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.errors import StageFailure
from thesisrecon.pipeline.reconstruction import reconstruct
from validation.studies.growth import exponent
from validation.harness.process import own_cores, run_process
from validation.scenes.many_views import walk, write_views

STAGES = (
    "images",
    "features",
    "pairs",
    "matches",
    "tracks",
    "projective",
    "selfcalibration",
    "metric",
    "outputs",
)
AFTER = {"matches": "tracks", "metric": "outputs"}
"""Stages that tell nobody when they begin: what follows the end of these."""


@dataclass
class Meter:
    """Processor seconds and highest memory by stage, from what a run tells of its progress."""

    cpu_s: dict[str, float] = field(default_factory=dict)
    peak_mb: dict[str, float] = field(default_factory=dict)
    stage: str = "images"
    since: float = field(default_factory=time.process_time)

    def hear(self, stage: str, done: int, total: int) -> None:
        """A part of a stage is done."""
        self.enter(stage)
        if done == total and stage in AFTER:
            self.enter(AFTER[stage])

    def enter(self, stage: str) -> None:
        """What was used until now counts to the stage before."""
        now, peak = time.process_time(), highest_memory_mb()
        self.cpu_s[self.stage] = self.cpu_s.get(self.stage, 0.0) + now - self.since
        self.peak_mb[self.stage] = max(self.peak_mb.get(self.stage, 0.0), peak)
        self.stage, self.since = stage, now
        forget_highest_memory()


def highest_memory_mb() -> float:
    """The most memory this process has held since :func:`forget_highest_memory`."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return float(line.split()[1]) / 1024.0


def forget_highest_memory() -> None:
    """Count the highest memory anew (Linux)."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


@dataclass(frozen=True)
class Cost:
    """One size: processor seconds and highest memory by stage, what there was to do (``counts``), wall
    seconds, and the error of the focal length; ``failure`` where the run ended without cameras."""

    photographs: int
    cpu_s: Mapping[str, float]
    peak_mb: Mapping[str, float]
    counts: Mapping[str, int]
    wall_s: float
    focal_error_rel: float
    failure: str = ""


def measure_here(images: Sequence[Path], *, threads: int, long_side: int) -> Cost:
    """Take the photographs to metric cameras in this process, its kernels loaded before."""
    with tempfile.TemporaryDirectory() as place:
        reconstruct(images[:4], Path(place) / "warm", until="metric", threads=threads)
        meter, failure = Meter(), ""
        try:
            reconstruct(images, Path(place) / "run", until="metric", threads=threads, progress=meter.hear)
        except StageFailure as error:
            failure = str(error)
        meter.enter("end")
        summary = json.loads((Path(place) / "run" / "summary.json").read_text(encoding="utf-8"))
    known = [view["focal_px"]["value"] for view in summary["cameras"] if "focal_px" in view]
    truth = float(walk(1, (long_side, long_side * 3 // 4))[0].K[0, 0])
    error_rel = abs(float(np.median(known)) / truth - 1.0) if known else float("nan")
    counts = counts_of(summary)
    return Cost(
        len(images), meter.cpu_s, meter.peak_mb, counts, summary["elapsed_seconds"], error_rel, failure
    )


def counts_of(summary: Mapping[str, Any]) -> dict[str, int]:
    """What there was to do."""
    pairs = summary["pairs"]
    counts = {"pairs tried": pairs["matched"], "pairs accepted": pairs["accepted"]}
    counts |= {"verified matches": pairs["verified_matches"]}
    return counts | {"registered": summary["registered"], "points": summary["points"] or 0}


def table(costs: Sequence[Cost]) -> str:
    """Processor seconds, memory and counts by stage, with their powers of N."""
    sizes = [float(cost.photographs) for cost in costs]
    lines = [f"| | {' | '.join(f'{n:.0f}' for n in sizes)} | power of N |", f"|{' --- |' * (len(sizes) + 2)}"]

    def row(name: str, values: Sequence[float], digits: int) -> None:
        power = f"{exponent(sizes, values):.2f}" if len(sizes) > 1 and min(values) > 0.0 else "-"
        lines.append(f"| {name} | {' | '.join(f'{v:.{digits}f}' for v in values)} | {power} |")

    for stage in STAGES:
        row(f"{stage}, processor s", [cost.cpu_s.get(stage, 0.0) for cost in costs], 2)
    row("all, processor s", [sum(cost.cpu_s.values()) for cost in costs], 1)
    for stage in STAGES:
        row(f"{stage}, peak MB", [cost.peak_mb.get(stage, 0.0) for cost in costs], 0)
    row("whole run, peak MB", [max(cost.peak_mb.values()) for cost in costs], 0)
    for name in costs[0].counts:
        row(name, [float(cost.counts[name] or 0) for cost in costs], 0)
    row("focal error, %", [100.0 * cost.focal_error_rel for cost in costs], 3)
    row("wall s", [cost.wall_s for cost in costs], 0)
    lines += [f"\n{cost.photographs} photographs: {cost.failure}" for cost in costs if cost.failure]
    return "\n".join(lines)


def measure(images: Path, count: int, wishes: argparse.Namespace) -> Cost:
    """One size in a process of its own."""
    with tempfile.TemporaryDirectory() as place:
        answer, log = Path(place) / "answer.json", Path(place) / "log"
        command = [
            sys.executable,
            "-m",
            "validation.studies.growth_of_cost",
            "--child",
            str(images),
            str(count),
        ]
        command += ["--threads", str(wishes.threads), "--long-side", str(wishes.long_side), "-o", str(answer)]
        environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        process = run_process(command, log=log, cores=own_cores()[: wishes.threads], environment=environment)
        if process.code != 0:
            raise RuntimeError(log.read_text(encoding="utf-8")[-2000:])
        return Cost(**json.loads(answer.read_text(encoding="utf-8")))


def main(arguments: list[str] | None = None) -> int:
    """Measure all sizes and print the table."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.growth_of_cost", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 30, 100, 300])
    parser.add_argument("--images", type=Path, help="where the photographs are kept (a temporary folder)")
    parser.add_argument("--long-side", type=int, default=480)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("-o", "--out", type=Path, help="JSON of the rows")
    parser.add_argument("--child", nargs=2, metavar=("IMAGES", "COUNT"), help=argparse.SUPPRESS)
    wishes = parser.parse_args(arguments)
    if wishes.child:
        paths = sorted(Path(wishes.child[0]).glob("*.png"))[: int(wishes.child[1])]
        cost = measure_here(paths, threads=wishes.threads, long_side=wishes.long_side)
        wishes.out.write_text(json.dumps(asdict(cost)), encoding="utf-8")
        return 0
    with tempfile.TemporaryDirectory() as place:
        images = wishes.images or Path(place)
        size = (wishes.long_side, wishes.long_side * 3 // 4)
        write_views(images, max(wishes.sizes), size=size, threads=wishes.threads)
        costs = []
        for count in sorted(wishes.sizes):
            costs.append(measure(images, count, wishes))
            print(f"{count} photographs: {sum(costs[-1].cpu_s.values()):.0f} processor s", flush=True)
            if wishes.out is not None:
                wishes.out.write_text(
                    json.dumps([asdict(c) for c in costs], indent=1) + "\n", encoding="utf-8"
                )
    print(f"\nlong side {wishes.long_side} px, {wishes.threads} threads, {os.cpu_count()} cores\n")
    print(table(costs))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Growth of time and memory with the number of images.

The first n images of a long walk around the courtyard become metric cameras. All sizes show the same yard, so
each image overlaps with ever more others. Exponents are slopes of lines fitted to the logarithms; those of
time use processor time, which other load disturbs less.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.errors import StageFailure
from thesisrecon.pipeline.reconstruction import reconstruct
from validation.scenes.many_views import walk, write_views
from validation.studies.measuring import call_apart, exponent
from validation.studies.runner import Part, text_table

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
"""Stage that reports its end -> the following stage, which does not report its beginning."""


@dataclass
class Meter:
    """Processor seconds and highest memory by stage, from the progress reports of a run."""

    cpu_s: dict[str, float] = field(default_factory=dict)
    peak_mb: dict[str, float] = field(default_factory=dict)
    stage: str = "images"
    since: float = field(default_factory=time.process_time)

    def progress(self, stage: str, done: int, total: int) -> None:
        self.enter(stage)
        if done == total and stage in AFTER:
            self.enter(AFTER[stage])

    def enter(self, stage: str) -> None:
        now, peak = time.process_time(), _peak_mb()
        self.cpu_s[self.stage] = self.cpu_s.get(self.stage, 0.0) + now - self.since
        self.peak_mb[self.stage] = max(self.peak_mb.get(self.stage, 0.0), peak)
        self.stage, self.since = stage, now
        _reset_peak()


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return float(line.split()[1]) / 1024.0


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


@dataclass(frozen=True)
class Cost:
    """One number of images.

    ``cpu_s``, ``peak_mb``: processor seconds and highest memory by stage; ``counts``: numbers of pairs,
    matches, cameras and points; ``failure``: message of a run without cameras.
    """

    images: int
    cpu_s: Mapping[str, float]
    peak_mb: Mapping[str, float]
    counts: Mapping[str, int]
    wall_s: float
    focal_error_rel: float
    failure: str = ""


def measure_cost(images: str, count: int, threads: int, long_side: int) -> dict[str, Any]:
    """Reconstruct cameras in this process, its kernels loaded before; return the fields of :class:`Cost`."""
    paths = sorted(Path(images).glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        reconstruct(paths[:4], Path(place) / "warm", until="metric", threads=threads)
        meter, failure = Meter(), ""
        try:
            reconstruct(paths, Path(place) / "run", until="metric", threads=threads, progress=meter.progress)
        except StageFailure as error:
            failure = str(error)
        meter.enter("end")
        summary = json.loads((Path(place) / "run" / "summary.json").read_text(encoding="utf-8"))
    known = [view["focal_px"]["value"] for view in summary["cameras"] if "focal_px" in view]
    truth = float(walk(1, (long_side, long_side * 3 // 4))[0].K[0, 0])
    error_rel = abs(float(np.median(known)) / truth - 1.0) if known else float("nan")
    seconds = summary["elapsed_seconds"]
    found = Cost(len(paths), meter.cpu_s, meter.peak_mb, counts_of(summary), seconds, error_rel, failure)
    return asdict(found)


def counts_of(summary: Mapping[str, Any]) -> dict[str, int]:
    pairs = summary["pairs"]
    counts = {"pairs tried": pairs["matched"], "pairs accepted": pairs["accepted"]}
    counts |= {"verified matches": pairs["verified_matches"]}
    return counts | {"registered": summary["registered"], "points": summary["points"] or 0}


def cost_table(costs: Sequence[Cost]) -> str:
    """Return processor seconds, memory and counts by stage, with their powers of N."""
    sizes, lines = [float(cost.images) for cost in costs], []

    def row(name: str, values: Sequence[float], digits: int) -> None:
        power = f"{exponent(sizes, values):.2f}" if len(sizes) > 1 and min(values) > 0.0 else "-"
        lines.append([name, *(f"{v:.{digits}f}" for v in values), power])

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
    failures = [f"\n{cost.images} images: {cost.failure}" for cost in costs if cost.failure]
    return "\n".join([text_table(["", *(f"{n:.0f}" for n in sizes), "power of N"], lines), *failures])


def growth_of_cost_study(
    out: Path, sizes: Sequence[int] = (10, 30, 100, 300), long_side: int = 480, threads: int = 2
) -> Iterator[Part]:
    """Measure what each stage costs by the number of images of one place."""
    write_views(out, max(sizes), size=(long_side, long_side * 3 // 4), threads=threads)
    costs = []
    for count in sorted(sizes):
        costs.append(Cost(**call_apart(measure_cost, out, count, threads, long_side, cores=threads)[0]))
        yield f"{count} images: {sum(costs[-1].cpu_s.values()):.0f} processor s"
    yield f"long side {long_side} px, {threads} threads, {os.cpu_count()} cores"
    yield cost_table(costs)

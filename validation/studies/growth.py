"""Growth of time and memory with the number of images.

``growth``: crops of images at random places and zooms are matched, each set in its own process, with all
pairs and with the overlap estimate. Exponents are slopes of lines fitted to the logarithms; those of time use
processor time, which other load disturbs less. By default every ten crops show a scene of their own, so that
each overlaps with as many others in sets of all sizes.
``growth-of-cost``: the first n images of a long walk around the courtyard become metric cameras. All sizes
show the same yard, so each image overlaps with ever more others.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.config import PipelineConfig, preset
from thesisrecon.errors import StageFailure
from thesisrecon.matching.pair_selection import AllPairs, OverlapEstimate
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import RunResult
from validation.scenes.crops import Crop, make_crops, make_separate_crops, shared_area
from validation.scenes.many_views import walk, write_views
from validation.scenes.real import REAL_SCENES
from validation.studies.measuring import call_apart, exponent
from validation.studies.runner import Part, load_scene, text_table

# ---------------------------------------------------------------- growth of matching

METHODS = ("overlap-estimate", "all-pairs")
SHARED = 0.3
"""Crops of one image that share this part of the smaller one must be tried."""


@dataclass(frozen=True)
class Growth:
    """One set and one method.

    ``features_s``, ``pairs_s``, ``matches_s``, ``cpu_s``: wall seconds by stage, and processor seconds of
    all; ``overlapping_tried``: tried share of the pairs known to overlap (crops of one image), None without
    such pairs; ``pair_list``: tried pairs (i, j, accepted); ``recall``: tried share of the pairs that are
    accepted when all are tried, None if not all were tried.
    """

    method: str
    images: int
    possible: int
    tried: int
    accepted: int
    features_s: float
    pairs_s: float
    matches_s: float
    cpu_s: float
    overlapping_tried: float | None
    pair_list: tuple[tuple[int, int, bool], ...]
    peak_mb: float = 0.0
    recall: float | None = None


def draw_crops(count: int, long_side: int, seed: int, *, separate: bool = False) -> list[Crop]:
    """Cut crops of the images of all scenes on this machine; ``separate``: a scene for each ten crops."""
    scenes = [load_scene(name) for name in ("courtyard", *REAL_SCENES)]
    paths = [scene.image_paths for scene in scenes if scene is not None]
    make = make_separate_crops if separate else make_crops
    return make(paths, count, long_side=long_side, rng=np.random.default_rng([seed, count]))


def configure(method: str) -> PipelineConfig:
    pairs = AllPairs() if method == "all-pairs" else OverlapEstimate(all_up_to=0)
    return replace(preset("default"), pairs=pairs)


def measure_crops(
    method: str, count: int, long_side: int, threads: int, seed: int, separate: bool
) -> dict[str, Any]:
    """Match one set in this process, its kernels loaded before; return the fields of :class:`Growth`."""
    crops = draw_crops(count, long_side, seed, separate=separate)
    config, images = configure(method), [crop.image for crop in crops]
    with tempfile.TemporaryDirectory() as place:
        reconstruct(images[:4], Path(place) / "warm", config=config, until="matches", threads=threads)
        start = time.process_time()
        result = reconstruct(images, Path(place) / "run", config=config, until="matches", threads=threads)
        cpu_s = time.process_time() - start
    return asdict(growth_of(method, crops, result, cpu_s))


def growth_of(method: str, crops: Sequence[Crop], result: RunResult, cpu_s: float) -> Growth:
    # Views are numbered without the crops that were left out.
    views = [crops[int(Path(image.name).stem)] for image in result.images]
    n = len(views)
    tried = {(pair.i, pair.j) for pair in result.pairs}
    known = [(i, j) for i in range(n) for j in range(i + 1, n) if shared_area(views[i], views[j]) >= SHARED]
    seconds = result.summary["seconds"]
    return Growth(
        method=method,
        images=n,
        possible=n * (n - 1) // 2,
        tried=len(tried),
        accepted=sum(pair.accepted for pair in result.pairs),
        features_s=seconds["features"],
        pairs_s=seconds["pairs"],
        matches_s=seconds["matches"],
        cpu_s=cpu_s,
        overlapping_tried=sum(pair in tried for pair in known) / len(known) if known else None,
        pair_list=tuple((pair.i, pair.j, pair.accepted) for pair in result.pairs),
    )


def recall_of(tried: Growth, everything: Growth) -> float:
    pairs = {(i, j) for i, j, _ in tried.pair_list}
    accepted = [(i, j) for i, j, good in everything.pair_list if good]
    return sum(pair in pairs for pair in accepted) / max(len(accepted), 1)


def table(rows: Sequence[Growth]) -> str:
    """Return the rows and, for each method, the powers of the numbers of images and of accepted pairs."""
    head = ["method", "images", "tried of possible", "accepted", "known overlaps tried"]
    head += ["of all accepted, tried", "features s", "choice s", "matching s", "processor s", "peak MB"]
    lines = []
    for r in rows:
        share = f"{r.tried} of {r.possible} ({100 * r.tried / r.possible:.0f} %)"
        cells = (r.method, r.images, share, r.accepted, _percent(r.overlapping_tried), _percent(r.recall))
        seconds = (f"{v:.1f}" for v in (r.features_s, r.pairs_s, r.matches_s, r.cpu_s))
        lines.append([*cells, *seconds, f"{r.peak_mb:.0f}"])
    text = [text_table(head, lines)]
    for method in METHODS:
        own = [r for r in rows if r.method == method]
        if len(own) > 1:
            text.append(_exponents(method, own))
    return "\n\n".join(text)


def _exponents(method: str, rows: Sequence[Growth]) -> str:
    costs = {
        "accepted pairs": [float(r.accepted) for r in rows],
        "tried pairs": [float(r.tried) for r in rows],
        "features": [r.features_s for r in rows],
        "choice": [r.pairs_s for r in rows],
        "matching": [r.matches_s for r in rows],
        "processor time": [r.cpu_s for r in rows],
        "peak memory": [r.peak_mb for r in rows],
    }
    powers = ", ".join(f"{name} {exponent([r.images for r in rows], v):.2f}" for name, v in costs.items())
    per_pair = exponent(costs["accepted pairs"], costs["processor time"])
    return f"{method}, powers of N: {powers}. Processor time over accepted pairs: {per_pair:.2f}."


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


# ---------------------------------------------------------------- growth of all stages

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


# ---------------------------------------------------------------- the studies


def growth_study(
    sizes: Sequence[int] = (10, 30, 100),
    all_pairs_up_to: int = 30,
    long_side: int = 480,
    threads: int = 2,
    same_scenes: bool = False,
    seed: int = 0,
) -> Iterator[Part]:
    """Measure how time and memory of matching grow with the number of images."""

    def measure(method: str, count: int) -> Growth:
        given = (method, count, long_side, threads, seed, not same_scenes)
        found, process = call_apart(measure_crops, *given, cores=threads)
        found["pair_list"] = tuple((i, j, accepted) for i, j, accepted in found["pair_list"])
        return replace(Growth(**found), peak_mb=process.peak_mb)

    # The first process compiles the kernels, which takes the most memory.
    measure(METHODS[0], 4)
    rows = []
    for count in sizes:
        row = measure(METHODS[0], count)
        if count <= all_pairs_up_to:
            rows.append(measure(METHODS[1], count))
            row = replace(row, recall=recall_of(row, rows[-1]))
        rows.append(row)
        yield f"{count} images: {row.cpu_s:.1f} processor s"
    rows.sort(key=lambda row: METHODS.index(row.method))
    yield f"long side {long_side} px, {threads} threads, seed {seed}, {os.cpu_count()} cores"
    yield table(rows)


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

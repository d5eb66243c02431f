"""Growth of time and memory with the number of images, compared with COLMAP on the same images and pairs.

The first n images of a long walk become metric cameras: around the courtyard, where each image overlaps with
ever more others, or along a street. Exponents are slopes of lines fitted to the logarithms; those of time use
processor time, which other load disturbs less.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage

from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io._files import write_text
from thesisrecon.pipeline.run import Until
from thesisrecon.records import Reconstruction
from validation.metrics.cameras import measure_cameras, relative_centre_error
from validation.references.colmap import read_run, reconstruct_with_pycolmap
from validation.runs.processes import call_apart, peak_mb, reset_peak
from validation.runs.study import Part
from validation.runs.tables import text_table
from validation.scenes.many_views import walk, walk_street, write_street, write_views
from validation.scenes.pose import true_cameras

STAGES = ["images", "features", "pairs", "matches", "tracks", "projective"]
STAGES += ["selfcalibration", "metric", "dense", "model", "outputs"]
AFTER = {"matches": "tracks", "metric": "outputs", "model": "outputs"}
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
        now, peak = time.process_time(), peak_mb()
        self.cpu_s[self.stage] = self.cpu_s.get(self.stage, 0.0) + now - self.since
        self.peak_mb[self.stage] = max(self.peak_mb.get(self.stage, 0.0), peak)
        self.stage, self.since = stage, now
        reset_peak()


Cost = dict[str, float]
"""Numbers of one run by their names in the table, the number of images under ``IMAGES``."""
IMAGES = "images"
DIGITS = {
    "all, processor s": 1,
    "focal error, %": 3,
    "centres, % of their extent": 4,
    "wall over COLMAP's": 2,
}


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Fit the slope of log cost against log size by least squares; NaN if all sizes are equal."""
    if min(sizes) == max(sizes):
        return float("nan")
    return float(np.polyfit(np.log(np.maximum(sizes, 1e-9)), np.log(np.maximum(costs, 1e-9)), 1)[0])


def measure_cost(
    images: str, count: int, threads: int, scene: str, until: Until = "metric", settings: Sequence[str] = ()
) -> tuple[Cost, str]:
    """Reconstruct in this process, its kernels loaded before; return the numbers, and why it failed."""
    paths = sorted(Path(images).glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        out, given = Path(place) / "run", {"until": until, "threads": threads}
        reconstruct(paths[:4], Path(place) / "warm", **given)  # type: ignore[arg-type]
        meter, failure, errors = Meter(), "", (float("nan"), float("nan"))
        try:
            result = reconstruct(paths, out, set=list(settings), progress=meter.progress, **given)  # type: ignore[arg-type]
            if result.metric is not None:
                errors = _errors(result.metric.reconstruction, scene, paths)
            listed = [f"{paths[pair.i].name} {paths[pair.j].name}\n" for pair in result.pairs]
            write_text(Path(images) / f"pairs-{count}.txt", "".join(listed))
        except StageFailure as error:
            failure = str(error)
        meter.enter("end")
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        files = [file for file in (out / "report.html", out / "model.glb") if file.exists()]
        sizes = {f"{file.name}, kB": file.stat().st_size // 1000 for file in files}
    pairs, found = summary["pairs"], {IMAGES: len(paths)} | costs_of(meter)
    found |= {"pairs tried": pairs["matched"], "pairs accepted": pairs["accepted"]}
    found |= {"verified matches": pairs["verified_matches"], "registered": summary["registered"]}
    found |= {"points": summary["points"] or 0, **sizes}
    found |= {"focal error, %": 100.0 * errors[0], "centres, % of their extent": 100.0 * errors[1]}
    return found | {"wall s": summary["elapsed_seconds"]}, failure


def costs_of(meter: Meter) -> Cost:
    """Return processor seconds and memory of each stage and of all."""
    seconds = {f"{stage}, processor s": meter.cpu_s.get(stage, 0.0) for stage in STAGES}
    memory = {f"{stage}, peak MB": meter.peak_mb.get(stage, 0.0) for stage in STAGES}
    seconds["all, processor s"] = sum(meter.cpu_s.values())
    return seconds | memory | {"whole run, peak MB": max(meter.peak_mb.values())}


def _errors(found: Reconstruction, scene: str, paths: Sequence[Path]) -> tuple[float, float]:
    with PillowImage.open(paths[0]) as image:
        poses = WALKS[scene][0](len(found.P), image.size)
    truth = true_cameras(poses)
    errors = measure_cameras(found, truth)
    return errors.focal_error_pct / 100.0, relative_centre_error(errors, truth[2])


def measure_colmap(images: Path, count: int, threads: int, scene: str) -> dict[str, float]:
    """COLMAP on the first ``count`` images and the pairs that :func:`measure_cost` listed."""
    paths = sorted(images.glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        folder, out = Path(place) / "images", Path(place) / "out"
        folder.mkdir()
        for path in paths:
            (folder / path.name).symlink_to(path.resolve())
        pairs = images / f"pairs-{count}.txt"
        arguments = (folder, out, pairs, threads, True)
        (wall_s, cpu_s), process = call_apart(reconstruct_with_pycolmap, *arguments, cores=threads)
        model, spent = read_run(folder, out)
    focal, centre = _errors(model, scene, paths)
    costs = {"wall s": wall_s, "processor s": cpu_s, "peak MB": process.peak_mb}
    costs |= {f"{name}, wall s": seconds for name, seconds in spent.items()}
    costs |= {"registered": float(model.registered.sum())}
    return costs | {"focal error, %": 100 * focal, "centres, %": 100 * centre}


def cost_table(costs: Sequence[Cost], failures: Sequence[str] = ()) -> str:
    """Return all numbers with their powers of N, without rows of zeros."""
    sizes, lines = [cost[IMAGES] for cost in costs], []
    for name in dict.fromkeys(name for cost in costs for name in cost if name != IMAGES):
        theirs = name.startswith("COLMAP")
        values = [cost.get(name, np.nan if theirs else 0.0) for cost in costs]
        if any(values):
            digits = 4 * ("%" in name) if theirs else DIGITS.get(name, 2 * name.endswith("processor s"))
            known = len(sizes) > 1 and bool(np.isfinite(values).all()) and min(values) > 0.0
            power = f"{exponent(sizes, values):.2f}" if known else "-"
            lines.append([name, *(f"{v:.{digits}f}" for v in values), power])
    notes = [f"\n{why}" for why in failures if why]
    return "\n".join([text_table(["", *(f"{n:.0f}" for n in sizes), "power of N"], lines), *notes])


WALKS = {"place": (walk, write_views), "street": (walk_street, write_street)}
"""True cameras and the writer of the images of each kind of scene."""


def write_scene(out: Path, scene: str, count: int, long_side: int, threads: int) -> Path:
    """Write the images of a walk into a folder in ``out``, which is returned; those that are there stay."""
    if scene not in WALKS:
        raise UsageError(f"the scene is {' or '.join(WALKS)}; got {scene!r}")
    folder = out / f"{scene}-{long_side}"
    WALKS[scene][1](folder, count, size=(long_side, long_side * 3 // 4), threads=threads)
    return folder


def growth_of_cost_study(
    out: Path,
    sizes: Sequence[int] = (10, 30, 100, 300),
    scene: str = "place",
    long_side: int = 480,
    threads: int = 2,
    colmap: bool = False,
    until: Until = "metric",
    set_: Sequence[str] = (),
) -> Iterator[Part]:
    """Measure what each stage costs by the number of images of one place or of a street."""
    images = write_scene(out, scene, max(sizes), long_side, threads)
    head = [scene, f"long side {long_side} px", f"{threads} threads", f"{os.cpu_count()} cores", *set_]
    yield ", ".join(head)
    costs, failures = list[Cost](), list[str]()
    for count in sorted(sizes):
        arguments = (images, count, threads, scene, until, list(set_))
        (cost, failure), _ = call_apart(measure_cost, *arguments, cores=threads)
        costs.append(cost)
        failures.append(f"{count} images: {failure}" if failure else "")
        yield cost_table(costs[-1:], failures[-1:]) if len(sizes) > 1 else ""
        if colmap and not failure:
            theirs = measure_colmap(images, count, threads, scene)
            cost |= {f"COLMAP, {name}": value for name, value in theirs.items()}
            cost["wall over COLMAP's"] = cost["wall s"] / theirs["wall s"]
    yield cost_table(costs, failures)

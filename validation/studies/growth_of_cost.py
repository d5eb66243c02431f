"""Growth of time and memory with the number of images, compared with COLMAP on the same images and pairs.

The first n images of a long walk become metric cameras: around the courtyard, where each image overlaps with
ever more others, or along a street, where it overlaps with a few. Exponents are slopes of lines fitted to the
logarithms; those of time use processor time, which other load disturbs less.
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
from PIL import Image as PillowImage

from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io._files import write_text
from thesisrecon.records import Reconstruction
from thesisrecon.runtime._run import Until
from validation.metrics.cameras import TrueCameras, measure_cameras, relative_centre_error
from validation.references.colmap import read_run, reconstruct_with_pycolmap
from validation.references.libraries import load
from validation.runs.processes import call_apart, peak_mb, reset_peak, timed
from validation.runs.study import Part
from validation.runs.tables import text_table
from validation.scenes.many_views import walk, write_views
from validation.scenes.street import walk_street, write_street

STAGES = (
    "images",
    "features",
    "pairs",
    "matches",
    "tracks",
    "projective",
    "selfcalibration",
    "metric",
    "dense",
    "model",
    "outputs",
)
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


@dataclass(frozen=True)
class Cost:
    """One number of images.

    ``cpu_s``, ``peak_mb``: processor seconds and highest memory by stage; ``counts``: numbers of pairs,
    matches, cameras and points; ``focal_error_rel``, ``centre_error_rel``: of the true focal length and of
    the extent of the true centres; ``failure``: message of a run without cameras; ``colmap``: the same of
    COLMAP.
    """

    images: int
    cpu_s: Mapping[str, float]
    peak_mb: Mapping[str, float]
    counts: Mapping[str, int]
    wall_s: float
    focal_error_rel: float
    centre_error_rel: float = float("nan")
    failure: str = ""
    colmap: Mapping[str, float] = field(default_factory=dict)


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Fit the slope of log cost against log size by least squares; NaN if all sizes are equal."""
    if min(sizes) == max(sizes):
        return float("nan")
    return float(np.polyfit(np.log(np.maximum(sizes, 1e-9)), np.log(np.maximum(costs, 1e-9)), 1)[0])


def measure_cost(
    images: str, count: int, threads: int, scene: str, until: Until = "metric", settings: Sequence[str] = ()
) -> dict[str, Any]:
    """Reconstruct in this process, its kernels loaded before; return the fields of :class:`Cost`."""
    paths = sorted(Path(images).glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        reconstruct(paths[:4], Path(place) / "warm", until=until, threads=threads)
        meter, failure, errors = Meter(), "", (float("nan"), float("nan"))
        try:
            result = reconstruct(
                paths,
                Path(place) / "run",
                until=until,
                set=list(settings),
                threads=threads,
                progress=meter.progress,
            )
            if result.metric is not None:
                errors = _errors(result.metric.reconstruction, scene, _size(paths))
            listed = [f"{paths[pair.i].name} {paths[pair.j].name}\n" for pair in result.pairs]
            write_text(Path(images) / f"pairs-{count}.txt", "".join(listed))
        except StageFailure as error:
            failure = str(error)
        meter.enter("end")
        summary = json.loads((Path(place) / "run" / "summary.json").read_text(encoding="utf-8"))
        files = [Path(place) / "run" / name for name in ("report.html", "model.glb")]
        sizes = {f"{file.name}, kB": file.stat().st_size // 1000 for file in files if file.exists()}
    seconds, counts = summary["elapsed_seconds"], counts_of(summary) | sizes
    found = Cost(len(paths), meter.cpu_s, meter.peak_mb, counts, seconds, *errors, failure)
    return asdict(found)


def _size(paths: Sequence[Path]) -> tuple[int, int]:
    with PillowImage.open(paths[0]) as image:
        return image.size


def _errors(found: Reconstruction, scene: str, size: tuple[int, int]) -> tuple[float, float]:
    poses = WALKS[scene][0](len(found.P), size)
    K, R, C = (np.array([getattr(pose, name) for pose in poses]) for name in "KRC")
    errors = measure_cameras(found, TrueCameras(K, R, C))
    return errors.focal_error_pct / 100.0, relative_centre_error(errors, C)


def measure_colmap(images: Path, count: int, threads: int, scene: str) -> dict[str, float]:
    """COLMAP on the first ``count`` images and the pairs that :func:`measure_cost` listed."""
    paths = sorted(images.glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        folder, out = Path(place) / "images", Path(place) / "out"
        folder.mkdir()
        for path in paths:
            (folder / path.name).symlink_to(path.resolve())
        pairs = images / f"pairs-{count}.txt"
        costs, process = call_apart(run_colmap, folder, out, pairs, threads, cores=threads)
        run = read_run(folder, out)
    focal, centre = _errors(run.reconstruction, scene, _size(paths))
    return {
        **costs,
        "peak MB": process.peak_mb,
        **{f"{name}, wall s": seconds for name, seconds in run.seconds.items()},
        "registered": float(run.reconstruction.registered.sum()),
        "focal error, %": 100 * focal,
        "centres, %": 100 * centre,
    }


def run_colmap(images: str, out: str, pairs: str, threads: int) -> dict[str, float]:
    """Run COLMAP in this process; return its wall and processor seconds, without imports as for ours."""
    load("pycolmap")
    given: dict[str, Any] = {"pairs": Path(pairs), "threads": threads, "refine_principal_point": True}
    _, wall, cpu = timed(lambda: reconstruct_with_pycolmap(Path(images), Path(out), **given))
    return {"wall s": wall, "processor s": cpu}


def counts_of(summary: Mapping[str, Any]) -> dict[str, int]:
    pairs = summary["pairs"]
    counts = {"pairs tried": pairs["matched"], "pairs accepted": pairs["accepted"]}
    counts |= {"verified matches": pairs["verified_matches"]}
    return counts | {"registered": summary["registered"], "points": summary["points"] or 0}


def cost_table(costs: Sequence[Cost]) -> str:
    """Return processor seconds, memory and counts by stage, with their powers of N, without rows of zeros."""
    sizes, lines = [float(cost.images) for cost in costs], []

    def row(name: str, values: Sequence[float], digits: int) -> None:
        if not any(values):
            return
        known = len(sizes) > 1 and bool(np.isfinite(values).all()) and min(values) > 0.0
        power = f"{exponent(sizes, values):.2f}" if known else "-"
        lines.append([name, *(f"{v:.{digits}f}" for v in values), power])

    for stage in STAGES:
        row(f"{stage}, processor s", [cost.cpu_s.get(stage, 0.0) for cost in costs], 2)
    row("all, processor s", [sum(cost.cpu_s.values()) for cost in costs], 1)
    for stage in STAGES:
        row(f"{stage}, peak MB", [cost.peak_mb.get(stage, 0.0) for cost in costs], 0)
    row("whole run, peak MB", [max(cost.peak_mb.values()) for cost in costs], 0)
    for name in dict.fromkeys(name for cost in costs for name in cost.counts):
        row(name, [float(cost.counts.get(name) or 0) for cost in costs], 0)
    row("focal error, %", [100.0 * cost.focal_error_rel for cost in costs], 3)
    row("centres, % of their extent", [100.0 * cost.centre_error_rel for cost in costs], 4)
    row("wall s", [cost.wall_s for cost in costs], 0)
    for name in dict.fromkeys(name for cost in costs for name in cost.colmap):
        row(
            f"COLMAP, {name}",
            [cost.colmap.get(name, float("nan")) for cost in costs],
            4 if "%" in name else 0,
        )
    if all(cost.colmap for cost in costs):
        row("wall over COLMAP's", [cost.wall_s / cost.colmap["wall s"] for cost in costs], 2)
    failures = [f"\n{cost.images} images: {cost.failure}" for cost in costs if cost.failure]
    return "\n".join([text_table(["", *(f"{n:.0f}" for n in sizes), "power of N"], lines), *failures])


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
    costs = []
    for count in sorted(sizes):
        arguments = (images, count, threads, scene, until, list(set_))
        costs.append(Cost(**call_apart(measure_cost, *arguments, cores=threads)[0]))
        yield cost_table(costs[-1:]) if len(sizes) > 1 else ""
        if colmap and not costs[-1].failure:
            costs[-1] = replace(costs[-1], colmap=measure_colmap(images, count, threads, scene))
    yield cost_table(costs)

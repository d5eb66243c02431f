"""Time and memory of features and matching of all pairs of fountain-P11, ours beside COLMAP's SIFT.

Each runs as a process of its own on the same cores, one after the other. Ours is measured with its compiled
kernels loaded: it relates two of the photographs before the clock starts. Reading the photographs and
verifying the pairs count on both sides.
``python -m validation.studies.front_end_time IMAGES OUT.json`` is our side alone.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

from thesisrecon.config import PipelineConfig
from thesisrecon.io.files import write_text
from thesisrecon.io.images import list_images, read_photographs
from thesisrecon.pipeline.features_to_tracks import detect_features, match_views
from thesisrecon.runtime.executors import Workers
from validation.studies.front_end_pairs import MAX_SIZE_PX
from validation.harness.process import own_cores, run_process
from validation.metrics.record import Metric
from validation.scenes.real import load_real_scene

SCENE = "fountain-P11"
OURS, COLMAP = "ours", "COLMAP"
SHARE = 0.5
CPU = "processor time"
ONE_BLAS_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""As the command line has it: workers whose matrix products run on all cores hinder one another."""


@dataclass(frozen=True)
class Timed:
    """How long each stage took, s, and what the process took: its peak memory, and the processor time of
    the stages (of COLMAP's whole process), which other work on the machine disturbs less."""

    seconds: Mapping[str, float]
    cpu_s: float
    peak_mb: float

    @property
    def wall_s(self) -> float:
        """All stages."""
        return sum(self.seconds.values())


@dataclass
class _Stages:
    """The seconds of named stages of one run of ours."""

    workers: Workers
    seconds: dict[str, float] = field(default_factory=dict)

    def all(self, stage: str, function: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> list[Any]:
        """``function`` of each of ``arguments`` on all workers, under the clock."""
        start = time.perf_counter()
        found: dict[int, Any] = {}
        self.workers.run(function, arguments, found.__setitem__)
        self.seconds[stage] = time.perf_counter() - start
        return [found[n] for n in range(len(arguments))]


def relate_all(paths: list[Path], *, threads: int) -> tuple[dict[str, float], int]:
    """Read, detect, prepare and match all pairs as the pipeline does; seconds by stage and pairs accepted."""
    config, stages = PipelineConfig(), _Stages(Workers(threads))
    start = time.perf_counter()
    images = read_photographs(paths, max_size_px=MAX_SIZE_PX, map_all=stages.workers.map_all).images
    stages.seconds["read"] = time.perf_counter() - start
    features = stages.all("corners", detect_features, [(config, image) for image in images])
    views = stages.all("prepare", config.matching.prepare, list(zip(images, features, strict=True)))
    wanted = [(config, views[i], views[j], (i, j), 0) for i, j in combinations(range(len(images)), 2)]
    pairs = stages.all("match and verify", match_views, wanted)
    return stages.seconds, sum(pair.accepted for pair in pairs)


def measure_time(*, threads: int = 2) -> dict[str, Timed] | None:
    """Both sides on the same cores; None where the photographs are not on this machine."""
    scene = load_real_scene(SCENE)
    if scene is None:
        return None
    images = scene.image_paths[0].parent
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ours = ["-m", "validation.studies.front_end_time", str(images), str(folder / "ours.json")]
        theirs = ["-m", "validation.references.colmap_run", str(images), str(folder / "colmap")]
        return {
            OURS: _timed(ours, folder / "ours.json", threads),
            COLMAP: _timed([*theirs, "--only-matches"], folder / "colmap" / "seconds.json", threads),
        }


def _timed(command: list[str], told: Path, threads: int) -> Timed:
    log = told.parent.with_suffix(".log") if told.name == "seconds.json" else told.with_suffix(".log")
    command = [sys.executable, *command, "--threads", str(threads)]
    process = run_process(command, log=log, cores=own_cores()[:threads], environment=ONE_BLAS_THREAD)
    if process.code:
        raise RuntimeError(f"{' '.join(command)} ended with {process.code}: {log.read_text()[-2000:]}")
    seconds: dict[str, float] = json.loads(told.read_text(encoding="utf-8"))
    cpu_s = seconds.pop(CPU, process.cpu_s)
    return Timed(seconds, cpu_s, process.peak_mb)


def check_time(runs: Mapping[str, Timed]) -> list[Metric]:
    """Wall time judged, memory and stages told."""
    wall = {name: run.wall_s for name, run in runs.items()}
    rows = [
        Metric(SCENE, "features and matching of 55 pairs", "s", wall, OURS, SHARE * wall[COLMAP]),
        Metric(SCENE, "ratio to COLMAP", "", {n: s / wall[COLMAP] for n, s in wall.items()}, OURS, SHARE),
        Metric(SCENE, "peak memory", "MB", {n: run.peak_mb for n, run in runs.items()}, OURS),
        Metric(SCENE, "processor time", "s", {n: r.cpu_s for n, r in runs.items()}, OURS),
    ]
    for name, run in runs.items():
        rows += [Metric(SCENE, f"{stage}", "s", {name: s}, OURS) for stage, s in run.seconds.items()]
    return rows


def main() -> None:
    """Our side alone: the seconds of each stage as JSON."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    wishes = parser.parse_args()
    paths = list_images(wishes.images)
    # One pair first: loading compiled kernels is no work of the stages.
    relate_all(paths[:2], threads=wishes.threads)
    start = time.process_time()
    seconds, _ = relate_all(paths, threads=wishes.threads)
    told = {**seconds, CPU: time.process_time() - start}
    write_text(wishes.out, json.dumps(told))


if __name__ == "__main__":
    main()

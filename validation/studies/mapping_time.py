"""Time of chapters 6 and 7, tracks given, beside COLMAP's incremental mapping, matches given:
``python -m validation.studies.mapping_time``.

Both take turns in processes of their own on the same number of threads, since a machine is never quite
quiet; ours once before the clock starts, so that compiled code is loaded. Processor time stands beside the
wall's, which hangs on what else runs. COLMAP gets its default options; its matching is done once and kept.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.intrinsics import prior_from_options
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import MetricResult, RunResult
from thesisrecon.runtime.run import stream
from validation.metrics.record import Metric, markdown_table
from validation.references.colmap_mapping import map_database, mapper_options
from validation.references.colmap_matching import match_with_pycolmap
from validation.scenes.real import REAL_SCENES, load_real_scene

OURS, COLMAP = "thesisrecon", "COLMAP"
STAGES = ("projective", "selfcalibration", "metric")
WANTED_SHARE = 0.5


def time_ours(images: Path, work: Path) -> dict[str, float]:
    """Seconds of each stage on the matches kept in ``work``, the whole, and processor seconds."""
    matched = reconstruct(images, work, until="projective")
    _stages(matched)
    cpu = time.process_time()
    seconds, result = _stages(matched)
    registered = float(result.reconstruction.registered.sum())
    return {
        **seconds,
        "wall": sum(seconds.values()),
        "cpu": time.process_time() - cpu,
        "registered": registered,
    }


def _stages(matched: RunResult) -> tuple[dict[str, float], MetricResult]:
    config, n, tracks = PipelineConfig(), len(matched.images), matched.tracks
    assert tracks is not None
    prior = prior_from_options(
        config.intrinsics, [image.size for image in matched.images], np.full(n, np.nan), np.ones(n)
    )
    sizes = np.array([image.size for image in matched.images], dtype=np.int64)
    seconds: dict[str, float] = {}

    def clocked(stage: str, work: Callable[[np.random.Generator], Any]) -> Any:
        start = time.perf_counter()
        found = work(stream(0, stage, 0))
        seconds[stage] = time.perf_counter() - start
        return found

    projective = clocked(
        "projective",
        lambda rng: config.projective.reconstruct(tracks, matched.pairs, sizes, rng=rng),
    )
    calibration = clocked(
        "selfcalibration",
        lambda rng: config.selfcalibration.calibrate(projective, prior=prior, rng=rng),
    )
    result = clocked(
        "metric", lambda rng: config.metric.refine(projective, calibration, prior=prior, rng=rng)
    )
    return seconds, result


def time_colmap(images: Path, work: Path, threads: int) -> dict[str, float]:
    """Seconds of incremental mapping on the database kept in ``work``."""
    options = mapper_options(threads)
    with tempfile.TemporaryDirectory() as place:
        start, cpu = time.perf_counter(), time.process_time()
        registered = map_database(work / "database.db", images, Path(place), options)
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    return {"wall": wall, "cpu": cpu, "registered": float(registered)}


def in_its_own_process(side: str, images: Path, work: Path, threads: int) -> dict[str, float]:
    """One measurement, with so many threads for BLAS and all."""
    limit = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), str(threads))
    command = [sys.executable, "-m", "validation.studies.mapping_time", "--measure", side]
    command += ["--images", str(images), "--work", str(work), "--threads", str(threads)]
    done = subprocess.run(command, env={**os.environ, **limit}, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def compare(images: Path, work: Path, *, threads: int, repeats: int) -> dict[str, dict[str, float]]:
    """The median of every number of both sides."""
    if not (work / COLMAP / "database.db").is_file():
        match_with_pycolmap(images, work / COLMAP, threads=2)
    reconstruct(images, work / OURS, until="projective")
    found: dict[str, list[dict[str, float]]] = {OURS: [], COLMAP: []}
    for _ in range(repeats):
        for side, runs in found.items():
            runs.append(in_its_own_process(side, images, work / side, threads))
    return {
        side: {key: float(np.median([run[key] for run in runs])) for key in runs[0]}
        for side, runs in found.items()
    }


def to_metrics(name: str, threads: int, found: dict[str, dict[str, float]]) -> list[Metric]:
    """The table of one set and number of threads: at most half of COLMAP's wall time."""
    scene = f"{name}, {threads} thread{'s' if threads > 1 else ''}"

    def row(key: str, label: str, unit: str, target: float | None = None) -> Metric:
        values = {side: numbers.get(key) for side, numbers in found.items()}
        return Metric(scene, label, unit, values, OURS, target)

    rows = [row("registered", "cameras", "")]
    rows += [row(stage, f"{stage}, wall", "s") for stage in STAGES]
    rows.append(row("wall", "all, wall", "s", WANTED_SHARE * found[COLMAP]["wall"]))
    rows.append(row("cpu", "all, processor", "s"))
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.mapping_time", description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=["fountain-P11"], choices=list(REAL_SCENES))
    parser.add_argument("--work", type=Path, help="folder that keeps the matches of both")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--measure", choices=[OURS, COLMAP], help=argparse.SUPPRESS)
    parser.add_argument("--images", type=Path, help=argparse.SUPPRESS)
    wishes = parser.parse_args(arguments)
    if wishes.measure == OURS:
        print(json.dumps(time_ours(wishes.images, wishes.work)))
        return 0
    if wishes.measure == COLMAP:
        print(json.dumps(time_colmap(wishes.images, wishes.work, wishes.threads[0])))
        return 0
    missed = False
    with tempfile.TemporaryDirectory() as place:
        for name in wishes.scenes:
            scene = load_real_scene(name)
            if scene is None:
                print(f"{name} is not on this machine")
                continue
            for threads in wishes.threads:
                work = (wishes.work or Path(place)) / name
                found = compare(scene.image_paths[0].parent, work, threads=threads, repeats=wishes.repeats)
                rows = to_metrics(name, threads, found)
                print(f"{name}, {threads} threads\n\n{markdown_table(rows)}\n", flush=True)
                missed |= any(row.verdict == "missed" for row in rows)
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())

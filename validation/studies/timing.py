"""Ratios of times: mapping beside COLMAP, parallel efficiency, overhead of ablations, benchmark tables.

``mapping-time``: chapters 6 and 7 from given tracks beside COLMAP's incremental mapping from given matches.
Both take turns in processes of their own on the same number of threads; the first, compiling call is not
timed.
``parallel``: features and matches of the same images by one thread, two threads and two processes. Efficiency
by the clock is T1 / (2 T2); efficiency by work is processor time of one worker over that of two, which other
load disturbs less.
``ablation-cost``: overhead is the processor time of an ablation on one thread over that of calling its task
for the same rows; efficiency on two processes is the share of their time in which a row runs.
``benchmark-table``: ratios of the least times in a JSON file of pytest-benchmark.
"""

from __future__ import annotations

import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError
from thesisrecon.intrinsics import prior_from_options
from thesisrecon.io._files import write_text
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import MetricResult, RunResult
from thesisrecon.runtime.run import stream
from validation.ablation import Study, ablate
from validation.ablation.plan import plan_study
from validation.ablation.study import Place
from validation.ablation.tasks.fundamental import FundamentalOfCube
from validation.metrics.record import Metric
from validation.references.colmap_mapping import map_database, mapper_options
from validation.references.colmap_matching import match_with_pycolmap
from validation.scenes.many_views import write_views
from validation.studies.measuring import call_apart, timed
from validation.studies.runner import Part, Rows, scenes_here, text_table

OURS, COLMAP = "thesisrecon", "COLMAP"
STAGES = ("projective", "selfcalibration", "metric")
SHARE_OF_COLMAP = 0.5
KINDS = {"one thread": (1, "local"), "two threads": (2, "local"), "two processes": (2, "processes")}
MIN_EFFICIENCY = 0.85
OVERHEAD_PCT = 5.0
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
Seconds = tuple[float, float]
"""Wall and processor seconds."""


# ---------------------------------------------------------------- mapping


def time_ours(images: str, work: str) -> dict[str, float]:
    """Time each stage on the matches kept in ``work``: wall seconds, and processor seconds of all."""
    matched = reconstruct(Path(images), Path(work), until="projective")
    _map(matched)
    cpu = time.process_time()
    seconds, result = _map(matched)
    cpu = time.process_time() - cpu
    registered = float(result.reconstruction.registered.sum())
    return {**seconds, "wall": sum(seconds.values()), "cpu": cpu, "registered": registered}


def _map(matched: RunResult) -> tuple[dict[str, float], MetricResult]:
    config, n, tracks = PipelineConfig(), len(matched.images), matched.tracks
    assert tracks is not None
    prior = prior_from_options(
        config.intrinsics, [image.size for image in matched.images], np.full(n, np.nan), np.ones(n)
    )
    sizes = np.array([image.size for image in matched.images], dtype=np.int64)
    seconds: dict[str, float] = {}

    def clocked(stage: str, work: Callable[[np.random.Generator], Any]) -> Any:
        found, seconds[stage], _ = timed(lambda: work(stream(0, stage, 0)))
        return found

    solver, calibrator = config.projective, config.selfcalibration
    projective = clocked(STAGES[0], lambda rng: solver.reconstruct(tracks, matched.pairs, sizes, rng=rng))
    calibration = clocked(STAGES[1], lambda rng: calibrator.calibrate(projective, prior=prior, rng=rng))
    result = clocked(
        STAGES[2], lambda rng: config.metric.refine(projective, calibration, prior=prior, rng=rng)
    )
    return seconds, result


def time_colmap(images: str, work: str, threads: int) -> dict[str, float]:
    """Time incremental mapping on the database kept in ``work``."""
    options, database = mapper_options(threads), Path(work) / "database.db"
    with tempfile.TemporaryDirectory() as place:
        registered, wall, cpu = timed(lambda: map_database(database, Path(images), Path(place), options))
    return {"wall": wall, "cpu": cpu, "registered": float(registered)}


def compare_mapping(images: Path, work: Path, *, threads: int, repeats: int) -> dict[str, dict[str, float]]:
    """Return the medians of all numbers of both programs."""
    if not (work / COLMAP / "database.db").is_file():
        match_with_pycolmap(images, work / COLMAP, threads=2)
    reconstruct(images, work / OURS, until="projective")
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    environment = dict.fromkeys(names, str(threads))
    found: dict[str, list[dict[str, float]]] = {OURS: [], COLMAP: []}
    for _ in range(repeats):
        ours = call_apart(time_ours, images, work / OURS, environment=environment)
        theirs = call_apart(time_colmap, images, work / COLMAP, threads, environment=environment)
        found[OURS].append(ours[0])
        found[COLMAP].append(theirs[0])
    return {
        side: {key: float(np.median([run[key] for run in runs])) for key in runs[0]}
        for side, runs in found.items()
    }


def mapping_time_study(
    out: Path, scenes: Sequence[str] = ("fountain-P11",), repeats: int = 3, threads: Sequence[int] = (1, 2)
) -> Iterator[Part]:
    """Time projective reconstruction, self-calibration and metric refinement beside COLMAP's mapping."""
    for scene in scenes_here(scenes):
        for n in threads:
            folder = scene.image_paths[0].parent
            found = compare_mapping(folder, out / scene.name, threads=n, repeats=repeats)
            rows = Rows(f"{scene.name}, {n} thread{'s' * (n > 1)}", OURS)
            for key, label, unit in (
                ("registered", "cameras", ""),
                *((stage, f"{stage}, wall", "s") for stage in STAGES),
                ("wall", "all, wall", "s"),
                ("cpu", "all, processor", "s"),
            ):
                bound = SHARE_OF_COLMAP * found[COLMAP]["wall"] if key == "wall" else None
                rows.add(label, {side: v.get(key) for side, v in found.items()}, unit, at_most=bound)
            yield rows


# ---------------------------------------------------------------- parallel efficiency


def time_front_end(images: str, kind: str, count: int) -> Seconds:
    """Time features and matches of the first images in this process, its kernels loaded before."""
    threads, executor = KINDS[kind]
    paths = sorted(Path(images).glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        reconstruct(paths[:3], Path(place) / "warm", until="matches", threads=1)
        start, before = time.perf_counter(), _processor_s()
        reconstruct(paths, Path(place) / "run", until="matches", threads=threads, executor=executor)
        return time.perf_counter() - start, _processor_s() - before


def _processor_s() -> float:
    """Return the processor seconds of this process and of its ended children."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in used)


def efficiency_rows(name: str, found: Mapping[str, Sequence[Seconds]]) -> list[Metric]:
    """Return medians over the repeats and both efficiencies."""
    wall, cpu = ({k: float(np.median([s[c] for s in v])) for k, v in found.items()} for c in (0, 1))
    one = "one thread"
    others = [kind for kind in found if kind != one]
    rows = Rows(name, "two processes")
    rows.add("wall", wall, "s")
    rows.add("processor", cpu, "s")
    rows.add("efficiency by the clock", {kind: wall[one] / (2.0 * wall[kind]) for kind in others})
    work = {kind: cpu[one] / cpu[kind] for kind in others}
    rows.add("efficiency by work", work, at_least=MIN_EFFICIENCY)
    return rows


def parallel_study(out: Path, count: int = 30, long_side: int = 480, repeats: int = 3) -> Iterator[Part]:
    """Measure the efficiency of two workers on features and matches.

    Parameters
    ----------
    count : int
        Number of images.
    """
    write_views(out, count, size=(long_side, long_side * 3 // 4))
    found: dict[str, list[Seconds]] = {kind: [] for kind in KINDS}
    for _ in range(repeats):
        for kind, seconds in found.items():
            seconds.append(tuple(call_apart(time_front_end, out, kind, count, environment=ONE_THREAD)[0]))
    yield efficiency_rows(f"{count} images", found)


# ---------------------------------------------------------------- ablations


def _ablation(seeds: int) -> Study:
    """Return an ablation with rows of about a quarter of a second."""
    task = FundamentalOfCube(outliers=0.3, pairs=16)
    return Study({"epipolar.threshold_px": [0.5, 2.0]}, ["cube"], seeds=seeds, task=task)


def _direct_s(study: Study) -> float:
    """Return the processor time of the rows, called one after the other."""
    rows, place = plan_study(study).rows, Place(Path(), Path())
    start = time.process_time()
    for row in rows:
        row.setting.task.run(row.setting.config, row.scene, row.seed, place)
    return time.process_time() - start


def _ablation_s(study: Study) -> float:
    """Return the processor time of the same rows as an ablation on one thread."""
    with tempfile.TemporaryDirectory() as folder:
        return timed(lambda: ablate(study, folder, executor="local", threads=1))[2]


def ablation_cost_study(seeds: int = 8, repeats: int = 5, long_seeds: int = 60) -> Iterator[Part]:
    """Measure what an ablation costs beside its rows.

    Parameters
    ----------
    seeds : int
        Seeds of the overhead.
    long_seeds : int
        Seeds of the efficiency.
    """
    study, rows = _ablation(seeds), Rows("ablation", "ours")
    _direct_s(study)
    ratios = sorted(100.0 * (_ablation_s(study) / _direct_s(study) - 1.0) for _ in range(repeats))
    rows.add("overhead over calling the task", ratios[len(ratios) // 2], "%", at_most=OVERHEAD_PCT)
    with tempfile.TemporaryDirectory() as folder:
        done, wall, _ = timed(lambda: ablate(_ablation(long_seeds), folder, executor="processes", threads=2))
    share = sum(row.seconds for row in done) / (2.0 * wall)
    note = f"{len(done)} rows in {wall:.0f} s"
    rows.add("efficiency on 2 processes", share, at_least=MIN_EFFICIENCY, note=note)
    yield rows


# ---------------------------------------------------------------- benchmark


def ratios_to_ours(groups: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return group -> reference -> our time over its time; groups without ours are left out."""
    return {
        group: {name: times["ours"] / seconds for name, seconds in times.items() if name != "ours"}
        for group, times in groups.items()
        if "ours" in times
    }


def ratio_table(groups: Mapping[str, Mapping[str, float]]) -> str:
    """Return a row for each group and method."""
    ratios, rows = ratios_to_ours(groups), []
    for group, times in groups.items():
        for name, seconds in times.items():
            ratio = ratios.get(group, {}).get(name)
            rows.append([group, name, f"{1e3 * seconds:.3g}", "" if ratio is None else f"**{ratio:.2f}**"])
    return text_table(["", "method", "ms a call", "ours / this"], rows)


def benchmark_table_study(benchmark: Path, ratios: Path | None = None) -> Iterator[Part]:
    """Compare the least times of the benchmarks with those of the references.

    Parameters
    ----------
    benchmark : Path
        JSON file of pytest-benchmark.
    ratios : Path
        JSON file for the ratios.
    """
    groups: dict[str, dict[str, float]] = {}
    try:
        for entry in json.loads(benchmark.read_text(encoding="utf-8"))["benchmarks"]:
            times = groups.setdefault(entry["group"], {})
            times[entry["extra_info"]["method"]] = float(entry["stats"]["min"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{benchmark} is not a JSON file of our benchmarks: {error}") from error
    yield ratio_table(groups)
    if ratios is not None:
        content = {"seconds": groups, "ours_over": ratios_to_ours(groups)}
        write_text(ratios, json.dumps(content, indent=1))

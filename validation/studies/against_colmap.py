"""Reconstruction compared with COLMAP on the same images: cameras, errors, reprojection, wall time.

Each method runs in its own process on the same number of processor cores. Ours is the command line up to
the metric stage, and its whole time counts; of COLMAP only extraction, matching and mapping count. Every
number is computed here from saved cameras and points.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from thesisrecon.io._files import read_json
from thesisrecon.io._outputs import clear_folder
from thesisrecon.records import Reconstruction
from validation.metrics.cameras import measure_reprojection
from validation.references.colmap import reconstruct_with_pycolmap
from validation.runs.processes import Process, call_apart, failure_of, last_line, own_cores, run_process
from validation.runs.records import Outcome
from validation.runs.results import camera_limit
from validation.runs.study import Part, report_progress
from validation.runs.tables import OURS, Metric, Rows, each, machine, slug
from validation.scenes.real import REAL_SCENES, Scene, scenes_here
from validation.stages.cameras import COLMAP, COLMAP_PP, SETTINGS, THESIS, error_rows, fit_rows, read_model

METHODS = {OURS: "default", THESIS: "thesis", COLMAP: "colmap", COLMAP_PP: "colmap-principal-point"}


@dataclass(frozen=True)
class Run:
    """A method on a scene: its outcome with the wall time that counts, its model, and what it states itself:
    ``summary.json`` of ours, ``seconds.json`` of COLMAP.
    """

    outcome: Outcome
    model: Reconstruction | None
    stated: Mapping[str, Any] = field(default_factory=dict)


def check_reconstruction(scene: Scene, runs: Mapping[str, Run]) -> list[Metric]:
    """Return all rows of one scene, those of the report bounded by its gates."""
    models = {name: run.model for name, run in runs.items()}
    rows = Rows(scene.name, OURS)
    for metric in (*error_rows(scene, models), *fit_rows(scene, models)):
        bound = {"at_most" if metric.at_most else "at_least": camera_limit(scene.name, slug(metric.name))}
        rows.add(metric.name, metric.values, metric.unit, **bound)
    bounded = COLMAP in runs and scene.name in ("fountain-P11", "Herz-Jesus-P8")
    wall_s = each(runs, lambda run: run.outcome.wall_s)
    rows.add("wall time", wall_s, "s", at_most=wall_s[COLMAP] if bounded else None)
    claims = {
        name: 100.0 * abs(claimed / measure_reprojection(run.model).rms_px - 1.0)
        for name, run in runs.items()
        if run.model is not None and (claimed := run.stated.get("reprojection_rms_px")) is not None
    }
    rows.add("rms it claims off by", claims, "%", at_most=1.0)
    rows.add("processor time", each(runs, lambda run: run.outcome.cpu_s), "s")
    rows.add("peak memory", each(runs, lambda run: run.outcome.peak_mb), "MB")
    return rows


def run_method(method: str, scene: Scene, out: Path, *, threads: int, environment: dict[str, str]) -> Run:
    """Run one method on one scene in the emptied folder ``out`` and read its result."""
    images, ours = scene.image_paths[0].parent, method in SETTINGS
    clear_folder(out)
    if ours:
        command = [sys.executable, "-m", "thesisrecon", "reconstruct", str(images), "-o", str(out / "run")]
        command += ["--until", "metric"]  # the last stage that the references have
        command += ["--preset", METHODS[method], "--cameras", "shared", "--threads", str(threads)]
        log, cores = out.with_suffix(".log"), own_cores()[:threads]
        process = run_process(command, log=log, cores=cores, environment=environment)
        failure = failure_of(process, last_line(log), 0.0)
    else:
        arguments, failure = (images, out, None, threads, method == COLMAP_PP), ""
        try:
            _, process = call_apart(reconstruct_with_pycolmap, *arguments, cores=threads)
        except RuntimeError as error:
            process, failure = Process(1, 0.0, 0.0, 0.0), str(error).strip().rpartition("\n")[2]
    outcome = Outcome(out, failure, process.wall_s, process.cpu_s, process.peak_mb)
    stated = read_json(out / "run" / "summary.json" if ours else out / "seconds.json") or {}
    if not ours and not failure:
        stated = {"seconds": stated}
        outcome = replace(outcome, wall_s=sum(stated["seconds"].values()))
    return Run(outcome, read_model(scene, method, outcome), stated)


def measure_scene(
    scene: Scene, out: Path, *, threads: int, repeats: int, environment: dict[str, str]
) -> tuple[list[Metric], dict[str, Run]]:
    """Run all methods on one scene in turn; the fastest run of each counts, or one that failed."""
    runs: dict[str, list[Run]] = {method: [] for method in METHODS}
    for _ in range(repeats):
        for method, folder in METHODS.items():
            place = out / scene.name / folder
            run = run_method(method, scene, place, threads=threads, environment=environment)
            report_progress(f"{scene.name}: {method}: {run.outcome.wall_s:.1f} s {run.outcome.failure}")
            runs[method].append(run)
    counted = {
        method: min(found, key=lambda run: (run.outcome.ok, run.outcome.wall_s))
        for method, found in runs.items()
    }
    return check_reconstruction(scene, counted), counted


def warm_up(scene: Scene, out: Path, *, threads: int, environment: dict[str, str]) -> float:
    """Compile the kernels into an empty cache; return the seconds of ``default`` meanwhile."""
    clear_folder(Path(environment["NUMBA_CACHE_DIR"]))
    cold = run_method(OURS, scene, out / "cold" / "default", threads=threads, environment=environment)
    run_method(THESIS, scene, out / "cold" / "thesis", threads=threads, environment=environment)
    report_progress(f"{scene.name}: {OURS}, compiling: {cold.outcome.wall_s:.1f} s {cold.outcome.failure}")
    return cold.outcome.wall_s


def _notes(runs: Mapping[str, Run]) -> str:
    lines = []
    for method, run in runs.items():
        if seconds := run.stated.get("seconds"):
            stages = ", ".join(f"{stage} {float(spent):.2f} s" for stage, spent in seconds.items())
            lines.append(f"- {method}: {stages}")
        lines += [f"- {method} failed: {run.outcome.failure}"] * (not run.outcome.ok)
        refused = run.stated.get("refused", ())
        lines += [f"- {method} refused {item['name']}: {item['reason']}" for item in refused]
    return "\n".join(lines)


def against_colmap_study(
    out: Path, scenes: Sequence[str] = ("courtyard", *REAL_SCENES), repeats: int = 1, threads: int = 2
) -> Iterator[Part]:
    """Run both presets and COLMAP on the same images and compare them with the truth."""
    found = scenes_here(scenes)
    if not found:
        return
    environment = {"NUMBA_CACHE_DIR": str(out / "numba_cache")}
    first = min(found, key=lambda scene: len(scene.image_paths))
    seconds = warm_up(first, out, threads=threads, environment=environment)
    versions = f"python: {platform.python_version()}; pycolmap: {version('pycolmap')}"
    cold = f"first run, kernels compiling: {seconds:.1f} s on {first.name}"
    yield f"machine: {machine()}; threads: {threads}; {versions}; {cold}"
    for scene in found:
        rows, runs = measure_scene(scene, out, threads=threads, repeats=repeats, environment=environment)
        yield rows
        yield _notes(runs)

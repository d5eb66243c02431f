"""Reconstruction compared with COLMAP on the same images: cameras, errors, reprojection, wall time.

Each method runs in its own process on the same number of processor cores. Ours is the command line up to
the metric stage, and its whole time counts; of COLMAP only extraction, matching and mapping count. Every
number is computed here from saved cameras and points.
"""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io._outputs import clear_folder
from thesisrecon.records import Reconstruction
from validation.metrics.cameras import measure_reprojection
from validation.references.colmap import read_colmap_model, read_run
from validation.runs.processes import Process, own_cores, run_process
from validation.runs.results import camera_limit
from validation.runs.study import Part, report_progress
from validation.runs.tables import Metric, Rows, each, machine, slug
from validation.scenes.real import REAL_SCENES, Scene, scenes_here
from validation.stages.cameras import error_rows, fit_rows

OURS, THESIS = "ours (default)", "ours (thesis)"
COLMAP, COLMAP_PP = "COLMAP", "COLMAP, principal point refined"


@dataclass(frozen=True)
class Outcome:
    """Result of one method on one scene: the time that counts and its parts, processor time of the process;
    unregistered image -> ``reasons`` that the method gives; the reprojection error that it states.
    """

    reconstruction: Reconstruction | None
    wall_s: float
    peak_mb: float
    cpu_s: float
    seconds: Mapping[str, float] = field(default_factory=dict)
    failure: str = ""
    reasons: Mapping[str, str] = field(default_factory=dict)
    claimed_rms_px: float | None = None


def check_reconstruction(scene: Scene, outcomes: Mapping[str, Outcome]) -> list[Metric]:
    """Return all rows of one scene, those of the report bounded by its gates."""
    models = {name: outcome.reconstruction for name, outcome in outcomes.items()}
    rows = Rows(scene.name, OURS)
    for metric in (*error_rows(scene, models), *fit_rows(scene, models)):
        bound = {"at_most" if metric.at_most else "at_least": camera_limit(scene.name, slug(metric.name))}
        rows.add(metric.name, metric.values, metric.unit, **bound)
    bounded = COLMAP in outcomes and scene.name in ("fountain-P11", "Herz-Jesus-P8")
    wall_s = each(outcomes, lambda o: o.wall_s)
    rows.add("wall time", wall_s, "s", at_most=wall_s[COLMAP] if bounded else None)
    claims = {
        name: 100.0 * abs(outcome.claimed_rms_px / measure_reprojection(model).rms_px - 1.0)
        for name, outcome in outcomes.items()
        if (model := outcome.reconstruction) is not None and outcome.claimed_rms_px is not None
    }
    rows.add("rms it claims off by", claims, "%", at_most=1.0)
    rows.add("processor time", each(outcomes, lambda o: o.cpu_s), "s")
    rows.add("peak memory", each(outcomes, lambda o: o.peak_mb), "MB")
    return rows


METHODS = {OURS: "default", THESIS: "thesis", COLMAP: "colmap", COLMAP_PP: "colmap-principal-point"}


def run_method(method: str, scene: Scene, out: Path, *, threads: int, environment: dict[str, str]) -> Outcome:
    """Run one method on one scene in the emptied folder ``out`` and read its result."""
    images = scene.image_paths[0].parent
    clear_folder(out)
    command, cores = _command(method, images, out, threads), own_cores()[:threads]
    process = run_process(command, log=out.with_suffix(".log"), cores=cores, environment=environment)
    try:
        if method in (OURS, THESIS):
            return _read_ours(scene, out, process)
        model, seconds = read_run(images, out)
        return Outcome(model, sum(seconds.values()), process.peak_mb, process.cpu_s, seconds=seconds)
    except (StageFailure, OSError) as error:
        failure = f"exit code {process.code}: {error}"
        return Outcome(None, process.wall_s, process.peak_mb, process.cpu_s, failure=failure)


def _command(method: str, images: Path, out: Path, threads: int) -> list[str]:
    if method in (OURS, THESIS):
        ours = [sys.executable, "-m", "thesisrecon", "reconstruct", str(images), "-o", str(out)]
        ours += ["--until", "metric"]  # the last stage that the references have
        return [*ours, "--preset", METHODS[method], "--cameras", "shared", "--threads", str(threads)]
    theirs = [sys.executable, "-m", "validation.references.colmap", str(images), str(out)]
    extra = ["--refine-principal-point"] if method == COLMAP_PP else []
    return [*theirs, "--threads", str(threads), *extra]


def _read_ours(scene: Scene, out: Path, process: Process) -> Outcome:
    """Read cameras and points from the saved model, the rest from summary.json."""
    path = out / "summary.json"
    summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    reasons = {item["name"]: item["reason"] for item in summary.get("refused", [])}
    names = [path.name for path in scene.image_paths]
    model, failure = None, ""
    try:
        model = read_colmap_model(out / "sparse" / "0", names)
    except UsageError as missing:
        failure = str(summary.get("failure") or f"exit code {process.code}: {missing}")
    seconds = {stage: float(spent) for stage, spent in (summary.get("seconds") or {}).items()}
    used, claimed = (process.wall_s, process.peak_mb, process.cpu_s), summary.get("reprojection_rms_px")
    return Outcome(model, *used, seconds, failure, reasons, claimed)


def measure_scene(
    scene: Scene, out: Path, *, threads: int, repeats: int, environment: dict[str, str]
) -> tuple[list[Metric], dict[str, Outcome]]:
    """Run all methods on one scene in turn; the fastest run of each counts, or one that failed."""
    runs: dict[str, list[Outcome]] = {method: [] for method in METHODS}
    for _ in range(repeats):
        for method, folder in METHODS.items():
            place = out / scene.name / folder
            outcome = run_method(method, scene, place, threads=threads, environment=environment)
            report_progress(f"{scene.name}: {method}: {outcome.wall_s:.1f} s {outcome.failure}")
            runs[method].append(outcome)
    outcomes = {
        method: min(found, key=lambda run: (not run.failure, run.wall_s)) for method, found in runs.items()
    }
    return check_reconstruction(scene, outcomes), outcomes


def warm_up(scene: Scene, out: Path, *, threads: int, environment: dict[str, str]) -> float:
    """Compile the kernels into an empty cache; return the seconds of ``default`` meanwhile."""
    clear_folder(Path(environment["NUMBA_CACHE_DIR"]))
    cold = run_method(OURS, scene, out / "cold" / "default", threads=threads, environment=environment)
    run_method(THESIS, scene, out / "cold" / "thesis", threads=threads, environment=environment)
    report_progress(f"{scene.name}: {OURS}, compiling: {cold.wall_s:.1f} s {cold.failure}")
    return cold.wall_s


def _notes(outcomes: dict[str, Outcome]) -> str:
    lines = []
    for method, run in outcomes.items():
        if run.seconds:
            stages = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in run.seconds.items())
            lines.append(f"- {method}: {stages}")
        lines += [f"- {method} failed: {run.failure}"] * bool(run.failure)
        lines += [f"- {method} refused {name}: {reason}" for name, reason in run.reasons.items()]
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
        rows, outcomes = measure_scene(scene, out, threads=threads, repeats=repeats, environment=environment)
        yield rows
        yield _notes(outcomes)

"""Reconstruction compared with COLMAP on the same images: cameras, errors, reprojection, wall time.

Each method runs in its own process on the same number of processor cores. Ours is the command line up to
the metric stage, and its whole time counts; of COLMAP only extraction, matching and mapping count. Every
number is computed here from saved cameras and points.
"""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io._outputs import clear_folder
from thesisrecon.records import Reconstruction
from validation.metrics.cameras import (
    CameraErrors,
    Reprojection,
    TrueCameras,
    measure_cameras,
    measure_reprojection,
)
from validation.references.colmap import read_run
from validation.references.colmap_reading import read_colmap_model
from validation.runs.gates import camera_limit
from validation.runs.processes import Process, own_cores, run_process
from validation.runs.scenes import truth_of
from validation.runs.study import Part, report_progress
from validation.runs.tables import Metric, Rows
from validation.scenes.real import REAL_SCENES, Scene, scenes_here
from validation.stamp import machine

OURS, THESIS = "ours (default)", "ours (thesis)"
COLMAP, COLMAP_PP = "COLMAP", "COLMAP, principal point refined"

CLAIM_TOLERANCE_PCT = 1.0
TIMED_SCENES = ("fountain-P11", "Herz-Jesus-P8")


@dataclass(frozen=True)
class Outcome:
    """Result of one method on one scene.

    ``reconstruction``: none after a failure; ``wall_s``, ``seconds``: the time that counts, and its parts;
    ``cpu_s``: processor time of the whole process; ``failure``: message of the failure; ``reasons``:
    unregistered image -> reason that the method gives; ``claimed_rms_px``: reprojection error that the
    method states.
    """

    reconstruction: Reconstruction | None
    wall_s: float
    peak_mb: float
    cpu_s: float
    seconds: Mapping[str, float] = field(default_factory=dict)
    failure: str = ""
    reasons: Mapping[str, str] = field(default_factory=dict)
    claimed_rms_px: float | None = None


def check_reconstruction(
    scene: str, n_views: int, truth: TrueCameras | None, outcomes: Mapping[str, Outcome]
) -> list[Metric]:
    """Return all rows of one scene, bounded by the gates of the report; truth may be None.

    ``outcomes`` maps methods to their results.
    """
    models = {name: outcome.reconstruction for name, outcome in outcomes.items()}
    limit = partial(camera_limit, scene)
    residuals = {name: None if m is None else measure_reprojection(m) for name, m in models.items()}
    rows = Rows(scene, OURS)

    registered = {name: 0.0 if m is None else float(m.registered.sum()) for name, m in models.items()}
    share = limit("registered")
    least = None if share is None else float(np.ceil(share / 100.0 * n_views))
    rows.add(f"cameras registered of {n_views}", registered, at_least=least)
    if truth is not None:
        errors = {name: None if m is None else measure_cameras(m, truth) for name, m in models.items()}
        read: dict[str, tuple[str, str, Callable[[CameraErrors], float | None]]] = {
            "focal error": ("%", "focal-error", lambda e: e.focal_error_pct),
            "principal point error": ("px", "principal-point-error", lambda e: e.principal_point_error_px),
            "mean camera-centre error": ("mm", "centre-error", lambda e: e.centre_error_mm),
            "median rotation error": ("deg", "rotation-error", lambda e: e.rotation_error_deg),
        }
        for name, (unit, gate, number) in read.items():
            rows.each(name, errors, number, unit, at_most=limit(gate))
    rows.each("median reprojection", residuals, lambda r: r.median_px, "px", at_most=limit("reprojection"))
    rows.each("mean reprojection", residuals, lambda r: r.mean_px, "px")
    rows.each("points", models, lambda m: float(m.valid.sum()))
    rows.each("observations", residuals, lambda r: float(r.observations))
    colmap_s = outcomes[COLMAP].wall_s if COLMAP in outcomes and scene in TIMED_SCENES else None
    rows.each("wall time", outcomes, lambda o: o.wall_s, "s", at_most=colmap_s)
    rows.add("rms it claims off by", _claims(outcomes, residuals), "%", at_most=CLAIM_TOLERANCE_PCT)
    rows.each("processor time", outcomes, lambda o: o.cpu_s, "s")
    rows.each("peak memory", outcomes, lambda o: o.peak_mb, "MB")
    return rows


def _claims(
    outcomes: Mapping[str, Outcome], residuals: Mapping[str, Reprojection | None]
) -> dict[str, float | None]:
    differences: dict[str, float | None] = {}
    for name, outcome in outcomes.items():
        measured, claimed = residuals[name], outcome.claimed_rms_px
        if measured is not None and claimed is not None:
            differences[name] = 100.0 * abs(claimed / measured.rms_px - 1.0)
    return differences


METHODS = {OURS: "default", THESIS: "thesis", COLMAP: "colmap", COLMAP_PP: "colmap-principal-point"}


def run_method(method: str, scene: Scene, out: Path, *, threads: int, environment: dict[str, str]) -> Outcome:
    """Run one method on one scene in the emptied folder ``out`` and read its result."""
    images = scene.image_paths[0].parent
    clear_folder(out)
    process = run_process(
        _command(method, images, out, threads),
        log=out.with_suffix(".log"),
        cores=own_cores()[:threads],
        environment=environment,
    )
    read = _read_colmap if method in (COLMAP, COLMAP_PP) else _read_ours
    try:
        return read(scene, out, process)
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
    return Outcome(
        model,
        process.wall_s,
        process.peak_mb,
        process.cpu_s,
        seconds=_stage_seconds(summary),
        failure=failure,
        reasons=reasons,
        claimed_rms_px=summary.get("reprojection_rms_px"),
    )


def _stage_seconds(summary: dict[str, Any]) -> dict[str, float]:
    seconds = summary.get("seconds")
    return {k: float(v) for k, v in seconds.items()} if isinstance(seconds, dict) else {}


def _read_colmap(scene: Scene, out: Path, process: Process) -> Outcome:
    run = read_run(scene.image_paths[0].parent, out)
    wall_s = sum(run.seconds.values())
    return Outcome(run.reconstruction, wall_s, process.peak_mb, process.cpu_s, seconds=run.seconds)


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
    rows = check_reconstruction(scene.name, len(scene.image_paths), truth_of(scene), outcomes)
    return rows, outcomes


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
    out: Path,
    scenes: Sequence[str] = ("courtyard", *REAL_SCENES),
    repeats: int = 1,
    threads: int = 2,
) -> Iterator[Part]:
    """Run both presets and COLMAP on the same images and compare them with the truth."""
    found = scenes_here(scenes)
    if not found:
        return
    environment = {"NUMBA_CACHE_DIR": str(out / "numba_cache")}
    first = min(found, key=lambda scene: len(scene.image_paths))
    seconds = warm_up(first, out, threads=threads, environment=environment)
    facts: dict[str, Any] = {
        "machine": machine(),
        "threads": threads,
        "python": platform.python_version(),
        "pycolmap": version("pycolmap"),
        "first run, kernels compiling": f"{seconds:.1f} s on {first.name}",
    }
    yield "; ".join(f"{name}: {value}" for name, value in facts.items())
    for scene in found:
        rows, outcomes = measure_scene(scene, out, threads=threads, repeats=repeats, environment=environment)
        yield rows
        yield _notes(outcomes)

"""The main job and COLMAP on the same photographs in one run: ``python -m validation.main_job -o OUT``.

Each method runs as a process of its own on the same number of processor cores; ours is the command line a
user types, report and all, and its whole life counts. Of COLMAP only extraction, matching and mapping count.
OUT gets ``main_job.md`` and ``main_job.json``; the exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from thesisrecon.errors import StageFailure
from thesisrecon.io.colmap import reconstruction_from_colmap
from thesisrecon.io.colmap_files import read_colmap_model
from thesisrecon.io.files import write_text
from validation.studies.reconstruction import COLMAP, COLMAP_PP, OURS, THESIS, Outcome, check_reconstruction
from validation.harness.process import Process, own_cores, run_process
from validation.metrics.cameras import TrueCameras
from validation.metrics.record import Metric, markdown_table, summary_table
from validation.references.colmap_mapping import read_run
from validation.scenes.real import REAL_SCENES, Scene, load_fixture_scene, load_real_scene

METHODS = {OURS: "default", THESIS: "thesis", COLMAP: "colmap", COLMAP_PP: "colmap-principal-point"}


README_BEGIN, README_END = "<!-- measured: begin -->", "<!-- measured: end -->"
README_ROWS = (
    "cameras registered",
    "focal error",
    "principal point error",
    "mean camera-centre error",
    "median rotation error",
    "median reprojection",
    "points",
    "wall time",
    "peak memory",
)


def run_method(method: str, scene: Scene, out: Path, *, threads: int, environment: dict[str, str]) -> Outcome:
    """Run one method on one scene in the folder ``out``, emptied first, and read what it saved."""
    images = scene.image_paths[0].parent
    shutil.rmtree(out, ignore_errors=True)
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
        ours += ["--until", "metric"]  # as far as the mappings of the references go
        return [*ours, "--preset", METHODS[method], "--cameras", "shared", "--threads", str(threads)]
    theirs = [sys.executable, "-m", "validation.references.colmap_run", str(images), str(out)]
    extra = ["--refine-principal-point"] if method == COLMAP_PP else []
    return [*theirs, "--threads", str(threads), *extra]


def _read_ours(scene: Scene, out: Path, process: Process) -> Outcome:
    """Cameras and points from the saved model; reasons, times and claims from summary.json."""
    told = out / "summary.json"
    summary: dict[str, Any] = json.loads(told.read_text(encoding="utf-8")) if told.is_file() else {}
    reasons = {item["name"]: item["reason"] for item in summary.get("refused", [])}
    names = [path.name for path in scene.image_paths]
    model, failure = None, ""
    try:
        model = reconstruction_from_colmap(read_colmap_model(out / "sparse" / "0"), names=names)
    except StageFailure as missing:
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


def find_scenes(names: list[str]) -> list[Scene]:
    """The scenes of these names; those whose photographs are not on this machine are named and left out."""
    scenes = []
    for name in names:
        scene = load_real_scene(name) if name in REAL_SCENES else load_fixture_scene(name)
        if scene is None:
            print(f"{name}: its photographs are not on this machine, left out", flush=True)
        else:
            scenes.append(scene)
    return scenes


def measure_scene(
    scene: Scene, out: Path, *, threads: int, repeats: int, environment: dict[str, str]
) -> tuple[list[Metric], dict[str, Outcome]]:
    """All methods on one scene; with repeats, the methods take turns and the fastest run of each counts."""
    outcomes: dict[str, Outcome] = {}
    for _ in range(repeats):
        for method, folder in METHODS.items():
            place = out / scene.name / folder
            outcome = run_method(method, scene, place, threads=threads, environment=environment)
            print(f"{scene.name}: {method}: {outcome.wall_s:.1f} s {outcome.failure}", flush=True)
            if method not in outcomes or outcome.wall_s < outcomes[method].wall_s:
                outcomes[method] = outcome
    truth = None
    if scene.K is not None and scene.R is not None and scene.C is not None:
        truth = TrueCameras(scene.K, scene.R, scene.C)
    return check_reconstruction(scene.name, len(scene.image_paths), truth, outcomes), outcomes


def warm_up(scene: Scene, out: Path, *, threads: int, environment: dict[str, str]) -> float:
    """Fill the empty cache of compiled kernels; the seconds of ``default`` while it compiles."""
    shutil.rmtree(environment["NUMBA_CACHE_DIR"], ignore_errors=True)
    cold = run_method(OURS, scene, out / "cold" / "default", threads=threads, environment=environment)
    run_method(THESIS, scene, out / "cold" / "thesis", threads=threads, environment=environment)
    print(f"{scene.name}: {OURS}, compiling: {cold.wall_s:.1f} s {cold.failure}", flush=True)
    return cold.wall_s


def write_results(
    out: Path, rows: dict[str, list[Metric]], outcomes: dict[str, dict[str, Outcome]], facts: dict[str, Any]
) -> None:
    """``main_job.md`` and ``main_job.json`` in ``out``."""
    parts = [f"{name}: {value}" for name, value in facts.items()]
    text = ["# The main job beside COLMAP", "", "; ".join(parts) + ".", ""]
    told: dict[str, Any] = {"facts": facts, "scenes": {}}
    for scene, metrics in rows.items():
        runs = outcomes[scene]
        stages = {m: {k: round(s, 2) for k, s in run.seconds.items()} for m, run in runs.items()}
        failures = {m: run.failure for m, run in runs.items() if run.failure}
        refused = {m: dict(run.reasons) for m, run in runs.items() if run.reasons}
        text += [f"## {scene}", "", markdown_table(metrics), ""]
        text += [
            f"- {m}: {', '.join(f'{k} {s} s' for k, s in part.items())}" for m, part in stages.items() if part
        ]
        text += [f"- {m} failed: {failure}" for m, failure in failures.items()]
        text += [f"- {m} refused {n}: {why}" for m, part in refused.items() for n, why in part.items()]
        text += [""]
        told["scenes"][scene] = {
            "rows": [{**asdict(metric), "verdict": metric.verdict} for metric in metrics],
            "seconds": stages,
            "failures": failures,
            "refused": refused,
        }
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "main_job.md", "\n".join(text))
    write_text(out / "main_job.json", json.dumps(told, indent=1) + "\n")


def write_readme(readme: Path, rows: dict[str, list[Metric]], facts: dict[str, Any]) -> None:
    """The summary of all scenes between the markers of a README."""
    text = readme.read_text(encoding="utf-8")
    before, rest = text.split(README_BEGIN)
    _, after = rest.split(README_END)
    table = summary_table([metric for metrics in rows.values() for metric in metrics], README_ROWS)
    told = "; ".join(f"{name}: {value}" for name, value in facts.items())
    measured = f"{README_BEGIN}\n{table}\n\n{told}.\n{README_END}"
    write_text(readme, before + measured + after)


def main(arguments: list[str] | None = None) -> int:
    """Measure, write, and say whether every target was reached."""
    parser = argparse.ArgumentParser(prog="python -m validation.main_job", description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=["courtyard", *REAL_SCENES])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--readme", type=Path, help="a README whose table of measurements is to be replaced")
    wishes = parser.parse_args(arguments)
    out = wishes.out.resolve()
    scenes = find_scenes(wishes.scenes)
    if not scenes:
        parser.error("none of these scenes is on this machine")
    environment = {"NUMBA_CACHE_DIR": str(out / "numba_cache")}
    cold_scene = min(scenes, key=lambda scene: len(scene.image_paths))
    facts: dict[str, Any] = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
        "threads": wishes.threads,
        "python": platform.python_version(),
        "pycolmap": version("pycolmap"),
        "first run, kernels compiling": "",
    }
    seconds = warm_up(cold_scene, out, threads=wishes.threads, environment=environment)
    facts["first run, kernels compiling"] = f"{seconds:.1f} s on {cold_scene.name}"
    rows, outcomes = {}, {}
    for scene in scenes:
        rows[scene.name], outcomes[scene.name] = measure_scene(
            scene, out, threads=wishes.threads, repeats=wishes.repeats, environment=environment
        )
        # Written after each scene, so that a run cut short keeps what it has.
        write_results(out, rows, outcomes, facts)
    if wishes.readme is not None:
        write_readme(wishes.readme, rows, facts)
    print((out / "main_job.md").read_text(encoding="utf-8"))
    return int(any(metric.verdict == "missed" for metrics in rows.values() for metric in metrics))


if __name__ == "__main__":
    sys.exit(main())

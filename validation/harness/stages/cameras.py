"""Chapters 4 to 7: intrinsics and cameras of images beside COLMAP's mappers and the truth."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

import thesisrecon
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.errors import StageFailure
from thesisrecon.io._files import read_json
from thesisrecon.io.colmap import reconstruction_from_colmap
from thesisrecon.io.colmap_model import read_colmap_model
from thesisrecon.records import Reconstruction
from thesisrecon.runtime._run_folder import MANIFEST_FILE, RunDirectory
from thesisrecon.runtime.run import FOLDERS
from thesisrecon.settings import config_from_tables
from validation.harness.records import Judgement, Outcome, Plot, ReportOptions, Task
from validation.harness.scenes import is_photographs, load_photographs, truth_of
from validation.metrics.cameras import CameraErrors, measure_cameras, measure_reprojection
from validation.metrics.intervals import focal_errors_pct
from validation.metrics.record import Metric
from validation.references.colmap_mapping import Start, map_with_pycolmap
from validation.references.colmap_matching import match_with_pycolmap
from validation.scenes.real import Scene

OURS, THESIS, PER_IMAGE = "ours", "ours (thesis)", "ours (a camera each)"
COLMAP, COLMAP_PP, COLMAP_GLOBAL = "COLMAP", "COLMAP, pp refined", "COLMAP, global"
MATCHES = "COLMAP, matches"
FIXTURE = "courtyard"
"""Scene of the gates of the thesis preset, always available."""
SETTINGS: dict[str, PipelineConfig] = {
    OURS: preset("default"),
    THESIS: preset("thesis"),
    PER_IMAGE: config_from_tables({"intrinsics": {"cameras": "per-image"}}),
}
MAPPERS = {COLMAP: "default", COLMAP_PP: "principal-point", COLMAP_GLOBAL: "global"}
FOCAL = "median |f / f_true - 1|, f = sqrt(fx fy), over the registered cameras"
CENTRE = "mean distance of the camera centres after the least-squares similarity"
PRINCIPAL_POINT = "median distance from the true one"
REPROJECTION = "median distance of inlier observations from their projected points"
ROTATION = "median angle after the rotation common to all cameras is taken off"
SHARE_HELD = "share of focal lengths and principal points whose stated 95 % interval contains the truth"


class CamerasStage:
    """Reconstruction by ours and by COLMAP without priors on the same images."""

    name = "cameras"
    title = "Cameras and intrinsics"
    definition = (
        "From images without any camera prior: the default and the thesis' preset beside "
        "COLMAP (default, with the principal point refined, and its global mapper), one thread each. "
        "Every number is recomputed from the saved cameras and points."
    )

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return is_photographs(scene, options)

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        if options.gates_only:
            return (OURS, THESIS) if scene == FIXTURE else (OURS, PER_IMAGE)
        return (
            (OURS, MATCHES, COLMAP, THESIS) if options.quick else (OURS, MATCHES, PER_IMAGE, THESIS, *MAPPERS)
        )

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        if method == PER_IMAGE:
            return ((self.name, OURS),)
        return ((self.name, MATCHES),) if method in MAPPERS else ()

    def run(self, task: Task, options: ReportOptions) -> None:
        scene = load_photographs(task.scene, options)
        place = options.place(task.stage, task.scene, task.method)
        if task.method not in SETTINGS:
            _run_colmap(task, scene, options, place)
            return
        if task.method == PER_IMAGE:
            # The matches are the same.
            matched = options.place(self.name, task.scene, OURS) / "run"
            shutil.copytree(matched, place / "run", dirs_exist_ok=True)
        thesisrecon.reconstruct(
            list(scene.image_paths),
            place / "run",
            config=SETTINGS[task.method],
            seed=options.seed,
            threads=1,
            until="metric",
            overwrite=True,
        )

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        photographs = load_photographs(scene, options)
        models = {m: read_model(photographs, m, o) for m, o in outcomes.items() if m != MATCHES}
        shared = outcomes.get(MATCHES)
        metrics = [*_numbers(photographs, models), *_costs(scene, outcomes, shared)]
        metrics += _before_adjustment(photographs, outcomes.get(OURS))
        metrics += [*_per_image(photographs, models.get(PER_IMAGE)), *_stated(photographs, outcomes)]
        notes = [f"{name}: {o.failure}." for name, o in outcomes.items() if not o.ok]
        return Judgement(metrics, plots=_plots(photographs, models), notes=notes)


def read_model(scene: Scene, method: str, outcome: Outcome) -> Reconstruction | None:
    """Return the saved model of a method in image order, or None."""
    names = [path.name for path in scene.image_paths]
    try:
        if method in SETTINGS:
            return reconstruction_from_colmap(
                read_colmap_model(outcome.place / "run" / "sparse" / "0"), names=names
            )
        folders = sorted(path for path in (outcome.place / "sparse").glob("*") if path.is_dir())
        if not folders:
            return None
        largest = max((read_colmap_model(path) for path in folders), key=lambda model: len(model.images))
        return reconstruction_from_colmap(largest, names=names)
    except (StageFailure, OSError):
        return None


def _run_colmap(task: Task, scene: Scene, options: ReportOptions, place: Path) -> None:
    images = scene.image_paths[0].parent
    if task.method == MATCHES:
        match_with_pycolmap(images, place, threads=1)
        return
    matched = options.place(task.stage, task.scene, MATCHES)
    start = Start(refine_principal_point=task.method == COLMAP_PP)
    mapper: Literal["incremental", "global"] = "global" if task.method == COLMAP_GLOBAL else "incremental"
    map_with_pycolmap(images, matched, place, start=start, threads=1, mapper=mapper)


def _numbers(scene: Scene, models: Mapping[str, Reconstruction | None]) -> list[Metric]:
    registered = {n: 0.0 if m is None else float(m.registered.mean() * 100) for n, m in models.items()}
    words = "share of the images"
    rows = [Metric(scene.name, "registered", "%", registered, OURS, at_most=False, definition=words)]
    return [*rows, *_errors(scene, models), *_fit(scene, models)]


def _errors(scene: Scene, models: Mapping[str, Reconstruction | None]) -> list[Metric]:
    """Compare the cameras with the true ones, if known."""
    truth = truth_of(scene)
    if truth is None:
        return []
    errors = {n: None if m is None else measure_cameras(m, truth) for n, m in models.items()}

    def row(name: str, unit: str, read: Callable[[CameraErrors], float | None], words: str) -> list[Metric]:
        values = {n: None if e is None else read(e) for n, e in errors.items()}
        found = [Metric(scene.name, name, unit, values, OURS, definition=words)]
        if THESIS in values:
            of_thesis = {OURS: values[THESIS]}
            found.append(Metric(scene.name, f"{THESIS}: {name}", unit, of_thesis, OURS, definition=words))
        return found

    return [
        *row("focal error", "%", lambda e: e.focal_error_pct, FOCAL),
        *row("principal point error", "px", lambda e: e.principal_point_error_px, PRINCIPAL_POINT),
        *row("centre error", "mm", _millimetres, CENTRE),
        *row("rotation error", "deg", lambda e: e.rotation_error_deg, ROTATION),
    ]


def _fit(scene: Scene, models: Mapping[str, Reconstruction | None]) -> list[Metric]:
    """Return reprojection errors and numbers of points."""
    residuals = {n: None if m is None else measure_reprojection(m) for n, m in models.items()}
    points = {n: None if m is None else float(m.valid.sum()) for n, m in models.items()}
    median = {n: None if r is None else r.median_px for n, r in residuals.items()}
    seen = {n: r.observations / p if r and (p := points[n]) else None for n, r in residuals.items()}

    def row(name: str, unit: str, values: dict[str, float | None], more: bool, words: str) -> Metric:
        return Metric(scene.name, name, unit, values, OURS, at_most=not more, definition=words)

    return [
        row("reprojection", "px", median, False, REPROJECTION),
        row("observations a point", "", seen, True, "inlier observations over points"),
        row("points", "", points, True, "valid points of the model"),
    ]


def _before_adjustment(scene: Scene, outcome: Outcome | None) -> list[Metric]:
    """Evaluate chapters 6 and 7 separately, before the metric stage corrects their errors."""
    if outcome is None or not outcome.ok:
        return []
    projective = _kept(outcome, "projective")
    t, P, X = projective.tracks, projective.P, projective.X
    seen = projective.inlier & projective.registered[t.view_index] & projective.valid[t.point_index]
    x = np.einsum("kab,kb->ka", P[t.view_index[seen]], X[t.point_index[seen]])
    residual = float(np.median(np.linalg.norm(x[:, :2] / x[:, 2:] - t.xy[seen], axis=1)))
    words = f"{REPROJECTION}, by the projective model"
    rows = [Metric(scene.name, "projective reprojection", "px", {OURS: residual}, OURS, definition=words)]
    if scene.K is None:
        return rows
    K = _kept(outcome, "selfcalibration").K
    known = np.isfinite(K).all(axis=(1, 2)) & (K[:, 0, 0] > 0.0)
    error = float(np.median(focal_errors_pct(K[known], scene.K[known])))
    words = f"{FOCAL}, as self-calibration leaves it"
    return [
        *rows,
        Metric(scene.name, "self-calibrated focal error", "%", {OURS: error}, OURS, definition=words),
    ]


def _kept(outcome: Outcome, stage: str) -> Any:
    """Return the last record of a stage of the run."""
    folder = RunDirectory(outcome.place / "run").stage(FOLDERS[stage])
    *_, (item, key) = read_json(folder.path / MANIFEST_FILE)["keys"].items()
    return folder.load(item, key)


def _costs(scene: str, outcomes: Mapping[str, Outcome], shared: Outcome | None) -> list[Metric]:
    """Return processor seconds and memory; COLMAP's mappers include the shared matching."""

    def seconds(name: str, outcome: Outcome) -> float | None:
        if not outcome.ok:
            return None
        return outcome.cpu_s + (shared.cpu_s if shared is not None and name in MAPPERS else 0.0)

    kept = {n: o for n, o in outcomes.items() if n != MATCHES}
    times = {n: seconds(n, o) for n, o in kept.items()}
    memory = {n: o.peak_mb if o.ok else None for n, o in kept.items()}
    return [
        Metric(scene, "time", "s", times, OURS, definition="processor seconds from images to cameras"),
        Metric(scene, "peak memory", "MB", memory, OURS, definition="of the process"),
    ]


def _per_image(scene: Scene, model: Reconstruction | None) -> list[Metric]:
    """Return errors of focal lengths with independent cameras."""
    if scene.K is None or model is None or model.K is None or not model.registered.any():
        return []
    errors = focal_errors_pct(model.K[model.registered], scene.K[model.registered])
    words = "|f / f_true - 1| over the images, with independent cameras"
    return [
        Metric(
            scene.name,
            "focal error, a camera each",
            "%",
            {OURS: float(np.median(errors))},
            OURS,
            definition=f"median {words}",
        ),
        Metric(
            scene.name,
            "worst focal error, a camera each",
            "%",
            {OURS: float(errors.max())},
            OURS,
            definition=f"largest {words}",
        ),
    ]


def _stated(scene: Scene, outcomes: Mapping[str, Outcome]) -> list[Metric]:
    """Return self-check results and the coverage of the stated intervals."""
    records: dict[str, dict[str, Any]] = {}
    for name in (n for n in SETTINGS if n in outcomes and outcomes[n].ok):
        text = (outcomes[name].place / "run" / "summary.json").read_text(encoding="utf-8")
        records[name] = json.loads(text)
    trusted: dict[str, float | None] = {n: float(bool(t["trusted"])) for n, t in records.items()}
    silent = {n: float(sum(not r["reason"] for r in t["refused"])) for n, t in records.items()}
    rows = [
        Metric(
            scene.name, "trusted", "", trusted, OURS, at_most=False, definition="1: passed its self-check"
        ),
        Metric(scene.name, "refused without a reason", "", {**silent}, OURS, definition="photographs"),
    ]
    truth = truth_of(scene)
    if truth is None or not records:
        return rows
    for name, where in ((OURS, ""), (PER_IMAGE, ", a camera each")):
        cameras = records.get(name, {}).get("cameras", [])
        held: dict[str, float | None] = {OURS: _share_held(cameras, truth.K) if cameras else None}
        widest = {OURS: _widest(cameras)}
        words = "largest stated standard deviation of a focal length"
        rows += [
            Metric(
                scene.name,
                f"intervals that hold{where}",
                "%",
                held,
                OURS,
                at_most=False,
                definition=SHARE_HELD,
            ),
            Metric(scene.name, f"widest focal interval{where}", "%", widest, OURS, definition=words),
        ]
    return rows


def _widest(cameras: list[dict[str, Any]]) -> float | None:
    focals = [c["focal_px"] for c in cameras if c.get("focal_px")]
    return max((100.0 * f["std"] / f["value"] for f in focals), default=None)


def _share_held(cameras: list[dict[str, Any]], K: np.ndarray[Any, Any]) -> float | None:
    places = {"focal_px": None, "principal_x_px": (0, 2), "principal_y_px": (1, 2)}
    held = []
    for camera, true_K in zip(cameras, K, strict=True):
        for name, place in places.items():
            interval = camera.get(name)
            if interval is None or not interval["std"]:
                continue
            truth = np.sqrt(true_K[0, 0] * true_K[1, 1]) if place is None else true_K[place]
            held.append(abs(interval["value"] - truth) <= 1.96 * interval["std"])
    return 100.0 * float(np.mean(held)) if held else None


def _millimetres(errors: CameraErrors) -> float | None:
    return None if errors.centre_error is None else 1000.0 * errors.centre_error


def _plots(scene: Scene, models: Mapping[str, Reconstruction | None]) -> list[Plot]:
    """Plot the focal length of every image by each method, and the true one."""
    traces: list[dict[str, Any]] = []
    for name, model in models.items():
        if model is None:
            continue
        focal = _focals(model)
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "x": list(range(1, len(focal) + 1)),
                "y": focal,
            }
        )
    if scene.K is not None:
        true = np.sqrt(scene.K[:, 0, 0] * scene.K[:, 1, 1]).tolist()
        marker = {"symbol": "line-ew-open", "size": 18, "color": "#1b2733"}
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": "truth",
                "x": list(range(1, len(true) + 1)),
                "y": true,
                "marker": marker,
            }
        )
    layout = {
        "xaxis": {"title": {"text": "photograph"}},
        "yaxis": {"title": {"text": "focal length (px)"}},
        "margin": {"l": 70, "r": 10, "t": 10, "b": 50},
    }
    return [Plot("Focal lengths", {"data": traces, "layout": layout})]


def _focals(model: Reconstruction) -> list[float | None]:
    assert model.K is not None
    found = np.sqrt(model.K[:, 0, 0] * model.K[:, 1, 1])
    return [float(f) if seen else None for f, seen in zip(found, model.registered, strict=True)]

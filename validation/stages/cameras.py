"""Chapters 4 to 7: intrinsics and cameras compared with COLMAP's mappers and the truth."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np

import thesisrecon
from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.config.text import config_from_tables
from thesisrecon.errors import StageFailure
from thesisrecon.io._files import read_json
from thesisrecon.pipeline.run import FOLDERS
from thesisrecon.records import Reconstruction
from thesisrecon.runtime._run_folder import MANIFEST_FILE, RunDirectory
from validation.metrics.cameras import (
    area_under_recall,
    focal_errors_pct,
    measure_cameras,
    measure_reprojection,
    pose_pair_errors,
)
from validation.references.colmap import (
    map_with_pycolmap,
    match_with_pycolmap,
    principal_points_by_pycolmap,
    read_colmap_model,
)
from validation.references.libraries import NoReference
from validation.runs.records import IMAGE_SCENES, Judgement, Outcome, ReportOptions, Stage, Task, load_images
from validation.runs.tables import OURS, Metric, Plot, Values, each, plot, row, scatter
from validation.scenes.real import Scene

THESIS, PER_IMAGE = "ours (thesis)", "ours (a camera each)"
COLMAP, COLMAP_PP, COLMAP_GLOBAL = "COLMAP", "COLMAP, pp refined", "COLMAP, global"
MATCHES = "COLMAP, matches"
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
AUC = "area under the recall of relative poses over thresholds, all pairs; missing cameras fail"
SHARE_HELD = "share of focal lengths and principal points whose stated 95 % interval contains the truth"


class CamerasStage(Stage):
    """Reconstruction by ours and by COLMAP without priors on the same images."""

    name = "cameras"
    scenes, own = IMAGE_SCENES, True

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        if options.gates_only:
            if scene == "courtyard":
                return (OURS, THESIS)
            return (OURS, PER_IMAGE) if load_images(scene, options).has_truth else (OURS,)
        if options.quick:
            return (OURS, MATCHES, COLMAP, THESIS)
        return (OURS, MATCHES, PER_IMAGE, THESIS, *MAPPERS)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        if method == PER_IMAGE:
            return ((self.name, OURS),)
        return ((self.name, MATCHES),) if method in MAPPERS else ()

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        scene = load_images(task.scene, options)
        if task.method not in SETTINGS:
            _run_colmap(task, scene, options, folder)
            return
        run, config = folder / "run", SETTINGS[task.method]
        if task.method == PER_IMAGE:
            # The matches are the same.
            shutil.copytree(options.folder(self.name, task.scene, OURS) / "run", run, dirs_exist_ok=True)
        paths, seed = list(scene.image_paths), options.seed
        thesisrecon.reconstruct(
            paths, run, config=config, seed=seed, threads=1, until="metric", overwrite=True
        )

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        images = load_images(scene, options)
        models = {m: read_model(images, m, o) for m, o in outcomes.items() if m != MATCHES}
        metrics = [*error_rows(images, models), *fit_rows(images, models), *_costs(scene, outcomes)]
        metrics += [*_before_adjustment(images, outcomes.get(OURS)), *_as_colmap_reads(images, outcomes)]
        metrics += [
            replace(m, name=f"{THESIS}: {m.name}", values={OURS: m.values[THESIS]})
            for m in metrics
            if THESIS in m.values and m.name.endswith(" error")
        ]
        metrics += [*_per_image(images, models.get(PER_IMAGE)), *_stated(images, outcomes)]
        known, total = int(images.known.sum()), len(images.image_paths)
        partly = 0 < known < total
        notes = (
            [f"The truth has cameras of {known} of {total} images; errors are of those."] if partly else []
        )
        return Judgement(metrics, notes, plots=[_plot(images, models)])


def read_model(scene: Scene, method: str, outcome: Outcome) -> Reconstruction | None:
    """Return the saved model of a method in image order, or None."""
    names = [path.name for path in scene.image_paths]
    folder = outcome.folder / "run" if method in SETTINGS else outcome.folder
    try:
        folders = [path for path in sorted((folder / "sparse").glob("*")) if path.is_dir()]
        models = [read_colmap_model(path, names) for path in folders]
        return max(models, key=lambda model: model.registered.sum(), default=None)
    except (StageFailure, OSError):
        return None


def our_model(scene: Scene, options: ReportOptions) -> Reconstruction:
    """Return our saved reconstruction of a scene; ``ValueError`` if missing."""
    model = read_model(scene, OURS, Outcome(options.folder("cameras", scene.name, OURS)))
    if model is None:
        raise ValueError(f"our model of {scene.name} is missing: run the stage cameras too")
    return model


def _run_colmap(task: Task, scene: Scene, options: ReportOptions, folder: Path) -> None:
    images = scene.image_paths[0].parent
    if task.method == MATCHES:
        match_with_pycolmap(images, folder, threads=1)
        return
    matched = options.folder(task.stage, task.scene, MATCHES)
    mapper: Literal["incremental", "global"] = "global" if task.method == COLMAP_GLOBAL else "incremental"
    refined = task.method == COLMAP_PP
    given: dict[str, Any] = {"matched": matched, "refine_principal_point": refined, "mapper": mapper}
    map_with_pycolmap(images, folder, threads=1, **given)


def error_rows(scene: Scene, models: Mapping[str, Reconstruction | None]) -> list[Metric]:
    """Return the share of registered images, errors of cameras and the recall of relative poses."""
    registered = {n: 0.0 if m is None else float(m.registered.mean() * 100) for n, m in models.items()}
    rows = [row(scene.name, "registered", "%", registered, "share of the images", more=True)]
    truth = scene.cameras_of(range(len(scene.image_paths)))
    errors = {n: None if m is None else measure_cameras(m, truth) for n, m in models.items()}
    for name, unit, field, text in (
        ("focal error", "%", "focal_error_pct", FOCAL),
        ("principal point error", "px", "principal_point_error_px", PRINCIPAL_POINT),
        ("centre error", "mm", "centre_error_mm", CENTRE),
        ("rotation error", "deg", "rotation_error_deg", ROTATION),
    ):
        if (scene.R if unit in ("mm", "deg") else scene.K) is None:
            continue
        values: Values = {n: None if e is None else getattr(e, field) for n, e in errors.items()}
        rows.append(row(scene.name, name, unit, values, text))
    if scene.R is None:
        return rows
    pairs = {n: pose_pair_errors(m, truth) for n, m in models.items()}
    for threshold in (1.0, 5.0):
        areas: Values = {n: 100.0 * area_under_recall(e, threshold) for n, e in pairs.items()}
        rows.append(row(scene.name, f"AUC@{threshold:g}°", "%", areas, AUC, more=True))
    return rows


def fit_rows(scene: Scene, models: Mapping[str, Reconstruction | None]) -> list[Metric]:
    """Return reprojection errors and numbers of points of the models."""
    residuals = {n: None if m is None else measure_reprojection(m) for n, m in models.items()}
    points = each(models, lambda m: m.valid.sum())
    seen: Values = {n: r.observations / p if r and (p := points[n]) else None for n, r in residuals.items()}
    return [
        row(scene.name, "reprojection", "px", each(residuals, lambda r: r.median_px), REPROJECTION),
        row(scene.name, "observations a point", "", seen, "inlier observations over points", more=True),
        row(scene.name, "points", "", points, "valid points of the model", more=True),
    ]


def _before_adjustment(scene: Scene, outcome: Outcome | None) -> list[Metric]:
    """Evaluate chapters 6 and 7 separately, before the metric stage corrects their errors."""
    if outcome is None or not outcome.ok:
        return []
    projective = _last_record(outcome, "projective")
    t, P, X = projective.tracks, projective.P, projective.X
    seen = projective.used
    x = np.einsum("kab,kb->ka", P[t.view_index[seen]], X[t.point_index[seen]])
    residual = float(np.median(np.linalg.norm(x[:, :2] / x[:, 2:] - t.xy[seen], axis=1)))
    text = f"{REPROJECTION}, by the projective model"
    rows = [row(scene.name, "projective reprojection", "px", residual, text)]
    if scene.K is None:
        return rows
    K = _last_record(outcome, "selfcalibration").K
    known = np.isfinite(K).all(axis=(1, 2)) & (K[:, 0, 0] > 0.0)
    error = float(np.nanmedian(focal_errors_pct(K[known], scene.K[known])))
    text = f"{FOCAL}, as self-calibration leaves it"
    return [*rows, row(scene.name, "self-calibrated focal error", "%", error, text)]


def _as_colmap_reads(scene: Scene, outcomes: Mapping[str, Outcome]) -> list[Metric]:
    """Evaluate the principal point that pycolmap reads: another centre of the pixels would not cancel."""
    outcome = outcomes.get(OURS)
    if scene.K is None or outcome is None or not outcome.ok:
        return []
    names = [path.name for path in scene.image_paths]
    try:
        found = principal_points_by_pycolmap(outcome.folder / "run" / "sparse" / "0", names)
        error = float(np.nanmedian(np.linalg.norm(found - scene.K[:, :2, 2], axis=1)))
    except NoReference:
        return []
    text = f"{PRINCIPAL_POINT}, in the files that pycolmap reads"
    return [row(scene.name, "principal point error, read by pycolmap", "px", error, text)]


def _last_record(outcome: Outcome, stage: str) -> Any:
    folder = RunDirectory(outcome.folder / "run").stage(FOLDERS[stage])
    *_, (item, key) = read_json(folder.path / MANIFEST_FILE)["keys"].items()
    return folder.load(item, key)


def _costs(scene: str, outcomes: Mapping[str, Outcome]) -> list[Metric]:
    """Return processor seconds and memory; both of COLMAP's mappers include the shared matching."""
    done = {n: o if o.ok else None for n, o in outcomes.items() if n not in (MATCHES, PER_IMAGE)}
    shared = outcomes.get(MATCHES, Outcome(Path()))
    times: Values = {
        n: None if o is None else o.cpu_s + shared.cpu_s * (n in MAPPERS) for n, o in done.items()
    }
    memory: Values = {
        n: None if o is None else max(o.peak_mb, shared.peak_mb * (n in MAPPERS)) for n, o in done.items()
    }
    return [
        row(scene, "time", "s", times, "processor seconds from images to cameras"),
        row(scene, "peak memory", "MB", memory, "largest of the processes from images to cameras"),
    ]


def _per_image(scene: Scene, model: Reconstruction | None) -> list[Metric]:
    if scene.K is None or model is None or model.K is None or not model.registered.any():
        return []
    errors = focal_errors_pct(model.K[model.registered], scene.K[model.registered])
    text, name = "|f / f_true - 1| over the images, with independent cameras", "focal error, a camera each"
    return [
        row(scene.name, name, "%", float(np.nanmedian(errors)), f"median {text}"),
        row(scene.name, f"worst {name}", "%", float(np.nanmax(errors)), f"largest {text}"),
    ]


def _stated(scene: Scene, outcomes: Mapping[str, Outcome]) -> list[Metric]:
    done = [name for name in SETTINGS if name in outcomes and outcomes[name].ok]
    records: dict[str, Any] = {n: read_json(outcomes[n].folder / "run" / "summary.json") for n in done}
    trusted = each(records, lambda r: bool(r["trusted"]))
    silent = each(records, lambda r: sum(not refused["reason"] for refused in r["refused"]))
    rows = [
        row(scene.name, "trusted", "", trusted, "1: passed its self-check", more=True),
        row(scene.name, "refused without a reason", "", silent, "images"),
    ]
    checks = {n: r["self_check"] for n, r in records.items() if r.get("self_check")}
    noise, off = (each(checks, itemgetter(name)) for name in ("sigma_rel", "sigmas_to_minimum"))
    rows += [
        row(scene.name, "noise", "", noise, "noise of the observations over the longer side of the image"),
        row(scene.name, "distance to the minimum", "", off, "of the adjusted cameras, standard deviations"),
    ]
    if scene.K is None or not records:
        return rows
    text = "largest stated standard deviation of a focal length"
    for name, where in ((OURS, ""), (PER_IMAGE, ", a camera each")):
        cameras = records.get(name, {}).get("cameras", [])
        held = _share_held(cameras, scene.K) if cameras else None
        focals = [c["focal_px"] for c in cameras if c.get("focal_px")]
        widest = max((100.0 * f["std"] / f["value"] for f in focals), default=None)
        rows.append(row(scene.name, f"intervals that hold{where}", "%", held, SHARE_HELD, more=True))
        rows.append(row(scene.name, f"largest focal deviation{where}", "%", widest, text))
    return rows


def _share_held(cameras: list[dict[str, Any]], K: F64) -> float | None:
    truths = {"focal_px": np.sqrt(K[:, 0, 0] * K[:, 1, 1])}
    truths |= {"principal_x_px": K[:, 0, 2], "principal_y_px": K[:, 1, 2]}
    held = [
        abs(interval["value"] - truth[view]) <= 1.96 * interval["std"]
        for view, camera in enumerate(cameras)
        for name, truth in truths.items()
        if (interval := camera.get(name)) and interval["std"] and np.isfinite(truth[view])
    ]
    return 100.0 * float(np.mean(held)) if held else None


def _plot(scene: Scene, models: Mapping[str, Reconstruction | None]) -> Plot:
    """Plot the focal length of every image by each method, and the true one."""
    images = range(1, len(scene.image_paths) + 1)
    traces = []
    for name, model in models.items():
        if model is not None and model.K is not None:
            focal = np.sqrt(model.K[:, 0, 0] * model.K[:, 1, 1])
            seen = zip(focal, model.registered, strict=True)
            traces.append(scatter(name, images, [float(f) if there else None for f, there in seen]))
    if scene.K is not None:
        focal = np.sqrt(scene.K[:, 0, 0] * scene.K[:, 1, 1]).tolist()
        true = [f if np.isfinite(f) else None for f in focal]
        marker = {"symbol": "line-ew-open", "size": 18, "color": "#1b2733"}
        traces.append(scatter("truth", images, true, marker=marker))
    return plot("Focal lengths", traces, "image", "focal length (px)")

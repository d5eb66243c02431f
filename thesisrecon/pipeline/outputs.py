"""Output files of a run, written and read back: COLMAP model, points, cameras, surface, summary, report."""

import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import wait
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from thesisrecon import __version__
from thesisrecon._numba import ThreadPool
from thesisrecon.arrays import F32, U8
from thesisrecon.config.text import toml_from_config
from thesisrecon.errors import NOT_MADE, Notice, StageFailure, UsageError, counted, made
from thesisrecon.io._colmap import COLMAP_FILES, write_colmap_model
from thesisrecon.io._exports import cameras_csv, cameras_table, write_point_cloud
from thesisrecon.io._files import as_read, read_json, write_atomically, write_json, write_text
from thesisrecon.io._images import image_without_pixels
from thesisrecon.io._meshes import glb_bytes
from thesisrecon.io._outputs import claim_folder
from thesisrecon.pipeline.matching import final_pairs
from thesisrecon.pipeline.run import FOLDERS, Run, Until, name_images
from thesisrecon.records import TexturedMesh
from thesisrecon.report._data import ReportData, pictured, point_colors, summarize
from thesisrecon.report._page import render_report
from thesisrecon.results import SUMMARY, RunResult
from thesisrecon.runtime._run_folder import MANIFEST_FILE, RUN_FILE, RunDirectory, StageFolder
from thesisrecon.surface._simplification import reduce_faces
from thesisrecon.surface.model import MAX_TEXELS, SurfaceModel, texture_mesh

DEPTH_PX = 400
PAGE_FACES, PAGE_TEXELS = 45_000, 2048 * 2048
PAGE, SURFACE_FILES = "report.html", ("model.glb", "model-full.glb")
MODEL_FILES = (*COLMAP_FILES, "points.ply", "cameras.json", "cameras.csv", *SURFACE_FILES)
RESULT_FILES = (SUMMARY, PAGE, *MODEL_FILES)
REPLACED_FILES = (*RESULT_FILES, *(f"group-[0-9]*/{name}" for name in RESULT_FILES))
"""Files of another run that a run removes from its folder."""
CONFIG = "config.toml"
WRITTEN_FILES = (*REPLACED_FILES, CONFIG, *(f"group-[0-9]*/{name}" for name in (CONFIG, RUN_FILE)))
"""Files that a run writes beside the results of its stages."""


def write_outputs(run: Run, result: RunResult, *, until: str, failure: StageFailure | None) -> RunResult:
    """Write all results of a run; return it with warnings, reports and summary."""
    result, stages = with_image_names(result), get_args(Until)
    there = read_json(run.directory.path / SUMMARY)
    later = there.get("until") if isinstance(there, dict) and not there.get("failure") else None
    longer = later in stages[stages.index(until) + 1 :] and not run.directory.continues
    if failure is not None or not longer:
        return _write(run, result, until, failure)
    # An earlier, longer run in this folder.
    run.warnings.append(Notice("older-outputs", later, "its summary and report are kept"))
    return _described(run, result, until, failure)


def with_image_names(result: RunResult) -> RunResult:
    """Replace image numbers by file names in all sentences of a result."""
    names = [image.name for image in result.images]

    def named(record: Any, *fields: str) -> Any:
        texts = {field: tuple(name_images(t, names) for t in getattr(record, field)) for field in fields}
        return replace(record, **texts)

    metric, calibration = result.metric, result.calibration
    if metric is not None:
        metric = named(metric, "failed_checks", "warnings", "limitations")
    if calibration is not None:
        calibration = named(calibration, "reasons")
        if (report := calibration.identifiability) is not None:
            calibration = replace(calibration, identifiability=named(report, "sentences"))
    return replace(result, metric=metric, calibration=calibration)


def _described(run: Run, result: RunResult, until: str, failure: StageFailure | None) -> RunResult:
    metric, calibration, warnings = result.metric, result.calibration, list(run.warnings)
    own = () if metric is None or metric.trusted else tuple(dict.fromkeys(metric.failed_checks))
    if metric is not None and not metric.trusted:
        warnings.append(Notice("failed-self-check", "; ".join(own)))
    tested = metric is not None and metric.identifiability is not None
    if calibration is not None and not calibration.identifiable and not tested:
        # The self-check may repeat the reasons of its calibration.
        rest = [reason for reason in dict.fromkeys(calibration.reasons) if reason not in own]
        if rest or not own:
            warnings.append(Notice("undetermined-calibration", "; ".join(rest)))
    reports, text = tuple(run.reports.values()), "" if failure is None else str(failure)
    result = replace(result, warnings=tuple(warnings), reports=reports, failure=text)
    return replace(result, summary=summarize(result) | _run_facts(run, until))


def _write(run: Run, result: RunResult, until: str, failure: StageFailure | None) -> RunResult:
    """Write the records and the summary, then files and page, each on its own, and the summary again."""
    out, config = run.directory.path, toml_from_config(run.config)
    result = _described(run, result, until, failure)

    def coarse_model() -> TexturedMesh | None:
        if result.mesh is None:
            return None
        threads = max(run.workers.threads - 1, 1)
        coarse = reduce_faces(result.mesh, PAGE_FACES, threads=threads)
        return texture_mesh(coarse, result.views, max_texels=PAGE_TEXELS, threads=threads)

    _write_records(run.directory, result)
    write_text(out / CONFIG, config)
    with run.clock("outputs"), ThreadPool(1) as beside:
        # The file of the model is written while that of the page is made.
        for_page = beside.submit(coarse_model)
        if run.workers.threads == 1:
            wait([for_page])
        max_mb = getattr(run.config.model, "max_glb_mb", SurfaceModel.max_glb_mb)
        colors, warnings = _write_exports(run.directory, result, max_mb, run.workers.threads)
        model = made("the model in report.html", for_page.result, warnings, None)
        depths = made("a depth map in report.html", lambda: _thinned_maps(result), warnings, dict[int, F32]())
        page = ReportData.of(
            result, title=run.title, config_text=config, colors=colors, model=model, depths=depths,
            until=None if until == "model" else until, end=failure,
        )  # fmt: skip
        made(PAGE, lambda: write_text(out / PAGE, render_report(page, warnings)), warnings, None)
    run.finish("outputs", counts={})
    summary = {**result.summary, "warnings": [*result.warnings, *warnings], **_run_facts(run, until)}
    # Without space for it, the summary that was written first stays.
    made(SUMMARY, lambda: write_json(out / SUMMARY, summary), warnings, None)
    summary["warnings"] = [*result.warnings, *warnings]
    reports = tuple(run.reports.values())
    return replace(result, reports=reports, summary=summary, warnings=tuple(summary["warnings"]))


def folder_with(result: RunResult) -> Path | None:
    """Return the folder of a result if it still contains it: summaries contain times and so differ."""
    out = result.out
    return out if out is not None and read_json(out / SUMMARY) == as_read(result.summary) else None


def save_result(result: RunResult, folder: Path, *, overwrite: bool) -> None:
    """Copy the result files of a run; those that no folder contains are written, except the page."""
    warnings: list[str] = []
    with claim_folder(folder, overwrite=overwrite, names=RESULT_FILES):
        if (out := folder_with(result)) is not None:
            for path in (path for name in RESULT_FILES for path in sorted(out.glob(name))):
                if path.is_file():
                    write_atomically(folder / path.relative_to(out), path.read_bytes())
            return
        _write_records(RunDirectory(folder), result)
        _, warnings = _write_exports(RunDirectory(folder), result)
    if lost := [text for text in warnings if text.startswith(NOT_MADE)]:
        raise UsageError("; ".join(lost))


def _write_surface(directory: RunDirectory, result: RunResult, max_mb: float, threads: int) -> list[str]:
    """Write the mesh as GLB, above ``max_mb`` reduced, with the whole beside it; return warnings."""
    mesh, path, whole = result.mesh, directory.path / "model.glb", directory.path / "model-full.glb"
    directory.remove(SURFACE_FILES if mesh is None else SURFACE_FILES[1:])
    if mesh is None:
        return []
    warnings: list[str] = []
    content = made(path.name, lambda: glb_bytes(mesh), warnings, b"")
    if len(content) <= 1e6 * max_mb or not result.views:
        made(path.name, lambda: write_atomically(path, content), warnings, None) if content else None
        return warnings
    made(whole.name, lambda: write_atomically(whole, content), warnings, None)

    def reduced() -> TexturedMesh:
        texels = MAX_TEXELS if mesh.texture is None else mesh.texture[..., 0].size
        share, smaller, packed = 1.0, mesh, content
        while len(packed) > 1e6 * max_mb:
            share *= 0.9 * 1e6 * max_mb / len(packed)
            smaller = reduce_faces(mesh, int(share * len(mesh.faces)), threads=threads)
            limit = int(share * texels)
            packed = glb_bytes(texture_mesh(smaller, result.views, max_texels=limit, threads=threads))
        write_atomically(path, packed)
        return smaller

    if (smaller := made(path.name, reduced, warnings, None)) is None:
        return warnings
    faces = f"{len(smaller.faces)} of {len(mesh.faces)} faces and fewer texels (model.max_glb_mb={max_mb:g})"
    whole_in = f"; {whole.name} holds all" if whole.is_file() else ""
    return [*warnings, f"model.glb is reduced to {faces}{whole_in}"]


def _write_records(directory: RunDirectory, result: RunResult) -> None:
    """Write ``cameras.json``, or remove old results, and the summary."""
    if result.metric is None:
        directory.remove(MODEL_FILES)
    else:
        write_json(directory.path / "cameras.json", cameras_table(result.cameras))
        write_text(directory.path / "cameras.csv", cameras_csv(result.cameras))
    write_json(directory.path / SUMMARY, result.summary)


def _write_exports(
    directory: RunDirectory, result: RunResult, max_mb: float = SurfaceModel.max_glb_mb, threads: int = 1
) -> tuple[U8 | None, list[str]]:
    """Write points and model, each file on its own; return colours and warnings."""
    if result.metric is None:
        return None, []
    warnings: list[str] = []
    metric, images = result.metric.reconstruction, result.images
    grey = np.full((len(metric.X), 3), 128, dtype=np.uint8)
    colors = made("the colours of points.ply", lambda: point_colors(metric, images), warnings, grey)
    points, shown = metric.X[metric.valid, :3] / metric.X[metric.valid, 3:], colors[metric.valid]
    path = directory.path / "points.ply"
    made(path.name, lambda: write_point_cloud(path, points, shown), warnings, None)

    def write() -> int:
        names, scales = [image.name for image in images], np.array([1 / image.scale for image in images])
        sizes = np.array([image.original_size for image in images])
        return write_colmap_model(
            directory.path / "sparse" / "0", metric, names,
            colors=colors, groups=result.groups, scales=scales, original_sizes=sizes,
        )  # fmt: skip

    # In original pixels, all of it or nothing.
    if skewed := made("sparse/0", write, warnings, -1):
        directory.remove(COLMAP_FILES)
    if skewed > 0:
        cameras = counted(int(metric.registered.sum()), "camera")
        warnings.append(Notice("no-colmap-skew", skewed, cameras))
    return colors, warnings + _write_surface(directory, result, max_mb, threads)


def _run_facts(run: Run, until: str) -> dict[str, Any]:
    seconds = {stage: round(report.seconds, 3) for stage, report in run.reports.items()}
    return {
        "version": __version__,
        "seed": run.seed,
        "until": until,
        "images_folder": None if run.images_folder is None else str(run.images_folder),
        **({"images_elsewhere": run.images_elsewhere} if run.images_elsewhere else {}),
        **({} if run.masks_folder is None else {"masks_folder": str(run.masks_folder)}),
        **({"as_stored": True} if run.as_stored else {}),
        **({"world": run.world} if run.world else {}),
        **({"groups": run.groups} if run.groups else {}),
        "threads": run.workers.threads,
        "executor": run.workers.name,
        "seconds": seconds | {"total": round(sum(seconds.values()), 3)},
        "elapsed_seconds": round(time.perf_counter() - run.started, 3),
        "resumed": list(run.resumed),
        "peak_memory_mb": _peak_memory_mb(),
    }


def _peak_memory_mb() -> float | None:
    """The largest resident size of this process; None on Windows."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


def _thinned_maps(result: RunResult) -> dict[int, F32]:
    """Depths for the page."""
    shown, maps = set(pictured(len(result.images))), {}
    for n, view in enumerate(result.views):
        if view.view in shown:
            depth = result.depth_maps[n].depth
            step = max(1, -(-max(depth.shape) // DEPTH_PX))
            maps[view.view] = depth[::step, ::step].copy()
    return maps


def best_result(tried: Sequence[RunResult]) -> RunResult:
    """The best result: metric before projective, then trusted, then with most cameras, then most points."""

    def quality(result: RunResult) -> tuple[bool, bool, int, int]:
        metric, best = result.metric, result.best_reconstruction
        size = (0, 0) if best is None else (int(best.registered.sum()), int(best.valid.sum()))
        return metric is not None, metric is not None and metric.trusted, *size

    return max(tried, key=quality)


def load_run(folder: Path, summary: Mapping[str, Any], run: Mapping[str, Any]) -> RunResult:
    # The folders of later stages may be those of a run that this one replaced.
    finished = {stage: folder / name for stage, name in FOLDERS.items() if stage in summary["seconds"]}
    reports = [StageFolder(path).finished(_keys(path)) for path in finished.values()]
    stages: dict[str, dict[str, Any]] = {stage: {} for stage in FOLDERS}
    stages |= {stage: _records(path) for stage, path in finished.items() if stage != "dense"}
    views, projective = summary["cameras"], list(stages["projective"].values())
    sides = ("width_px", "height_px")
    scaled = [[int(view[side] * view["working_scale"] + 1e-9) for side in sides] for view in views]
    sizes = projective[0].sizes.tolist() if projective else scaled
    names = [view["name"] for view in views]
    unread = {one["name"]: one["reason"] for one in summary["refused"] if one["name"] not in names}
    features, further = tuple(stages["features"].values()), list[RunResult]()
    for group in summary.get("groups", ()):
        part, own = (read_json(folder / group["folder"] / name) for name in (SUMMARY, RUN_FILE))
        if group["registered"] and isinstance(part, dict) and isinstance(own, dict):
            further.append(load_run(folder / group["folder"], part, own))
    images = tuple(
        image_without_pixels(view["name"], size, (view["width_px"], view["height_px"]))
        for view, size in zip(views, sizes, strict=True)
    )
    groups = np.array([view["camera"] for view in views], dtype=np.int64)
    result = RunResult(
        folder, images, unread, features, final_pairs(stages["matches"], features), groups, run["settings"],
        pair_choice=stages["pairs"].get("choice"), tracks=stages["tracks"].get("tracks"),
        mesh=stages["model"].get("model"), held_out=stages["model"].get("held-out"),
        reports=tuple(report for report in reports if report is not None),
        warnings=tuple(summary["warnings"]), summary=summary, failure=summary["failure"] or "",
        further_models=tuple(further),
    )  # fmt: skip
    attempts = list[RunResult]()
    # A run of known cameras has no projective model.
    for item, model in (stages["projective"] or dict.fromkeys(stages["metric"])).items():
        # The last of the metric records of an attempt.
        metrics = stages["metric"]
        found = [metrics.get(f"{item}{suffix}") for suffix in ("-joined", "-more", "")]
        found = [metrics.get(f"{item}-world", {}).get("result"), *found]
        metric = next((record for record in found if record is not None), None)
        calibration = stages["selfcalibration"].get(item)
        attempts.append(replace(result, projective=model, calibration=calibration, metric=metric))
    return with_image_names(best_result(attempts or [result]))


def _keys(folder: Path) -> dict[str, str]:
    content = read_json(folder / MANIFEST_FILE)
    return dict(content["keys"]) if isinstance(content, dict) else {}


def _records(folder: Path) -> dict[str, Any]:
    """Item -> record of a stage, in order of the items."""
    stage = StageFolder(folder)
    found = {item: stage.load(item, key) for item, key in sorted(_keys(folder).items())}
    return {item: record for item, record in found.items() if record is not None}

"""The affine stratum of a reconstruction: the front door to it, and what a run keeps of it.

What a run leaves for its user: the COLMAP model, points, cameras, summary and page.
"""

from __future__ import annotations

import resource
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from thesisrecon import __version__
from thesisrecon.arrays import F32, U8
from thesisrecon.config import toml_from_config
from thesisrecon.errors import StageFailure, counted
from thesisrecon.io.colmap import colmap_from_reconstruction, skewed_views
from thesisrecon.io.colmap_files import write_colmap_model
from thesisrecon.io.exports import write_point_cloud
from thesisrecon.io.files import read_json, write_json, write_text
from thesisrecon.io.meshes import write_mesh
from thesisrecon.records import Image, Reconstruction, RunResult, TexturedMesh
from thesisrecon.report.data import ReportData, ReportImage
from thesisrecon.report.page import write_report
from thesisrecon.report.summary import cameras_table, point_colors, summarize
from thesisrecon.runtime.run import Run, Until
from thesisrecon.runtime.run_folder import RunDirectory
from thesisrecon.selfcalibration.stratified import affine_camera_centres, upgrade_to_affine
from thesisrecon.surface.mesh import simplify_mesh
from thesisrecon.surface.texture_atlas import TextureAtlas

FARTHEST_AFFINE = 1e3
"""Points of the affine file are within this many standard deviations of the bulk of them."""


def affine_of(result: RunResult) -> Reconstruction | None:
    """The affine stratum that the run passed through, None where it got to none.

    That is its projective reconstruction under the plane at infinity of self-calibration."""
    if result.projective is None or result.calibration is None:
        return None
    return upgrade_to_affine(result.projective, result.calibration.plane_at_infinity)


def write_affine(path: Path, affine: Reconstruction | None, colours: U8) -> None:
    """Points in their colours (N, 3) and the camera centres in red, in an affine frame; the nearer part of
    them, since points near infinity have no place in a viewer. Nothing without a reconstruction."""
    if affine is None:
        return
    X = affine.X[:, :3]
    near = affine.valid & (np.abs(X) < FARTHEST_AFFINE).all(axis=1)
    centres = affine_camera_centres(affine)
    centres = centres[np.isfinite(centres).all(axis=1)]
    red = np.tile(np.array([255, 0, 0], dtype=np.uint8), (len(centres), 1))
    write_point_cloud(path, np.concatenate([X[near], centres]), np.concatenate([colours[near], red]))


THUMBNAIL_PX = 800
DEPTH_PX = 400
PAGE_FACES, PAGE_TEXELS = 150_000, 2048 * 2048
SUMMARY, PAGE = "summary.json", "report.html"
COLMAP_FILES = tuple(f"sparse/0/{name}.bin" for name in ("rigs", "cameras", "frames", "images", "points3D"))
MODEL_FILES = (
    *COLMAP_FILES,
    *("points.ply", "affine.ply", "cameras.json", "model.glb"),
)
RESULT_FILES = (SUMMARY, PAGE, *MODEL_FILES)


def write_outputs(run: Run, result: RunResult, *, until: str, failure: StageFailure | None) -> RunResult:
    """Write whatever was found, and return it with its summary.

    A run that ends early, as asked, leaves the files of a longer one that has ended in this folder; files of
    a model are removed where there is none. Raises :class:`OutputError` where the output folder cannot be
    written.
    """
    later = _later_end(run.directory.path, until) if failure is None else None
    if later is None:
        return _write(run, result, until, failure)
    run.warnings.append(
        f"the folder holds the result of this run up to {later}: its summary and page are kept"
    )
    return _described(run, result, until, failure)


def _later_end(out: Path, until: str) -> str | None:
    """The stage up to which this run has already ended well here, where that is a later one."""
    summary = read_json(out / SUMMARY)
    if not isinstance(summary, dict) or summary.get("failure"):
        return None
    stages, there = get_args(Until), summary.get("until")
    return there if there in stages[stages.index(until) + 1 :] else None


def _described(run: Run, result: RunResult, until: str, failure: StageFailure | None) -> RunResult:
    """The result with its warnings, reports and summary."""
    result = replace(
        result,
        warnings=(*run.warnings, *_doubts(result)),
        reports=tuple(run.reports.values()),
        failure=str(failure) if failure is not None else "",
    )
    return replace(result, summary=summarize(result) | _run_facts(run, until))


def _write(run: Run, result: RunResult, until: str, failure: StageFailure | None) -> RunResult:
    out, colours = run.directory.path, None
    with run.clock("outputs"):
        if result.metric is not None:
            colours = point_colors(result.metric.reconstruction, result.images)
            run.warnings.extend(write_model(run.directory, result, result.metric.reconstruction, colours))
            write_affine(out / "affine.ply", affine_of(result), colours)
            if result.mesh is not None:
                write_mesh(out / "model.glb", result.mesh)
            else:
                run.directory.remove(("model.glb",))
        else:
            run.directory.remove(MODEL_FILES)
        result = _described(run, result, until, failure)
        write_text(out / "config.toml", toml_from_config(run.config))
        page = _report_data(run, result, colours, failure)
        write_report(out / PAGE, replace(page, until=None if until == "model" else until))
    run.finish("outputs", counts={})
    result = replace(
        result, reports=tuple(run.reports.values()), summary={**result.summary, **_run_facts(run, until)}
    )
    write_json(out / SUMMARY, result.summary)
    return result


def _doubts(result: RunResult) -> list[str]:
    """The sentences nobody may overlook."""
    failed_checks: list[str] = []
    own: tuple[str, ...] = ()
    if result.metric is not None and not result.metric.trusted:
        own = tuple(dict.fromkeys(result.metric.failed_checks))
        failed_checks.append(f"the result failed its self-check and is not to be trusted: {'; '.join(own)}")
    if result.calibration is not None and not result.calibration.identifiable:
        # The self-check repeats the reasons of the calibration it was given.
        rest = [reason for reason in dict.fromkeys(result.calibration.reasons) if reason not in own]
        if rest or not own:
            failed_checks.append(f"these views do not determine the calibration: {'; '.join(rest)}")
    return failed_checks


def write_model(
    directory: RunDirectory, result: RunResult, reconstruction: Reconstruction, colours: U8
) -> list[str]:
    """``sparse/0``, ``points.ply`` and ``cameras.json`` of a metric reconstruction, in original pixels.

    Returns what is to be said of a file that could not be written: COLMAP has no camera with skew.
    """
    said: list[str] = []
    skewed = skewed_views(reconstruction)
    if len(skewed):
        directory.remove(COLMAP_FILES)
        said.append(
            f"sparse/0 is not written: COLMAP has no camera with skew, as {len(skewed)} of "
            f"{counted(int(reconstruction.registered.sum()), 'camera')} would need; cameras.json holds them"
        )
    else:
        model = colmap_from_reconstruction(
            reconstruction,
            [image.name for image in result.images],
            colors=colours,
            groups=result.groups,
            scales=np.array([1 / image.scale for image in result.images]),
            original_sizes=np.array([image.original_size for image in result.images]),
        )
        write_colmap_model(directory.path / "sparse" / "0", model)
    X = reconstruction.X[reconstruction.valid]
    write_point_cloud(directory.path / "points.ply", X[:, :3] / X[:, 3:], colours[reconstruction.valid])
    write_json(directory.path / "cameras.json", cameras_table(reconstruction, result.images))
    return said


def _run_facts(run: Run, until: str) -> dict[str, Any]:
    """What the summary says of the run itself."""
    seconds = {stage: round(report.seconds, 3) for stage, report in run.reports.items()}
    return {
        "version": __version__,
        "seed": run.seed,
        "until": until,
        "threads": run.workers.threads,
        "executor": run.workers.name,
        "seconds": seconds | {"total": round(sum(seconds.values()), 3)},
        "elapsed_seconds": round(run.elapsed_s, 3),
        "resumed": list(run.resumed),
        "peak_memory_mb": round(_peak_memory_mb(), 1),
    }


def _peak_memory_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def _report_data(run: Run, result: RunResult, colours: U8 | None, failure: StageFailure | None) -> ReportData:
    images = tuple(
        ReportImage(image.name, image.size, image.original_size, _thumbnail(image)) for image in result.images
    )
    return ReportData(
        title=run.title,
        images=images,
        reports=result.reports,
        config_text=toml_from_config(run.config),
        summary=result.summary,
        version=__version__,
        unread=tuple(result.refused.items()),
        pairs=result.pairs,
        pair_choice=result.pair_choice,
        reconstruction=result.projective,
        metric=result.metric,
        colors=colours,
        affine=affine_of(result) if result.metric is not None else None,
        failure=failure,
        model=_model_for_page(run, result),
        held_out=result.held_out,
        depth_maps={m.view: _thinned(m.depth) for m in result.depth_maps},
    )


def _model_for_page(run: Run, result: RunResult) -> TexturedMesh | None:
    """The model in a size that a page can carry."""
    if result.mesh is None:
        return None
    coarse = simplify_mesh(result.mesh, PAGE_FACES)
    return TextureAtlas(max_texels=PAGE_TEXELS).texture(coarse, result.views, threads=run.workers.threads)


def _thinned(depth: F32) -> F32:
    """Every n-th pixel, as many as a picture on the page has."""
    step = max(1, -(-max(depth.shape) // DEPTH_PX))
    return depth[::step, ::step]


def _thumbnail(image: Image) -> U8:
    """Every n-th pixel; the page shrinks it further, with care."""
    step = max(1, max(image.size) // THUMBNAIL_PX)
    return image.rgb[::step, ::step]

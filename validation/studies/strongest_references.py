"""What not knowing the camera costs: ours and COLMAP without a prior and with the true calibration.

Of COLMAP the table has the default, and of all lenses, mappers and seeds that of the smallest error of the
centres: a choice that only the truth can make, in COLMAP's favour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from thesisrecon import PipelineConfig, reconstruct
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure
from thesisrecon.records import Reconstruction
from validation.metrics.cameras import (
    CameraErrors,
    TrueCameras,
    area_under_recall,
    measure_cameras,
    pose_pair_errors,
    relative_centre_error,
)
from validation.references.colmap import map_and_read, match_with_pycolmap
from validation.runs.study import Part, report_progress
from validation.runs.tables import text_table
from validation.scenes.real import REAL_SCENES, TURNTABLE_SCENES, Scene, scenes_here

LENSES = ("SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV", "THIN_PRISM_FISHEYE")
SETTINGS = tuple(product(("incremental", "global"), LENSES, (False, True)))
"""Mapper, lens, and whether the principal point is refined; the first is the default."""
AUC_DEG = (0.1, 0.5, 1.0, 5.0)
HEAD = ("", "cameras", "focal length", "centres", *(f"AUC {at:g}°" for at in AUC_DEG))


def strongest_references_study(
    out: Path, scenes: Sequence[str] = ("courtyard", *REAL_SCENES, *TURNTABLE_SCENES), seeds: int = 5,
    threads: int = 2,
) -> Iterator[Part]:  # fmt: skip
    """Compare ours and every setting of COLMAP with the truth, without a prior and with the calibration."""
    for scene in scenes_here(scenes):
        if not scene.has_truth:
            continue
        rows = list[list[object]]()
        for name, model in _models(scene, out / scene.name, seeds, threads):
            report_progress(f"{scene.name}: {name}")
            rows.append([name, *_scores(model, scene.cameras)])
        yield f"{scene.name}, {len(scene.image_paths)} images\n\n" + text_table(HEAD, rows)


def _models(scene: Scene, out: Path, seeds: int, threads: int) -> Iterator[tuple[str, Reconstruction | None]]:
    truth, images = scene.cameras, scene.image_paths[0].parent
    for name, prior in (
        ("ours", IntrinsicsOptions()), ("ours, true calibration", _known(truth)),
    ):  # fmt: skip
        config = PipelineConfig(intrinsics=prior)
        try:
            result = reconstruct(
                images, out / name, config=config, until="metric", threads=threads, overwrite=True
            )
            yield name, None if result.metric is None else result.metric.reconstruction
        except StageFailure:
            yield name, None
    match_with_pycolmap(images, matched := out / "matched", threads=threads)
    best, smallest, best_name = None, np.inf, "none"
    for (mapper, lens, principal), seed in product(SETTINGS, range(seeds)):
        given = {"mapper": mapper, "lens": lens, "refine_principal_point": principal, "seed": seed}
        place = out / "mapped" / f"{mapper}-{lens}-{principal:d}-{seed}"
        model = map_and_read(images, place, matched=matched, threads=threads, **given)
        name = f"{lens}, {mapper}{', principal point refined' if principal else ''}"
        if (mapper, lens, principal) == SETTINGS[0] and seed == 0:
            yield "COLMAP", model
        missing = np.inf if model is None else float((~model.registered).sum())
        centres = np.inf if model is None else _relative(measure_cameras(model, truth), truth)
        # A camera that is missing counts as off by the whole extent.
        if missing + centres < smallest:
            best, smallest, best_name = model, missing + centres, f"{name}, seed {seed}"
    yield f"COLMAP, best: {best_name}", best
    K, calibrated = truth[0][0], out / "calibrated"
    centre = K[:2, 2] + 0.5  # COLMAP's origin is the corner of a pixel
    match_with_pycolmap(images, calibrated, threads=threads, camera=("PINHOLE", [K[0, 0], K[1, 1], *centre]))
    yield "COLMAP, true calibration", map_and_read(images, calibrated, fixed=True, threads=threads)


def _known(truth: TrueCameras) -> IntrinsicsOptions:
    K = truth[0][0]
    return IntrinsicsOptions(
        focal="known", focal_px=K[0, 0], aspect_ratio=K[1, 1] / K[0, 0], skew_px=K[0, 1],
        principal_point="known", principal_point_px=(K[0, 2], K[1, 2]), k1="known",
    )  # fmt: skip


def _relative(errors: CameraErrors, truth: TrueCameras) -> float:
    return float(np.nan_to_num(relative_centre_error(errors, truth[2]), nan=1.0))


def _scores(model: Reconstruction | None, truth: TrueCameras) -> list[str]:
    pairs = pose_pair_errors(model, truth)
    areas = [f"{area_under_recall(pairs, at):.3f}" for at in AUC_DEG]
    if model is None:
        return ["0", "–", "–", *areas]
    errors = measure_cameras(model, truth)
    centres = f"{_relative(errors, truth):.4%}"
    return [f"{model.registered.sum()}", f"{errors.focal_error_pct:.4f} %", centres, *areas]

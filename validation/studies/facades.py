"""Facades: what a scene of one plane with little relief costs, and whether the stated intervals hold there.

Rendered facades with true cameras go through the pipeline. Its tracks are then distorted by lens errors that
the camera model does not have, of about a tenth of a pixel, and solved with an unknown and with the true
calibration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.intrinsics import IntrinsicsOptions
from thesisrecon.records import MetricResult
from validation.metrics.cameras import TrueCameras, measure_cameras
from validation.metrics.intervals import LEVEL, interval_scores
from validation.runs.study import Part, report_progress
from validation.runs.tables import Rows
from validation.scenes.many_views import load_facade
from validation.scenes.real import Scene
from validation.studies.subsets import Matched, match_scene, solve

KINDS = ("none", "decentring", "aspect", "smooth")
UNKNOWN, KNOWN = "unknown calibration", "true calibration"
DECENTRING = (4e-4, -3e-4)
ASPECT, WAVE_PX = 1e-3, 0.12
MIN_HOLDING = 0.92


def lens_error(kind: str, xy: F64, K: F64, rng: np.random.Generator) -> F64:
    """Displacement (N, 2) px of image points: "none", "decentring", "aspect" or a "smooth" random field."""
    n = (xy - K[:2, 2]) / K[0, 0]
    moved = np.zeros_like(n)
    if kind == "decentring":
        p1, p2 = DECENTRING
        r2, cross = np.sum(n**2, axis=1), 2.0 * n[:, 0] * n[:, 1]
        moved[:, 0] = p1 * cross + p2 * (r2 + 2.0 * n[:, 0] ** 2)
        moved[:, 1] = p1 * (r2 + 2.0 * n[:, 1] ** 2) + p2 * cross
    elif kind == "aspect":
        moved[:, 1] = ASPECT * n[:, 1]
    elif kind == "smooth":
        for _ in range(6):
            wave, phase, size = (
                rng.normal(0.0, 5.0, 2),
                rng.uniform(0.0, 2.0 * np.pi),
                rng.normal(0.0, 1.0, 2),
            )
            moved += WAVE_PX / K[0, 0] * size * np.sin(n @ wave + phase)[:, None]
    elif kind != "none":
        raise UsageError(unknown_word("lens error", kind, KINDS))
    return np.asarray(K[0, 0] * moved)


def facades_study(
    out: Path,
    *,
    scenes: int = 3,
    kinds: Sequence[str] = KINDS,
    threads: int = 2,
) -> Iterator[Part]:
    """Compare unknown with true calibration on rendered facades, with lens errors that no model has."""
    z: dict[str, list[F64]] = {kind: [] for kind in kinds}
    errors: dict[str, list[list[float | None]]] = {kind: [] for kind in kinds}
    for number in range(scenes):
        scene = load_facade(number)
        matched = match_scene(scene, out, threads=threads)
        for kind in kinds:
            report_progress(f"{scene.name}, {kind}")
            unknown, known = _solved(matched, scene, kind, number)
            truth = TrueCameras(*scene.cameras)
            # One camera: its first view stands for all.
            z[kind].append(interval_scores(unknown, truth.K).z[0])
            measured = [measure_cameras(one.reconstruction, truth) for one in (unknown, known)]
            errors[kind].append([one.centre_error_mm for one in measured])
    for kind in kinds:
        rows = Rows(f"lens error: {kind}", UNKNOWN)
        mean = np.mean(np.array(errors[kind], dtype=np.float64), axis=0)
        rows.add("error of the camera centres, mean", {UNKNOWN: mean[0], KNOWN: mean[1]}, "mm")
        scores = np.abs(np.array(z[kind]))
        held = float(np.mean(scores <= LEVEL))
        rows.add("95 % intervals of focal length and principal point that hold", held, at_least=MIN_HOLDING)
        rows.add("largest error in stated standard deviations", float(scores.max()))
        yield rows


def _solved(matched: Matched, scene: Scene, kind: str, seed: int) -> tuple[MetricResult, MetricResult]:
    K = scene.cameras[0][0]
    xy = matched.tracks.xy
    moved = xy + lens_error(kind, xy, K, np.random.default_rng(seed))
    matched = replace(matched, tracks=replace(matched.tracks, xy=moved))
    known = IntrinsicsOptions(
        focal="known", focal_px=float(K[0, 0]), principal_point="known", principal_point_px=tuple(K[:2, 2])
    )
    found = []
    for options in (IntrinsicsOptions(), known):
        result, failures, _ = solve(matched, PipelineConfig(intrinsics=options), seed=seed, first=0)
        assert result is not None, failures
        found.append(result)
    return found[0], found[1]

"""Growth of time, memory and error from tracks to metric cameras, on simulated tracks of many views.

Projective reconstruction, self-calibration and refinement with their usual settings; nothing is matched.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_from_options
from thesisrecon.pipeline.large_sets import calibrate_with_core, calibrated_part
from thesisrecon.projective.incremental import IncrementalProjective
from thesisrecon.runtime._run import stream
from validation.metrics.cameras import TrueCameras, measure_cameras, relative_centre_error
from validation.runs.processes import call_apart, peak_mb, reset_peak
from validation.runs.study import Part
from validation.runs.tables import text_table
from validation.scenes.many_tracks import Kind, make_tracks

COLUMNS = ("projective", "selfcalibration", "metric")


@dataclass(frozen=True)
class CameraCost:
    """Processor seconds and peak MB by stage, registered views, and errors (centres: of their extent)."""

    cpu_s: list[float]
    peak_mb: list[float]
    registered: int
    trusted: bool
    focal_pct: float
    focal_std_pct: float
    centre_pct: float


def measure_growth(kind: Kind, views: int, core_views: int) -> dict[str, Any]:
    """Reconstruct simulated views in this process; return the fields of :class:`CameraCost`."""
    set_, config, cost = make_tracks(kind, views), PipelineConfig(), CameraCost([], [], 0, False, 0, 0, 0)
    sizes = [(int(width), int(height)) for width, height in set_.sizes]
    prior = prior_from_options(IntrinsicsOptions(), sizes, np.full(views, np.nan), np.ones(views))
    method = IncrementalProjective(core_views=core_views)

    def measured(stage: str, work: Any) -> Any:
        reset_peak()
        before, answer = time.process_time(), work(stream(0, stage))
        cost.cpu_s.append(time.process_time() - before)
        cost.peak_mb.append(peak_mb())
        return answer

    found = measured(
        "projective", lambda rng: method.reconstruct(set_.tracks, set_.pairs, set_.sizes, rng=rng)
    )
    calibration = measured(
        "selfcalibration",
        lambda rng: calibrate_with_core(config.selfcalibration, found, prior=prior, rng=rng),
    )
    part = calibrated_part(found, calibration)
    metric = measured(
        "metric", lambda rng: config.metric.refine(part, calibration, prior=prior, rng=rng, threads=1)
    )
    K, R, C = (np.array([getattr(pose, name) for pose in set_.poses]) for name in "KRC")
    errors, n = measure_cameras(metric.reconstruction, TrueCameras(K, R, C)), metric.reconstruction.registered
    focal = metric.intrinsics[int(np.flatnonzero(n)[0])]["focal_px"]
    centre = 100.0 * relative_centre_error(errors, C)
    std = 100.0 * focal.std / focal.value
    fields = (int(n.sum()), bool(metric.trusted), errors.focal_error_pct, std, centre)
    return asdict(CameraCost(cost.cpu_s, cost.peak_mb, *fields))


def growth_of_cameras_study(
    kinds: tuple[str, ...] = ("place", "street"),
    sizes: tuple[int, ...] = (30, 100, 300, 1000),
    core_views: int = IncrementalProjective().core_views,
) -> Iterator[Part]:
    """Measure what cameras of many views cost from tracks on, and how exact they are."""
    lines = []
    for kind in kinds:
        for views in sizes:
            cost = CameraCost(**call_apart(measure_growth, kind, views, core_views)[0])
            seconds = [f"{s:.1f}" for s in cost.cpu_s]
            errors = [f"{e:.4f}" for e in (cost.focal_pct, cost.focal_std_pct, cost.centre_pct)]
            counts = [str(cost.registered), "yes" if cost.trusted else "no"]
            lines.append([f"{kind} {views}", *seconds, f"{max(cost.peak_mb):.0f}", *counts, *errors])
            yield " ".join(lines[-1])
    heads = [
        *(f"{c}, s" for c in COLUMNS),
        "peak MB",
        "registered",
        "trusted",
        "focal %",
        "std %",
        "centre %",
    ]
    yield text_table(["", *heads], lines)

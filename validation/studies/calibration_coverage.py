"""Coverage of the 95 % intervals of self-calibration on synthetic scenes.

General scenes of random cameras with noisy tracks, from the projective maximum-likelihood reconstruction
through self-calibration to the metric stage. The intervals of focal length and principal point should contain
the truth in 95 of 100 cases.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Literal

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.records import MetricResult
from thesisrecon.runtime._run import stream
from validation.metrics.intervals import LEVEL, IntervalScores, holding_std, interval_scores, join_scores
from validation.runs.study import Part
from validation.runs.tables import Metric, Rows
from validation.scenes.critical import Motion, make_sequence, projective_estimate
from validation.studies.against_colmap import OURS

Cameras = Literal["shared", "per-image"]
MODES: tuple[Cameras, ...] = ("shared", "per-image")
SUCCESS_PCT = 3.0


def one_camera(scores: IntervalScores, cameras: Cameras) -> IntervalScores:
    if cameras == "per-image":
        return scores
    first = int(np.flatnonzero(np.isfinite(scores.std_rel))[0])
    return IntervalScores(scores.z[first : first + 1], scores.std_rel[first : first + 1])


COVERAGE = 0.92, 0.98
ZOOM = 0.3


def run_trial(cameras: Cameras, number: int) -> tuple[IntervalScores, MetricResult] | None:
    """Solve one synthetic scene; None if calibration fails."""
    rng = np.random.default_rng([number, 5])
    scene = make_sequence(Motion.GENERAL, rng, zoom=0.0 if cameras == "shared" else ZOOM)
    projective = projective_estimate(scene, rng)
    config = PipelineConfig()
    prior = prior_for(projective, replace(config.intrinsics, cameras=cameras))
    try:
        calibration = config.selfcalibration.calibrate(
            projective, prior=prior, rng=stream(number, "selfcalibration")
        )
        result = config.metric.refine(
            projective, calibration, prior=prior, rng=stream(number, "metric"), threads=1
        )
    except StageFailure:
        return None
    return one_camera(interval_scores(result, scene.K), cameras), result


def check_coverage(cameras: Cameras, numbers: Iterable[int]) -> list[Metric]:
    """Measure one mode over these trials; results that are not trusted do not count."""
    found = [run_trial(cameras, number) for number in numbers]
    trusted = [part for part in found if part is not None and part[1].trusted]
    rows = Rows(f"synthetic, {cameras}", OURS)
    rows.add(f"calibrated of {len(found)}", float(sum(part is not None for part in found)))
    rows.add(f"trusted of {len(found)}", float(len(trusted)), at_least=1.0)
    if not trusted:
        return rows
    scores = [part[0] for part in trusted]
    joined = join_scores(scores)
    for label, columns in {"focal": (0,), "principal point": (1, 2)}.items():
        z, share = joined.z[:, columns], joined.holding(columns)
        name = f"95 % intervals of the {label} that hold the truth"
        rows.add(name, share, at_least=COVERAGE[0])
        rows.add(f"{name} (no wider than needed)", share, at_most=COVERAGE[1])
        rows.add(f"{name}, 95 % uncertainty of this share", LEVEL * holding_std(scores, columns))
        rows.add(f"error, {label}, rms in stated standard deviations", float(np.sqrt(np.nanmean(z**2))))
    rows.add("stated standard deviation of the focal, median, %", float(100 * np.nanmedian(joined.std_rel)))
    return rows


def calibration_coverage_study(trials: int = 200) -> Iterator[Part]:
    """Count 95 % intervals that contain the truth, on synthetic scenes that match the model."""
    for cameras in MODES:
        yield check_coverage(cameras, range(trials))

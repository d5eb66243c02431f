"""Whether stated intervals hold the truth where everything is as the model has it:
``python -m validation.studies.calibration_coverage -o OUT [--trials N]``.

General scenes of random cameras with noisy tracks, from the projective reconstruction of maximum likelihood
through self-calibration and the metric stage; 95 % intervals of focal length and principal point should hold
the truth in 95 of 100 cases. OUT gets ``calibration_coverage.md`` and ``calibration_coverage.json``; the exit
code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from thesisrecon.arrays import B8
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import prior_for
from thesisrecon.io.files import write_text
from thesisrecon.records import MetricResult
from thesisrecon.runtime.run import stream
from validation.metrics.intervals import (
    LEVEL,
    IntervalScores,
    holding_std,
    interval_scores,
    join_scores,
)
from validation.metrics.record import Metric, markdown_table
from validation.scenes.critical import Motion, Sequence, make_sequence, projective_estimate
from validation.studies.calibration_parts import (
    MODES,
    Cameras,
    OwnRows,
    keep_observations,
    named,
    one_camera,
)

COVERAGE = 0.92, 0.98
ZOOM = 0.3
COLUMNS = {"focal": (0,), "principal point": (1, 2)}


def run_trial(cameras: Cameras, number: int) -> tuple[IntervalScores, MetricResult] | None:
    """One scene: what its intervals hold; None where it could not be calibrated.

    With one camera per image the focal lengths vary by factors e^+-0.3.
    """
    rng = np.random.default_rng([number, 5])
    scene = make_sequence(Motion.GENERAL, rng, zoom=0.0 if cameras == "shared" else ZOOM)
    return _solve(scene, cameras, number, rng)


def _solve(
    scene: Sequence, cameras: Cameras, number: int, rng: np.random.Generator, postponed: tuple[int, ...] = ()
) -> tuple[IntervalScores, MetricResult] | None:
    projective = projective_estimate(scene, rng)
    registered = ~np.isin(np.arange(len(scene.K)), postponed)
    projective = replace(
        projective,
        registered=registered,
        P=np.where(registered[:, None, None], projective.P, 0.0),
        inlier=projective.inlier & registered[scene.tracks.view_index],
    )
    config = PipelineConfig()
    config = replace(config, intrinsics=replace(config.intrinsics, cameras=cameras))
    prior = prior_for(projective, config.intrinsics)
    try:
        calibration = config.selfcalibration.calibrate(
            projective, prior=prior, rng=stream(number, "selfcalibration")
        )
        result = config.metric.refine(projective, calibration, prior=prior, rng=stream(number, "metric"))
    except StageFailure:
        return None
    return one_camera(interval_scores(result, scene.K), cameras), result


def run_weak_trial(number: int) -> tuple[IntervalScores, MetricResult] | None:
    """One scene with a camera per image whose first photograph keeps a window of 30 % of width and height, or
    in every other trial what lies near a plane; the projective stage has postponed it."""
    rng = np.random.default_rng([number, 6])
    scene = make_sequence(Motion.GENERAL, rng, zoom=ZOOM)
    keep = _in_window(scene, rng) if number % 2 else _near_plane(scene)
    tracks = keep_observations(scene.tracks, keep | (scene.tracks.view_index != 0))
    return _solve(replace(scene, tracks=tracks), "per-image", number, rng, postponed=(0,))


def _in_window(scene: Sequence, rng: np.random.Generator) -> B8:
    xy, mine = scene.tracks.xy, np.flatnonzero(scene.tracks.view_index == 0)
    return np.asarray((np.abs(xy - xy[rng.choice(mine)]) <= 0.15 * scene.sizes[0]).all(axis=1))


def _near_plane(scene: Sequence) -> B8:
    """Points within a twentieth of the scene's size from the plane x = 0."""
    return np.asarray(np.abs(scene.X[scene.tracks.point_index, 0]) < 0.1)


def check_weak_coverage(numbers: Iterable[int]) -> list[Metric]:
    """The first photograph of these trials: its error, its interval, whether it is named."""
    title = "synthetic, per-image, one photograph with little overlap"
    found = [part for part in map(run_weak_trial, numbers) if part is not None]
    scores = [part[0] for part in found]
    there = np.array([bool(np.isfinite(s.std_rel[0])) for s in scores])
    error = np.array([100.0 * abs(s.z[0, 0]) * s.std_rel[0] for s in scores])
    told = np.array([named(result, 0) for _, result in found])
    z = np.array([abs(s.z[0, 0]) for s in scores])
    rows = OwnRows(title)
    rows.add(f"registered of {len(found)}", float(there.sum()))
    rows.add("focal error, median, %", float(np.median(error[there])))
    rows.add("focal error, worst, %", float(np.max(error[there])))
    held = float(np.mean(z[there] <= LEVEL))
    rows.add("95 % intervals of the focal that hold the truth", held, COVERAGE[0], at_most=False)
    rows.add("largest deviation, stated sigmas", float(np.max(z[there])))
    rows.add("off by more than 3 % and not named", float(np.sum(there & (error > 3.0) & ~told)), 0.0)
    rows.add("named", float(np.mean(told)))
    return rows.metrics


def check_coverage(cameras: Cameras, numbers: Iterable[int]) -> list[Metric]:
    """The rows of one mode over these trials; what the self-check does not trust states nothing."""
    found = [run_trial(cameras, number) for number in numbers]
    trusted = [part for part in found if part is not None and part[1].trusted]
    rows = OwnRows(f"synthetic, {cameras}")
    rows.add(f"calibrated of {len(found)}", float(sum(part is not None for part in found)))
    rows.add(f"trusted of {len(found)}", float(len(trusted)))
    if not trusted:
        return rows.metrics
    scores = [part[0] for part in trusted]
    joined = join_scores(scores)
    for what, columns in COLUMNS.items():
        z, share = joined.z[:, columns], joined.holding(columns)
        name = f"95 % intervals of the {what} that hold the truth"
        rows.add(name, share, COVERAGE[0], at_most=False)
        rows.add(f"{name} (no wider than needed)", share, COVERAGE[1])
        rows.add(f"{name}, 95 % uncertainty of this share", LEVEL * holding_std(scores, columns))
        rows.add(f"deviation, {what}, rms in stated sigmas", float(np.sqrt(np.nanmean(z**2))))
    rows.add("stated sigma of the focal, median, %", float(100 * np.nanmedian(joined.std_rel)))
    return rows.metrics


def main(arguments: list[str] | None = None) -> int:
    """Measure, write, and say whether every target was reached."""
    parser = argparse.ArgumentParser(
        prog="python -m validation.studies.calibration_coverage", description=__doc__
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=200)
    wishes = parser.parse_args(arguments)
    numbers = range(wishes.trials)
    tables = [*(check_coverage(cameras, numbers) for cameras in MODES), check_weak_coverage(numbers)]
    text = ["# Intervals on synthetic scenes", ""]
    for rows in tables:
        text += [f"## {rows[0].scene}", "", markdown_table(rows), ""]
    told = [{**asdict(metric), "verdict": metric.verdict} for rows in tables for metric in rows]
    wishes.out.mkdir(parents=True, exist_ok=True)
    write_text(wishes.out / "calibration_coverage.md", "\n".join(text))
    write_text(wishes.out / "calibration_coverage.json", json.dumps(told, indent=1) + "\n")
    print("\n".join(text))
    return int(any(metric.verdict == "missed" for rows in tables for metric in rows))


if __name__ == "__main__":
    sys.exit(main())

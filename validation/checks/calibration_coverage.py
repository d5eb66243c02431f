"""Whether stated intervals hold the truth where everything is as the model has it:
``python -m validation.checks.calibration_coverage -o OUT [--trials N]``.

General scenes of random cameras with noisy tracks, from the projective reconstruction of maximum likelihood
through self-calibration and the metric stage; 95 % intervals of focal length and principal point should hold
the truth in 95 of 100 cases. OUT gets ``calibration_coverage.md`` and ``calibration_coverage.json``; the exit
code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from thesisrecon.assumptions import assume
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.run import stream
from thesisrecon.types import MetricResult
from validation.checks.calibration_parts import MODES, Cameras, one_camera
from validation.checks.reconstruction import OURS
from validation.metrics.intervals import IntervalScores, interval_scores, join_scores
from validation.metrics.record import Metric, markdown_table
from validation.scenes.critical import Motion, make_sequence, projective_estimate

COVERAGE = 0.92, 0.98
ZOOM = 0.3
COLUMNS = {"focal": (0,), "principal point": (1, 2)}


def run_trial(cameras: Cameras, number: int) -> tuple[IntervalScores, MetricResult] | None:
    """One scene: what its intervals hold; None where it could not be calibrated.

    With one camera per image the focal lengths vary by factors e^+-0.3.
    """
    rng = np.random.default_rng([number, 5])
    scene = make_sequence(Motion.GENERAL, rng, zoom=0.0 if cameras == "shared" else ZOOM)
    projective = projective_estimate(scene, rng)
    config = PipelineConfig()
    config = replace(config, intrinsics=replace(config.intrinsics, cameras=cameras))
    assumed = assume(projective, config.intrinsics)
    try:
        calibration = config.selfcalibration.calibrate(
            projective, assumed=assumed, rng=stream(number, "selfcalibration")
        )
        result = config.metric.refine(projective, calibration, assumed=assumed, rng=stream(number, "metric"))
    except StageFailure:
        return None
    return one_camera(interval_scores(result, scene.K), cameras), result


def check_coverage(cameras: Cameras, numbers: Sequence[int]) -> list[Metric]:
    """The rows of one mode over these trials; what the self-check does not trust states nothing."""
    found = [run_trial(cameras, number) for number in numbers]
    trusted = [part for part in found if part is not None and part[1].trusted]
    title = f"synthetic, {cameras}"
    rows = [
        _row(title, f"calibrated of {len(found)}", float(sum(part is not None for part in found))),
        _row(title, f"trusted of {len(found)}", float(len(trusted))),
    ]
    if not trusted:
        return rows
    scores = join_scores([part[0] for part in trusted])
    for what, columns in COLUMNS.items():
        z, share = scores.z[:, columns], scores.holding(columns)
        name = f"95 % intervals of the {what} that hold the truth"
        rows.append(_row(title, name, share, COVERAGE[0], at_most=False))
        rows.append(_row(title, f"{name} (no wider than needed)", share, COVERAGE[1]))
        rows.append(_row(title, f"deviation, {what}, rms in stated sigmas", float(np.sqrt(np.nanmean(z**2)))))
    rows.append(
        _row(title, "stated sigma of the focal, median, %", float(100 * np.nanmedian(scores.std_rel)))
    )
    return rows


def _row(title: str, name: str, value: float, target: float | None = None, *, at_most: bool = True) -> Metric:
    return Metric(title, name, "", {OURS: value}, OURS, target, at_most=at_most)


def main(arguments: list[str] | None = None) -> int:
    """Measure, write, and say whether every target was reached."""
    parser = argparse.ArgumentParser(
        prog="python -m validation.checks.calibration_coverage", description=__doc__
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=200)
    wishes = parser.parse_args(arguments)
    tables = [check_coverage(cameras, range(wishes.trials)) for cameras in MODES]
    text = ["# Intervals on synthetic scenes", ""]
    for rows in tables:
        text += [f"## {rows[0].scene}", "", markdown_table(rows), ""]
    told = [{**asdict(metric), "verdict": metric.verdict} for rows in tables for metric in rows]
    wishes.out.mkdir(parents=True, exist_ok=True)
    (wishes.out / "calibration_coverage.md").write_text("\n".join(text), encoding="utf-8")
    (wishes.out / "calibration_coverage.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    print("\n".join(text))
    return int(any(metric.verdict == "missed" for rows in tables for metric in rows))


if __name__ == "__main__":
    sys.exit(main())

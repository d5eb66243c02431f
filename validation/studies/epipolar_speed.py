"""Processor time and accuracy of F beside OpenCV, PoseLib and COLMAP; run as a module.

OpenCV's robust methods have the confidence of ours, 0.9999, and 20000 iterations; its defaults, 0.99 and
1000, PoseLib and COLMAP are taken as they come. All threads count, so a BLAS that starts some needs
OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from thesisrecon.epipolar.configuration import Configuration
from validation.metrics.epipolar import rms_epipolar_distance
from validation.metrics.record import Metric, markdown_table
from validation.references.fundamental import OURS, SOLVERS
from validation.references.libraries import one_thread
from validation.scenes.two_views import make_two_views

SIZE, SIGMA_PX, THRESHOLD_PX = (1280.0, 960.0), 0.5, 1.0
ACCURATE, POSELIB = "USAC_ACCURATE", "PoseLib"
METHODS = (OURS, ACCURATE, POSELIB, "USAC_ACCURATE default", "USAC_MAGSAC", "FM_RANSAC", "COLMAP")
"""Judged against the second and third; the others are for information."""


def check_speed(outliers: float, n: int, trials: int) -> list[Metric]:
    """Medians over the trials of milliseconds and of RMS distances of exact matches, px; warm, one thread."""
    one_thread()
    milliseconds: dict[str, list[float]] = {name: [] for name in METHODS}
    errors: dict[str, list[float]] = {name: [] for name in METHODS}
    for seed in range(-1, trials):
        rng = np.random.default_rng(abs(seed))
        scene = make_two_views(Configuration.GENERAL, n, rng)
        xy1, xy2 = (xy + rng.normal(0.0, SIGMA_PX, xy.shape) for xy in (scene.xy1, scene.xy2))
        wrong = rng.random(n) < outliers
        xy2[wrong] = rng.uniform((0.0, 0.0), SIZE, (int(wrong.sum()), 2))
        for name in METHODS:
            start = time.process_time()
            F = SOLVERS[name](xy1, xy2, THRESHOLD_PX, max(seed, 0))[0]
            elapsed = 1e3 * (time.process_time() - start)
            if seed >= 0:
                milliseconds[name].append(elapsed)
                truth = np.hstack([scene.xy1, scene.xy2])
                errors[name].append(rms_epipolar_distance(F, truth))
    time_ms = {name: float(np.median(values)) for name, values in milliseconds.items()}
    error_px = {name: float(np.median(values)) for name, values in errors.items()}
    failed = {name: float(np.sum(np.array(values) > THRESHOLD_PX)) for name, values in errors.items()}
    title = f"{100.0 * outliers:.0f} % outliers, n = {n}"
    allowed_ms = min(time_ms[ACCURATE], 0.5 * time_ms[POSELIB])
    return [
        Metric(title, "time", "ms", time_ms, OURS, allowed_ms),
        Metric(title, "median error", "px", error_px, OURS, min(error_px[ACCURATE], error_px[POSELIB])),
        Metric(title, f"runs > {THRESHOLD_PX:g} px, of {trials}", "", failed, OURS),
        Metric(title, "time of ours over theirs", "", _over(time_ms), OURS),
        Metric(title, "median error of ours over theirs", "", _over(error_px), OURS),
    ]


def _over(values: dict[str, float]) -> dict[str, float]:
    return {name: values[OURS] / value for name, value in values.items()}


def main() -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    arguments = parser.parse_args()
    rows: list[Metric] = []
    for outliers in (0.1, 0.3, 0.5, 0.7):
        block = check_speed(outliers, 1000, arguments.trials)
        rows += block
        print(block[0].scene, markdown_table(block), sep="\n\n", flush=True)
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())

"""Processor time and accuracy of F beside OpenCV and PoseLib; run as a module."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray

from thesisrecon.epipolar import estimate_fundamental
from thesisrecon.epipolar.degeneracy import Configuration
from thesisrecon.geometry.multiview import symmetric_residuals
from validation.metrics.record import Metric, markdown_table
from validation.scenes.two_views import make_two_views

F64 = NDArray[np.float64]
SIZE, SIGMA_PX, THRESHOLD_PX = (1280.0, 960.0), 0.5, 1.0
OURS, ACCURATE, POSELIB = "ours", "USAC_ACCURATE", "PoseLib"


def _accurate(xy1: F64, xy2: F64, _: int) -> Any:
    return cv2.findFundamentalMat(xy1, xy2, cv2.USAC_ACCURATE, THRESHOLD_PX, 0.9999, 20000)[0]


def _poselib(xy1: F64, xy2: F64, seed: int) -> Any:
    return poselib.estimate_fundamental(xy1, xy2, {"max_epipolar_error": THRESHOLD_PX, "seed": seed}, {})[0]


METHODS: dict[str, Callable[[F64, F64, int], Any]] = {
    OURS: lambda xy1, xy2, seed: estimate_fundamental(xy1, xy2, threshold_px=THRESHOLD_PX, seed=seed).F,
    ACCURATE: _accurate,
    POSELIB: _poselib,
}


def check_speed(outliers: float, n: int, trials: int) -> list[Metric]:
    """Medians over the trials of milliseconds and of RMS distances of exact matches, px; warm, one thread."""
    cv2.setNumThreads(1)
    milliseconds: dict[str, list[float]] = {name: [] for name in METHODS}
    errors: dict[str, list[float]] = {name: [] for name in METHODS}
    for seed in range(-1, trials):
        rng = np.random.default_rng(abs(seed))
        scene = make_two_views(Configuration.GENERAL, n, rng)
        xy1, xy2 = (xy + rng.normal(0.0, SIGMA_PX, xy.shape) for xy in (scene.xy1, scene.xy2))
        wrong = rng.random(n) < outliers
        xy2[wrong] = rng.uniform((0.0, 0.0), SIZE, (int(wrong.sum()), 2))
        for name, estimate in METHODS.items():
            start = time.process_time()
            F = np.asarray(estimate(xy1, xy2, max(seed, 0)))
            elapsed = 1e3 * (time.process_time() - start)
            if seed >= 0:
                milliseconds[name].append(elapsed)
                rms = np.sqrt(np.mean(symmetric_residuals(F, scene.xy1, scene.xy2) ** 2) / 2.0)
                errors[name].append(float(rms))
    time_ms = {name: float(np.median(values)) for name, values in milliseconds.items()}
    error_px = {name: float(np.median(values)) for name, values in errors.items()}
    title = f"{100.0 * outliers:.0f} % outliers, n = {n}"
    allowed_ms = min(time_ms[ACCURATE], 0.5 * time_ms[POSELIB])
    return [
        Metric(title, "time", "ms", time_ms, OURS, allowed_ms),
        Metric(title, "median error", "px", error_px, OURS, min(error_px[ACCURATE], error_px[POSELIB])),
    ]


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

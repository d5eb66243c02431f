"""Robust estimators by samples and by time: the best model of a search so far, against the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

import thesisrecon
from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.epipolar._matches import PairFrame
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.errors import StageFailure, unknown_word
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, whitened_frame
from validation.ablation.statistics import Sample
from validation.ablation.study import Measure, Place, Task
from validation.metrics.fundamental_precision import rms_epipolar_distance
from validation.metrics.searches import Step, traced
from validation.scenes.two_views import K, TwoViews, make_two_views

K_INVERSE = np.linalg.inv(K)


class Data(NamedTuple):
    """Two views with exact points, their noisy and wrong matches (N, 2), and what the search needs."""

    exact: TwoViews
    xy1: F64
    xy2: F64
    threshold_px: float
    seed: int


class Estimator(NamedTuple):
    """A robust estimator: ``estimate`` (configuration, data) gives its model, ``in_pixels`` (model of a step,
    data) a model of the trace in the same form, and ``error_px`` the RMS distance of exact points from it.
    """

    estimate: Callable[[PipelineConfig, Data], F64]
    in_pixels: Callable[[F64, Data], F64]
    error_px: Callable[[F64, TwoViews], float]


def _of_configuration(config: PipelineConfig, d: Data) -> F64:
    return config.epipolar.estimate(d.xy1, d.xy2, np.random.default_rng(d.seed)).F


def _pair_frame(d: Data) -> PairFrame:
    return PairFrame.of(d.xy1, d.xy2)


def _epipolar(F: F64, exact: TwoViews) -> float:
    return rms_epipolar_distance(F, np.hstack([exact.xy1, exact.xy2]))


def _transfer(H: F64, exact: TwoViews) -> float:
    return _rms(dehomogenize(homogenize(exact.xy1) @ H.T) - exact.xy2)


def _reprojection(P: F64, exact: TwoViews) -> float:
    return _rms(project(P, exact.X) - exact.xy2)


def _rms(difference: F64) -> float:
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))


ESTIMATORS = {
    "fundamental": Estimator(_of_configuration, lambda f, d: _pair_frame(d).matrix_in_pixels(f), _epipolar),
    "essential": Estimator(
        lambda _, d: (
            thesisrecon.estimate_essential(d.xy1, d.xy2, K, threshold_px=d.threshold_px, seed=d.seed).E
        ),
        lambda E, _: E,
        lambda E, exact: _epipolar(K_INVERSE.T @ E @ K_INVERSE, exact),
    ),
    "homography": Estimator(
        lambda _, d: (
            thesisrecon.estimate_homography(d.xy1, d.xy2, threshold_px=d.threshold_px, seed=d.seed).H
        ),
        lambda H, d: (_pair_frame(d).homography_to_pixels @ H.ravel()).reshape(3, 3),
        _transfer,
    ),
    "camera": Estimator(
        lambda _, d: thesisrecon.resect(d.exact.X, d.xy2, threshold_px=d.threshold_px, seed=d.seed).P,
        lambda P, d: whitened_frame(homogenize(d.exact.X)).cameras_back(P),
        _reprojection,
    ),
    "pose": Estimator(
        lambda _, d: thesisrecon.resect(d.exact.X, d.xy2, K=K, threshold_px=d.threshold_px, seed=d.seed).P,
        lambda pose, _: K @ pose,
        _reprojection,
    ),
}


@dataclass(frozen=True)
class RobustSearch(Task):
    """``matches`` of two simulated views (1280 x 960 px) with Gaussian noise of ``noise_px`` and a share
    ``outliers`` thrown anywhere. ``estimator`` is "fundamental" (the variant of the stage epipolar, with its
    own threshold), "essential", "homography" (the points lie in a plane), "camera" or "pose" (of the second
    view, from the points in space). Judged is the best model after ``after_samples`` samples and ``after_ms``
    of its search, or the result of a search that ends before; 0 is no limit. Over such conditions the curves
    of a study are accuracy over samples and over time; ``cost`` and ``inliers_pct`` are those of the search.
    A row fails while there is no model.
    """

    estimator: str = "fundamental"
    matches: int = 500
    outliers: float = 0.5
    noise_px: float = 0.5
    threshold_px: float = 1.5
    after_samples: int = 0
    after_ms: float = 0.0

    scenes: ClassVar[Sequence[str]] = ("two views",)
    sample: ClassVar[Sample] = "draws"
    measures: ClassVar[Sequence[Measure]] = (
        Measure("error_px", "px", "less", True, "RMS distance of the exact points from the model"),
        Measure("inliers_pct", "%", "more", False, "data within the threshold of the best model"),
        Measure("cost", "", "less", True, "its mean truncated squared residual over the threshold"),
        Measure("samples", "", "less", True, "samples drawn until then", extra=True),
        Measure("search_ms", "ms", "less", True, "time until then", extra=True),
    )

    def __post_init__(self) -> None:
        if self.estimator not in ESTIMATORS:
            raise ValueError(unknown_word("estimator", self.estimator, ESTIMATORS))
        if self.noise_px < 0.0 or not 0.0 <= self.outliers < 1.0 or self.matches < 20:
            raise ValueError("noise_px is at least 0, outliers between 0 and 1, matches at least 20")
        if self.after_samples < 0 or self.after_ms < 0.0:
            raise ValueError("after_samples and after_ms are at least 0, which is the end")

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        data, kind = self._draw(seed), ESTIMATORS[self.estimator]
        if self.after_ms:
            kind.estimate(config, data)  # kernels are compiled or loaded
        with traced() as trace:
            result = kind.estimate(config, data)
            seconds = time.perf_counter() - trace.started
        limits = self.after_samples or np.inf, 1e-3 * self.after_ms or np.inf
        step = trace.after(*limits)
        if step is None:
            raise StageFailure("no model yet", f"{trace.samples} samples were drawn in all")
        early = limits[0] < trace.samples or limits[1] < seconds
        model = kind.in_pixels(step.model, data) if early else result
        return _numbers(step, kind.error_px(model, data.exact))

    def _draw(self, seed: int) -> Data:
        rng = np.random.default_rng((seed, round(1e3 * self.noise_px), round(1e3 * self.outliers)))
        plane = Configuration.PLANE if self.estimator == "homography" else Configuration.GENERAL
        exact = make_two_views(plane, self.matches, rng)
        xy1, xy2 = (xy + self.noise_px * rng.normal(size=xy.shape) for xy in (exact.xy1, exact.xy2))
        wrong = rng.random(len(xy2)) < self.outliers
        xy2[wrong] = rng.uniform(0.0, (1280.0, 960.0), (int(wrong.sum()), 2))
        return Data(exact, xy1, xy2, self.threshold_px, seed)


def _numbers(step: Step, error_px: float) -> dict[str, float]:
    found = {"error_px": error_px, "inliers_pct": 100.0 * step.share, "cost": step.cost}
    return {**found, "samples": float(step.samples), "search_ms": 1e3 * step.seconds}

"""The thesis' cube study (5.5) as a task: F of noisy points against the exact ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, UsageError, unknown_word
from thesisrecon.geometry.two_view import epipoles, symmetric_residuals
from validation.ablation.statistics import Sample
from validation.ablation.study import Measure, Place, Task
from validation.metrics.fundamental_precision import fundamental_bound
from validation.scenes.cube import K, cube_pairs, make_cube
from validation.scenes.two_views import TwoViews
from validation.studies.epipolar_methods import MATCHED_SIGMAS, METHODS, THRESHOLD_PX

BY_METHOD = {m.name: m for m in METHODS}
OF_CONFIG = "epipolar of the configuration"


@dataclass(frozen=True)
class FundamentalOfCube(Task):
    """``pairs`` pairs of the 27 cameras, drawn by the seed, with Gaussian noise of ``noise_px`` and a share
    ``outliers`` of matches thrown anywhere.

    ``method`` is one of the catalogue of methods of F; "epipolar of the configuration" is the variant of that
    stage, whose threshold is its own. ``iterations`` and the like are then paths of that stage.
    """

    method: str = OF_CONFIG
    noise_px: float = 1.0
    outliers: float = 0.0
    pairs: int = 8

    sample: ClassVar[Sample] = "draws"
    measures: ClassVar[Sequence[Measure]] = (
        Measure(
            "distance_px", "px", "less", True, "median over the pairs of the RMS distance of the exact points"
            " to their epipolar lines",
        ),
        Measure("over_bound", "", "less", True, "the same over the least possible, RMS over the pairs"),
        Measure("epipole_deg", "deg", "less", True, "median error of the worse epipole, 90 without F"),
        Measure("within_pct", "%", "more", False, "share of the pairs whose distance is below 1 px"),
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.method not in (OF_CONFIG, *BY_METHOD):
            raise ValueError(unknown_word("method", self.method, [OF_CONFIG, *BY_METHOD]))
        if self.noise_px < 0.0 or not 0.0 <= self.outliers < 1.0 or self.pairs < 1:
            raise ValueError("noise_px is at least 0, outliers between 0 and 1, pairs at least 1")

    def check(self, scene: str) -> None:
        if scene != "cube":
            raise UsageError(unknown_word("scene", scene, ["cube"]))

    def unavailable(self, scene: str) -> set[str]:
        """Without noise there is no bound."""
        return set() if self.noise_px > 0.0 else {"over_bound"}

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        rng = np.random.default_rng((seed, round(1e3 * self.noise_px), round(1e3 * self.outliers)))
        chosen = rng.choice(len(_pairs()), self.pairs, replace=False)
        threshold = max(THRESHOLD_PX, MATCHED_SIGMAS * self.noise_px)
        found = []
        for pair in (_pairs()[k] for k in chosen):
            xy1, xy2 = self._matches(pair, rng)
            F = self._fundamental(config, xy1, xy2, threshold, seed)
            found.append(measure_pair(F, pair))
        distance, angle = np.array(found).T
        if np.isnan(distance).all():
            raise StageFailure("no pair has an F")
        bound = np.array([self._bound(_pairs()[k]) for k in chosen])
        distance = np.where(np.isnan(distance), np.inf, distance)
        # Error of an epipole without F, the largest that a direction of either sign can have.
        angle = np.where(np.isnan(angle), 90.0, angle)
        numbers = {
            "distance_px": float(np.median(distance)),
            "epipole_deg": float(np.median(angle)),
            "within_pct": 100.0 * float(np.mean(distance < 1.0)),
        }
        if self.noise_px > 0.0:
            numbers["over_bound"] = float(np.sqrt(np.mean((distance / bound) ** 2)))
        return numbers

    def _matches(self, pair: TwoViews, rng: np.random.Generator) -> tuple[F64, F64]:
        xy1, xy2 = (xy + self.noise_px * rng.normal(size=xy.shape) for xy in (pair.xy1, pair.xy2))
        wrong = rng.random(len(xy2)) < self.outliers
        anywhere = rng.uniform(pair.xy2.min(axis=0), pair.xy2.max(axis=0), xy2.shape)
        return xy1, np.where(wrong[:, None], anywhere, xy2)

    def _fundamental(
        self, config: PipelineConfig, xy1: F64, xy2: F64, threshold_px: float, seed: int
    ) -> F64 | None:
        if self.method != OF_CONFIG:
            return BY_METHOD[self.method].fundamental(xy1, xy2, threshold_px=threshold_px, seed=seed)
        try:
            return config.epipolar.estimate(xy1, xy2, np.random.default_rng(seed)).F
        except StageFailure:
            return None

    def _bound(self, pair: TwoViews) -> float:
        if self.noise_px == 0.0:
            return float("nan")
        return fundamental_bound(pair.P1, pair.P2, pair.X, sigma_px=self.noise_px).rms_distance_px


@cache
def _pairs() -> list[TwoViews]:
    return cube_pairs(make_cube())


def measure_pair(F: F64 | None, pair: TwoViews) -> tuple[float, float]:
    """RMS distance (px) of exact points to their lines, larger epipole error (degrees); NaN without F."""
    if F is None:
        return float("nan"), float("nan")
    distance = float(np.sqrt(np.mean(symmetric_residuals(F, pair.xy1, pair.xy2) ** 2) / 2.0))
    return distance, _epipole_error_deg(F, pair)


def _epipole_error_deg(F: F64, pair: TwoViews) -> float:
    centres = [np.linalg.svd(P)[2][3] for P in (pair.P1, pair.P2)]
    truths = (pair.P1 @ centres[1], pair.P2 @ centres[0])
    angles = []
    for found, true in zip(epipoles(F), truths, strict=True):
        a, b = (np.linalg.solve(K, e) for e in (found, true))
        sine, cosine = np.linalg.norm(np.cross(a, b)), abs(float(a @ b))
        angles.append(float(np.degrees(np.arctan2(sine, cosine))))
    return max(angles)

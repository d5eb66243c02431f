"""Section 5.4, Algorithm 2: random sample consensus (RANSAC) for any model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.kernels import kernel


@kernel
def draw_sample(uniforms: F64, n: int, out: I64) -> None:
    """Turn uniform numbers (s,) into distinct sorted indices below n; every subset is equally likely."""
    for k in range(len(out)):
        index = min(int(uniforms[k] * (n - k)), n - k - 1)
        place = 0
        while place < k and out[place] <= index:
            index += 1
            place += 1
        for m in range(k, place, -1):
            out[m] = out[m - 1]
        out[place] = index


@kernel
def required_samples(inlier_ratio: float, sample_size: int, confidence: float, largest: int) -> int:
    """Return the number of samples of which one is free of outliers with probability ``confidence``.

    N = log(1 - confidence) / log(1 - ratio^size) (Fischler and Bolles 1981), at most ``largest``.
    """
    good = inlier_ratio**sample_size
    if good <= 1e-12:
        return largest
    if good >= 1.0:
        return 1
    needed = np.log(1.0 - confidence) / np.log1p(-good)
    return int(min(float(largest), np.ceil(needed)))


Model = TypeVar("Model")


@dataclass(frozen=True)
class SampleConsensus:
    """Algorithm 2: the model with the most data within a threshold.

    Of two models with equally many inliers the one with the lower standard deviation wins (Fischler and
    Bolles, 1981). An exhaustive search would need n! / (s! (n - s)!) samples of size s (the thesis' text has
    n! / s!). ``stop_inlier_ratio`` ends the search; ``least_median`` ranks models by the median of their
    residuals instead (Rousseeuw, 1984).
    """

    threshold: float
    max_samples: int = 1000
    stop_inlier_ratio: float = 1.0
    least_median: bool = False

    def search(
        self,
        solve: Callable[[I64], list[Model]],
        residuals: Callable[[Model], F64],
        sample_size: int,
        n: int,
        rng: np.random.Generator,
    ) -> tuple[Model, B8, int] | None:
        """Return the best model of n data, its inliers (n,) and the number of samples; None without a model.

        ``solve`` gives the models of some data by their indices, ``residuals`` the distances (n,) of a model.
        """
        best: tuple[Model, B8] | None = None
        best_rank, drawn = (-np.inf, 0.0), 0
        sample = np.empty(sample_size, dtype=np.int64)
        while drawn < self.max_samples and best_rank[0] <= self.stop_inlier_ratio * n:
            draw_sample(rng.random(sample_size), n, sample)
            drawn += 1
            for model in solve(sample):
                rank, inliers = self._rank(residuals(model))
                if rank > best_rank:
                    best, best_rank = (model, inliers), rank
        return None if best is None else (*best, drawn)

    def _rank(self, residuals: F64) -> tuple[tuple[float, float], B8]:
        if self.least_median:
            median = float(np.partition(residuals, len(residuals) // 2)[len(residuals) // 2])
            return (-median, 0.0), residuals <= median
        inliers = np.abs(residuals) < self.threshold
        rms = float(np.sqrt(np.mean(residuals[inliers] ** 2))) if inliers.any() else 0.0
        return (int(inliers.sum()), -rms), inliers

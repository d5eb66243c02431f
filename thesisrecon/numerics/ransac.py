"""Section 5.4, Algorithm 2: the loop of random sampling consensus; what is sampled is the caller's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numba import njit
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, I64


@njit(cache=True, nogil=True)
def draw_sample(uniforms: F64, n: int, out: I64) -> None:
    """Turn uniform numbers (s,) in [0, 1) into s distinct indices below n (``out``, sorted).

    The k-th number picks one of the n - k indices not yet taken, so every subset is equally likely.
    """
    for k in range(len(out)):
        index = min(int(uniforms[k] * (n - k)), n - k - 1)
        place = 0
        while place < k and out[place] <= index:
            index += 1
            place += 1
        for m in range(k, place, -1):
            out[m] = out[m - 1]
        out[place] = index


@njit(cache=True, nogil=True)
def required_samples(inlier_share: float, sample_size: int, confidence: float, largest: int) -> int:
    """Samples after which one is free of outliers with probability ``confidence``, at most ``largest``.

    N = log(1 - confidence) / log(1 - share^size) (Fischler and Bolles 1981).
    """
    good = inlier_share**sample_size
    if good <= 1e-12:
        return largest
    if good >= 1.0:
        return 1
    needed = np.log(1.0 - confidence) / np.log1p(-good)
    return int(min(float(largest), np.ceil(needed)))


Model = TypeVar("Model")


class SampledProblem(Protocol[Model]):
    """What is estimated: models through a minimal sample, and how far the data are from a model."""

    @property
    def sample_size(self) -> int:
        """Data in a minimal sample."""

    def solve(self, sample: I64) -> list[Model]:
        """Models through the data of these indices (sample_size,), possibly none."""

    def residuals(self, model: Model) -> F64:
        """Distance of every datum from the model; (N,)."""


@dataclass(frozen=True)
class Consensus(Generic[Model]):
    """The model with the most data within the threshold, which they are (N,), and the samples drawn."""

    model: Model
    inliers: B8
    samples: int


@dataclass(frozen=True)
class SampleConsensus:
    """Random sample consensus (Algorithm 2 of the thesis; Fischler and Bolles, 1981).

    The model with the most residuals within ``threshold`` wins; of two with equal counts, the one whose
    inliers have the lower standard deviation. Trying every sample would take n! / (s! (n - s)!) samples of
    size s (the thesis has n! / s!).

    Parameters
    ----------
    threshold : float
        Residual below which a datum is an inlier.
    max_samples : int
        Maximum number of samples.
    stop_inlier_ratio : float
        Sampling stops once the inlier ratio exceeds this.
    least_median : bool
        Rank models by their median residual instead (Rousseeuw, 1984); ``threshold`` is then not used.
    """

    threshold: float
    max_samples: int = 1000
    stop_inlier_ratio: float = 1.0
    least_median: bool = False

    def search(self, problem: SampledProblem[Model], n: int, rng: Generator) -> Consensus[Model] | None:
        """The best model of ``n`` data, or None where no sample gave one.

        Raises ``ValueError`` for fewer data than a sample has.
        """
        if n < problem.sample_size:
            raise ValueError(f"sampling needs at least {problem.sample_size} data; got {n}")
        best: Consensus[Model] | None = None
        best_rank = (-np.inf, 0.0)
        sample = np.empty(problem.sample_size, dtype=np.int64)
        for drawn in range(1, self.max_samples + 1):
            draw_sample(rng.random(problem.sample_size), n, sample)
            for model in problem.solve(sample):
                rank, inliers = self._rank(problem.residuals(model))
                if rank > best_rank:
                    best, best_rank = Consensus(model, inliers, drawn), rank
            if best is not None and best_rank[0] > self.stop_inlier_ratio * n:
                break
        return None if best is None else Consensus(best.model, best.inliers, drawn)

    def _rank(self, residuals: F64) -> tuple[tuple[float, float], B8]:
        if self.least_median:
            median = float(np.partition(residuals, len(residuals) // 2)[len(residuals) // 2])
            return (-median, 0.0), residuals <= median
        inliers = np.abs(residuals) < self.threshold
        spread = float(np.sqrt(np.mean(residuals[inliers] ** 2))) if inliers.any() else 0.0
        return (int(inliers.sum()), -spread), inliers

"""Section 5.4, Algorithm 2: random sample consensus (RANSAC) for any model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.kernels import kernel


@kernel
def draw_sample(uniforms: F64, n: int, out: I64) -> None:
    """Turn uniform random numbers into distinct sorted indices; every subset is equally likely.

    Parameters
    ----------
    uniforms, n : ndarray (s,), int
        Numbers in [0, 1), and number of data.
    out : ndarray (s,) of int
        Output, indices below n.
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


@kernel
def required_samples(inlier_ratio: float, sample_size: int, confidence: float, largest: int) -> int:
    """Return the number of samples of which one is free of outliers with probability ``confidence``.

    N = log(1 - confidence) / log(1 - ratio^size) (Fischler and Bolles 1981).

    Parameters
    ----------
    inlier_ratio, sample_size, confidence : float, int, float
        Fraction of inliers, data in a minimal sample, and required probability.
    largest : int
        Upper bound.

    Returns
    -------
    int
        Number of samples.
    """
    good = inlier_ratio**sample_size
    if good <= 1e-12:
        return largest
    if good >= 1.0:
        return 1
    needed = np.log(1.0 - confidence) / np.log1p(-good)
    return int(min(float(largest), np.ceil(needed)))


Model = TypeVar("Model")


class SampledProblem(Protocol[Model]):
    """Model estimation from minimal samples."""

    @property
    def sample_size(self) -> int:
        """Data in a minimal sample."""

    def solve(self, sample: I64) -> list[Model]:
        """Return the models of the data with indices ``sample`` (sample_size,), possibly none."""

    def residuals(self, model: Model) -> F64:
        """Return the distance (N,) of every datum."""


@dataclass(frozen=True)
class Consensus(Generic[Model]):
    """Best model of a search.

    Parameters
    ----------
    model, inliers : Model, ndarray (N,) of bool
        Model with the most data within the threshold, and these data.
    samples : int
        Samples drawn.
    """

    model: Model
    inliers: B8
    samples: int


@dataclass(frozen=True)
class SampleConsensus:
    """Algorithm 2: the model with the most data within a threshold.

    Of two models with equally many inliers the one with the lower standard deviation wins (Fischler and
    Bolles, 1981). An exhaustive search would need n! / (s! (n - s)!) samples of size s (the thesis' text has
    n! / s!).

    Parameters
    ----------
    threshold : float
        Largest residual of an inlier.
    max_samples : int
        Number of samples.
    stop_inlier_ratio : float
        The search ends if a model has more inliers than this share of the data.
    least_median : bool
        Rank models by the median of their residuals instead (Rousseeuw, 1984).
    """

    threshold: float
    max_samples: int = 1000
    stop_inlier_ratio: float = 1.0
    least_median: bool = False

    def search(
        self, problem: SampledProblem[Model], n: int, rng: np.random.Generator
    ) -> Consensus[Model] | None:
        """Search the best model.

        Parameters
        ----------
        problem, n : SampledProblem, int
            Minimal solver and residuals, and number of data.
        rng : numpy.random.Generator
            Source of randomness.

        Returns
        -------
        Consensus or None
            Best model; None if no sample gave one.

        Raises
        ------
        ValueError
            If there are fewer data than in a sample.
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
        rms = float(np.sqrt(np.mean(residuals[inliers] ** 2))) if inliers.any() else 0.0
        return (int(inliers.sum()), -rms), inliers

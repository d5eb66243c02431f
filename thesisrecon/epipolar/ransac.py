"""Section 5.4: RANSAC of the thesis (Algorithm 2), its inlier tests, and least median of squares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.epipolar._frame import PairFrame, check_matches
from thesisrecon.epipolar._noise import noise_scale
from thesisrecon.epipolar._sampling import draw_sample, sampson_distances
from thesisrecon.epipolar.criteria import fundamental_covariance
from thesisrecon.epipolar.linear import seven_point
from thesisrecon.epipolar.refinement import Criterion, refine_fundamental
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.two_view import epipolar_distances, sampson_residuals, symmetric_residuals
from thesisrecon.records import FundamentalFit

# 95 % quantiles of the chi-square distribution with one and two degrees of freedom.
CHI2_1_95, CHI2_2_95 = 3.841458820694124, 5.991464547107979
MINIMUM = 8
# Residuals below this are rounding errors, not noise.
EXACT_PX = 1e-6
# The last rounds take the median over the matches within this many sigma; that of all matches is biased by
# the wrong ones.
NEAR_SIGMAS = 2.5


class _InlierTest(NamedTuple):
    """Distances (N,), their ratio to Sampson's for images of equal weight, squared limit in variances."""

    distances: Callable[[F64, F64, F64], F64]
    ratio: float
    limit: float


def _larger_epipolar_distance(F: F64, xy1: F64, xy2: F64) -> F64:
    return np.asarray(epipolar_distances(F, xy1, xy2).max(axis=1))


InlierTest = Literal["sampson", "epipolar-distance", "symmetric-distance"]
INLIER_TESTS = {
    # Chi-square with one degree of freedom: 95 % of the right matches pass.
    "sampson": _InlierTest(sampson_residuals, 1.0, CHI2_1_95),
    # First test of section 5.4: both points within 1.96 sigma_d of their epipolar lines, sigma_d = sqrt(2)
    # sigma. If the images have equal weight the distances are equal: the test by the Sampson distance.
    "epipolar-distance": _InlierTest(_larger_epipolar_distance, 1.4142135623730951, 2.0 * CHI2_1_95),
    # Second test of section 5.4: sum of both squared epipolar distances below 5.99 sigma_d^2. Both are
    # multiples of one residual, so the sum is 2 sigma_d^2 times a chi-square of one degree of freedom, not of
    # two: 92 % of the right matches pass, not the 95 % of the thesis.
    "symmetric-distance": _InlierTest(symmetric_residuals, 2.0, 2.0 * CHI2_2_95),
}


def discard_outliers(
    F: F64, xy1: F64, xy2: F64, *, limit_px: float = np.inf, test: InlierTest = "sampson"
) -> tuple[float, B8]:
    """Return the noise, from the median distance within ``limit_px``, and the matches (N,) that pass.

    sigma = 1.4826 (1 + 5 / (n - 7)) median |d| over at least 8 matches; the thesis divides by Phi(0.75) where
    Phi^-1(0.75) is meant. Without a limit sigma is too large if more than half of the matches are wrong.
    """
    distances, ratio, most = INLIER_TESTS[test]
    residuals = np.abs(distances(F, xy1, xy2))
    limit = max(ratio * limit_px, float(np.partition(residuals, MINIMUM - 1)[MINIMUM - 1]))
    sigma = noise_scale(residuals[residuals <= limit]) / ratio
    inliers = residuals**2 <= max(most * sigma**2, EXACT_PX**2)
    return sigma, inliers if inliers.sum() >= MINIMUM else residuals <= limit


@dataclass(frozen=True)
class _SampleConsensus:
    """Algorithm 2: the model with the most data within a threshold.

    Between models with the same number of inliers the lower standard deviation decides (Fischler and
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
        solve: Callable[[I64], list[F64]],
        residuals: Callable[[F64], F64],
        sample_size: int,
        n: int,
        rng: Generator,
    ) -> tuple[F64, B8, int] | None:
        """Return the best model of n data, its inliers (n,) and the number of samples, or None."""
        best: tuple[F64, B8] | None = None
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


@dataclass(frozen=True)
class ThesisRansac:
    """RANSAC as in section 5.4 of the thesis, with its errors corrected.

    Draw samples of seven, keep the F with the most inliers, estimate sigma from the median distance, discard
    outliers, then refine and discard again ``rounds`` times.

    Differences from the thesis: matches are tested by the Sampson distance unless ``inlier_test`` selects a
    test of section 5.4; the search counts inliers within a fixed threshold, since the fraction within a
    multiple of the median is the same for every F; the refinement uses the orthonormal representation, which
    reaches every epipole.

    Parameters
    ----------
    threshold_px : float
        Sampson distance of an inlier during the search.
    samples : int
        Maximum number of samples.
    epipolar_distance : bool
        Minimise the distances to epipolar lines (5.6) in the refinement instead of the Sampson distances
        (5.4).
    rounds : int
        Rounds of refinement.
    inlier_test : {"sampson", "epipolar-distance", "symmetric-distance"}
        Test of a match: the default, or the first or second test of section 5.4.
    """

    threshold_px: float = 1.0
    samples: int = 1000
    epipolar_distance: bool = False
    rounds: int = 2
    inlier_test: InlierTest = "sampson"

    # Inlier ratio at which sampling stops.
    stop_inlier_ratio = 0.95

    def __post_init__(self) -> None:
        if not (np.isfinite(self.threshold_px) and self.threshold_px > 0.0):
            raise ValueError(f"threshold_px must be positive; got {self.threshold_px}")
        if self.samples < 1 or self.rounds < 0:
            raise ValueError(f"a search needs samples >= 1, rounds >= 0; got {self.samples}, {self.rounds}")
        if self.inlier_test not in INLIER_TESTS:
            raise ValueError(
                f"inlier_test must be one of {', '.join(INLIER_TESTS)}; got {self.inlier_test!r}"
            )

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """See `thesisrecon.config.FundamentalEstimator.estimate`."""
        gate_px = INLIER_TESTS[self.inlier_test].ratio * self.threshold_px
        search = _SampleConsensus(gate_px, self.samples, self.stop_inlier_ratio)
        criterion: Criterion = "epipolar-distance" if self.epipolar_distance else "sampson"
        limit_px, test = self.threshold_px, self.inlier_test
        return _search_and_refine(xy1, xy2, rng, search, self.rounds, limit_px, test, criterion)


@dataclass(frozen=True)
class LeastMedianOfSquares:
    """F with the least median squared Sampson distance among random samples of seven (Zhang, IJCV 1998).

    It is refined as in :class:`ThesisRansac`, with sigma from the matches within 2.5 sigma. No threshold is
    needed, but the method fails if more than half of the matches are wrong. If half of them are wrong, 900
    samples contain one without outliers with probability 99.9 %.

    Parameters
    ----------
    samples : int
        Number of samples.
    rounds : int
        Rounds of refinement.
    """

    samples: int = 900
    rounds: int = 2

    def __post_init__(self) -> None:
        if self.samples < 1 or self.rounds < 0:
            raise ValueError(f"a search needs samples >= 1, rounds >= 0; got {self.samples}, {self.rounds}")

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """See `thesisrecon.config.FundamentalEstimator.estimate`."""
        search = _SampleConsensus(np.inf, self.samples, least_median=True)
        return _search_and_refine(xy1, xy2, rng, search, self.rounds)


def _search_and_refine(
    xy1: F64,
    xy2: F64,
    rng: Generator,
    search: _SampleConsensus,
    rounds: int,
    limit_px: float | None = None,
    test: InlierTest = "sampson",
    criterion: Criterion = "sampson",
) -> FundamentalFit:
    """Search, then refine and discard outliers; without ``limit_px`` the limit follows from sigma."""
    xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
    frame = PairFrame.of(xy1, xy2)
    points = frame.points(xy1, xy2)
    search = replace(search, threshold=search.threshold * frame.scale)

    def solve(sample: I64) -> list[F64]:
        solutions = np.empty((3, 9))
        return list(solutions[: seven_point(points, sample, solutions)])

    def residuals(model: F64) -> F64:
        if test == "sampson":
            return np.asarray(sampson_distances(model, points))
        return INLIER_TESTS[test].distances(model.reshape(3, 3), points[:, :2], points[:, 2:])

    found = search.search(solve, residuals, 7, len(points), rng)
    needed = MINIMUM if limit_px else 1
    if found is None or found[1].sum() < needed:
        raise StageFailure(
            "no epipolar geometry explains the matches",
            f"none of {search.max_samples} samples has {needed} inliers among {len(xy1)} matches",
            "check that the images overlap and that the matches are correct",
        )
    F = frame.matrix_in_pixels(found[0])
    sigma, inliers = discard_outliers(F, xy1, xy2, limit_px=limit_px or np.inf, test=test)
    for _ in range(rounds):
        F = refine_fundamental(F, xy1[inliers], xy2[inliers], criterion)
        sigma, inliers = discard_outliers(F, xy1, xy2, limit_px=limit_px or NEAR_SIGMAS * sigma, test=test)
    f = frame.matrix_in_frame(F)
    covariance = fundamental_covariance(frame, f, points[inliers], sigma * frame.scale)
    return FundamentalFit(F, inliers, sigma, covariance, found[2])

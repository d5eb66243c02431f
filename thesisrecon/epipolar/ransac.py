"""Section 5.4: the noise from the residuals, and the matches that are too far off to share it.

Algorithm 2 of the thesis: seven-point samples, the most inliers, then the gradient criterion.

Section 5.4: least median of squares, which needs no threshold but fewer than half of wrong matches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.epipolar.frame import PairFrame, as_matches, check_matches
from thesisrecon.epipolar.linear import seven_point
from thesisrecon.epipolar.precision import fundamental_covariance
from thesisrecon.epipolar.refinement import refine_epipolar_distance, refine_sampson
from thesisrecon.epipolar.sampling import sampson_distances
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.two_view import epipolar_distances, sampson_residuals, symmetric_residuals
from thesisrecon.numerics.noise import noise_scale
from thesisrecon.numerics.ransac import SampleConsensus, draw_sample
from thesisrecon.records import FundamentalFit

CHI2_1_95, CHI2_2_95 = 3.841458820694124, 5.991464547107979
"""95 % of a chi-square variable with one or two degrees of freedom lies below."""
MINIMUM = 8
EXACT_PX = 1e-6
"""Residuals below are rounding, not noise."""


class InlierTest(Protocol):
    """How far a match is from an F, and how far the right ones are."""

    @property
    def ratio(self) -> float:
        """The distance over the Sampson distance where both images weigh the same."""

    @property
    def limit(self) -> float:
        """The squared distance up to which a match is right, in variances of one coordinate."""

    def distances(self, F: F64, xy1: F64, xy2: F64) -> F64:
        """px; (N,) >= 0."""


@dataclass(frozen=True)
class SampsonTest:
    """The Sampson distance against the chi-square of one degree of freedom: 95 % of the right ones pass."""

    ratio: float = 1.0
    limit: float = CHI2_1_95

    def distances(self, F: F64, xy1: F64, xy2: F64) -> F64:
        """px; (N,) >= 0."""
        return np.abs(sampson_residuals(F, xy1, xy2))


@dataclass(frozen=True)
class BothLinesTest:
    """The first test of section 5.4: both points within 1.96 sigma_d of their epipolar lines.

    sigma_d, of the distance to a line, is root 2 times that of a coordinate where the images weigh the same;
    then the two distances are equal and this is the test by Sampson's.
    """

    ratio: float = 1.4142135623730951
    limit: float = 2.0 * CHI2_1_95

    def distances(self, F: F64, xy1: F64, xy2: F64) -> F64:
        """The larger one, px; (N,)."""
        return np.asarray(epipolar_distances(F, xy1, xy2).max(axis=1))


@dataclass(frozen=True)
class SumOfLinesTest:
    """The second test of section 5.4: the sum of both squared distances below 5.99 sigma_d^2.

    The thesis takes x_alpha from the chi-square of two degrees of freedom. The distances are multiples of one
    residual, so the sum is 2 sigma_d^2 times a chi-square of one: 92 % of the right matches pass, not 95 %.
    """

    ratio: float = 2.0
    limit: float = 2.0 * CHI2_2_95

    def distances(self, F: F64, xy1: F64, xy2: F64) -> F64:
        """The root of the sum of both squared, px; (N,)."""
        return symmetric_residuals(F, xy1, xy2)


def discard_outliers(
    F: F64, xy1: F64, xy2: F64, *, limit_px: float = np.inf, test: InlierTest | None = None
) -> tuple[float, B8]:
    """sigma (px) by the median of the distances, and which matches (N,) pass the test with it.

    ``test`` is by Sampson's distance unless given. The median is over the matches within ``limit_px`` of
    that distance (at least 8), r^2 <= 3.84 sigma^2 the test. Without a limit sigma is too large where more
    than half of the matches are wrong. Raises ``ValueError`` for fewer than 8 matches and as
    :func:`~thesisrecon.epipolar.frame.as_matches`.
    """
    xy1, xy2 = as_matches(xy1, xy2)
    test = SampsonTest() if test is None else test
    residuals = test.distances(F, xy1, xy2)
    if len(residuals) < MINIMUM:
        raise ValueError(f"discard_outliers needs at least {MINIMUM} matches; got {len(residuals)}")
    limit = max(test.ratio * limit_px, float(np.partition(residuals, MINIMUM - 1)[MINIMUM - 1]))
    sigma = noise_scale(residuals[residuals <= limit]) / test.ratio
    inliers = residuals**2 <= max(test.limit * sigma**2, EXACT_PX**2)
    return sigma, inliers if inliers.sum() >= MINIMUM else residuals <= limit


SAMPSON_TEST = SampsonTest()


@dataclass(frozen=True)
class SevenPointProblem:
    """Minimal samples of matches: rows (x1, y1, x2, y2) of ``points`` (N, 4), in one frame."""

    points: F64
    sample_size: int = 7
    test: InlierTest = SAMPSON_TEST

    def solve(self, sample: I64) -> list[F64]:
        """The one to three matrices through seven matches, as vectors (9,)."""
        solutions = np.empty((3, 9))
        return list(solutions[: seven_point(self.points, sample, solutions)])

    def residuals(self, model: F64) -> F64:
        """Distances (N,) of the test in the units of the points, Sampson's where it has no other."""
        if isinstance(self.test, SampsonTest):
            return np.asarray(sampson_distances(model, self.points))
        return self.test.distances(model.reshape(3, 3), self.points[:, :2], self.points[:, 2:])


@dataclass(frozen=True)
class ThesisRansac:
    """Section 5.4 as it stands, its slips corrected.

    Draw ``samples`` samples of seven, or stop once a share ``enough_share`` of the matches are inliers; keep
    the F with the most; estimate sigma by the median (1.4826 (1 + 5 / (n - 7)) median |d|; the text divides
    by Phi(0.75) where Phi^-1(0.75) is meant) and discard the outliers; then ``rounds`` times minimise the
    gradient criterion (5.4), or the distances to the epipolar lines (5.6) with ``epipolar_distance``, and
    discard again.

    Departures: a match is tested by its Sampson distance against the chi-square of one degree of freedom (the
    two epipolar distances are multiples of one residual, so their sum is not a chi-square of two), unless
    ``both_lines`` or ``sum_of_lines`` asks for the first or second test of the text; the search
    counts inliers within a fixed ``threshold_px``, since the share within a multiple of the median is the
    same for every F; the refinement runs over the orthonormal representation, which has no epipole it cannot
    reach.
    """

    threshold_px: float = 1.0
    samples: int = 1000
    enough_share: float = 0.95
    epipolar_distance: bool = False
    rounds: int = 2
    both_lines: bool = False
    sum_of_lines: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.threshold_px) and self.threshold_px > 0.0):
            raise ValueError(f"threshold_px must be positive; got {self.threshold_px}")
        if min(self.samples, self.rounds) < 1 or not 0.0 < self.enough_share <= 1.0:
            raise ValueError("a search needs samples >= 1, rounds >= 1 and 0 < enough_share <= 1")
        if self.both_lines and self.sum_of_lines:
            raise ValueError("a match is tested by both_lines or by sum_of_lines, not by both")

    @property
    def test(self) -> InlierTest:
        """The test of a match."""
        if self.both_lines:
            return BothLinesTest()
        return SumOfLinesTest() if self.sum_of_lines else SampsonTest()

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """F of matches (N >= 8, 2) px; raises as
        :meth:`~thesisrecon.epipolar.locally_optimised.LocallyOptimisedRansac.estimate`."""
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        test = self.test
        gate = test.ratio * self.threshold_px * frame.scale
        loop = SampleConsensus(gate, max_samples=self.samples, enough_share=self.enough_share)
        found = loop.search(SevenPointProblem(points, test=test), len(points), rng)
        if found is None or found.inliers.sum() < MINIMUM:
            raise StageFailure(
                "no epipolar geometry explains the matches",
                f"{self.samples} samples, none with {MINIMUM} of {len(xy1)} matches close enough",
                "the photographs may not overlap, or the matches are wrong",
            )
        F, sigma = frame.matrix_in_pixels(found.model), 0.0
        _, inliers = discard_outliers(F, xy1, xy2, limit_px=self.threshold_px, test=test)
        refine = refine_epipolar_distance if self.epipolar_distance else refine_sampson
        for _ in range(self.rounds):
            F = refine(F, xy1[inliers], xy2[inliers])
            sigma, inliers = discard_outliers(F, xy1, xy2, limit_px=self.threshold_px, test=test)
        f = frame.matrix_in_frame(F)
        covariance = fundamental_covariance(frame, f, points[inliers], sigma * frame.scale)
        return FundamentalFit(F, inliers, sigma, covariance, found.samples)


NEAR_SIGMAS = 2.5
"""The median of the last rounds is over matches this near, since that over all grows with the wrong ones."""


@dataclass(frozen=True)
class LeastMedianOfSquares:
    """The F of ``samples`` samples of seven whose median squared Sampson distance is the least.

    Then sigma = 1.4826 (1 + 5 / (n - 7)) sqrt(median) and ``rounds`` times: discard what lies beyond the 95 %
    limit, minimise the gradient criterion (5.4) over the rest, estimate sigma of those near (Rousseeuw 1984;
    Zhang, IJCV 1998). 900 samples hold one free of outliers with 99.9 % where half of the matches are wrong;
    with more than half wrong the median is of wrong matches and the answer means nothing.
    """

    samples: int = 900
    rounds: int = 2

    def __post_init__(self) -> None:
        if min(self.samples, self.rounds) < 1:
            raise ValueError(f"a search needs samples and rounds of 1; got {self.samples}, {self.rounds}")

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """F of matches (N >= 8, 2) px; raises as
        :meth:`~thesisrecon.epipolar.locally_optimised.LocallyOptimisedRansac.estimate`."""
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        found = self._search(points, rng)
        if found is None:
            raise StageFailure(
                "no epipolar geometry explains the matches",
                f"none of {self.samples} samples of seven of {len(xy1)} matches determines one",
                "the matches may be repeated or lie on few points",
            )
        F = frame.matrix_in_pixels(found)
        sigma, inliers = discard_outliers(F, xy1, xy2)
        for _ in range(self.rounds):
            F = refine_sampson(F, xy1[inliers], xy2[inliers])
            sigma, inliers = discard_outliers(F, xy1, xy2, limit_px=NEAR_SIGMAS * sigma)
        covariance = fundamental_covariance(
            frame, frame.matrix_in_frame(F), points[inliers], sigma * frame.scale
        )
        return FundamentalFit(F, inliers, sigma, covariance, self.samples)

    def _search(self, points: F64, rng: Generator) -> F64 | None:
        problem, sample = SevenPointProblem(points), np.empty(7, dtype=np.int64)
        best, best_median, middle = None, np.inf, len(points) // 2
        for _ in range(self.samples):
            draw_sample(rng.random(7), len(points), sample)
            for f in problem.solve(sample):
                median = np.partition(problem.residuals(f), middle)[middle]
                if median < best_median:
                    best, best_median = f.copy(), median
        return best

"""Section 5.4: RANSAC of the thesis (Algorithm 2), its inlier tests, and least median of squares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

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
from thesisrecon.numerics.ransac import SampleConsensus
from thesisrecon.records import FundamentalFit

# 95 % quantiles of the chi-square distribution with one and two degrees of freedom.
CHI2_1_95, CHI2_2_95 = 3.841458820694124, 5.991464547107979
MINIMUM = 8
# Residuals below this are rounding errors, not noise.
EXACT_PX = 1e-6
# Matches over which the last rounds take the median; over all matches it grows with the wrong ones.
NEAR_SIGMAS = 2.5


@dataclass(frozen=True)
class InlierTest:
    """Distance of a match to F and its limit for an inlier.

    Parameters
    ----------
    ratio : float
        Ratio to the Sampson distance if both images have equal weight.
    limit : float
        Maximum squared distance of an inlier, in variances of one coordinate.
    distances : callable
        ``distances(F, xy1, xy2)`` returns the distances (N,), px, of either sign.
    """

    ratio: float
    limit: float
    distances: Callable[[F64, F64, F64], F64]


def _larger_epipolar_distance(F: F64, xy1: F64, xy2: F64) -> F64:
    return np.asarray(epipolar_distances(F, xy1, xy2).max(axis=1))


# Chi-square with one degree of freedom: 95 % of the right matches pass.
SAMPSON_TEST = InlierTest(1.0, CHI2_1_95, sampson_residuals)
# First test of section 5.4: both points within 1.96 sigma_d of their epipolar lines, sigma_d = sqrt(2) sigma.
# If the images have equal weight the distances are equal and this is the test by the Sampson distance.
EPIPOLAR_DISTANCE_TEST = InlierTest(1.4142135623730951, 2.0 * CHI2_1_95, _larger_epipolar_distance)
# Second test of section 5.4: sum of both squared epipolar distances below 5.99 sigma_d^2. The distances are
# multiples of one residual, so the sum is 2 sigma_d^2 times a chi-square of one degree of freedom, not the
# two of the thesis: 92 % of the right matches pass, not 95 %.
SYMMETRIC_DISTANCE_TEST = InlierTest(2.0, 2.0 * CHI2_2_95, symmetric_residuals)
INLIER_TESTS = {
    "sampson": SAMPSON_TEST,
    "epipolar-distance": EPIPOLAR_DISTANCE_TEST,
    "symmetric-distance": SYMMETRIC_DISTANCE_TEST,
}


def discard_outliers(
    F: F64, xy1: F64, xy2: F64, *, limit_px: float = np.inf, test: InlierTest = SAMPSON_TEST
) -> tuple[float, B8]:
    """Estimate the noise from the median distance and test every match against it.

    Parameters
    ----------
    F : ndarray (3, 3)
        Fundamental matrix, px.
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 8, px.
    limit_px : float
        The median is taken over matches with a Sampson distance up to this (at least 8). Without it sigma is
        too large if more than half of the matches are wrong.
    test : InlierTest
        Distance and limit of an inlier.

    Returns
    -------
    sigma_px : float
        Standard deviation of one coordinate.
    inliers : ndarray (N,) of bool
        Matches that pass.

    Raises
    ------
    ValueError
        If there are fewer than 8 matches, or as :func:`~thesisrecon.epipolar.frame.as_matches`.

    Examples
    --------
    >>> import numpy as np
    >>> F = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2)
    >>> xy1 = np.array([[0, 0], [9, 1], [2, 8], [7, 7], [4, 3], [1, 5], [8, 4], [5, 9], [6, 2]], dtype=float)
    >>> xy2 = xy1 + [[3.0, 0.1]] * np.array([[1], [-1], [1], [-1], [1], [-1], [1], [-1], [90]])
    >>> discard_outliers(F, xy1, xy2)[1].tolist()
    [True, True, True, True, True, True, True, True, False]
    """
    xy1, xy2 = as_matches(xy1, xy2)
    residuals = np.abs(test.distances(F, xy1, xy2))
    if len(residuals) < MINIMUM:
        raise ValueError(f"discard_outliers needs at least {MINIMUM} matches; got {len(residuals)}")
    limit = max(test.ratio * limit_px, float(np.partition(residuals, MINIMUM - 1)[MINIMUM - 1]))
    sigma = noise_scale(residuals[residuals <= limit]) / test.ratio
    inliers = residuals**2 <= max(test.limit * sigma**2, EXACT_PX**2)
    return sigma, inliers if inliers.sum() >= MINIMUM else residuals <= limit


@dataclass(frozen=True)
class SevenPointProblem:
    """Seven-point sampling of matches for :class:`~thesisrecon.numerics.ransac.SampleConsensus`.

    Parameters
    ----------
    points : ndarray (N, 4)
        Matches as rows (x1, y1, x2, y2) in a common frame.
    sample_size : int
        Size of a minimal sample.
    test : InlierTest
        Distance of a match to F.
    """

    points: F64
    sample_size: int = 7
    test: InlierTest = SAMPSON_TEST

    def solve(self, sample: I64) -> list[F64]:
        """Compute the fundamental matrices through seven matches.

        Parameters
        ----------
        sample : ndarray (7,)
            Indices of the matches.

        Returns
        -------
        list of ndarray (9,)
            The solutions, none to three.
        """
        solutions = np.empty((3, 9))
        return list(solutions[: seven_point(self.points, sample, solutions)])

    def residuals(self, model: F64) -> F64:
        """Compute the distances of all matches to F.

        Parameters
        ----------
        model : ndarray (9,)
            F in the frame.

        Returns
        -------
        ndarray (N,)
            Distances >= 0 in units of the frame.
        """
        if self.test is SAMPSON_TEST:
            return np.asarray(sampson_distances(model, self.points))
        return self.test.distances(model.reshape(3, 3), self.points[:, :2], self.points[:, 2:])


@dataclass(frozen=True)
class ThesisRansac:
    """RANSAC as in section 5.4 of the thesis, with its errors corrected.

    Draw samples of seven, keep the F with the most inliers, estimate sigma from the median distance, discard
    outliers, then refine and discard again ``rounds`` times. sigma = 1.4826 (1 + 5 / (n - 7)) median |d|; the
    thesis divides by Phi(0.75) where Phi^-1(0.75) is meant.

    Departures: matches are tested by the Sampson distance unless ``inlier_test`` selects a test of the text;
    the search counts inliers within a fixed threshold, since the fraction within a multiple of the median is
    the same for every F; the refinement uses the orthonormal representation, which reaches every epipole.

    Parameters
    ----------
    threshold_px : float
        Sampson distance of an inlier during the search.
    samples : int
        Maximum number of samples.
    stop_inlier_ratio : float
        Inlier ratio at which sampling stops.
    epipolar_distance : bool
        Refine the distances to epipolar lines (5.6) instead of the Sampson distances (5.4).
    rounds : int
        Rounds of refinement.
    inlier_test : {"sampson", "epipolar-distance", "symmetric-distance"}
        Test of a match: the default, or the first or second test of section 5.4.
    """

    threshold_px: float = 1.0
    samples: int = 1000
    stop_inlier_ratio: float = 0.95
    epipolar_distance: bool = False
    rounds: int = 2
    inlier_test: Literal["sampson", "epipolar-distance", "symmetric-distance"] = "sampson"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.threshold_px) and self.threshold_px > 0.0):
            raise ValueError(f"threshold_px must be positive; got {self.threshold_px}")
        if min(self.samples, self.rounds) < 1 or not 0.0 < self.stop_inlier_ratio <= 1.0:
            raise ValueError("a search needs samples >= 1, rounds >= 1 and 0 < stop_inlier_ratio <= 1")
        if self.inlier_test not in INLIER_TESTS:
            raise ValueError(
                f"inlier_test must be one of {', '.join(INLIER_TESTS)}; got {self.inlier_test!r}"
            )

    @property
    def test(self) -> InlierTest:
        """The inlier test."""
        return INLIER_TESTS[self.inlier_test]

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """Estimate F of matches with outliers.

        Parameters
        ----------
        xy1, xy2 : array_like (N, 2)
            Matched points, N >= 8, px.
        rng : numpy.random.Generator
            Source of the samples.

        Returns
        -------
        FundamentalFit
            F, inliers, noise and covariance.

        Raises
        ------
        ValueError
            As :func:`~thesisrecon.epipolar.frame.as_matches`.
        StageFailure
            If there are too few or collinear matches, or no F has 8 inliers.

        Examples
        --------
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> xy1 = rng.uniform(0, 500, (60, 2))
        >>> xy2 = xy1 + np.array([[40.0, 10.0]]) / rng.uniform(1, 4, (60, 1)) + rng.normal(0, 0.3, (60, 2))
        >>> xy2[:15] = rng.uniform(0, 500, (15, 2))
        >>> fit = ThesisRansac().estimate(xy1, xy2, rng)
        >>> bool(fit.inliers[15:].mean() > 0.8)
        True
        """
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        test = self.test
        gate = test.ratio * self.threshold_px * frame.scale
        loop = SampleConsensus(gate, max_samples=self.samples, stop_inlier_ratio=self.stop_inlier_ratio)
        found = loop.search(SevenPointProblem(points, test=test), len(points), rng)
        if found is None or found.inliers.sum() < MINIMUM:
            raise StageFailure(
                "no epipolar geometry explains the matches",
                f"none of {self.samples} samples has {MINIMUM} inliers among {len(xy1)} matches",
                "check that the images overlap and that the matches are correct",
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


@dataclass(frozen=True)
class LeastMedianOfSquares:
    """F with the least median squared Sampson distance among random samples of seven.

    Then sigma = 1.4826 (1 + 5 / (n - 7)) sqrt(median), and ``rounds`` times: discard matches beyond the 95 %
    limit, minimise the Sampson distances (5.4) of the rest, and estimate sigma from the matches nearby. No
    threshold is needed, but with more than half of the matches wrong the median belongs to wrong matches. 900
    samples contain one without outliers with 99.9 % probability if half of the matches are wrong.

    Parameters
    ----------
    samples : int
        Number of samples.
    rounds : int
        Rounds of refinement.

    References
    ----------
    P. Rousseeuw, "Least median of squares regression", JASA 79, 1984. Z. Zhang, "Determining the epipolar
    geometry and its uncertainty", IJCV 27, 1998.
    """

    samples: int = 900
    rounds: int = 2

    def __post_init__(self) -> None:
        if min(self.samples, self.rounds) < 1:
            raise ValueError(f"a search needs samples and rounds of 1; got {self.samples}, {self.rounds}")

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """Estimate F of matches with less than half of outliers.

        Parameters
        ----------
        xy1, xy2 : array_like (N, 2)
            Matched points, N >= 8, px.
        rng : numpy.random.Generator
            Source of the samples.

        Returns
        -------
        FundamentalFit
            F, inliers, noise and covariance.

        Raises
        ------
        ValueError
            As :func:`~thesisrecon.epipolar.frame.as_matches`.
        StageFailure
            If there are too few or collinear matches, or no sample determines an F.

        Examples
        --------
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> xy1 = rng.uniform(0, 500, (60, 2))
        >>> xy2 = xy1 + np.array([[40.0, 10.0]]) / rng.uniform(1, 4, (60, 1))
        >>> xy2[:15] = rng.uniform(0, 500, (15, 2))
        >>> fit = LeastMedianOfSquares(samples=300).estimate(xy1, xy2, rng)
        >>> bool(fit.inliers[15:].all())
        True
        """
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        loop = SampleConsensus(np.inf, max_samples=self.samples, least_median=True)
        found = loop.search(SevenPointProblem(points), len(points), rng)
        if found is None:
            raise StageFailure(
                "no epipolar geometry explains the matches",
                f"none of {self.samples} seven-point samples of {len(xy1)} matches determines one",
                "check for repeated matches or matches on few points",
            )
        F = frame.matrix_in_pixels(found.model)
        sigma, inliers = discard_outliers(F, xy1, xy2)
        for _ in range(self.rounds):
            F = refine_sampson(F, xy1[inliers], xy2[inliers])
            sigma, inliers = discard_outliers(F, xy1, xy2, limit_px=NEAR_SIGMAS * sigma)
        covariance = fundamental_covariance(
            frame, frame.matrix_in_frame(F), points[inliers], sigma * frame.scale
        )
        return FundamentalFit(F, inliers, sigma, covariance, self.samples)

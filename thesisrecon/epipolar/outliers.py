"""Section 5.4: the noise from the residuals, and the matches that are too far off to share it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.frame import as_matches
from thesisrecon.geometry.multiview import epipolar_distances, sampson_residuals, symmetric_residuals
from thesisrecon.robust.noise import noise_scale

F64 = NDArray[np.float64]
B8 = NDArray[np.bool_]

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

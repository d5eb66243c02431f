"""Section 5.4: the noise from the residuals, and the matches that are too far off to share it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.multiview import sampson_residuals
from thesisrecon.robust.noise import noise_scale

F64 = NDArray[np.float64]
B8 = NDArray[np.bool_]

CHI2_1_95 = 3.841458820694124
"""95 % of a chi-square variable with one degree of freedom lies below."""
MINIMUM = 8
EXACT_PX = 1e-6
"""Residuals below are rounding, not noise."""


def discard_outliers(F: F64, xy1: F64, xy2: F64, *, limit_px: float = np.inf) -> tuple[float, B8]:
    """sigma (px) by the median of the Sampson distances, and which matches (N,) pass the test with it.

    The median is over the matches within ``limit_px`` (at least 8), r^2 <= 3.84 sigma^2 the test. Without a
    limit sigma is too large where more than half of the matches are wrong. Raises ``ValueError`` for fewer
    than 8 matches.
    """
    residuals = np.abs(sampson_residuals(F, xy1, xy2))
    if len(residuals) < MINIMUM:
        raise ValueError(f"discard_outliers needs at least {MINIMUM} matches; got {len(residuals)}")
    limit = max(limit_px, float(np.partition(residuals, MINIMUM - 1)[MINIMUM - 1]))
    sigma = noise_scale(residuals[residuals <= limit])
    inliers = residuals**2 <= max(CHI2_1_95 * sigma**2, EXACT_PX**2)
    return sigma, inliers if inliers.sum() >= MINIMUM else residuals <= limit

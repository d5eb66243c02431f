"""Section 5.4: the standard deviation of the noise from residuals that hold wrong matches too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

MAD_FACTOR = 1.4826022185056018
"""1 / Phi^-1(0.75): the thesis' text divides by Phi(0.75), which is not consistent."""
ENDED, WIDENINGS = 0.22, 6
RAYLEIGH_MEDIAN = 1.1774
CUT, CUT_VARIANCE, TRIMMINGS = 2.5, 0.91125, 5
"""Where the noise is cut, and the variance of a standard normal variable cut there."""


def noise_scale(residuals: F64, *, parameters: int = 7) -> float:
    """Robust standard deviation 1.4826 (1 + 5 / (n - p)) median |r| of residuals with mean 0.

    ``residuals`` (N,), of any sign, ``parameters`` the p degrees of freedom that were fitted to them
    (Rousseeuw and Leroy 1987; Torr and Murray, IJCV 1997). The factor is 1 / Phi^-1(0.75), where the thesis'
    text has 1 / Phi(0.75). Breaks down where half of the residuals are wrong. Raises ``ValueError`` where
    N <= p, since nothing is left to estimate from, and for residuals that are not finite.
    """
    n = len(residuals)
    if n <= parameters:
        raise ValueError(f"noise_scale needs more than {parameters} residuals; got {n}")
    if not np.isfinite(residuals).all():
        raise ValueError("noise_scale needs finite residuals")
    return float(MAD_FACTOR * (1.0 + 5.0 / (n - parameters)) * np.median(np.abs(residuals)))


def noise_width(residuals: F64, threshold: float, *, parameters: int = 7) -> float:
    """The width within which residuals (N,) >= 0 are of the noise: ``threshold``, or more if they go on.

    Normal noise has its median at no more than 0.22 of a width of 3 standard deviations or more; a higher
    one (the ``parameters`` that were fitted allowed for) says that the width cuts the noise off, or that the
    residuals are of wrong matches and spread evenly.
    The width grows, by 1.5 a step, until the noise ends; where it does not end within 11 thresholds they are
    wrong matches, and the threshold stands.
    """
    width = threshold
    for _ in range(WIDENINGS + 1):
        near = residuals[residuals < width]
        if len(near) <= parameters:
            return threshold
        if np.median(near) <= ENDED * width * np.sqrt(1.0 - parameters / len(near)):
            return width
        width *= 1.5
    return threshold


def trimmed_noise_scale(residuals: F64, start: float, *, parameters: int = 7) -> float:
    """Standard deviation of residuals (N,) >= 0 from those within 2.5 of it, where they are normal.

    The root of the mean square, corrected for the cut and the ``parameters`` fitted, repeated from ``start``
    until the cut stays: half the variance of the median's estimate. Returns ``start`` where too few are left.
    """
    sigma = start
    for _ in range(TRIMMINGS):
        kept = residuals[residuals <= CUT * sigma]
        if len(kept) <= 2 * parameters:
            return start
        sigma = float(np.sqrt(kept @ kept / (len(kept) - parameters) / CUT_VARIANCE))
    return sigma


def noise_from_distances(distances: F64) -> float:
    """Standard deviation of one coordinate from the lengths (N,) of two-dimensional residuals, N > 0.

    The median of a Rayleigh variable is 1.1774 sigma.
    """
    return float(np.median(distances)) / RAYLEIGH_MEDIAN

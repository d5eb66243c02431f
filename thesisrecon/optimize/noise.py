"""Robust losses rho(s) of squared residuals, and the standard deviation of the noise from residuals."""

from __future__ import annotations

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64


def huber(s: F64, delta: float) -> tuple[F64, F64]:
    """rho = s below delta^2, 2 delta sqrt(s) - delta^2 above (Huber 1964), and its derivative; convex."""
    root = np.sqrt(np.maximum(s, delta**2))
    inside = s <= delta**2
    return np.where(inside, s, 2.0 * delta * root - delta**2), np.where(inside, 1.0, delta / root)


def soft_l1(s: F64, delta: float) -> tuple[F64, F64]:
    """rho = 2 delta^2 (sqrt(1 + s / delta^2) - 1), smooth and convex, and its derivative."""
    root = np.sqrt(1.0 + s / delta**2)
    return 2.0 * delta**2 * (root - 1.0), 1.0 / root


NORMAL_95 = 1.959963984540054
"""97.5 % quantile of the normal distribution."""
# 1 / Phi^-1(0.75); the thesis' text has 1 / Phi(0.75), which is not consistent.
MAD_FACTOR = 1.4826022185056018
_RAYLEIGH_MEDIAN = 1.1774
INLIER_SIGMAS, VARIANCE_OF_INLIERS = 3.0, 0.9494
"""Residual of an inlier in standard deviations, and the variance of residuals within it."""
_HUBER_SIGMAS = (3.0, 2.0, 1.5, 1.0)


def noise_from_distances(distances: F64) -> float:
    """Standard deviation of a coordinate from lengths (N,) of residuals: their median by Rayleigh's."""
    return float(np.median(distances)) / _RAYLEIGH_MEDIAN


def student_factor(dof: int) -> float:
    """Student's 95 % quantile over the normal one; ``dof`` degrees of freedom estimate the noise."""
    return float(scipy.special.stdtrit(dof, 0.975) / NORMAL_95)


def next_inlier_limit(distance: F64, inliers: B8, limit: float, *, unknowns: int) -> float:
    """Limit of the inliers of the next round: ``INLIER_SIGMAS`` standard deviations of the noise of a fit."""
    # The median of the inliers alone would be too small, since their limit cuts off the noise.
    near = distance <= max(2.0 * limit, float(np.median(distance[inliers])))
    fitted = 2.0 * int(inliers.sum())
    return float(
        INLIER_SIGMAS * noise_from_distances(distance[near]) * np.sqrt(fitted / max(fitted - unknowns, 1.0))
    )


def trimmed_noise_scale(residuals: F64, start: float, *, parameters: int = 7) -> float:
    """Standard deviation of residuals >= 0 within 2.5 standard deviations; ``start`` if these are too few."""
    sigma = start
    for _ in range(5):
        kept = residuals[residuals <= 2.5 * sigma]
        if len(kept) <= 2 * parameters:
            return start
        # The variance of a normal variable trimmed there is 0.911.
        sigma = float(np.sqrt(kept @ kept / (len(kept) - parameters) / 0.91125))
    return sigma


def best_huber_width(residuals: F64, sigma: float, *, parameters: int = 7) -> float:
    """The width of Huber's loss with the least expected variance, infinite for least squares.

    The asymptotic variance mean(psi^2) / mean(psi')^2 (Huber, 1964) is estimated from residuals (N,) >= 0
    (Jaeckel, 1971) and must be smaller by more than twice the effect of chance.
    """
    n = len(residuals)
    if n <= 2 * parameters:
        return np.inf
    needed = (1.0 + 2.0 / np.sqrt(n)) * n / (n - 2 * parameters)
    width, least = np.inf, effective_noise(residuals, np.inf) ** 2
    for k in _HUBER_SIGMAS:
        variance = effective_noise(residuals, k * sigma) ** 2 * needed
        if variance < least:
            width, least = k * sigma, variance
    return width


def effective_noise(residuals: F64, width: float, *, parameters: int = 0) -> float:
    """Normal noise with which least squares is as uncertain as Huber's loss (Huber, 1973)."""
    n = len(residuals)
    psi = np.minimum(residuals, width)
    straight = max(int(np.count_nonzero(residuals < width)), 1) / n
    return float(np.sqrt(psi @ psi / max(n - parameters, 1))) / straight

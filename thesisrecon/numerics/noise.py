"""Compiled pieces of robust estimation: random samples, how many are needed, the noise of residuals.

Section 5.4: the standard deviation of the noise from residuals that hold wrong matches too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from thesisrecon.arrays import F64

TAIL, SEPARATION = 4.0, 12.0
"""Standard deviations of the tail of the noise, and the least of wrong residuals, in those of the noise."""
CORE_COUNT, TAIL_COUNT, WRONG_COUNT = 1.0, 0.5, 1.0
"""What is thought to have been seen of each before the first residual."""


@njit(cache=True, nogil=True, error_model="numpy")
def fit_noise_mixture(residuals: F64, parameters: float, spread: float, rounds: int, mixture: F64) -> float:
    """Expectation-maximisation of three normals with mean 0 on residuals (N,) >= 0; mean log-likelihood.

    ``mixture`` (5,) holds sigma, the spread of the wrong residuals and the shares of noise, of its tail (TAIL
    times as wide) and of the wrong; it is read and updated. ``parameters`` were fitted to the residuals,
    ``spread`` is what the one wrong residual thought to have been seen has.
    """
    n = len(residuals)
    likelihood = 0.0
    for last in range(rounds - 1, -1, -1):
        sigma, wide, core, tail, wrong = mixture
        c0, c1, c2 = core / sigma, tail / (TAIL * sigma), wrong / wide
        i1, i2 = 0.5 / (TAIL * TAIL * sigma * sigma), 0.5 / (wide * wide)
        n0, n1, n2, s01, s2 = 0.0, 0.0, 0.0, 0.0, 0.0
        likelihood = 0.0
        for k in range(n):
            q = residuals[k] * residuals[k]
            # The core's exponential is that of the tail to the power TAIL^2 = 16.
            e1 = np.exp(-i1 * q)
            e0 = e1 * e1
            e0 *= e0
            e0 *= e0
            e0 *= e0
            p0, p1, p2 = c0 * e0, c1 * e1, c2 * np.exp(-i2 * q)
            p = p0 + p1 + p2 + 1e-300
            if last == 0:
                likelihood += np.log(p)
            p = 1.0 / p
            n0 += p0 * p
            n1 += p1 * p
            n2 += p2 * p
            s01 += (p0 + p1 / (TAIL * TAIL)) * p * q
            s2 += p2 * p * q
        total = n + CORE_COUNT + TAIL_COUNT + WRONG_COUNT
        mixture[0] = np.sqrt(s01 / max(n0 + n1 - parameters, 1.0)) + 1e-12 * spread
        wide = np.sqrt((s2 + WRONG_COUNT * spread * spread) / (n2 + WRONG_COUNT))
        mixture[1] = max(wide, SEPARATION * mixture[0])
        mixture[2] = (n0 + CORE_COUNT) / total
        mixture[3] = (n1 + TAIL_COUNT) / total
        mixture[4] = (n2 + WRONG_COUNT) / total
    return likelihood / n


MAD_FACTOR = 1.4826022185056018
"""1 / Phi^-1(0.75): the thesis' text divides by Phi(0.75), which is not consistent."""
ENDED, WIDENINGS = 0.22, 6
RAYLEIGH_MEDIAN = 1.1774
CUT, CUT_VARIANCE, TRIMMINGS = 2.5, 0.91125, 5
"""Where the noise is cut, and the variance of a standard normal variable cut there."""
ROUNDS, QUANTILES = 6, 300
"""Rounds of a mixture's fit, and the residuals (evenly spaced in order) that stand for more of them."""
BISECTIONS = 20
HUBER_SIGMAS = (3.0, 2.0, 1.5, 1.0)


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
    width, ordered = threshold, np.sort(residuals)
    for _ in range(WIDENINGS + 1):
        n = int(np.searchsorted(ordered, width))
        if n <= parameters:
            return threshold
        median = 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])
        if median <= ENDED * width * np.sqrt(1.0 - parameters / n):
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


@dataclass(frozen=True)
class NoiseMixture:
    """Residuals as normal noise of ``sigma``, its tail four times as wide, and wrong ones of ``spread``.

    ``core``, ``tail`` and ``wrong`` are the shares, ``log_likelihood`` the mean over the residuals: of two
    models of the same data the one with the higher explains them better, whatever its noise.
    """

    sigma: float
    spread: float
    core: float
    tail: float
    wrong: float
    log_likelihood: float = -np.inf

    @classmethod
    def fit(cls, residuals: F64, sigma: float, *, spread: float, parameters: int = 7) -> NoiseMixture:
        """The mixture of residuals (N > 0,) >= 0 in ascending order, by expectation-maximisation.

        ``sigma`` > 0 is where it starts, ``spread`` what wrong residuals are thought to have before any was
        seen, ``parameters`` how many were fitted to the residuals (McLachlan and Peel, 2000).
        """
        step = max(len(residuals) // QUANTILES, 1)
        some = residuals[step // 2 :: step]
        share = float(np.count_nonzero(some < 3.0 * sigma)) / len(some)
        mixture = np.array([sigma, spread, 0.9 * share, 0.1 * share, 1.0 - share])
        likelihood = fit_noise_mixture(some, parameters / step, spread, ROUNDS, mixture)
        sigma, spread, core, tail, wrong = mixture.tolist()
        return cls(sigma, spread, core, tail, wrong, float(likelihood))

    @property
    def limit(self) -> float:
        """The residual at which noise, with its tail, and wrong ones are equally likely."""
        low, high = self.sigma, self.spread
        for _ in range(BISECTIONS):
            middle = float(np.sqrt(low * high))
            core = self.core * np.exp(-0.5 * (middle / self.sigma) ** 2)
            tail = self.tail / TAIL * np.exp(-0.5 * (middle / (TAIL * self.sigma)) ** 2)
            wrong = self.wrong / self.spread * np.exp(-0.5 * (middle / self.spread) ** 2)
            low, high = (middle, high) if core + tail > self.sigma * wrong else (low, middle)
        return low

    @property
    def core_limit(self) -> float:
        """The residual at which noise and its tail are equally likely."""
        odds = max(TAIL * self.core / self.tail, 1.5)
        return self.sigma * float(np.sqrt(2.0 * np.log(odds) / (1.0 - TAIL**-2)))


def best_huber_width(residuals: F64, sigma: float, *, parameters: int = 7) -> float:
    """Width of Huber's loss that promises the least variance for residuals (N > 0,) >= 0 of noise ``sigma``.

    The asymptotic variance of an M-estimator is mean(psi^2) / mean(psi')^2 (Huber, 1964), judged here from
    the residuals themselves (Jaeckel, 1971). Least squares (infinite width) is left only for a gain of more
    than twice the chance of N residuals to which ``parameters`` were fitted: few of them look heavy-tailed
    too easily, and the variance would be judged too small with them.
    """
    n = len(residuals)
    if n <= 2 * parameters:
        return np.inf
    needed = (1.0 + 2.0 / np.sqrt(n)) * n / (n - 2 * parameters)
    width, least = np.inf, effective_noise(residuals, np.inf) ** 2
    for k in HUBER_SIGMAS:
        variance = effective_noise(residuals, k * sigma) ** 2 * needed
        if variance < least:
            width, least = k * sigma, variance
    return width


def effective_noise(residuals: F64, width: float, *, parameters: int = 0) -> float:
    """Standard deviation of normal noise with which least squares would be as uncertain as Huber's loss is.

    sqrt(sum(psi^2) / (N - p)) / mean(psi') for residuals (N > 0,) >= 0 to which ``parameters`` p were fitted
    under the loss of ``width`` (Huber, 1973).
    """
    n = len(residuals)
    psi = np.minimum(residuals, width)
    straight = max(int(np.count_nonzero(residuals < width)), 1) / n
    return float(np.sqrt(psi @ psi / max(n - parameters, 1))) / straight

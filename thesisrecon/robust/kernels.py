"""Compiled pieces of robust estimation: random samples, how many are needed, the noise of residuals."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

TAIL, SEPARATION = 4.0, 12.0
"""Standard deviations of the tail of the noise, and the least of wrong residuals, in those of the noise."""
CORE_COUNT, TAIL_COUNT, WRONG_COUNT = 1.0, 0.5, 1.0
"""What is thought to have been seen of each before the first residual."""


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

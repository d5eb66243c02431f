"""Compiled pieces of random sampling: distinct indices from uniform numbers, the number of samples needed."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


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

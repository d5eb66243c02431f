"""How many matches agree with a wrong model by chance."""

from __future__ import annotations

import numpy as np
import scipy

from thesisrecon.arrays import F64

# Matches within a cell of this size count as one place.
SAME_PX = 2.0


def multiplicity_weights(xy1: F64, xy2: F64) -> F64:
    """Weight (N,) of each match, one over the number of matches at its position.

    At most one of the matches at one position (within 2 px in either image) is right, and all of them agree
    with every F whose epipole lies there: together they count once.
    """
    return 1.0 / np.maximum(_matches_per_cell(xy1), _matches_per_cell(xy2))


def _matches_per_cell(xy: F64) -> F64:
    cell = np.floor(xy / SAME_PX).astype(np.int64)
    _, place, count = np.unique(cell[:, 0] * 1_000_003 + cell[:, 1], return_inverse=True, return_counts=True)
    return np.asarray(count[place], dtype=np.float64)


def log10_false_alarms(agreeing: float, tried: float, *, chance: float, free: int) -> float:
    """log10 of the expected number of models with as many inliers among wrong matches.

    A-contrario bound (tried - free) C(tried, free) P(Binomial >= agreeing - free): the model passes through
    ``free`` matches and each of the rest agrees with probability ``chance`` (Moisan and Stival, IJCV 57,
    2004). ``agreeing`` and ``tried`` are sums of weights.
    """
    rest, hits = tried - free, agreeing - free
    if hits <= 0.0 or rest <= 0.0:
        return 0.0
    tail = float(scipy.special.betainc(hits, max(rest - hits, 0.0) + 1.0, min(chance, 1.0)))
    ways = (
        scipy.special.gammaln(tried + 1.0)
        - scipy.special.gammaln(free + 1.0)
        - scipy.special.gammaln(rest + 1.0)
        + np.log(max(rest, 1.0))
    )
    return float((ways + np.log(max(tail, 1e-300))) / np.log(10.0))


def chance_of_agreement(xy1: F64, xy2: F64, band_px: float) -> float:
    """Probability that a wrong match lies within a Sampson distance of any F.

    Area of a band of width 2 sqrt(2) band_px across the bounding box of the matches, relative to the box.
    """
    narrow = min(float(np.ptp(xy)) for xy in (*xy1.T, *xy2.T))
    return min(1.0, float(2.0 * np.sqrt(2.0) * band_px / max(narrow, 1e-300)))

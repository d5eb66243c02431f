"""The plane that most matches of an F lie on, and which matches stand off it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.epipolar.certainty.kernels import (
    dominant_plane,
    plane_distances,
    plane_normal_equations,
    refine_plane,
)

F64 = NDArray[np.float64]
B8 = NDArray[np.bool_]

TRIPLES, SUBSET = 100, 200
"""Planes tried, and matches that each is judged on: a plane of a third of them is found with 98 %."""
OFF_PLANE = 16.0
"""Squared distance in sigma^2 beyond which a match stands off the plane: noise does so once in 3000."""
GATE = 5.0
SUBSET_STEPS, ALL_STEPS, MOST = 3, 4, 600
SAME_PX = 2.0


@dataclass(frozen=True)
class DominantPlane:
    """``h`` (9,) unit norm in the frame of the points, ``squared`` (N,) distances of all, in sigma^2."""

    h: F64
    squared: F64

    @property
    def off(self) -> B8:
        """(N,) which points stand off the plane."""
        return np.asarray(self.squared > OFF_PLANE)


def find_dominant_plane(
    f: F64, points: F64, inliers: B8, *, sigma: float, rng: Generator
) -> DominantPlane | None:
    """The plane of F with most of its inliers, least squares over those within 5 sigma; None without one.

    ``f`` (9,), ``points`` (N, 4) and ``sigma`` in one frame.
    """
    mine = points[inliers]
    if len(mine) < 4:
        return None
    e2 = np.linalg.svd(f.reshape(3, 3))[0][:, 2].copy()
    mine = mine[rng.permutation(len(mine))[:MOST]]
    some = mine[:SUBSET]
    triples = rng.integers(0, len(some), (TRIPLES, 3))
    h = np.empty(9)
    dominant_plane(f, e2, some, triples, GATE * sigma, h)
    if not h.any():
        return None
    # A plane through three noisy matches is off elsewhere: the gate starts wide.
    refine_plane(h, some, 2.0 * GATE * sigma, SUBSET_STEPS)
    refine_plane(h, mine, GATE * sigma, ALL_STEPS)
    squared = np.asarray(plane_distances(h, points)) / sigma**2
    return DominantPlane(h, squared) if (squared < GATE**2).any() else None


def plane_covariance(h: F64, points: F64, sigma: float) -> F64:
    """Covariance (9, 9) of h, unit norm, from the points (N, 4) of the plane."""
    G = np.empty((9, 9))
    plane_normal_equations(h, points, 1e6 * sigma, G)
    values, vectors = np.linalg.eigh(G)
    # The least eigenvalue is the scale of H, which no distance sees.
    half = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-14 * values[-1]))
    return np.asarray(sigma**2 * half @ half.T)


def once_each(xy1: F64, xy2: F64) -> F64:
    """Weights (N,): one over the number of matches that share a place (of 2 px) in either image.

    At most one of the matches of one place is right, and all of them agree with every F whose epipole lies
    there: they are one piece of evidence.
    """
    return 1.0 / np.maximum(_crowd(xy1), _crowd(xy2))


def _crowd(xy: F64) -> F64:
    cell = np.floor(xy / SAME_PX).astype(np.int64)
    _, place, count = np.unique(cell[:, 0] * 1_000_003 + cell[:, 1], return_inverse=True, return_counts=True)
    return np.asarray(count[place], dtype=np.float64)


def log10_false_alarms(agreeing: float, tried: float, *, chance: float, free: int) -> float:
    """log10 of how often ``agreeing`` or more of ``tried`` wrong matches agree with the best model by chance.

    The model is laid through ``free`` of them and each of the rest agrees with probability ``chance``: the
    a-contrario bound (tried - free) C(tried, free) P(Binomial >= agreeing - free) of Moisan and Stival (IJCV
    2004). 0 or more where that many are no surprise.
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
    """Probability that a wrong match lies within Sampson distance ``band_px`` of any F.

    A band of width 2 sqrt(2) band_px across the picture, over the picture: the bounds of the matches.
    """
    narrow = min(float(np.ptp(xy)) for xy in (*xy1.T, *xy2.T))
    return min(1.0, float(2.0 * np.sqrt(2.0) * band_px / max(narrow, 1e-300)))

"""Other epipolar geometries of the same plane that explain about as many matches as the one found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.epipolar.certainty.kernels import geometries_of_plane, unlike
from thesisrecon.epipolar.certainty.plane import DominantPlane
from thesisrecon.epipolar.kernels import sampson_distances
from thesisrecon.epipolar.rank2.kernels import GRADIENT, refine

F64 = NDArray[np.float64]
B8 = NDArray[np.bool_]

PAIRS, SUBSET, RIVALS, LOOKED_AT = 300, 400, 3, 100
"""Epipoles tried, matches off the plane that each is judged on, and how many of the best by all of these, and
by those that the found F does not explain, are refined if they are unlike each other."""
TYPICAL = 0.3
"""Of the epipoles tried, so many are taken for wrong: what they explain, chance explains."""
ALIKE = 0.8
"""Share of its matches that two geometries have in common to count as one."""
GATES, KNEE, STEPS = (2.4, 1.8, 1.2), 0.4, 5
WIDE = 2.0
"""In bands: two noisy matches and a plane that is known where its matches are do not make a good F."""
FAR = 20.0
"""Distances count to so many bands, or one wrong match would be the whole difference of two geometries."""


@dataclass(frozen=True)
class Rival:
    """Another F: ``f`` (9,) in the frame, and how it differs from the one that was found.

    ``lost`` and ``gained`` are weights of matches that only the one or only the other explains; ``error`` is
    the RMS distance of the rival's inliers to the found F, ``apart`` that or the other way round, whichever
    is less, in the units of the frame.
    """

    f: F64
    lost: float
    gained: float
    error: float
    apart: float

    @property
    def margin(self) -> float:
        """By how many standard errors the found F explains more: McNemar's test."""
        return (self.lost - self.gained) / float(np.sqrt(max(self.lost + self.gained, 1.0)))


def find_rivals(
    f: F64, points: F64, weights: F64, plane: DominantPlane, *, band: float, rng: Generator
) -> tuple[list[Rival], float]:
    """The rivals of ``f`` and the share of the matches off the plane that a geometry explains by chance.

    [e]x H of the plane and two matches off it (Chum, Werner and Matas, CVPR 2005), right or wrong, are judged
    on all matches off it; the best that are unlike each other are refined on all ``points`` (N, 4). Of half
    of the pairs one match agrees with ``f`` and the other does not: a wrong F often has most of its matches
    in common with the right one. Matches have ``weights`` (N,), and agree within ``band``.
    """
    distances = np.asarray(sampson_distances(f, points))
    inside = distances < band
    off = np.flatnonzero(plane.off)
    if len(off) < 3:
        return [], 0.0
    off = off[rng.permutation(len(off))[:SUBSET]]
    w, mine = weights[off], inside[off]
    F, agree, sums = geometries_of_plane(
        plane.h, points[off], np.stack([w, w * ~mine]), _pairs(mine, rng), WIDE * band
    )
    # The two matches that made a geometry agree with it always.
    beyond = np.maximum(sums[:, 0] - 2.0, 0.0) / max(float(w.sum()) - 2.0, 1.0)
    chance = float(np.quantile(beyond, TYPICAL)) / WIDE
    chosen, count = np.empty(2 * RIVALS, dtype=np.int64), 0
    for k, value in enumerate((sums[:, 0], sums[:, 0] + sums[:, 1])):
        order = np.argsort(-value, kind="stable")
        count = unlike(order[:LOOKED_AT], agree, w, ALIKE, chosen, count, (k + 1) * RIVALS)
    rivals = [
        _rival(_refined(F[s], points, band), points, weights, (distances, inside), band)
        for s in chosen[:count]
    ]
    return rivals, chance


def _pairs(inside: B8, rng: Generator) -> NDArray[np.int64]:
    pairs = rng.integers(0, len(inside), (PAIRS, 2))
    mine, others = np.flatnonzero(inside), np.flatnonzero(~inside)
    if len(mine) and len(others):
        half = PAIRS // 2
        pairs[:half, 0] = mine[rng.integers(0, len(mine), half)]
        pairs[:half, 1] = others[rng.integers(0, len(others), half)]
    return pairs


def _refined(f: F64, points: F64, band: float) -> F64:
    f = f.copy()
    for gate in GATES:
        refine(f, points, GRADIENT, gate * band, KNEE * gate * band, STEPS)
    return f


def compare_rivals(others: list[F64], f: F64, points: F64, weights: F64, *, band: float) -> list[Rival]:
    """Other matrices (9,) in the frame as rivals of ``f``, each refined on all ``points`` (N, 4)."""
    distances = np.asarray(sampson_distances(f, points))
    found = (distances, distances < band)
    return [_rival(_refined(other, points, band), points, weights, found, band) for other in others]


def _rival(f: F64, points: F64, weights: F64, found: tuple[F64, B8], band: float) -> Rival:
    distances, inside = found
    own = np.asarray(sampson_distances(f, points))
    agreeing = own < band
    lost, gained = weights[inside & ~agreeing].sum(), weights[agreeing & ~inside].sum()
    if not agreeing.any() or not inside.any():
        return Rival(f, float(lost), float(gained), np.inf, np.inf)
    error, back = (
        np.sqrt(np.mean(np.minimum(d, FAR * band) ** 2)) for d in (distances[agreeing], own[inside])
    )
    return Rival(f, float(lost), float(gained), float(error), float(min(error, back)))

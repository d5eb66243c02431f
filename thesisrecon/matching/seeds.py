"""Best and second best of correlations between patches.

First matches without a search radius: mutual best patches that have no rival elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numba import njit

from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.records import Seeds


@njit(cache=True, nogil=True)
def scan_correlations(correlation: F32, xy2: F32, apart2: F32) -> tuple[I64, F32, F32]:
    """Best column of each row, its value, and the best value of a rival that lies elsewhere.

    ``correlation`` (B, N); ``xy2`` (N, 2) px; ``apart2`` (N,) squared distance within which a rival of column
    n counts as the same place. Returns index (B,), value (B,), rival (B,); -1 where there is no rival.
    """
    rows, columns = correlation.shape
    index = np.zeros(rows, np.int64)
    value = np.full(rows, -1.0, np.float32)
    competing_model = np.full(rows, -1.0, np.float32)
    for b in range(rows):
        row = correlation[b]
        best, top = 0, np.float32(-2.0)
        for n in range(columns):
            if row[n] > top:
                best, top = n, row[n]
        second = np.float32(-1.0)
        x, y, limit = xy2[best, 0], xy2[best, 1], apart2[best]
        for n in range(columns):
            if row[n] > second:
                dx, dy = xy2[n, 0] - x, xy2[n, 1] - y
                if dx * dx + dy * dy > limit:
                    second = row[n]
        index[b], value[b], competing_model[b] = best, top, second
    return index, value, competing_model


@njit(cache=True, nogil=True)
def update_column_best(correlation: F32, first_row: int, value: F32, index: I64) -> None:
    """Keep in ``value`` and ``index`` (N,) the best row of each column seen so far."""
    for b in range(correlation.shape[0]):
        row = correlation[b]
        for n in range(len(value)):
            if row[n] > value[n]:
                value[n] = row[n]
                index[n] = first_row + b


ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class SeedMatches:
    """``xy1, xy2`` (M, 2) px, ``affine`` (M, 2, 2) a first guess of the local map, ``score`` (M,)
    correlation."""

    xy1: F64
    xy2: F64
    affine: F64
    score: F32

    def __len__(self) -> int:
        """Number of matches."""
        return len(self.xy1)

    def at(self, chosen: B8 | I64) -> SeedMatches:
        """A part of them."""
        return SeedMatches(self.xy1[chosen], self.xy2[chosen], self.affine[chosen], self.score[chosen])


def match_seeds(seeds1: Seeds, seeds2: Seeds, *, turned: bool, ratio: float) -> SeedMatches:
    """Seeds that are each other's best, with every rival elsewhere worse by ``ratio`` in distance.

    ``turned`` takes the patches turned to their gradient, else the upright ones. Distance of unit patches:
    sqrt(2 - 2 correlation). Elsewhere: farther than a quarter of the patch (8 of its level's pixels).
    """
    use1, use2 = (np.flatnonzero((s.angle != 0.0) == turned) for s in (seeds1, seeds2))
    if not (len(use1) and len(use2)):
        none = np.empty((0, 2))
        return SeedMatches(none, none, np.empty((0, 2, 2)), np.empty(0, np.float32))
    index, value, competing_model, back = _correlate(seeds1, use1, seeds2, use2)
    mutual = back[index] == np.arange(len(use1))
    distinct = (1.0 - value) < ratio**2 * (1.0 - competing_model)
    rows = np.flatnonzero(mutual & distinct & (value > 0.5))
    one, two = use1[rows], use2[index[rows]]
    turn = (seeds2.angle[two] - seeds1.angle[one]).astype(np.float64)
    grow = (seeds2.scale[two] / seeds1.scale[one]).astype(np.float64)
    return SeedMatches(seeds1.xy[one], seeds2.xy[two], similarity(grow, turn), value[rows])


def _correlate(seeds1: Seeds, use1: I64, seeds2: Seeds, use2: I64) -> tuple[I64, F32, F32, I64]:
    xy2 = seeds2.xy[use2].astype(np.float32)
    apart2 = (8.0 * seeds2.scale[use2]) ** 2
    patches1, patches2 = seeds1.patches[use1], np.ascontiguousarray(seeds2.patches[use2].T)
    column_value = np.full(len(use2), -2.0, np.float32)
    back = np.zeros(len(use2), np.int64)
    parts = []
    # A block of rows stays in the cache between the product and the two scans.
    for first in range(0, len(use1), ROWS_AT_ONCE):
        correlation = patches1[first : first + ROWS_AT_ONCE] @ patches2
        parts.append(scan_correlations(correlation, xy2, apart2))
        update_column_best(correlation, first, column_value, back)
    index, value, competing_model = (np.concatenate(column) for column in zip(*parts, strict=True))
    return index, value, competing_model, back


def similarity(scale: F64, angle: F64) -> F64:
    """Scaled rotations (M, 2, 2)."""
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    maps: F64 = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return maps


def common_similarity(matches: SeedMatches) -> F64:
    """(2, 2) the scaled rotation most matches agree on: medians of log scale and of angle (about the mean
    one)."""
    a = matches.affine
    scale = np.exp(np.median(np.log(np.hypot(a[:, 0, 0], a[:, 1, 0]))))
    angle = np.arctan2(a[:, 1, 0], a[:, 0, 0])
    # The mode of the angles, by a histogram of 10 degrees, and the median around it.
    counts, edges = np.histogram(angle, bins=36, range=(-np.pi, np.pi))
    counts = counts + np.roll(counts, 1) + np.roll(counts, -1)
    mode = edges[np.argmax(counts)] + np.pi / 36
    around = np.angle(np.exp(1j * (angle - mode)))
    near = np.abs(around) < np.pi / 6
    common: F64 = similarity(np.array([scale]), np.array([mode + np.median(around[near])]))[0]
    return common


def neighbour_support(matches: SeedMatches, *, neighbours: int = 10, tolerance: float = 0.3) -> F64:
    """(M,) strength of each match: how many of its neighbours move as it does (equation 4.1 with c = 1).

    Neighbour m of match k counts exp(-1/2 (|d_m - d_k| / (tolerance |u_m - u_k|))^2), d the displacement left
    after the rotation and scale that the two images have in common; both images serve as the first in turn.
    """
    if len(matches) < 2:
        return np.zeros(len(matches))
    a = common_similarity(matches)
    u, v = matches.xy1 @ a.T, matches.xy2
    k = min(neighbours + 1, len(matches))
    support = np.zeros(len(matches))
    for here, there in ((u, v), (v, u)):
        near = scipy.spatial.cKDTree(here).query(here, k)[1][:, 1:]
        apart = np.linalg.norm(here[near] - here[:, None], axis=2)
        strain = np.linalg.norm((there[near] - there[:, None]) - (here[near] - here[:, None]), axis=2)
        support += np.exp(-0.5 * (strain / (tolerance * apart + 1.0)) ** 2).sum(axis=1)
    return 0.5 * support


def corners_of_seeds(
    xy1: F64, xy2: F64, known: SeedMatches, *, reach_px: float = 4.0
) -> tuple[I64, I64, SeedMatches]:
    """Pairs of corners that the seeds stand on: the nearest to each seed in image 1 and the nearest in image
    2 to where the seed's map takes it, both within ``reach_px``; one-to-one, the best correlations first.

    ``xy1`` (N, 2), ``xy2`` (K, 2) the corners px. Returns their numbers (M,), (M,) and the matches.
    """
    apart1, one = scipy.spatial.cKDTree(xy1).query(known.xy1)
    led = known.xy2 + np.einsum("mij,mj->mi", known.affine, xy1[one] - known.xy1)
    apart2, two = scipy.spatial.cKDTree(xy2).query(led)
    order = np.argsort(-known.score, kind="stable")
    order = order[(apart1[order] <= reach_px) & (apart2[order] <= reach_px)]
    for corner in (one, two):
        order = order[np.sort(np.unique(corner[order], return_index=True)[1])]
    order = order[np.argsort(one[order], kind="stable")]
    one, two = one[order].astype(np.int64), two[order].astype(np.int64)
    return one, two, SeedMatches(xy1[one], xy2[two], known.affine[order], known.score[order])

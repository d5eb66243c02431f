"""What the ways to choose pairs share.

Loops of the overlap estimate; the tests compare each with a NumPy twin.

How much two photographs overlap, told from a few hundred small patches of each.

A vocabulary of patches made from the photographs themselves: which photographs use the same words.

J. Sivic and A. Zisserman, Video Google: a text retrieval approach to object matching in videos, ICCV 2003.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import scipy
from numba import njit

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.records import Seeds

MapAll = Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]]
"""Calls a function on each item, perhaps in several threads, and returns the answers in order."""


def pair_array(pairs: Iterable[Iterable[int]]) -> I64:
    """Pairs as (M, 2) with the smaller number first, sorted."""
    rows = sorted({(min(pair), max(pair)) for pair in (tuple(p) for p in pairs)})
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def every_pair(n: int) -> I64:
    """All pairs of ``n`` views."""
    return pair_array(combinations(range(n), 2))


@njit(cache=True, nogil=True)
def mutual_best(correlation: F32, xy2: F32, apart2: F32) -> tuple[I64, F32]:
    """Of each row of (N, M) correlations its column, -1 where they are not each other's best, and its rival.

    The rival (N,) is the largest correlation of a row elsewhere: with a column whose place ``xy2`` (M, 2) is
    farther from that of the best than the square root of the best's ``apart2`` (M,); -1 without any, and
    where the column is -1. The first of equal values counts.
    """
    rows, columns = correlation.shape
    column_value = np.full(columns, -2.0, np.float32)
    column_row = np.full(columns, -1, np.int64)
    index = np.full(rows, -1, np.int64)
    for r in range(rows):
        best, place = np.float32(-2.0), -1
        for c in range(columns):
            value = correlation[r, c]
            if value > best:
                best, place = value, c
            if value > column_value[c]:
                column_value[c] = value
                column_row[c] = r
        index[r] = place
    competing_model = np.full(rows, -1.0, np.float32)
    for r in range(rows):
        place = index[r]
        if place < 0 or column_row[place] != r:
            index[r] = -1
            continue
        for c in range(columns):
            if correlation[r, c] > competing_model[r]:
                dx, dy = xy2[c, 0] - xy2[place, 0], xy2[c, 1] - xy2[place, 1]
                if dx * dx + dy * dy > apart2[place]:
                    competing_model[r] = correlation[r, c]
    return index, competing_model


@njit(cache=True, nogil=True)
def most_agreeing(xy1: F64, xy2: F64, scale: F64, angle: F64, limits: F64) -> int:
    """The largest number of matches that the similarity of one of them predicts, that one not counted.

    Match m has places ``xy1[m]``, ``xy2[m]`` and a similarity: ``scale[m]`` (pixels of image 2 per pixel of
    image 1) and ``angle[m]`` (rad). It predicts another whose place in image 2 it foretells within
    ``limits[0]`` px, and whose scale differs by at most ``limits[1]`` in its logarithm, its angle by at most
    ``limits[2]`` rad.
    """
    most, radius2 = 0, limits[0] * limits[0]
    for h in range(len(xy1)):
        c, s = scale[h] * np.cos(angle[h]), scale[h] * np.sin(angle[h])
        count = 0
        for m in range(len(xy1)):
            x, y = xy1[m, 0] - xy1[h, 0], xy1[m, 1] - xy1[h, 1]
            dx = xy2[h, 0] + c * x - s * y - xy2[m, 0]
            dy = xy2[h, 1] + s * x + c * y - xy2[m, 1]
            turn = np.cos(angle[m] - angle[h])
            alike = abs(np.log(scale[m] / scale[h])) <= limits[1] and turn >= np.cos(limits[2])
            if m != h and alike and dx * dx + dy * dy <= radius2:
                count += 1
        most = max(most, count)
    return most


LEAST_CORRELATION = 0.5
"""Of two patches that may show the same: half of the variance in common."""
LEAST_LOG10 = -300.0
"""Below it the tail of the binomial underflows."""


@dataclass(frozen=True)
class FeatureSubset:
    """Some seeds of one photograph, of every scale; ``size`` (width, height) px is the extent of all.

    ``xy`` (S, 2) px; ``scale``, ``angle`` (S,); ``patches`` (S, D) float32 of zero mean and unit norm.
    """

    xy: F64
    scale: F64
    angle: F64
    patches: F32
    size: F64


def subset_seeds(seeds: Seeds, *, turned: bool, per_scale: int) -> FeatureSubset:
    """The strongest ``per_scale`` seeds of each scale: the turned patches, or the upright ones."""
    use = np.flatnonzero((seeds.angle != 0.0) == turned)
    parts = [use[seeds.scale[use] == scale][:per_scale] for scale in np.unique(seeds.scale[use])]
    kept = np.concatenate([np.empty(0, np.int64), *parts])
    extent = np.ptp(seeds.xy, axis=0) + 1.0 if len(seeds.xy) else np.ones(2)
    return FeatureSubset(
        np.ascontiguousarray(seeds.xy[kept]),
        seeds.scale[kept].astype(np.float64),
        seeds.angle[kept].astype(np.float64),
        np.ascontiguousarray(seeds.patches[kept]),
        extent,
    )


@dataclass(frozen=True)
class OverlapTest:
    """Patches that are each other's best name a similarity; how many agree with one is judged against chance.

    Parameters
    ----------
    ratio : distance of a patch to its match as a share of that to the best rival elsewhere, at most.
    radius_rel : how far a match may lie from where the similarity of another foretells it, share of the long
        side: wide, for parallax and perspective are no similarity.
    log_scale : how far logarithms of their scales may differ; ``angle_rad`` their angles.
    most_matches : matches, the best by correlation, that are asked.
    """

    ratio: float = 0.8
    radius_rel: float = 0.1
    log_scale: float = 0.8
    angle_rad: float = 0.8
    most_matches: int = 150

    def score(self, a: FeatureSubset, b: FeatureSubset) -> float:
        """-log10 of how many similarities with as many matches chance would give this pair (at 0: one).

        With M matches, each of which is a trial, k that agree with the best, and p the area around a
        foretold place as a share of the photograph: M B(M - 1, k, p), B the tail of the binomial (the number
        of false alarms of Desolneux, Moisan and Morel, Meaningful alignments, IJCV 2000).
        """
        one, two = self._matches(a, b)
        if len(one) < 2:
            return -float(np.log10(max(len(one), 1)))
        radius = self.radius_rel * float(b.size.max())
        turn = b.angle[two] - a.angle[one]
        k = most_agreeing(
            a.xy[one],
            b.xy[two],
            b.scale[two] / a.scale[one],
            turn,
            np.array([radius, self.log_scale, self.angle_rad]),
        )
        return -_log10_false_alarms(k, len(one), min(1.0, np.pi * radius**2 / float(np.prod(b.size))))

    def _matches(self, a: FeatureSubset, b: FeatureSubset) -> tuple[I64, I64]:
        if not (len(a.xy) and len(b.xy)):
            return np.empty(0, np.int64), np.empty(0, np.int64)
        correlation = a.patches @ b.patches.T
        apart2 = ((8.0 * b.scale) ** 2).astype(np.float32)
        index, competing_model = mutual_best(correlation, b.xy.astype(np.float32), apart2)
        one = np.flatnonzero(index >= 0)
        value = correlation[one, index[one]]
        distinct = (value > LEAST_CORRELATION) & (
            (1.0 - value) < self.ratio**2 * (1.0 - competing_model[one])
        )
        one, value = one[distinct], value[distinct]
        one = one[np.argsort(-value, kind="stable")[: self.most_matches]]
        return one, index[one]


def _log10_false_alarms(k: int, matches: int, chance: float) -> float:
    """log10 of M times the probability that of M - 1 others at least k agree by chance."""
    tail = float(scipy.special.bdtrc(k - 1, matches - 1, chance)) if k > 0 else 1.0
    return float(np.log10(matches)) + max(float(np.log10(max(tail, 1e-320))), LEAST_LOG10)


SAMPLES_PER_WORD = 8
ROUNDS = 4
ROWS_AT_ONCE = 4096


def bow_similarity(patches: Sequence[F32], words: int, *, map_all: MapAll, rng: np.random.Generator) -> F64:
    """(N, N) cosine of the photographs' word counts, each word weighed by how few photographs use it.

    ``patches[i]`` (S, D) are the unit patches of photograph i. A patch counts for the three words nearest
    to it, so that one at a border finds its like; roots of the counts keep repeated structure from deciding.
    The time grows with N, but for one product of (N, words) matrices.
    """
    everything = np.concatenate([np.empty((0, patches[0].shape[1]), np.float32), *patches])
    if not len(everything):
        return np.zeros((len(patches), len(patches)))
    vocabulary = _vocabulary(everything, min(words, len(everything)), rng)
    counts = np.stack(map_all(lambda given: _count_words(given, vocabulary), patches))
    used = np.maximum((counts > 0).sum(axis=0), 1)
    weighed = np.sqrt(counts) * np.log(len(patches) / used)
    weighed /= np.maximum(np.linalg.norm(weighed, axis=1, keepdims=True), 1e-12)
    alike: F64 = weighed @ weighed.T
    return alike


def _vocabulary(patches: F32, words: int, rng: np.random.Generator) -> F32:
    """(words, D) centres of spherical k-means over a sample of the patches."""
    sample = patches[rng.permutation(len(patches))[: SAMPLES_PER_WORD * words]]
    centres = sample[:words]
    for _ in range(ROUNDS):
        nearest = np.concatenate(
            [np.argmax(rows @ centres.T, axis=1) for rows in np.split(sample, _cuts(len(sample)))]
        )
        order = np.argsort(nearest, kind="stable")
        found, start = np.unique(nearest[order], return_index=True)
        sums = centres.copy()
        sums[found] = np.add.reduceat(sample[order], start, axis=0)
        centres = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.float32(1e-6))
    return centres


def _cuts(rows: int) -> list[int]:
    return list(range(ROWS_AT_ONCE, rows, ROWS_AT_ONCE))


def _count_words(patches: F32, vocabulary: F32) -> F64:
    words = len(vocabulary)
    nearest = np.argpartition(-(patches @ vocabulary.T), min(2, words - 1), axis=1)[:, :3]
    return np.bincount(nearest.ravel(), minlength=words).astype(np.float64)

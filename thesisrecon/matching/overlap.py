"""Estimate which images overlap: geometric test of small patch sets and bag-of-words similarity.

Bag of words after J. Sivic and A. Zisserman, "Video Google: a text retrieval approach to object matching in
videos", ICCV 2003, with a vocabulary made from the images themselves.
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
from thesisrecon.matching.seeds import mutual_best
from thesisrecon.records import Seeds

MapAll = Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]]
"""Apply a function to each item, possibly in several threads, and return the results in order."""
# Minimum correlation of two patches of the same surface: half of the variance in common.
MIN_CORRELATION = 0.5
# Below this the tail of the binomial distribution underflows.
MIN_LOG10 = -300.0
SAMPLES_PER_WORD = 8
ROUNDS = 4
ROWS_AT_ONCE = 4096


def pair_array(pairs: Iterable[Iterable[int]]) -> I64:
    """Return pairs as a sorted array without duplicates.

    Parameters
    ----------
    pairs : iterable of pairs of int
        Pairs in any order.

    Returns
    -------
    ndarray (M, 2) of int
        Pairs with the smaller number first.
    """
    rows = sorted({(min(pair), max(pair)) for pair in (tuple(p) for p in pairs)})
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def every_pair(n: int) -> I64:
    """Return all pairs of views.

    Parameters
    ----------
    n : int
        Number of views.

    Returns
    -------
    ndarray (M, 2) of int
        The pairs.
    """
    return pair_array(combinations(range(n), 2))


@njit(cache=True, nogil=True)
def _count_agreeing(xy1: F64, xy2: F64, scale: F64, angle: F64, limits: F64) -> int:
    """Largest number of other matches predicted by the similarity of one match.

    Match m has positions ``xy1[m]``, ``xy2[m]``, ``scale[m]`` (image 2 per image 1) and ``angle[m]`` rad.
    ``limits`` are the position error in px, the difference of log scales and the difference of angles.
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
            similarity = abs(np.log(scale[m] / scale[h])) <= limits[1] and turn >= np.cos(limits[2])
            if m != h and similarity and dx * dx + dy * dy <= radius2:
                count += 1
        most = max(most, count)
    return most


@dataclass(frozen=True)
class FeatureSubset:
    """Some seeds of one image, of every scale.

    Parameters
    ----------
    xy : ndarray (S, 2)
        Positions, px.
    scale, angle : ndarray (S,)
        Scale and angle, rad.
    patches : ndarray (S, D)
        Patches of zero mean and unit norm, float32.
    size : ndarray (2,)
        Extent of all seeds, px.
    """

    xy: F64
    scale: F64
    angle: F64
    patches: F32
    size: F64


def subset_seeds(seeds: Seeds, *, rotated: bool, per_scale: int) -> FeatureSubset:
    """Select the strongest seeds of each scale.

    Parameters
    ----------
    seeds : Seeds
        Seeds of one image.
    rotated : bool
        Use the patches rotated to their dominant gradient, else the upright ones.
    per_scale : int
        Number of seeds per scale.

    Returns
    -------
    FeatureSubset
        The selected seeds.
    """
    use = np.flatnonzero((seeds.angle != 0.0) == rotated)
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
    """Test of overlap by mutually best patches that agree with one similarity, compared with chance.

    Parameters
    ----------
    ratio : float
        Maximum ratio of the distances to the best and to the second best patch.
    radius_rel : float
        Maximum deviation of a match from the prediction, relative to the long side; wide because of parallax
        and perspective.
    log_scale : float
        Maximum difference of log scales.
    angle_rad : float
        Maximum difference of angles.
    max_matches : int
        Maximum number of matches, best correlations first.
    """

    ratio: float = 0.8
    radius_rel: float = 0.1
    log_scale: float = 0.8
    angle_rad: float = 0.8
    max_matches: int = 150

    def score(self, a: FeatureSubset, b: FeatureSubset) -> float:
        """Compute the evidence of overlap, -log10 of the number of false alarms.

        M B(M - 1, k, p) for M matches, k that agree with the best similarity and p the relative area around a
        prediction, with B the tail of the binomial distribution.

        Parameters
        ----------
        a, b : FeatureSubset
            Seeds of both images.

        Returns
        -------
        float
            0 means one false alarm is expected; larger is stronger evidence.

        References
        ----------
        A. Desolneux, L. Moisan and J.-M. Morel, "Meaningful alignments", IJCV 40, 2000.
        """
        one, two = self._matches(a, b)
        if len(one) < 2:
            return -float(np.log10(max(len(one), 1)))
        radius = self.radius_rel * float(b.size.max())
        turn = b.angle[two] - a.angle[one]
        k = _count_agreeing(
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
        index, value, second_best = mutual_best([correlation], b.xy.astype(np.float32), apart2)
        one = np.flatnonzero(index >= 0)
        value, second_best = value[one], second_best[one]
        distinct = (value > MIN_CORRELATION) & ((1.0 - value) < self.ratio**2 * (1.0 - second_best))
        one, value = one[distinct], value[distinct]
        one = one[np.argsort(-value, kind="stable")[: self.max_matches]]
        return one, index[one]


def _log10_false_alarms(k: int, matches: int, chance: float) -> float:
    """log10 of M times the probability that at least k of M - 1 other matches agree by chance."""
    tail = float(scipy.special.bdtrc(k - 1, matches - 1, chance)) if k > 0 else 1.0
    return float(np.log10(matches)) + max(float(np.log10(max(tail, 1e-320))), MIN_LOG10)


def bow_similarity(patches: Sequence[F32], words: int, *, map_all: MapAll, rng: np.random.Generator) -> F64:
    """Compute the bag-of-words similarity of all pairs of images.

    Cosine of the weighted word counts; a word is weighted by how few images contain it. A patch counts for
    its three nearest words, and square roots of the counts limit the effect of repeated structure.

    Parameters
    ----------
    patches : sequence of ndarray (S, D)
        Unit patches of each image.
    words : int
        Vocabulary size.
    map_all : callable
        Parallel map.
    rng : numpy.random.Generator
        Source of the vocabulary sample.

    Returns
    -------
    ndarray (N, N)
        Similarities.
    """
    everything = np.concatenate([np.empty((0, patches[0].shape[1]), np.float32), *patches])
    if not len(everything):
        return np.zeros((len(patches), len(patches)))
    vocabulary = _vocabulary(everything, min(words, len(everything)), rng)
    counts = np.stack(map_all(lambda given: _count_words(given, vocabulary), patches))
    used = np.maximum((counts > 0).sum(axis=0), 1)
    weighed = np.sqrt(counts) * np.log(len(patches) / used)
    weighed /= np.maximum(np.linalg.norm(weighed, axis=1, keepdims=True), 1e-12)
    similarity: F64 = weighed @ weighed.T
    return similarity


def _vocabulary(patches: F32, words: int, rng: np.random.Generator) -> F32:
    """Centres (words, D) of spherical k-means over a sample of the patches."""
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

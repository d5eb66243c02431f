"""A vocabulary of patches made from the photographs themselves: which photographs use the same words.

J. Sivic and A. Zisserman, Video Google: a text retrieval approach to object matching in videos, ICCV 2003.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thesisrecon.matching.pair_selection.records import MapAll
from thesisrecon.types import F32, F64

SAMPLES_PER_WORD = 8
ROUNDS = 4
ROWS_AT_ONCE = 4096


def likeness(patches: Sequence[F32], words: int, *, map_all: MapAll, rng: np.random.Generator) -> F64:
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

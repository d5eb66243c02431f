"""Bag-of-words description of images by their patches, with a vocabulary made from the images themselves.

After J. Sivic and A. Zisserman, "Video Google: a text retrieval approach to object matching in videos", ICCV
2003.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from thesisrecon.arrays import F32, I64
from thesisrecon.matching._prepared import MapAll

SAMPLES_PER_WORD = 8
ROUNDS = 4


def word_weights(
    patches: Sequence[F32], words: int, *, map_all: MapAll, rng: np.random.Generator
) -> scipy.sparse.csr_array:
    """Weighted word counts (N, W) of images with unit patches (S, D); products of the rows are cosines.

    A word is weighted by how few images contain it, and square roots of the counts limit the effect of
    repeated structure. The vocabulary must be large: if each image contains most words, all images are
    similar. The transpose is the inverted file: the images of each word.
    """
    everything = np.concatenate([np.empty((0, patches[0].shape[1]), np.float32), *patches])
    if not len(everything):
        return scipy.sparse.csr_array((len(patches), 1))
    words = min(words, len(everything) // SAMPLES_PER_WORD)
    vocabulary = _vocabulary(everything, words, map_all=map_all, rng=rng)
    found = map_all(lambda given: np.unique(_words_of(given, vocabulary), return_counts=True), patches)
    image = np.repeat(np.arange(len(patches)), [len(word) for word, _ in found])
    word, count = (np.concatenate([part[k] for part in found]) for k in (0, 1))
    used = np.bincount(word)
    weight = np.sqrt(count) * np.log(len(patches) / used[word])
    weight /= np.sqrt(np.maximum(np.bincount(image, weight**2), 1e-24))[image]
    return scipy.sparse.csr_array((weight, (image, word)), (len(patches), vocabulary[1][:, :, 0].size))


_Vocabulary = tuple[F32, F32]
"""Unit centres (B, D) of branches, and of the words (B, B, D) of each."""


def _vocabulary(patches: F32, words: int, *, map_all: MapAll, rng: np.random.Generator) -> _Vocabulary:
    """A tree of two levels with about ``words`` words (D. Nister and H. Stewenius, CVPR 2006)."""
    branches = max(int(np.sqrt(words)), 1)
    sample = patches[rng.permutation(len(patches))[: SAMPLES_PER_WORD * branches**2]]
    top = _centres(sample, branches)
    branch = np.argmax(sample @ top.T, axis=1)
    leaves = np.repeat(top[:, None], branches, axis=1)
    inside = [sample[branch == b] for b in range(branches)]
    used = [b for b in range(branches) if len(inside[b])]
    found = map_all(lambda b: _centres(inside[b], branches), used)
    for b, centres in zip(used, found, strict=True):
        leaves[b, : len(centres)] = centres
    return top, leaves


def _centres(sample: F32, count: int) -> F32:
    """Centres (at most ``count``, D) of spherical k-means, initialised by the first rows."""
    centres = sample[:count]
    for _ in range(ROUNDS):
        nearest = np.argmax(sample @ centres.T, axis=1)
        order = np.argsort(nearest, kind="stable")
        found, start = np.unique(nearest[order], return_index=True)
        sums = centres.copy()
        sums[found] = np.add.reduceat(sample[order], start, axis=0)
        centres = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.float32(1e-6))
    return centres


def _words_of(patches: F32, vocabulary: _Vocabulary) -> I64:
    """Word (S,) of each patch: the best of its best branch."""
    top, leaves = vocabulary
    if not len(patches):
        return np.empty(0, np.int64)
    branch = np.argmax(patches @ top.T, axis=1)
    order = np.argsort(branch, kind="stable")
    found, start = np.unique(branch[order], return_index=True)
    word = np.empty(len(patches), np.int64)
    for b, rows in zip(found, np.split(order, start[1:]), strict=True):
        word[rows] = b * len(top) + np.argmax(patches[rows] @ leaves[b].T, axis=1)
    return word

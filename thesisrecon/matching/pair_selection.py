"""Selection of the image pairs to match: all, a sequence window, a list, or by estimated overlap."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import UsageError
from thesisrecon.matching.overlap import (
    FeatureSubset,
    MapAll,
    OverlapTest,
    bow_similarity,
    every_pair,
    pair_array,
    subset_seeds,
)
from thesisrecon.records import Features, PairChoice

# ruff: noqa: ARG002 (all selectors have the same arguments)

# Evidence of the upright patches at which the rotated ones are not compared: one false alarm in a million.
DECIDED = 6.0


@dataclass(frozen=True)
class AllPairs:
    """Every image with every other: N (N - 1) / 2 pairs."""

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Accept all image names."""

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """Select all pairs."""
        return PairChoice(every_pair(len(names)), "all pairs")


@dataclass(frozen=True)
class SequenceWindow:
    """Each image with the next ones in the order of the file names.

    Parameters
    ----------
    window : int
        Number of following images.
    loop : bool
        Continue with the first image after the last.
    """

    window: int = 5
    loop: bool = False

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ValueError(
                f"window (number of following images to match) must be at least 1; got {self.window}"
            )

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Accept all image names."""

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """Select the pairs of the window."""
        n = len(names)
        steps = range(1, min(self.window, n - 1) + 1)
        ends = n if self.loop else 0
        pairs = {tuple(sorted((i, (i + s) % n))) for i in range(n) for s in steps if i + s < n + ends}
        what = "the next image" if self.window == 1 else f"the next {self.window} images"
        around = ", continuing at the first" if self.loop else ""
        return PairChoice(pair_array(pairs), f"each image with {what} by file name{around}")


@dataclass(frozen=True)
class ListedPairs:
    """The pairs of file names listed by the user.

    Pairs of an image that was left out (unreadable, a copy) are dropped.

    Parameters
    ----------
    listed : tuple of (str, str)
        Pairs of file names, each once, in any order.
    """

    listed: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        seen: set[frozenset[str]] = set()
        for one, two in self.listed:
            if one == two:
                raise ValueError(f"the pair list pairs {one!r} with itself; list two different images")
            if (pair := frozenset((one, two))) in seen:
                raise ValueError(f"the pair list contains {one!r}, {two!r} twice; list each pair once")
            seen.add(pair)

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Check the list against the image names.

        Parameters
        ----------
        names : sequence of str
            Names of the images.
        left_out : collection of str
            Names of images that were not used.

        Raises
        ------
        UsageError
            If a name is unknown or no pair remains.
        """
        known = {*names, *left_out}
        unknown = sorted({name for pair in self.listed for name in pair} - known)
        if unknown:
            more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
            some = ", ".join(repr(name) for name in sorted(known)[:3])
            raise UsageError(
                f"the pair list names {unknown[0]!r}{more}, which is not among the {len(known)} images "
                f"({some}{', ...' if len(known) > 3 else ''})"
            )
        if not any(set(pair) <= set(names) for pair in self.listed):
            without = "; its images were left out" if self.listed else ""
            raise UsageError(f"the pair list leaves no pair to match{without}")

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """Select the listed pairs of the images in use.

        Parameters
        ----------
        names : sequence of str
            Names of the images.
        features : sequence of Features
            Features of the images.
        map_all : callable
            Parallel map.
        rng : numpy.random.Generator
            Random generator.

        Returns
        -------
        PairChoice
            The pairs.
        """
        number = {name: i for i, name in enumerate(names)}
        there = (pair for pair in self.listed if pair[0] in number and pair[1] in number)
        return PairChoice(pair_array((number[one], number[two]) for one, two in there), "the listed pairs")


@dataclass(frozen=True)
class OverlapEstimate:
    """All pairs of a small set; in a larger one the pairs whose strongest patches agree beyond chance.

    Each image is compared with a fixed number of others by bag-of-words similarity, so that the time grows
    with the number of images and not with its square. The best few pairs of each image and the best pairs
    that connect the set are added: every image is matched, and a chain of pairs connects any two.

    Parameters
    ----------
    all_up_to : int
        Number of images up to which all pairs are taken.
    per_scale : int
        Seeds of each scale that represent an image, upright and rotated.
    min_evidence : float
        Minimum -log10 of the number of false alarms (:class:`OverlapTest`).
    nearest : int
        Pairs of each image that are always taken.
    shortlist : int
        Number of images that each is compared with.
    words : int
        Vocabulary size.
    test : OverlapTest
        Comparison of two images.
    """

    all_up_to: int = 30
    per_scale: int = 200
    min_evidence: float = 0.5
    nearest: int = 3
    shortlist: int = 40
    words: int = 1024
    test: OverlapTest = field(default_factory=OverlapTest)

    def __post_init__(self) -> None:
        least = {"all_up_to": 0, "per_scale": 1, "nearest": 1, "shortlist": 1, "words": 1}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ValueError(f"{name} must be at least {bound}; got {getattr(self, name)}")

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Accept all image names."""

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """Select the pairs that probably overlap.

        Parameters
        ----------
        names : sequence of str
            Names of the images.
        features : sequence of Features
            Features of the images, with seeds in a large set.
        map_all : callable
            Parallel map.
        rng : numpy.random.Generator
            Source of the vocabulary sample.

        Returns
        -------
        PairChoice
            The pairs.

        Raises
        ------
        UsageError
            If the set is large and the features have no seeds.
        """
        n = len(names)
        if n <= self.all_up_to:
            how = f"all pairs (at most {self.all_up_to} images)"
            return PairChoice(every_pair(n), how)
        subsets = map_all(self._subsets, features)
        similarity = np.zeros((n, n))
        if n - 1 > self.shortlist:
            for kind in (0, 1):
                patches = [subset[kind].patches for subset in subsets]
                similarity += bow_similarity(patches, self.words, map_all=map_all, rng=rng)
        compared = _most_similar(similarity, self.shortlist)
        evidence = np.array(
            map_all(lambda pair: self._evidence(subsets[pair[0]], subsets[pair[1]]), compared.tolist())
        )
        chosen = self._choose(similarity, compared, evidence)
        how = (
            f"pairs with overlap evidence among {len(compared)} compared pairs, and the best "
            f"{self.nearest} of each image"
        )
        return PairChoice(chosen, how, compared=len(compared))

    def _subsets(self, features: Features) -> tuple[FeatureSubset, FeatureSubset]:
        if features.seeds is None:
            raise UsageError(
                f"the overlap of more than {self.all_up_to} images is estimated from seeds, which these "
                "features do not have; set features.kind=multi-scale-corners, or pairs.kind=all-pairs"
            )
        upright, rotated = (
            subset_seeds(features.seeds, rotated=rotated, per_scale=self.per_scale)
            for rotated in (False, True)
        )
        return upright, rotated

    def _evidence(
        self, a: tuple[FeatureSubset, FeatureSubset], b: tuple[FeatureSubset, FeatureSubset]
    ) -> float:
        upright = self.test.score(a[0], b[0])
        return upright if upright >= DECIDED else max(upright, self.test.score(a[1], b[1]))

    def _choose(self, similarity: F64, compared: I64, evidence: F64) -> I64:
        """Pairs (M, 2) with enough evidence, the best of each image, and those that connect the set."""
        n = len(similarity)
        # Pairs that were not compared follow all that were, ordered by bag-of-words similarity.
        order = similarity - 1e6
        order[compared[:, 0], compared[:, 1]] = order[compared[:, 1], compared[:, 0]] = evidence
        np.fill_diagonal(order, -np.inf)
        best = np.argsort(-order, axis=1, kind="stable")[:, : min(self.nearest, n - 1)]
        near = np.column_stack([np.repeat(np.arange(n), best.shape[1]), best.ravel()])
        chosen = pair_array([*compared[evidence >= self.min_evidence].tolist(), *near.tolist()])
        return pair_array([*chosen.tolist(), *_connecting_pairs(chosen, order).tolist()])


def _most_similar(similarity: F64, count: int) -> I64:
    """Pairs (M, 2) of each image with the ``count`` most similar ones of an (N, N) matrix; sorted."""
    n = len(similarity)
    others = similarity.copy()
    np.fill_diagonal(others, -np.inf)
    best = np.argsort(-others, axis=1, kind="stable")[:, : min(count, n - 1)]
    return pair_array(np.column_stack([np.repeat(np.arange(n), best.shape[1]), best.ravel()]).tolist())


def _connecting_pairs(chosen: I64, order: F64) -> I64:
    """Pairs (M, 2) of highest ``order`` that connect the components of the chosen pairs.

    The edges that a maximum spanning tree of all pairs adds to the chosen ones if these cost nothing.
    """
    n = len(order)
    i, j = np.triu_indices(n, 1)
    rank = np.empty(len(i))
    # Ranks instead of values: no two costs are equal, so the tree is unique and independent of rounding.
    rank[np.argsort(-order[i, j], kind="stable")] = np.arange(1, len(i) + 1)
    cost = np.zeros((n, n))
    cost[i, j] = rank + len(i)
    cost[chosen[:, 0], chosen[:, 1]] -= len(i)
    tree = scipy.sparse.csgraph.minimum_spanning_tree(cost).tocoo()
    new = tree.data > len(i)
    return np.column_stack([tree.row[new], tree.col[new]]).astype(np.int64).reshape(-1, 2)

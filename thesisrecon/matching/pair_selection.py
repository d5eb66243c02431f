"""Pairs that need no look at the photographs: all of them, neighbours in a sequence, a list of the user.

Pairs that overlap, told from small patches before anything is matched.
"""

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

# ruff: noqa: ARG002 (a choice takes what every choice is given)


@dataclass(frozen=True)
class AllPairs:
    """Every photograph with every other: N (N - 1) / 2 pairs."""

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Nothing can be wrong."""

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """All pairs."""
        return PairChoice(every_pair(len(names)), "all pairs")


@dataclass(frozen=True)
class SequenceWindow:
    """Each photograph with the ``window`` that follow it in the order of their names.

    ``loop`` : the last ones are followed by the first.
    """

    window: int = 5
    loop: bool = False

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ValueError(
                f"a window of {self.window} gives no pairs; it is how many of the next photographs each is "
                "matched with, at least 1"
            )

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Nothing can be wrong."""

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """The pairs of the window; without features."""
        n = len(names)
        steps = range(1, min(self.window, n - 1) + 1)
        ends = n if self.loop else 0
        pairs = {tuple(sorted((i, (i + s) % n))) for i in range(n) for s in steps if i + s < n + ends}
        what = "the next photograph" if self.window == 1 else f"the next {self.window} photographs"
        around = ", the first again after the last" if self.loop else ""
        return PairChoice(pair_array(pairs), f"each with {what} in the order of their names{around}")


@dataclass(frozen=True)
class ListedPairs:
    """The pairs of file names that the user lists, in any order.

    A photograph that was left out (unreadable, a copy) takes its pairs with it; one that is not there is
    refused, as are a photograph paired with itself and a pair listed twice.
    """

    listed: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        seen: set[frozenset[str]] = set()
        for one, two in self.listed:
            if one == two:
                raise ValueError(f"the list pairs {one!r} with itself; a pair is two photographs")
            if (pair := frozenset((one, two))) in seen:
                raise ValueError(f"the list names the pair {one!r}, {two!r} twice; each pair stands once")
            seen.add(pair)

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Raise :class:`UsageError` for a name that is no photograph, and a list that leaves no pair."""
        known = {*names, *left_out}
        strange = sorted({name for pair in self.listed for name in pair} - known)
        if strange:
            more = f" and {len(strange) - 1} more" if len(strange) > 1 else ""
            some = ", ".join(repr(name) for name in sorted(known)[:3])
            raise UsageError(
                f"the list of pairs names {strange[0]!r}{more}, which is none of the {len(known)} "
                f"photographs ({some}{', ...' if len(known) > 3 else ''})"
            )
        if not any(set(pair) <= set(names) for pair in self.listed):
            without = "; its photographs were left out" if self.listed else ""
            raise UsageError(f"the list of pairs leaves no pair to match{without}")

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """The listed pairs whose photographs are both there; without features."""
        number = {name: i for i, name in enumerate(names)}
        there = (pair for pair in self.listed if pair[0] in number and pair[1] in number)
        return PairChoice(pair_array((number[one], number[two]) for one, two in there), "the listed pairs")


DECIDED = 6.0
"""Evidence of the upright patches at which the turned ones are not asked: one chance in a million."""


@dataclass(frozen=True)
class OverlapEstimate:
    """All pairs of a small set; of a larger one, the pairs whose strongest patches agree beyond chance.

    Each photograph is compared with a fixed number of others, those that use the same words
    (:mod:`.words`), so that the time grows with the number of photographs and of their overlaps and not with
    its square. Beside the pairs that pass, the best few of each photograph are taken, and the best ones that
    hold the set together: no photograph is lost for want of evidence, and a chain of pairs links any two.

    Parameters
    ----------
    all_up_to : photographs up to which all pairs are taken.
    per_scale : seeds of each scale that stand for a photograph, upright and turned ones.
    least_evidence : -log10 of how many such agreements chance may give a pair (:class:`OverlapTest`).
    nearest : pairs of each photograph taken in any case.
    shortlist : photographs each is compared with, those most alike in words.
    words : size of the vocabulary.
    test : how two photographs are compared.
    """

    all_up_to: int = 30
    per_scale: int = 200
    least_evidence: float = 0.5
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
        """Nothing can be wrong."""

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """The pairs worth matching. Raises :class:`UsageError` for features without seeds in a large set."""
        n = len(names)
        if n <= self.all_up_to:
            how = f"all pairs, as there are no more than {self.all_up_to} photographs"
            return PairChoice(every_pair(n), how)
        sketches = map_all(self._sketches, features)
        alike = np.zeros((n, n))
        if n - 1 > self.shortlist:
            for kind in (0, 1):
                patches = [sketch[kind].patches for sketch in sketches]
                alike += bow_similarity(patches, self.words, map_all=map_all, rng=rng)
        compared = most_alike(alike, self.shortlist)
        evidence = np.array(
            map_all(lambda pair: self._evidence(sketches[pair[0]], sketches[pair[1]]), compared.tolist())
        )
        chosen = self._choose(alike, compared, evidence)
        how = (
            f"those of {len(compared)} compared whose patches agree beyond chance, and the nearest "
            f"{self.nearest} of each photograph"
        )
        return PairChoice(chosen, how, compared=len(compared))

    def _sketches(self, features: Features) -> tuple[FeatureSubset, FeatureSubset]:
        if features.seeds is None:
            raise UsageError(
                f"the overlap of more than {self.all_up_to} photographs is told from their seeds, which "
                "these features lack; set features.kind=multi-scale-corners, or pairs.kind=all-pairs"
            )
        upright, turned = (
            subset_seeds(features.seeds, turned=turned, per_scale=self.per_scale) for turned in (False, True)
        )
        return upright, turned

    def _evidence(
        self, a: tuple[FeatureSubset, FeatureSubset], b: tuple[FeatureSubset, FeatureSubset]
    ) -> float:
        upright = self.test.score(a[0], b[0])
        return upright if upright >= DECIDED else max(upright, self.test.score(a[1], b[1]))

    def _choose(self, alike: F64, compared: I64, evidence: F64) -> I64:
        """The pairs (M, 2) that pass, those nearest to each photograph, and those that hold all together."""
        n = len(alike)
        # A pair that was not compared comes after all that were, by its words.
        order = alike - 1e6
        order[compared[:, 0], compared[:, 1]] = order[compared[:, 1], compared[:, 0]] = evidence
        np.fill_diagonal(order, -np.inf)
        best = np.argsort(-order, axis=1, kind="stable")[:, : min(self.nearest, n - 1)]
        near = np.column_stack([np.repeat(np.arange(n), best.shape[1]), best.ravel()])
        chosen = pair_array([*compared[evidence >= self.least_evidence].tolist(), *near.tolist()])
        return pair_array([*chosen.tolist(), *connecting_pairs(chosen, order).tolist()])


def most_alike(alike: F64, count: int) -> I64:
    """(M, 2) each photograph with the ``count`` most alike by an (N, N) matrix; sorted."""
    n = len(alike)
    others = alike.copy()
    np.fill_diagonal(others, -np.inf)
    best = np.argsort(-others, axis=1, kind="stable")[:, : min(count, n - 1)]
    return pair_array(np.column_stack([np.repeat(np.arange(n), best.shape[1]), best.ravel()]).tolist())


def connecting_pairs(chosen: I64, order: F64) -> I64:
    """The pairs (M, 2) that join the parts which the chosen ones leave apart: those of highest ``order``.

    They are what a largest spanning tree of all pairs has beside chosen ones when these count for nothing.
    """
    n = len(order)
    i, j = np.triu_indices(n, 1)
    rank = np.empty(len(i))
    # Ranks for values: no two pairs cost the same, so the tree is one and does not hang on rounding.
    rank[np.argsort(-order[i, j], kind="stable")] = np.arange(1, len(i) + 1)
    cost = np.zeros((n, n))
    cost[i, j] = rank + len(i)
    cost[chosen[:, 0], chosen[:, 1]] -= len(i)
    tree = scipy.sparse.csgraph.minimum_spanning_tree(cost).tocoo()
    new = tree.data > len(i)
    return np.column_stack([tree.row[new], tree.col[new]]).astype(np.int64).reshape(-1, 2)

"""Selection of the image pairs to match: all, a sequence window, a list, or by estimated overlap."""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64, I64, rows_of_views
from thesisrecon.errors import UsageError, require_range
from thesisrecon.matching._prepared import MapAll, select_found
from thesisrecon.matching._seeds import nearest_seeds
from thesisrecon.records import Features, PairChoice, Seeds, TwoView

# ruff: noqa: ARG002 (all selectors have the same arguments)

# Seeds of each scale that represent an image, upright and rotated.
PER_SCALE = 200
ROWS_AT_ONCE = 4096
FEW_VIEWS = 40  # Up to this number of views no pair is rejected: few pairs are redundant then
STRONG = 0.1
"""A pair is strong if it has this fraction of the matches, or common points, of the best pair of one of its
views."""
MAX_STEPS = 5  # maximum number of strong pairs on the shortest path between two views of the same place


def _pair_array(pairs: Iterable[Iterable[int]]) -> I64:
    """Pairs (M, 2), smaller number first, sorted and without duplicates."""
    rows = sorted({(min(pair), max(pair)) for pair in (tuple(p) for p in pairs)})
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


@dataclass(frozen=True)
class AllPairs:
    """Every image with every other: N (N - 1) / 2 pairs."""

    def select(
        self, names: Sequence[str], features: Sequence[Features], *, map_all: MapAll, rng: np.random.Generator
    ) -> PairChoice:
        """See `thesisrecon.config.PairSelector.select`."""
        return PairChoice(_pair_array(combinations(range(len(names)), 2)), "all pairs")


@dataclass(frozen=True)
class SequenceWindow:
    """Each image with the next ones in the order of the file names, with numbers compared as numbers."""

    window: int = 5  #: number of following images
    loop: bool = False  #: continue with the first image after the last

    def __post_init__(self) -> None:
        if self.window < 1:
            rule = "window (number of following images to match) must be at least 1"
            raise ValueError(f"{rule}; got {self.window}")

    def select(
        self, names: Sequence[str], features: Sequence[Features], *, map_all: MapAll, rng: np.random.Generator
    ) -> PairChoice:
        """See `thesisrecon.config.PairSelector.select`."""
        n = len(names)
        steps = range(1, min(self.window, n - 1) + 1)
        ends = n if self.loop else 0
        pairs = {tuple(sorted((i, (i + s) % n))) for i in range(n) for s in steps if i + s < n + ends}
        what = "the next image" if self.window == 1 else f"the next {self.window} images"
        around = ", continuing at the first" if self.loop else ""
        return PairChoice(_pair_array(pairs), f"each image with {what} by file name{around}")


@dataclass(frozen=True)
class ListedPairs:
    """The pairs of file names listed by the user.

    Pairs of an image that was left out (unreadable, a copy) are dropped.
    """

    listed: tuple[tuple[str, str], ...] = ()  #: pairs of file names, each once, in any order

    def __post_init__(self) -> None:
        seen: set[frozenset[str]] = set()
        for one, two in self.listed:
            if one == two:
                raise ValueError(f"the pair list pairs {one!r} with itself; list two different images")
            if (pair := frozenset((one, two))) in seen:
                raise ValueError(f"the pair list contains {one!r}, {two!r} twice; list each pair once")
            seen.add(pair)

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Check the list before anything is computed: ``names`` of images, and those ``left_out``."""
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
        self, names: Sequence[str], features: Sequence[Features], *, map_all: MapAll, rng: np.random.Generator
    ) -> PairChoice:
        """See `thesisrecon.config.PairSelector.select`."""
        number = {name: i for i, name in enumerate(names)}
        there = (pair for pair in self.listed if pair[0] in number and pair[1] in number)
        return PairChoice(_pair_array((number[one], number[two]) for one, two in there), "the listed pairs")


@dataclass(frozen=True)
class OverlapEstimate:
    """All pairs of a small set; in a larger one the pairs whose strongest patches agree beyond chance.

    Each image is compared with a fixed number of others by bag-of-words similarity, so that the time grows
    with the number of images and not with its square. The best few pairs of each image and the best pairs
    that connect the set are added: every image is matched, and a chain of pairs connects any two.
    """

    nearest: int = 3  #: pairs of each image that are always taken
    most: int = 10  #: largest number of pairs of most evidence that are taken for each image
    spread: int = 2
    """Number of further pairs of each image, evenly from the rest with enough evidence: they have wider
    baselines, so that many images from nearly the same place are also connected with others."""

    all_up_to = 30  # number of images up to which all pairs are taken
    min_evidence = 0.5  # minimum -log10 of the number of false alarms
    shortlist = 30  # number of images that each is compared with
    words = 65536  # largest size of the vocabulary; an eighth of the patches of the images if that is less

    def __post_init__(self) -> None:
        require_range(self, nearest="[1, inf)", most="[1, inf)", spread="[0, inf)")

    def select(
        self, names: Sequence[str], features: Sequence[Features], *, map_all: MapAll, rng: np.random.Generator
    ) -> PairChoice:
        """See `thesisrecon.config.PairSelector.select`."""
        n = len(names)
        if n <= self.all_up_to:
            every = _pair_array(combinations(range(n), 2))
            return PairChoice(every, f"all pairs (at most {self.all_up_to} images)")
        subsets = map_all(self._subsets, features)
        if n - 1 <= self.shortlist:
            words, compared = scipy.sparse.csr_array((n, 1)), _pair_array(combinations(range(n), 2))
        else:
            kinds = ([subset[kind].seeds.patches for subset in subsets] for kind in (0, 1))
            weights = [word_weights(k, self.words, map_all=map_all, rng=rng) for k in kinds]
            words = scipy.sparse.hstack(weights, format="csr")
            compared = _most_similar(words, self.shortlist)
        evidence = np.array(map_all(lambda p: _evidence(subsets[p[0]], subsets[p[1]]), compared.tolist()))
        rank, enough = _ranks(compared, evidence, n), evidence >= self.min_evidence
        # The further pairs of an image are taken at equal steps of the rank.
        further = np.bincount(compared[enough].ravel(), minlength=n)[compared.T] - self.most
        steps = [(rank - self.most + k) * self.spread // np.maximum(further, 1) for k in (0, 1)]
        taken = (rank < self.most) | (steps[1] > steps[0])
        chosen = compared[(enough & taken.any(axis=0)) | (rank < self.nearest).any(axis=0)]
        chosen = _pair_array([*chosen, *_connecting_pairs(chosen, compared, evidence, words)])
        best = f"the best {self.nearest} of each image"
        how = f"pairs with overlap evidence among {len(compared)} compared pairs, and {best}"
        return PairChoice(chosen, how, compared=len(compared))

    def _subsets(self, features: Features) -> "tuple[_Subset, _Subset]":
        if features.seeds is None:
            raise UsageError(
                f"the overlap of more than {self.all_up_to} images is estimated from seeds, which these "
                "features do not have; set features.kind=multi-scale-corners, or pairs.kind=all-pairs"
            )
        return _subsets(features.seeds)


@dataclass(frozen=True)
class PairsOfAdded:
    """The pairs of a run, and those that add images to it, of most overlap evidence for each new image."""

    before: I64  #: (M, 2) pairs of the first ``count`` images
    count: int

    def select(
        self, names: Sequence[str], features: Sequence[Features], *, map_all: MapAll, rng: np.random.Generator
    ) -> PairChoice:
        """See `thesisrecon.config.PairSelector.select`."""
        usual, n = OverlapEstimate(), len(names)
        new = _pair_array((i, j) for j in range(self.count, n) for i in range(j))
        if all(found.seeds is not None for found in features):
            subsets = [_subsets(found.seeds) for found in features if found.seeds is not None]
            evidence = np.array(map_all(lambda p: _evidence(subsets[p[0]], subsets[p[1]]), new.tolist()))
            rank = np.where(new >= self.count, _ranks(new, evidence, n).T, n)
            best = (rank < usual.most).any(axis=1) & (evidence >= usual.min_evidence)
            new = new[best | (rank < usual.nearest).any(axis=1)]
        how = "the pairs of the run, and the best of each new image"
        return PairChoice(_pair_array([*self.before, *new]), how)


def _most_similar(words: scipy.sparse.csr_array, count: int) -> I64:
    """Pairs (M, 2), sorted, of each image with the ``count`` most similar ones by word weights (N, W)."""
    n, pairs, inverted = words.shape[0], list[F64](), words.T.tocsr()
    for first in range(0, n, ROWS_AT_ONCE):
        similarity = (words[first : first + ROWS_AT_ONCE] @ inverted).toarray()
        rows = np.arange(first, first + len(similarity))
        similarity[rows - first, rows] = -np.inf
        best = np.argsort(-similarity, axis=1, kind="stable")[:, : min(count, n - 1)]
        pairs += np.column_stack([np.repeat(rows, best.shape[1]), best.ravel()]).tolist()
    return _pair_array(pairs)


def _ranks(pairs: I64, value: F64, n: int) -> I64:
    """Rank (2, M) of each pair (M, 2) among the pairs of both of its images; 0 is the highest value."""
    image, number = pairs.T.ravel(), np.tile(np.arange(len(pairs)), 2)
    order = np.lexsort((number, -value[number], image))
    start = np.searchsorted(image[order], np.arange(n))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - start[image[order]]
    return rank.reshape(2, -1)


def _connecting_pairs(chosen: I64, compared: I64, evidence: F64, words: scipy.sparse.csr_array) -> I64:
    """Pairs (M, 2) that connect the groups of the ``chosen``: of most evidence, else of most similar words.

    Edges of a maximum spanning tree of the compared pairs, chosen ones first; then the smallest group joins
    first.
    """
    n, m = words.shape[0], len(compared)
    cost = np.empty(m)
    # Ranks instead of values: no two costs are equal, so the tree is unique and independent of rounding.
    cost[np.argsort(-evidence, kind="stable")] = np.arange(1, m + 1)
    known = {(i, j) for i, j in chosen.tolist()}
    cost += [0 if (i, j) in known else m for i, j in compared.tolist()]
    graph = scipy.sparse.coo_array((cost, compared.T), (n, n))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    added = np.column_stack([tree.row, tree.col])[tree.data > m].tolist()
    group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    while group.any():
        sizes = np.bincount(group)
        inside = np.flatnonzero(group == np.argmin(np.where(sizes > 0, sizes, n + 1)))
        outside = np.flatnonzero(group != group[inside[0]])
        similarity = (words[inside] @ words[outside].T).toarray()
        i, j = np.unravel_index(np.argmax(similarity), similarity.shape)
        added.append([inside[i], outside[j]])
        joined = group[inside[i]], group[outside[j]]
        group[np.isin(group, joined)] = min(joined)
    return np.array(added, dtype=np.int64).reshape(-1, 2)


def _count_agreeing(xy1: F64, xy2: F64, scale: F64, angle: F64, limits: F64) -> int:
    """Largest number of other matches predicted by the similarity (scale, angle in rad) of one match."""
    # `limits`: position error in px, difference of log scales and of angles.
    turn = scale * np.exp(1j * angle)
    z1, z2 = (xy @ [1.0, 1j] for xy in (xy1, xy2))
    near = np.abs(z2[:, None] + turn[:, None] * (z1 - z1[:, None]) - z2) <= limits[0]
    near &= np.abs(np.log(scale / scale[:, None])) <= limits[1]
    near &= np.cos(angle - angle[:, None]) >= np.cos(limits[2])
    return int(near.sum(axis=1).max()) - 1


class _Subset(NamedTuple):
    seeds: Seeds
    extent: F64  #: (2,) px of all seeds of the image


def _subset_seeds(seeds: Seeds, *, rotated: bool) -> _Subset:
    """Select the strongest seeds of each scale, of patches ``rotated`` to their dominant gradient or not."""
    use = np.flatnonzero((seeds.angle != 0.0) == rotated)
    parts = [use[seeds.scale[use] == scale][:PER_SCALE] for scale in np.unique(seeds.scale[use])]
    kept = np.concatenate([np.empty(0, np.int64), *parts])
    extent = np.ptp(seeds.xy, axis=0) + 1.0 if len(seeds.xy) else np.ones(2)
    return _Subset(select_found(seeds, kept), extent)


def _subsets(seeds: Seeds) -> tuple[_Subset, _Subset]:
    """Upright and rotated seeds."""
    return _subset_seeds(seeds, rotated=False), _subset_seeds(seeds, rotated=True)


def _evidence(a: tuple[_Subset, _Subset], b: tuple[_Subset, _Subset]) -> float:
    upright = _overlap_evidence(a[0], b[0])
    # One false alarm in a million: the rotated patches are not compared.
    return upright if upright >= 6.0 else max(upright, _overlap_evidence(a[1], b[1]))


def _overlap_evidence(a: _Subset, b: _Subset) -> float:
    """Evidence that mutually best patches agree with one similarity, -log10 of the number of false alarms."""
    # M B(M - 1, k, p) for M matches, k that agree with the best one and p the relative area around a
    # prediction, B the tail of the binomial distribution (Desolneux, Moisan and Morel, IJCV 40, 2000). 0: one
    # false alarm is expected.
    one, two, score = nearest_seeds(a.seeds, b.seeds, 0.8)
    one, two = (rows[np.argsort(-score, kind="stable")[:150]] for rows in (one, two))
    if len(one) < 2:
        return -float(np.log10(max(len(one), 1)))
    # Position (wide because of parallax and perspective), log scale and angle, rad.
    radius = 0.1 * float(b.extent.max())
    first, second = select_found(a.seeds, one), select_found(b.seeds, two)
    scale = np.divide(second.scale, first.scale, dtype=np.float64)
    turn = np.subtract(second.angle, first.angle, dtype=np.float64)
    k = _count_agreeing(first.xy, second.xy, scale, turn, np.array([radius, 0.8, 0.8]))
    chance = min(1.0, np.pi * radius**2 / float(np.prod(b.extent)))
    tail = float(scipy.special.bdtrc(k - 1, len(one) - 1, chance)) if k > 0 else 1.0
    # The tail may underflow.
    return -(float(np.log10(len(one))) + max(float(np.log10(max(tail, 1e-320))), -300.0))


def word_weights(
    patches: Sequence[F32], words: int, *, map_all: MapAll, rng: np.random.Generator
) -> scipy.sparse.csr_array:
    """Weighted word counts (N, W) of images with unit patches (S, D); products of the rows are cosines.

    Weighted by rarity, square roots of counts against repeated structure (J. Sivic and A. Zisserman, "Video
    Google", ICCV 2003). The vocabulary is large: if each image contains most words, all are similar.
    """
    everything = np.concatenate([np.empty((0, patches[0].shape[1]), np.float32), *patches])
    if not len(everything):
        return scipy.sparse.csr_array((len(patches), 1))
    words = min(words, len(everything) // 8)
    vocabulary = _vocabulary(everything, words, map_all=map_all, rng=rng)
    found = map_all(lambda given: np.unique(_words_of(given, vocabulary), return_counts=True), patches)
    image = np.repeat(np.arange(len(patches)), [len(word) for word, _ in found])
    word, count = (np.concatenate([part[k] for part in found]) for k in (0, 1))
    used = np.bincount(word)
    weight = np.sqrt(count) * np.log(len(patches) / used[word])
    weight /= np.sqrt(np.maximum(np.bincount(image, weight**2), 1e-24))[image]
    return scipy.sparse.csr_array((weight, (image, word)), (len(patches), vocabulary[1][:, :, 0].size))


_Vocabulary = tuple[F32, F32]  # unit centres (B, D) of branches, and of the words (B, B, D) of each


def _vocabulary(patches: F32, words: int, *, map_all: MapAll, rng: np.random.Generator) -> _Vocabulary:
    """A tree of two levels with about ``words`` words (D. Nister and H. Stewenius, CVPR 2006)."""
    branches = max(int(np.sqrt(words)), 1)
    sample = patches[rng.permutation(len(patches))[: 8 * branches**2]]
    top = _centres(sample, branches)
    inside = rows_of_views(np.argmax(sample @ top.T, axis=1), branches)
    leaves = np.repeat(top[:, None], branches, axis=1)
    for b, centres in enumerate(map_all(lambda rows: _centres(sample[rows], branches), inside)):
        leaves[b, : len(centres)] = centres
    return top, leaves


def _centres(sample: F32, count: int) -> F32:
    """Centres (at most ``count``, D) of spherical k-means, initialised by the first rows."""
    centres = sample[:count]
    for _ in range(4 if len(sample) else 0):
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
    branch, word = np.argmax(patches @ top.T, axis=1), np.empty(len(patches), np.int64)
    for b, rows in enumerate(rows_of_views(branch, len(top))):
        if len(rows):
            word[rows] = b * len(top) + np.argmax(patches[rows] @ leaves[b].T, axis=1)
    return word


def reject_repeated_structure(pairs: Sequence[TwoView], n_views: int) -> list[TwoView]:
    """Reject weak pairs whose views are connected only by long paths of strong pairs.

    Views that overlap are connected by a short path; equal windows of two houses are not. Weak pairs between
    groups that no strong pair connects stay, because nothing else relates these groups.
    """
    accepted = [pair for pair in pairs if pair.accepted]
    if n_views <= FEW_VIEWS or not accepted:
        return list(pairs)
    i, j, count = np.array([(pair.i, pair.j, pair.inliers) for pair in accepted]).T
    strong = strong_pairs(i, j, count, n_views)
    ends = i[strong], j[strong]
    graph = scipy.sparse.coo_array((np.ones(strong.sum()), ends), (n_views, n_views)).tocsr()
    group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    weak = np.flatnonzero(~strong & (group[i] == group[j]))
    step, near = graph + graph.T + scipy.sparse.eye_array(n_views), np.zeros(len(weak), dtype=bool)
    # At most so many edges connect the views of a pair: steps from both ends meet.
    for rows in np.array_split(np.arange(len(weak)), len(weak) // ROWS_AT_ONCE + 1):
        reached = [scipy.sparse.eye_array(n_views, format="csr")[ends[weak[rows]]] for ends in (i, j)]
        for k in range(MAX_STEPS):
            reached[k % 2] = (reached[k % 2] @ step).sign()
        near[rows] = reached[0].multiply(reached[1]).sum(axis=1) > 0
    apart = {*map(tuple, np.column_stack([i, j])[weak[~near]].tolist())}
    reason = (
        "its {} matches are few compared with those of each image's best pair, and "
        f"at least {MAX_STEPS + 1} strong pairs separate the images: probably repeated structure"
    )
    rejected = (pair.accepted and (pair.i, pair.j) in apart for pair in pairs)
    return [
        replace(pair, accepted=False, reason=reason.format(pair.inliers)) if bad else pair
        for pair, bad in zip(pairs, rejected, strict=True)
    ]


def strong_pairs(i: I64, j: I64, count: I64 | F64, n_views: int) -> B8:
    """Whether pairs (i, j) have ``STRONG`` of the ``count`` of the best pair of one of their views."""
    most = np.zeros(n_views, count.dtype)
    np.maximum.at(most, np.concatenate([i, j]), np.tile(count, 2))
    return np.asarray(count >= STRONG * np.minimum(most[i], most[j]))


def connected_groups(views: int, pairs: Sequence[tuple[int, int]]) -> I64:
    """Number (V,) of the group of each view, 0-based: the views that ``pairs`` connect."""
    i, j = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    graph = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), (views, views))
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


def pairs_to_connect(features: Sequence[Features], two_views: Sequence[TwoView], most: int) -> list[int]:
    """Rejected pairs that would connect matched groups, likeliest first; ``most`` of an outer image."""
    if not most:
        return []
    accepted = [(pair.i, pair.j) for pair in two_views if pair.accepted]
    group = connected_groups(len(features), accepted)
    between = [n for n, pair in enumerate(two_views) if group[pair.i] != group[pair.j]]
    subsets = {v: _subsets(f.seeds) for v, f in enumerate(features) if f.seeds is not None and between}
    evidence = {n: _evidence(subsets[two_views[n].i], subsets[two_views[n].j]) for n in between}
    best_first = sorted(between, key=lambda n: (-evidence[n], n))
    chosen, taken, largest = list[int](), Counter[int](), np.argmax(np.bincount(group))
    for n in best_first:
        ends = [view for view in (two_views[n].i, two_views[n].j) if group[view] != largest]
        if any(taken[view] < most for view in ends):
            chosen.append(n)
        taken.update(ends)
    return chosen

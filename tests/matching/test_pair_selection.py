"""Pair selection: lists and windows of the user, and the estimate of the overlap."""

from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix, csr_array
from scipy.sparse.csgraph import connected_components

from tests.conftest import refuses
from tests.constants import with_constants
from tests.synthetic import one_by_one, photograph, texture
from thesisrecon.errors import UsageError
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.matching import pair_selection
from thesisrecon.matching.pair_selection import (
    FEW_VIEWS,
    AllPairs,
    ListedPairs,
    OverlapEstimate,
    SequenceWindow,
    _connecting_pairs,
    _count_agreeing,
    _most_similar,
    _overlap_evidence,
    _pair_array,
    _ranks,
    _subset_seeds,
    pairs_to_connect,
    reject_repeated_structure,
    word_weights,
)
from thesisrecon.records import Features, TwoView

SIDE, CROPS = 260, 14
NO_FEATURES = Features(np.zeros((0, 2)), np.zeros(0, np.float32), np.zeros(0, np.float32))


def names_of(n):
    return [f"{i:02d}.jpg" for i in range(n)]


def choose(selector, n, features=None, map_all=one_by_one):
    names = names_of(n)
    if isinstance(selector, ListedPairs):
        selector.check(names, ["blank.jpg"])
    rng = np.random.default_rng(0)
    return selector.select(names, features or [NO_FEATURES] * n, map_all=map_all, rng=rng)


def as_set(pairs):
    return {(int(i), int(j)) for i, j in pairs}


# ---------------------------------------------------------------- what the user can say


@pytest.mark.parametrize(
    "selector", [AllPairs(), OverlapEstimate(), SequenceWindow(99), SequenceWindow(99, loop=True)]
)
@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_all_pairs_of_a_small_set_in_order(selector, n):
    choice = choose(selector, n)
    assert choice.pairs.tolist() == [list(pair) for pair in combinations(range(n), 2)]
    assert choice.pairs.shape == (n * (n - 1) // 2, 2)
    assert choice.compared == 0
    assert choice.how


@given(st.integers(2, 12), st.integers(1, 12))
def test_a_window_takes_the_next_ones(n, window):
    pairs = as_set(choose(SequenceWindow(window), n).pairs)
    assert pairs == {(i, j) for i, j in combinations(range(n), 2) if j - i <= window}
    looped = as_set(choose(SequenceWindow(window, loop=True), n).pairs)
    assert looped == {(i, j) for i, j in combinations(range(n), 2) if min(j - i, n - j + i) <= window}


def test_listed_pairs_are_taken_and_what_cannot_be_is_refused():
    for words, listed in (
        (r"names 'nope.jpg', which is not among the 5 images", (("00.jpg", "nope.jpg"),)),
        (r"names 'nope.jpg' and 3 more", (("zz", "nope.jpg"), ("x", "y"))),
        ("leaves no pair to match", ()),
        ("images were left out", (("00.jpg", "blank.jpg"),)),
    ):
        refuses(UsageError, words, choose, ListedPairs(listed), 4)
    for words, kind, options in (
        ("pairs 'a' with itself", ListedPairs, {"listed": (("a", "a"),)}),
        ("'b', 'a' twice", ListedPairs, {"listed": (("a", "b"), ("b", "a"))}),
        ("window .* must be at least 1", SequenceWindow, {"window": 0}),
        ("must be at least 1; got -3", SequenceWindow, {"window": -3}),
        ("nearest must be at least 1", OverlapEstimate, {"nearest": 0}),
        ("most must be at least 1", OverlapEstimate, {"most": 0}),
    ):
        refuses(ValueError, words, kind, **options)
    features = [HarrisCorners(max_corners=20).detect(photograph(texture(80, 90, k))) for k in range(4)]
    with pytest.raises(UsageError, match=r"features\.kind=multi-scale-corners, or pairs\.kind=all-pairs"):
        choose(ESTIMATE, 4, features)
    listed = (("03.jpg", "00.jpg"), ("01.jpg", "02.jpg"), ("blank.jpg", "02.jpg"))
    assert choose(ListedPairs(listed), 4).pairs.tolist() == [[0, 3], [1, 2]]


# ---------------------------------------------------------------- the estimate of the overlap


Windows = namedtuple("Windows", "features wall place")
"""Windows of two walls: features, which wall, and where (left, top) px."""


def shared(windows, i, j):
    """The part of a window that two of them share."""
    part = np.prod(np.maximum(1.0 - np.abs(windows.place[i] - windows.place[j]) / SIDE, 0.0))
    return float(part) * (windows.wall[i] == windows.wall[j])


@pytest.fixture(scope="module")
def windows():
    rng = np.random.default_rng(7)
    walls = [texture(520, 700, seed) for seed in (1, 2)]
    wall = [k % 2 for k in range(CROPS)]
    place = rng.uniform(0.0, (700 - SIDE, 520 - SIDE), (CROPS, 2)).astype(int)
    detector = with_constants(MultiScaleCorners, seeds_per_level=400)(full_corners=300, half_corners=100)
    images = [photograph(walls[w][y : y + SIDE, x : x + SIDE]) for w, (x, y) in zip(wall, place, strict=True)]
    return Windows([detector.detect(image) for image in images], wall, place.astype(float))


def test_only_pairs_between_groups_are_tried_again_the_likeliest_first(windows):
    def pair(i, j, accepted):
        none, xy = np.zeros(0, np.int64), np.zeros((0, 2))
        return TwoView(i, j, np.eye(3), 1.0, none, none, xy, xy, np.zeros((0, 2, 2)), 0, 0.0, accepted)

    features = windows.features
    # All but image 0 are linked to the next of their wall, and the walls to each other.
    linked = {(k, k + 2) for k in range(1, CROPS - 2)} | {(1, 2)}
    pairs = [pair(i, j, (i, j) in linked) for i, j in combinations(range(CROPS), 2)]
    tried = pairs_to_connect(features, pairs, CROPS)
    assert sorted(tried) == list(range(CROPS - 1))
    (best,) = pairs_to_connect(features, pairs, 1)
    assert best == tried[0]
    assert windows.wall[pairs[best].j] == windows.wall[0]
    assert not pairs_to_connect(features, pairs, 0)
    assert not pairs_to_connect(features, [pair(0, 4, True), *pairs], CROPS)


ESTIMATE = with_constants(OverlapEstimate, all_up_to=2, shortlist=10, words=256)(nearest=1)


def test_pairs_that_overlap_are_chosen_and_few_others(windows):
    choice = choose(ESTIMATE, CROPS, windows.features)
    chosen, every = as_set(choice.pairs), list(combinations(range(CROPS), 2))
    much = {pair for pair in every if shared(windows, *pair) > 0.15}
    apart = {pair for pair in every if shared(windows, *pair) == 0.0}
    assert len(much) > 10
    assert much <= chosen
    assert len(chosen & apart) <= 0.3 * len(apart)
    assert choice.compared < len(every)
    assert str(choice.compared) in choice.how


def test_of_many_pairs_the_best_and_some_of_the_rest_are_taken(windows, monkeypatch):
    every = list(combinations(range(CROPS), 2))
    monkeypatch.setattr(pair_selection, "_evidence", lambda a, b: float(evidence[a, b]))
    monkeypatch.setattr(OverlapEstimate, "_subsets", lambda *_: next(numbers))
    evidence = np.random.default_rng(1).uniform(5.0, 9.0, (CROPS, CROPS))
    for most, spread in ((2, 0), (2, 3), (CROPS, 0)):
        numbers = iter(range(CROPS))
        few = with_constants(type(ESTIMATE), shortlist=CROPS)(1, most, spread)
        chosen = as_set(choose(few, CROPS, windows.features).pairs)
        for k in range(CROPS):
            mine = sorted((p for p in every if k in p), key=lambda p: -evidence[p])
            assert set(mine[:most]) <= chosen
            # As many steps between the taken ones of the rest.
            rest = [mine.index(pair) for pair in mine[most:] if pair in chosen]
            assert len(rest) >= min(spread, len(mine) - most)
        assert len(chosen) <= CROPS * (most + spread) + CROPS


def test_every_photograph_is_paired_and_all_hang_together_with_any_number_of_threads(windows):
    strict = with_constants(type(ESTIMATE), min_evidence=1e9)(nearest=1)
    pairs = choose(strict, CROPS, windows.features).pairs
    assert set(pairs.ravel().tolist()) == set(range(CROPS))
    assert len(pairs) <= 2 * CROPS
    assert _parts(CROPS, pairs)[0] == 1
    blank = MultiScaleCorners().detect(photograph(np.full((SIDE, SIDE), 90.0)))
    choice = choose(ESTIMATE, CROPS, [*windows.features[:-1], blank])
    assert CROPS - 1 in choice.pairs
    assert len(choose(ESTIMATE, 5, [blank] * 5).pairs) >= 4

    def in_threads(function, items):
        with ThreadPoolExecutor(3) as pool:
            return list(pool.map(function, items))

    alone, together = (choose(ESTIMATE, CROPS, windows.features, m) for m in (one_by_one, in_threads))
    assert alone.pairs.tolist() == together.pairs.tolist()


def test_chance_gives_no_evidence_and_a_turned_copy_gives_much(windows):
    image = photograph(texture(SIDE, SIDE, 5))
    rotated = photograph(np.rot90(texture(SIDE, SIDE, 5)).copy())
    detector = MultiScaleCorners()
    one, other = (detector.detect(view).seeds for view in (image, rotated))
    strange = [f.seeds for f in windows.features]
    for kind, least in ((True, 20.0), (False, -10.0)):
        sketch = _subset_seeds(one, rotated=kind)
        assert _overlap_evidence(sketch, _subset_seeds(other, rotated=kind)) > least
        assert _overlap_evidence(sketch, sketch) > 20.0
        # The number of false alarms bounds how often chance reaches an evidence.
        chance = [_overlap_evidence(sketch, _subset_seeds(s, rotated=kind)) for s in strange if s]
        assert max(chance) < 2.0


def test_views_of_places_with_the_same_windows_are_told_apart_by_the_rest():
    """Nine tenths of the patches stand in every image; two views of a place share the others, with noise."""
    rng = np.random.default_rng(6)

    def unit(patches):
        return (patches / np.linalg.norm(patches, axis=1, keepdims=True)).astype(np.float32)

    windows, images = rng.normal(size=(90, 32)), []
    for _ in range(60):
        own = rng.normal(size=(10, 32))
        images += [unit(np.concatenate([windows, own]) + 0.1 * rng.normal(size=(100, 32))) for _ in range(2)]
    words = word_weights(images, 1024, map_all=one_by_one, rng=np.random.default_rng(0))
    pairs = as_set(_most_similar(words, 1))
    assert sum((2 * place, 2 * place + 1) in pairs for place in range(60)) > 55


# ---------------------------------------------------------------- its parts


@given(st.integers(2, 9), st.integers(1, 9), st.integers(0, 2**31))
def test_the_most_alike_of_each(n, count, seed):
    words = np.random.default_rng(seed).random((n, 4))
    alike = words @ words.T
    pairs = as_set(_most_similar(csr_array(words), count))
    every = list(combinations(range(n), 2))
    best = (_ranks(np.array(every), np.array([alike[pair] for pair in every]), n) < count).any(axis=0)
    assert pairs == {pair for pair, taken in zip(every, best, strict=True) if taken}
    for i in range(n):
        others = sorted((j for j in range(n) if j != i), key=lambda j: -alike[i, j])[:count]
        assert {(min(i, j), max(i, j)) for j in others} <= pairs
    assert len(pairs) <= n * count
    with pytest.MonkeyPatch.context() as patch:
        # The similarities of many images are never in memory at once.
        patch.setattr(pair_selection, "ROWS_AT_ONCE", 2)
        assert as_set(_most_similar(csr_array(words), count)) == pairs


@given(st.integers(2, 9), st.integers(0, 2**31), st.floats(0.0, 1.0))
def test_connecting_pairs_join_separate_groups_by_their_best_pairs_only(n, seed, share):
    rng = np.random.default_rng(seed)
    words, every = rng.random((n, 4)), list(combinations(range(n), 2))
    compared = _pair_array([pair for pair in every if rng.random() < share])
    evidence = rng.random(len(compared))
    chosen = compared[rng.random(len(compared)) < 0.2]
    added = _connecting_pairs(chosen, compared, evidence, csr_array(words))
    parts, part = _parts(n, chosen)
    assert len(added) == parts - 1
    assert _parts(n, np.concatenate([chosen, added]))[0] == 1
    if parts == 2:
        across = [k for k, (i, j) in enumerate(compared) if part[i] != part[j]]
        if across:
            wanted = tuple(compared[max(across, key=lambda k: evidence[k])].tolist())
        else:
            apart = [pair for pair in every if part[pair[0]] != part[pair[1]]]
            wanted = max(apart, key=lambda pair: words[pair[0]] @ words[pair[1]])
        assert as_set(np.sort(added, axis=1)) == {wanted}


def _parts(n, pairs):
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(n, n))
    return connected_components(graph, directed=False)


def test_matches_that_one_similarity_predicts_are_counted():
    rng = np.random.default_rng(0)
    xy1 = rng.uniform(0.0, 300.0, (9, 2))
    scale, angle = np.full(9, 1.5), np.full(9, 0.4)
    turn = 1.5 * np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    xy2, limits = xy1 @ turn.T + 7.0, np.array([12.0, 0.6, 0.9])
    assert _count_agreeing(xy1, xy2, scale, angle, limits) == 8
    # Another place, scale or angle excludes a match each.
    xy2[0] += 20.0
    scale[1], angle[2] = 3.0, 1.5
    assert _count_agreeing(xy1, xy2, scale, angle, limits) == 5
    assert _count_agreeing(xy1[:1], xy2[:1], scale[:1], angle[:1], limits) == 0


def pair(i, j, inliers, accepted=True):
    xy = np.zeros((inliers, 2))
    index, affine = np.zeros(inliers, np.int64), np.zeros((inliers, 2, 2))
    return TwoView(i, j, np.eye(3), 0.1, index, index, xy, xy, affine, inliers, 0.2, accepted)


def street(n, reach=3):
    return [pair(i, j, 900 // (j - i)) for i in range(n) for j in range(i + 1, min(i + reach + 1, n))]


def test_only_weak_pairs_of_far_views_that_nothing_supports_are_rejected():
    pairs = [*street(60), pair(5, 50, 80)]
    (last,) = [p for p in reject_repeated_structure(pairs, 60) if not p.accepted]
    assert (last.i, last.j) == (5, 50)
    assert last.reason.startswith("its 80 matches are few")
    two = [p for p in street(60) if not p.i < 30 <= p.j]
    for pairs, gone in (
        # A loop that closes strongly stays and brings its weak pairs.
        ([*street(60), pair(0, 59, 500), pair(1, 58, 70)], []),
        ([*street(60), pair(5, 17, 70)], []),
        ([*street(60), pair(5, 22, 70)], [(5, 22)]),
        # Groups without a strong pair between them stay connected.
        ([*two, pair(29, 31, 70)], []),
    ):
        assert [(p.i, p.j) for p in reject_repeated_structure(pairs, 60) if not p.accepted] == gone
    pairs = [*street(FEW_VIEWS), pair(2, 30, 60), pair(1, 20, 0, accepted=False)]
    assert reject_repeated_structure(pairs, FEW_VIEWS) == pairs
    assert reject_repeated_structure([], 100) == []

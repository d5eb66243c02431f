import numpy as np

from thesisrecon.matching.pair_selection import FEW_VIEWS, reject_repeated_structure
from thesisrecon.records import TwoView

NONE = np.zeros(0, np.int64)


def pair(i, j, inliers, accepted=True):
    xy = np.zeros((inliers, 2))
    index, affine = np.zeros(inliers, np.int64), np.zeros((inliers, 2, 2))
    return TwoView(i, j, np.eye(3), 0.1, index, index, xy, xy, affine, inliers, 0.2, accepted)


def street(n, reach=3):
    return [pair(i, j, 900 // (j - i)) for i in range(n) for j in range(i + 1, min(i + reach + 1, n))]


def rejected(pairs, n):
    return [(p.i, p.j) for p in reject_repeated_structure(pairs, n) if not p.accepted]


def test_windows_of_another_house_are_rejected_with_a_reason():
    pairs = [*street(60), pair(5, 50, 80)]
    (last,) = [p for p in reject_repeated_structure(pairs, 60) if not p.accepted]
    assert (last.i, last.j) == (5, 50)
    assert last.reason.startswith("its 80 matches are few")


def test_a_loop_that_closes_strongly_stays_and_brings_its_weak_pairs():
    pairs = [*street(60), pair(0, 59, 500), pair(1, 58, 70)]
    assert rejected(pairs, 60) == []


def test_weak_pairs_of_near_views_stay():
    assert rejected([*street(60), pair(5, 17, 70)], 60) == []
    assert rejected([*street(60), pair(5, 22, 70)], 60) == [(5, 22)]


def test_groups_without_a_strong_pair_between_them_stay_connected():
    two = [p for p in street(60) if not p.i < 30 <= p.j]
    assert rejected([*two, pair(29, 31, 70)], 60) == []


def test_small_sets_and_rejected_pairs_are_left_alone():
    pairs = [*street(FEW_VIEWS), pair(2, 30, 60), pair(1, 20, 0, accepted=False)]
    assert reject_repeated_structure(pairs, FEW_VIEWS) == pairs
    assert reject_repeated_structure([], 100) == []

"""The judgement of the overlap estimate, on a run whose accepted pairs are known."""

from types import SimpleNamespace

from thesisrecon.records import PairChoice
from validation.studies.pair_choice import Choice, choose, to_metrics


class FirstPairOnly:
    def select(self, names, features, **rest):
        del names, features, rest
        return PairChoice(pairs=[(0, 1)], how="the first")


def pair(i, j, inliers, accepted):
    return SimpleNamespace(i=i, j=j, inliers=inliers, accepted=accepted)


def test_accepted_pairs_that_were_not_tried_are_missed_and_others_are_not():
    pairs = (pair(0, 1, 90, True), pair(0, 2, 70, True), pair(1, 2, 40, True), pair(0, 3, 20, False))
    images = tuple(SimpleNamespace(name=str(n)) for n in range(4))
    run = SimpleNamespace(images=images, features=(), pairs=pairs)
    choice = choose("wall", run, 1, FirstPairOnly())
    assert choice == Choice("wall", possible=4, tried=1, accepted=3, missed=(40, 70))
    assert abs(choice.recall - 1 / 3) < 1e-12
    row = to_metrics(choice)[-1]
    assert row.verdict == "missed"
    assert row.note == "missed pairs have 40, 70 verified matches"


def test_a_set_without_accepted_pairs_misses_none():
    assert [row.verdict for row in to_metrics(Choice("dark", 6, 3, 0, ()))][-1] == "reached"

"""Values made when they are used: kept within a number of bytes, the same each time."""

import pickle

import numpy as np
import pytest

from thesisrecon.imaging.on_demand import MappingOnDemand, OnDemand, RecentlyUsed, size_in_bytes
from thesisrecon.records import PinholeView


def made_of(kind, bound):
    """Arrays of 800 bytes on demand, and the numbers of those that were made."""
    made = []

    def make(number):
        made.append(number)
        return np.full(100, float(number))

    return kind(range(6) if kind is MappingOnDemand else 6, make, bound), made


@pytest.mark.parametrize("kind", [OnDemand, MappingOnDemand])
def test_items_are_made_once_while_they_fit_and_then_the_least_recently_used_is_dropped(kind):
    items, made = made_of(kind, 3 * 800)
    assert [items[n][0] for n in (0, 1, 2, 0, 1, 2)] == [0, 1, 2, 0, 1, 2]
    assert made == [0, 1, 2]
    assert items[0] is items[0]
    assert items[3][0] == 3.0  # drops item 1
    assert [items[n][0] for n in (0, 2, 3, 1)] == [0, 2, 3, 1]
    assert made == [0, 1, 2, 3, 1]


def test_a_sequence_counts_from_both_ends_and_gives_parts_and_a_mapping_has_its_keys_only():
    items, made = made_of(OnDemand, np.inf)
    assert (len(items), items[-1][0], [one[0] for one in items[1:4][1:]]) == (6, 5.0, [2.0, 3.0])
    assert made == [5, 2, 3]
    mapping = MappingOnDemand([7, 3], str)
    assert (list(mapping), 3 in mapping, 4 in mapping, mapping[3], mapping.get(4)) == (
        [7, 3], True, False, "3", None,
    )  # fmt: skip
    for kind, beyond, error in ((items, 6, IndexError), (items, -7, IndexError), (mapping, 4, KeyError)):
        with pytest.raises(error):
            kind[beyond]


@pytest.mark.parametrize(("kind", "plain"), [(OnDemand, list), (MappingOnDemand, dict)])
def test_what_is_sent_elsewhere_holds_all_items(kind, plain):
    sent = pickle.loads(pickle.dumps(made_of(kind, 0)[0]))
    assert isinstance(sent, plain)
    assert [sent[n][0] for n in range(6)] == [0, 1, 2, 3, 4, 5]


def test_nothing_is_kept_without_memory_and_the_size_of_a_record_is_that_of_its_arrays():
    items, made = made_of(OnDemand, 0)
    assert [one[0] for one in (*items, *items)] == made == [*range(6), *range(6)]
    # Values larger than the bound stay while they are few.
    kept, made = RecentlyUsed(10, least=2), []
    for key in "abab":
        kept.get(key, lambda: made.append(0) or np.zeros(100))
    assert len(made) == 2
    view = PinholeView(0, np.eye(3, 4), np.zeros((5, 6, 3), np.uint8), np.ones((5, 6), bool))
    assert size_in_bytes(view) == 12 * 8 + 90 + 30
    assert size_in_bytes((view.P, 7, "text")) == 96

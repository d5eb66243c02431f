"""Pairs are visited so that what was made of a view serves again."""

from collections import OrderedDict

import numpy as np
import pytest

from thesisrecon.numerics.observations import morton_pair_order


def times_made(first, second, room):
    """How often a view is made where those asked for last are kept in a room for so many."""
    kept = OrderedDict()
    made = 0
    for view in np.stack([first, second], axis=1).ravel().tolist():
        made += view not in kept
        kept[view] = None
        kept.move_to_end(view)
        if len(kept) > room:
            kept.popitem(last=False)
    return made


def test_every_pair_is_visited_once_and_a_pair_and_its_turned_one_together():
    i, j = np.array([5, 3, 9, 5, 0]), np.array([3, 5, 2, 9, 1])
    order = morton_pair_order(i, j)
    assert sorted(order) == [0, 1, 2, 3, 4]
    places = np.argsort(order)
    assert abs(places[0] - places[1]) == 1
    assert len(morton_pair_order([], [])) == 0


@pytest.mark.parametrize("room", [16, 60, 120])
def test_views_are_made_few_times_whatever_room_there_is(room):
    i, j = np.divmod(np.arange(300 * 300), 300)
    i, j = i[i != j], j[i != j]
    order = morton_pair_order(i, j)
    # Tiles with one side of half the room are the best there is, up to a factor.
    assert times_made(i[order], j[order], room) < 2.0 * 300**2 / room
    assert times_made(i, j, room) > 0.9 * len(i)

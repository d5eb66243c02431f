"""Images that are left out: between which images a photograph joins them, and at what angle."""

from types import SimpleNamespace

import numpy as np

from tests.synthetic import reconstruction_of
from thesisrecon import Tracks
from thesisrecon.pipeline.next_photographs import next_photographs

STEP = 15.0
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def ring(at, registered):
    """A model of cameras at angles around an object, and pairs, accepted up to 30 degrees apart."""
    angles = np.radians(at)
    rng = np.random.default_rng(0)
    X = rng.uniform(-0.3, 0.3, (40, 3))
    P = []
    for a in angles:
        z = -np.array([np.cos(a), 0, np.sin(a)])
        R = np.stack([np.cross([0.0, 1, 0], z), [0, 1, 0], z])
        P.append(K @ np.column_stack([R, [0, 0, 4.0]]))
    view, point = np.repeat(np.arange(len(at)), 40), np.tile(np.arange(40), len(at))
    tracks = Tracks(view, point, np.zeros((len(view), 2)), len(at), 40)
    homogeneous = np.column_stack([X, np.ones(40)])
    model = reconstruction_of(np.array(P), (640, 480), X=homogeneous, tracks=tracks, registered=registered)
    pairs = []
    for i in range(len(at)):
        for j in range(i + 1, len(at)):
            apart = abs((at[i] - at[j] + 180) % 360 - 180)
            near = apart <= 2 * STEP + 1
            pairs.append(SimpleNamespace(i=i, j=j, accepted=near, inliers=200 if near else 8))
    return model, pairs, [f"{k:02d}.png" for k in range(len(at))]


def ring_of_two_arcs():
    """Arcs of nine views, which are registered, and of seven, with gaps of 60 and 90 degrees between them."""
    at = np.concatenate([np.arange(9) * STEP, 180 + np.arange(7) * STEP])
    return ring(at, np.arange(16) < 9)


def test_a_gap_is_named_by_the_pair_with_more_matches_than_chance_gives():
    model, pairs, names = ring_of_two_arcs()
    next(p for p in pairs if (p.i, p.j) == (0, 15)).inliers = 20
    (notice,) = next_photographs(model, pairs, names)
    assert notice.code == "photograph-next"
    assert "To join 7 images to the model, photograph between 00.png and 15.png" in notice
    # Half of the accepted pairs are one step apart.
    assert "about 15 degrees from each (20 of their matches agree, too few to join them" in notice
    assert "accepted pairs are up to 30 degrees apart" in notice


def test_without_evidence_the_order_of_the_names_tells_where_the_gap_is():
    (notice,) = next_photographs(*ring_of_two_arcs())
    assert "between 08.png and 09.png" in notice
    assert "next to each other by name" in notice


def test_each_part_is_named_and_a_whole_ring_needs_nothing():
    model, pairs, names = ring(np.arange(24) * STEP, np.ones(24, dtype=bool))
    assert list(next_photographs(model, pairs, names)) == []
    at = np.concatenate([np.arange(6), [9, 10, 11], [16]]) * STEP
    notices = list(next_photographs(*ring(at, np.arange(10) < 6)))
    assert ["05.png and 06.png" in n for n in notices] == [True, False]
    assert "To join 1 image to the model, photograph between 05.png and 09.png" in notices[1]


def test_images_that_match_as_well_as_others_are_left_out_for_another_reason():
    at = np.arange(6) * STEP
    model, pairs, names = ring(at, np.arange(6) < 5)
    assert list(next_photographs(model, pairs, names)) == []
    for pair in pairs:
        pair.inliers = 20 if pair.j == 5 and pair.accepted else pair.inliers
    assert "between 03.png and 05.png" in next(next_photographs(model, pairs, names))

"""Near images of a model show the same everywhere, or they are images of places that look alike."""

import numpy as np
import pytest

from tests.synthetic import photograph, reconstruction_of, texture
from thesisrecon import Tracks
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.matching.look_alikes import swapped_pairs, swapped_sentence

SIZE, SHIFT, DEPTH, VIEWS = (320, 240), 8, 5.0, 3
K = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])


def scene(own_ground=(), noise=2.0, ground_from=130, depths=(DEPTH,)):
    """A wall seen by cameras side by side, matched in its upper rows; some images have another lower part.

    Further points of the model, in the same places of the images, have the further ``depths``.
    """
    rng = np.random.default_rng(0)
    wall, width = texture(SIZE[1], SIZE[0] + SHIFT * VIEWS), SIZE[0]
    images = []
    for v in range(VIEWS):
        seen = wall[:, SHIFT * v : SHIFT * v + width].copy()
        if v in own_ground:
            seen[ground_from:] = texture(SIZE[1] - ground_from, width, seed=10 + v)
        images.append(photograph(np.clip(seen + rng.normal(0, noise, seen.shape), 0, 255)))
    features = [MultiScaleCorners().detect(image) for image in images]
    xy = features[0].xy
    xy = xy[(xy[:, 1] < 120) & (xy[:, 0] > 40)]
    P = np.tile(K @ np.eye(3, 4), (VIEWS, 1, 1))
    P[:, 0, 3] = -SHIFT * DEPTH / K[0, 0] * np.arange(VIEWS) * K[0, 0]
    rays = homogenize(xy) @ np.linalg.inv(K).T
    X = homogenize(np.concatenate([depth * rays for depth in depths]))
    view, point = np.repeat(np.arange(VIEWS), len(X)), np.tile(np.arange(len(X)), VIEWS)
    xy = np.tile(xy, (len(depths), 1))
    tracks = Tracks(view, point, xy[point] - np.outer(view, [SHIFT, 0]), VIEWS, len(X))
    return reconstruction_of(P, SIZE, X=X, tracks=tracks, K=np.tile(K, (VIEWS, 1, 1))), images, features


@pytest.mark.parametrize("noise", [0.0, 4.0])
def test_images_of_one_place_are_not_swapped_although_only_a_part_of_them_is_matched(noise):
    assert swapped_pairs(*scene(noise=noise)) == []


def test_images_whose_surroundings_differ_are_named():
    # The third image is of another place: both others look alike in its upper half only.
    assert swapped_pairs(*scene([2])) == [(0, 2), (1, 2)]
    assert swapped_pairs(*scene([0, 1, 2])) == [(0, 1), (0, 2), (1, 2)]


def test_images_before_close_things_need_not_show_the_same():
    # A step that turns the view of the wall by a degree turns that of things in front of it by twenty.
    assert swapped_pairs(*scene([0, 1, 2], depths=[DEPTH, 0.07 * DEPTH])) == []
    assert swapped_pairs(*scene([0, 1, 2], depths=[DEPTH, 0.7 * DEPTH])) == [(0, 1), (0, 2), (1, 2)]


def test_a_small_part_that_moved_does_not_swap_images():
    assert swapped_pairs(*scene([0, 1, 2], ground_from=205)) == []


def test_images_without_texture_or_corners_give_no_verdict():
    model, images, features = scene([2])
    blank = photograph(np.full(SIZE[::-1], 128.0))
    assert swapped_pairs(model, [blank] * VIEWS, features) == []
    none = MultiScaleCorners().detect(blank)
    assert swapped_pairs(model, images, [none] * VIEWS) == []


def test_the_sentence_names_six_pairs_and_counts_the_rest():
    text = swapped_sentence([(0, k) for k in range(1, 10)])
    assert "#0 and #1; #0 and #2" in text
    assert "#0 and #6; and 3 more pairs" in text

"""What is unknown stays unknown: scenes that cannot be matched, or only in part, with both presets."""

from dataclasses import replace

import numpy as np
import pytest

from tests.stereo import hard_scenes as scenes
from tests.stereo.depth_scenes import photograph_scene
from thesisrecon.api.surface import confirmed_depth_maps
from thesisrecon.config import preset

DEFAULT, THESIS = (preset(name).dense for name in ("default", "thesis"))
BOTH = pytest.mark.parametrize("stereo", [DEFAULT, THESIS], ids=["default", "thesis"])


def shares(scene, maps):
    """Shares of all pixels: known, wrong by more than 5 %; of the known ones: beyond three deviations."""
    known = wrong = beyond = total = 0
    for i, found in maps.items():
        error = np.abs(found.depth / scene.depth[i] - 1.0)[np.isfinite(found.depth)]
        apart = np.abs(found.depth - scene.depth[i])[np.isfinite(found.depth)]
        known, total = known + error.size, total + found.depth.size
        wrong += int(np.sum(error > 0.05))
        beyond += int(np.sum(apart > 3.0 * found.std[np.isfinite(found.depth)]))
    return known / total, wrong / total, beyond / max(known, 1)


def solve(stereo, scene):
    return shares(scene, confirmed_depth_maps(stereo, stereo.prepare(scene.images, scene.reconstruction)))


@BOTH
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_blank_wall_is_not_invented(stereo, noise):
    """The points of the rim give a range of disparities, and the wall would fit at any of them."""
    known, wrong, _ = solve(stereo, photograph_scene(scenes.abreast(0.4), scenes.blank_wall(), noise=noise))
    assert wrong < (0.001 if stereo is DEFAULT else 0.03)
    assert known < 0.1


# The baselines are a thousandth of the depth at most: less than a fifth of a pixel.
HOPELESS = {
    "no texture": lambda: photograph_scene(scenes.abreast(0.4), scenes.blank_wall(0.0)),
    "no baseline": lambda: scenes.fenced(0.0),
    "a baseline of 0.0005": lambda: scenes.fenced(5e-4),
    "a baseline of 0.005": lambda: scenes.fenced(5e-3),
    "no points": scenes.without_points,
    "no common points": lambda: scenes.observed(
        scenes.fenced(), lambda r: r.tracks.view_index == r.tracks.point_index % 3
    ),
}


@BOTH
@pytest.mark.parametrize("scene", HOPELESS)
def test_nothing_is_known_of_hopeless_scenes(stereo, scene):
    assert solve(stereo, HOPELESS[scene]())[0] == 0.0


@BOTH
def test_a_tiny_baseline_gives_depths_that_say_how_vague_they_are(stereo):
    known, _, beyond = solve(stereo, scenes.fenced(5e-2))
    assert known > 0.2
    assert beyond < 0.05


@BOTH
def test_forward_motion_with_the_epipole_inside(stereo):
    known, wrong, beyond = solve(stereo, scenes.ahead())
    assert known > 0.4
    assert wrong < (0.04 if stereo is DEFAULT else 0.12)
    assert beyond < 0.02


@BOTH
def test_occlusions_everywhere(stereo):
    """Behind a fence as much is hidden as is seen, and order along the rows does not hold."""
    known, wrong, beyond = solve(stereo, scenes.fenced())
    assert known > 0.35
    assert wrong < 0.015
    assert beyond < 0.1


@BOTH
def test_a_range_that_the_points_do_not_cover(stereo):
    """The fence has no points; few of its pixels get the depth of the wall."""
    scene = scenes.observed(scenes.fenced(), lambda r: r.X[r.tracks.point_index, 2] > 5.0)
    _, wrong, _ = solve(stereo, scene)
    assert wrong < (0.01 if stereo is DEFAULT else 0.1)


@BOTH
def test_an_unrelated_view_stays_unregistered_and_does_no_harm(stereo):
    scene = scenes.of_elsewhere()
    prepared = stereo.prepare(scene.images, scene.reconstruction)
    assert prepared.neighbours[3] == ()
    maps = confirmed_depth_maps(stereo, prepared)
    assert np.isnan(maps[3].depth).all()
    assert not maps[3].views.any()
    r = scene.reconstruction
    without = stereo.prepare(scene.images, replace(r, registered=np.array([True, True, True, False])))
    assert stereo.depth_map(without, 1).depth.tobytes() == stereo.depth_map(prepared, 1).depth.tobytes()


@BOTH
def test_a_photograph_far_smaller_than_the_others(stereo):
    scene = scenes.far_smaller(0.15)
    maps = confirmed_depth_maps(stereo, stereo.prepare(scene.images, scene.reconstruction))
    known, wrong, _ = shares(scene, {i: maps[i] for i in range(3)})
    assert known > 0.6
    assert wrong < 0.01
    assert maps[3].depth.shape == (22, 30)


@BOTH
def test_burnt_out_and_black_regions(stereo):
    """They stay where they are from view to view, and mean nothing."""
    scene = photograph_scene(scenes.abreast(0.4), scenes.fence()[:1])
    _, wrong, beyond = solve(stereo, scenes.burnt_out(scene))
    assert wrong < 0.04
    assert beyond < 0.1


def test_pixels_that_no_photograph_has_stay_without_depth():
    scene = photograph_scene(scenes.abreast(0.4), scenes.fence()[:1])
    prepared = DEFAULT.prepare(scene.images, scene.reconstruction)
    views = dict(prepared.views)
    for i, view in views.items():
        seen = view.seen.copy()
        seen[:, 50:90] = False
        views[i] = replace(view, seen=seen)
    found = DEFAULT.depth_map(replace(prepared, views=views), 1)
    assert np.isnan(found.depth[:, 50:90]).all()
    assert np.isfinite(found.depth[:, 100:190]).mean() > 0.5
    blind = {i: replace(view, seen=np.zeros_like(view.seen)) for i, view in views.items()}
    assert np.isnan(DEFAULT.depth_map(replace(prepared, views=blind), 1).depth).all()

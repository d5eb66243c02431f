"""Depth maps of whole scenes against truth, and what hopeless ones give."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

from tests.conftest import refuses
from tests.constants import with_constants
from tests.stereo.depth_scenes import RADIAL, make_walled, on_arc
from thesisrecon.api.surface import confirmed_depth_maps
from thesisrecon.geometry.camera_matrix import camera_from_centre, project
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.imaging.resampling import pinhole_view
from thesisrecon.records import Image
from thesisrecon.stereo import correspondence, depth
from thesisrecon.stereo.correspondence import PairMatching
from thesisrecon.stereo.depth import MultiViewStereo
from thesisrecon.stereo.semi_global import SemiGlobalMatching
from validation.scenes.real import load_fixture_depth, load_fixture_scene

STEREO = MultiViewStereo()


@pytest.fixture(scope="module")
def walled():
    return make_walled(on_arc((-14.0, -5.0, 4.0, 13.0)), lens=RADIAL)


def errors(walled, maps):
    """Relative errors of known pixels, and the share of all that is known."""
    apart = [maps[i].depth / walled.depth[i] - 1.0 for i in maps]
    known = np.concatenate([a[np.isfinite(a)] for a in apart])
    return np.abs(known), len(known) / sum(a.size for a in apart)


@pytest.mark.parametrize("links", [0, 4])
def test_depth_matches_the_scene_and_its_std_predicts_the_error(walled, links):
    stereo = MultiViewStereo(sequence_links=links)
    maps = confirmed_depth_maps(stereo, stereo.prepare(walled.images, walled.reconstruction))
    error, known = errors(walled, maps)
    assert np.median(error) < 0.002
    assert np.mean(error < 0.01) > 0.95
    assert known > 0.75
    for i, found in maps.items():
        z = (found.depth - walled.depth[i]) / found.std
        assert 0.05 < np.nanmedian(np.abs(z)) < 2.0
        assert (found.views[np.isfinite(found.depth)] >= 1).all()
        assert (found.views[np.isnan(found.depth)] == 0).all()
        assert np.array_equal(np.isnan(found.depth), np.isnan(found.std))


def test_the_same_bytes_with_any_number_of_threads(walled):
    reconstruction = replace(walled.reconstruction, registered=np.array([True, True, True, False]))
    stereo = replace(STEREO, max_side=120, match_side=90)
    scene = stereo.prepare(walled.images, reconstruction)
    together = confirmed_depth_maps(stereo, scene, threads=2)
    raw = {i: stereo.depth_map(scene, i) for i in sorted(scene.views, reverse=True)}
    for i in scene.views:
        one = stereo.confirm(scene, raw, i)
        for field in ("depth", "std", "views", "P"):
            assert getattr(one, field).tobytes() == getattr(together[i], field).tobytes()


@pytest.mark.parametrize(
    ("wrong", "rule"),
    [
        ({"sequence_links": -1}, "not be negative"), ({"max_neighbours": 0}, "at least 1; got 0"),
        ({"max_side": 0}, "at least 64 px; got 0 and 640"), ({"match_side": 1}, "at least 64 px; got 1024"),
    ],
    ids=str,
)  # fmt: skip
def test_settings_without_depth_are_refused(wrong, rule):
    refuses(ValueError, rule, MultiViewStereo, **wrong)


def test_idle_threads_take_part_in_a_depth_map(walled):
    stereo = replace(STEREO, max_side=120, match_side=90)
    scene = stereo.prepare(walled.images, walled.reconstruction)
    with ThreadPoolExecutor(3) as pool:
        shared = stereo.depth_map(scene, 1, pool=pool)
    assert shared.depth.tobytes() == stereo.depth_map(scene, 1).depth.tobytes()


def test_frames_with_many_disparities_are_reduced_and_still_match_the_scene(walled, monkeypatch):
    costs = []

    class Counting(SemiGlobalMatching):
        def match(self, left, right, *, disparity_range):
            first, last = disparity_range
            costs.append(left.shape[0] * left.shape[1] * (last - first + 1) / (240 * 180))
            return super().match(left, right, disparity_range=disparity_range)

    stereo = MultiViewStereo(pairs=PairMatching(matcher=Counting()))
    stereo.depth_map(stereo.prepare(walled.images, walled.reconstruction), 1)
    whole, limit = max(costs), 0.4 * max(costs)
    costs.clear()
    monkeypatch.setattr(correspondence, "MAX_COSTS", limit)
    scene = stereo.prepare(walled.images, walled.reconstruction)
    error, known = errors(walled, confirmed_depth_maps(stereo, scene))
    # Margins of whole pixels add to the limit of so small an image.
    assert max(costs) < 1.2 * limit < whole
    assert np.median(error) < 0.002
    assert np.mean(error < 0.01) > 0.95
    assert known > 0.75


def test_views_are_undistorted_when_they_are_used_and_the_same_within_any_memory(walled, monkeypatch):
    stereo, made = replace(STEREO, max_side=120, match_side=90), []

    def counted(*given, max_side):
        made.append(max_side)
        return pinhole_view(*given, max_side=max_side)

    monkeypatch.setattr(depth, "pinhole_view", counted)
    whole = stereo.prepare(walled.images, walled.reconstruction)
    assert made == []
    monkeypatch.setattr(depth, "VIEW_BYTES", 0)
    within = stereo.prepare(walled.images, walled.reconstruction, threads=2)
    assert whole.neighbours == within.neighbours
    maps = [stereo.depth_map(scene, 1) for scene in (whole, within, whole)]
    assert np.isfinite(maps[0].depth).any()
    assert len({one.depth.tobytes() for one in maps}) == 1
    for i in whole.views:
        one, other = whole.views[i], within.views[i]
        assert (one.rgb.tobytes(), one.seen.tobytes()) == (other.rgb.tobytes(), other.seen.tobytes())
    once = len(made)
    assert whole.views[1] is whole.views[1]
    assert within.views[1] is not within.views[1]
    assert len(made) == once + 2


@pytest.mark.parametrize("links", [0, 1])
def test_the_surroundings_of_a_view_are_enough_for_its_map(links):
    """What is sent to a worker elsewhere: a part of the scene, and the same bytes come back."""
    walled = make_walled(on_arc(tuple(np.linspace(-15.0, 15.0, 5))))
    few = {"max_neighbours": 1, "max_side": 80, "match_side": 64}
    stereo = replace(
        with_constants(MultiViewStereo, min_comparison_views=2)(STEREO.pairs), sequence_links=links, **few
    )
    scene = stereo.prepare(walled.images, walled.reconstruction)
    raw = {i: stereo.depth_map(scene, i) for i in scene.views}
    for i in (0, 2):
        near = stereo.required_views(scene, i)
        assert i in near
        assert len(near) < len(scene.views)
        part = scene.subset(near)
        assert set(part.views) == set(part.matched) == near
        assert len(part.points.X) < len(scene.points.X) or part.points.seen[sorted(near)].any(axis=0).all()
        partly = {j: raw[j] for j in near}
        for whole, alone in (
            (raw[i], stereo.depth_map(part, i)),
            (stereo.confirm(scene, raw, i), stereo.confirm(part, partly, i)),
        ):
            assert np.isfinite(whole.depth).any()
            assert whole.depth.tobytes() == alone.depth.tobytes()
            assert whole.std.tobytes() == alone.std.tobytes()


def test_one_baseline_gives_depth_though_nothing_is_seen_by_a_third_view():
    walled = make_walled(on_arc((-5.0, 5.0)))
    scene = STEREO.prepare(walled.images, walled.reconstruction)
    error, known = errors(walled, confirmed_depth_maps(STEREO, scene))
    assert known > 0.5
    assert np.median(error) < 0.003


def test_views_without_a_camera_are_omitted_and_cannot_be_requested(walled):
    reconstruction = replace(walled.reconstruction, registered=np.array([True, True, False, False]))
    scene = STEREO.prepare(walled.images, reconstruction)
    assert sorted(scene.views) == [0, 1]
    assert scene.neighbours == {0: (1,), 1: (0,)}
    refuses(ValueError, "no camera", STEREO.depth_map, scene, 2)
    refuses(ValueError, "as many images", STEREO.prepare, walled.images[:2], reconstruction)
    with pytest.raises(ValueError, match="metric"):
        STEREO.prepare(walled.images, replace(reconstruction, stratum="projective"))


SIZE = (512, 384)


@pytest.fixture(scope="module")
def courtyard():
    """Two photographs at half size, and where the pixels of each are in the other by their true depth."""
    scene = load_fixture_scene()
    half = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
    views = (6, 7)
    images, correspondences, P = (
        [],
        [],
        [camera_from_centre(half @ scene.K[k], scene.R[k], scene.C[k]) for k in views],
    )
    for k in views:
        with PIL.Image.open(scene.image_paths[k]) as image:
            images.append(np.asarray(image.resize(SIZE, PIL.Image.Resampling.BOX)))
    for side, k in enumerate(views):
        depth, stride = load_fixture_depth(k)
        y, x = np.indices(depth.shape)
        # The depth is that of every second pixel, a quarter of a small pixel beside its middle.
        rays = np.stack([x * stride, y * stride, np.ones_like(x)], axis=-1) @ np.linalg.inv(scene.K[k]).T
        X = (rays * depth[..., None]) @ scene.R[k] + scene.C[k]
        xy = project(P[side], X.reshape(-1, 3)), project(P[1 - side], X.reshape(-1, 3))
        correspondences.append(tuple(part.reshape(*depth.shape, 2) for part in xy))
    return images, P, correspondences


def test_both_photographs_know_where_their_pixels_are_in_the_other(courtyard):
    images, P, truth = courtyard
    here, there = (part[::12, ::12].reshape(-1, 2) for part in truth[0])
    seen = np.all((there > 0) & (there < np.array(SIZE)), axis=1)
    darker = (images[1] * 0.8).astype(np.uint8)
    photographs = [Image(f"{k}.png", rgb, SIZE) for k, rgb in enumerate((images[0], darker))]
    pair = STEREO.match_two_views(*photographs, fundamental_from_cameras(*P), here[seen], there[seen])
    np.testing.assert_allclose(pair.gain, 1.25 * np.ones(3), rtol=0.2)
    pixels = np.indices(SIZE[::-1])[::-1].transpose(1, 2, 0)
    forth, back = (pair.correspondences(side, SIZE) for side in (0, 1))
    for found, (at, to) in zip((forth, back), truth, strict=True):
        off = np.linalg.norm(found - (pixels + to - at), axis=2)
        inside = np.all((to > 2) & (to < np.array(SIZE) - 3), axis=2)
        assert np.isfinite(off[inside]).mean() > 0.97
        assert np.nanmedian(off[inside]) < 0.35
        assert np.nanmean(off[inside] < 1.5) > 0.8
    near = np.rint(forth)
    inside = np.all((near >= 0) & (near <= np.array(SIZE) - 1), axis=2)
    x, y = near[inside].astype(int).T
    again = back[y, x] + forth[inside] - near[inside]
    assert np.nanmedian(np.linalg.norm(again - pixels[inside], axis=1)) < 0.3

"""Depth maps of whole scenes against truth, and each of their steps."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

from tests.conftest import refuses
from tests.constants import with_constants
from tests.stereo.depth_scenes import RADIAL, SIZE, make_walled, on_arc
from thesisrecon.api.surface import confirmed_depth_maps
from thesisrecon.geometry.camera_matrix import camera_from_centre, project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.imaging.pinholes import pinhole_view
from thesisrecon.records import DepthMap, DisparityMap, Image, PinholeView
from thesisrecon.stereo import correspondence, depth
from thesisrecon.stereo._depth_fusion import _concatenated, fuse_inverse_depths, inverse_depths
from thesisrecon.stereo._epipolar_pair import pair_of_cameras
from thesisrecon.stereo.correspondence import PairMatching, _sample_disparity, brightness_gain
from thesisrecon.stereo.depth import (
    MultiViewStereo,
    _complete_depths,
    _confirm_depths,
    _select_neighbours,
    _shared_projections,
    _sparse_points,
    _without_small_regions,
)
from thesisrecon.stereo.rectification import common_orientation, polar
from thesisrecon.stereo.semi_global import SemiGlobalMatching
from validation.scenes.real import load_fixture_depth, load_fixture_scene

STEREO = MultiViewStereo()
SMALL = replace(STEREO, max_side=120, match_side=90)


@pytest.fixture(scope="module")
def walled():
    return make_walled(on_arc((-14.0, -5.0, 4.0, 13.0)), lens=RADIAL)


def require_accurate(walled, maps, *, median=0.002, known=0.75):
    """Most depths are known and right."""
    apart = np.concatenate([(maps[i].depth / walled.depth[i] - 1.0).ravel() for i in maps])
    error = np.abs(apart[np.isfinite(apart)])
    assert np.median(error) < median
    assert abs(np.nanmedian(apart)) < 0.1 * median, "depths are biased"
    assert np.mean(error < 0.01) > 0.95
    assert len(error) > known * len(apart)


@pytest.mark.parametrize("links", [0, 4])
def test_depth_matches_the_scene_and_its_std_predicts_the_error(walled, links):
    stereo = MultiViewStereo(sequence_links=links)
    maps = confirmed_depth_maps(stereo, stereo.prepare(walled.images, walled.reconstruction))
    require_accurate(walled, maps)
    for i, found in maps.items():
        z = (found.depth - walled.depth[i]) / found.std
        assert 0.05 < np.nanmedian(np.abs(z)) < 2.0
        assert np.array_equal(found.views >= 1, np.isfinite(found.depth))
        assert np.array_equal(np.isnan(found.depth), np.isnan(found.std))


def test_depths_of_normal_noise_are_as_far_off_as_they_state():
    rng, shape = np.random.default_rng(0), (60, 80)
    found = [(0.2 + s * rng.normal(size=shape), np.full(shape, s)) for s in (4e-3, 2e-3, 1e-3)]
    fused = fuse_inverse_depths([tuple(np.float32(part)) for part in found], shape)
    view = PinholeView(0, np.eye(3, 4), np.zeros((*shape, 3), np.uint8), np.ones(shape, bool))
    depths = depth._depth_map(view, fused, view.seen)
    z = (depths.depth - 5.0) / depths.std
    # Scatter that is larger by chance widens some of the intervals.
    assert np.sqrt(np.mean(z**2)) == pytest.approx(0.92, abs=0.06)
    assert abs(z.mean()) < 4.0 / np.sqrt(z.size)


def test_the_same_bytes_with_any_number_of_threads(walled):
    reconstruction = replace(walled.reconstruction, registered=np.array([True, True, True, False]))
    scene = SMALL.prepare(walled.images, reconstruction)
    together = confirmed_depth_maps(SMALL, scene, threads=2)
    raw = {i: SMALL.depth_map(scene, i) for i in sorted(scene.views, reverse=True)}
    for i in scene.views:
        one = SMALL.confirm(scene, raw, i)
        for field in ("depth", "std", "views", "P"):
            assert getattr(one, field).tobytes() == getattr(together[i], field).tobytes()
    with ThreadPoolExecutor(3) as pool:
        assert SMALL.depth_map(scene, 1, pool=pool).depth.tobytes() == raw[1].depth.tobytes()


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
    require_accurate(walled, confirmed_depth_maps(stereo, scene))
    # Margins of whole pixels add to the limit of so small an image.
    assert max(costs) < 1.2 * limit < whole


def test_views_are_undistorted_when_they_are_used_and_the_same_within_any_memory(walled, monkeypatch):
    made = []

    def counted(*given, max_side):
        made.append(max_side)
        return pinhole_view(*given, max_side=max_side)

    monkeypatch.setattr(depth, "pinhole_view", counted)
    whole = SMALL.prepare(walled.images, walled.reconstruction)
    assert made == []
    monkeypatch.setattr(depth, "VIEW_BYTES", 0)
    within = SMALL.prepare(walled.images, walled.reconstruction, threads=2)
    assert whole.neighbours == within.neighbours
    maps = [SMALL.depth_map(scene, 1) for scene in (whole, within, whole)]
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
    variant = with_constants(MultiViewStereo, min_comparison_views=2)(STEREO.pairs)
    stereo = replace(variant, sequence_links=links, max_neighbours=1, max_side=80, match_side=64)
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


def test_one_baseline_gives_depth_and_settings_without_any_are_refused():
    walled = make_walled(on_arc((-5.0, 5.0)))
    scene = STEREO.prepare(walled.images, walled.reconstruction)
    require_accurate(walled, confirmed_depth_maps(STEREO, scene), median=0.003, known=0.5)
    for rule, wrong in (
        ("at least 0; got -1", {"sequence_links": -1}), ("at least 1; got 0", {"max_neighbours": 0}),
        ("max_side .* at least 64; got 0", {"max_side": 0}), ("match_side .* at least 64", {"match_side": 1}),
    ):  # fmt: skip
        refuses(ValueError, rule, MultiViewStereo, **wrong)


def test_views_without_a_camera_are_omitted_and_cannot_be_requested(walled):
    reconstruction = replace(walled.reconstruction, registered=np.array([True, True, False, False]))
    scene = STEREO.prepare(walled.images, reconstruction)
    assert sorted(scene.views) == [0, 1]
    assert scene.neighbours == {0: (1,), 1: (0,)}
    refuses(ValueError, "no camera", STEREO.depth_map, scene, 2)
    refuses(ValueError, "as many images", STEREO.prepare, walled.images[:2], reconstruction)
    projective = replace(reconstruction, stratum="projective")
    refuses(ValueError, "metric", STEREO.prepare, walled.images, projective)


COURTYARD = (512, 384)


@pytest.fixture(scope="module")
def courtyard():
    """Two photographs at half size, and where the pixels of each are in the other by their true depth."""
    scene, views = load_fixture_scene(), (6, 7)
    half = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
    P = [camera_from_centre(half @ scene.K[k], scene.R[k], scene.C[k]) for k in views]
    images, correspondences = [], []
    for side, k in enumerate(views):
        with PIL.Image.open(scene.image_paths[k]) as image:
            images.append(np.asarray(image.resize(COURTYARD, PIL.Image.Resampling.BOX)))
        depth, stride = load_fixture_depth(k)
        y, x = np.indices(depth.shape)
        # The depth is that of every second pixel, a quarter of a small pixel beside its middle.
        rays = np.stack([x * stride, y * stride, np.ones_like(x)], axis=-1) @ np.linalg.inv(scene.K[k]).T
        X = ((rays * depth[..., None]) @ scene.R[k] + scene.C[k]).reshape(-1, 3)
        correspondences.append([project(P[j], X).reshape(*depth.shape, 2) for j in (side, 1 - side)])
    return images, P, correspondences


def test_both_photographs_know_where_their_pixels_are_in_the_other(courtyard):
    images, P, truth = courtyard
    here, there = (part[::12, ::12].reshape(-1, 2) for part in truth[0])
    seen = np.all((there > 0) & (there < np.array(COURTYARD)), axis=1)
    darker = (images[1] * 0.8).astype(np.uint8)
    photographs = [Image(f"{k}.png", rgb, COURTYARD) for k, rgb in enumerate((images[0], darker))]
    pair = STEREO.match_two_views(*photographs, fundamental_from_cameras(*P), here[seen], there[seen])
    np.testing.assert_allclose(pair.gain, 1.25 * np.ones(3), rtol=0.2)
    pixels = np.indices(COURTYARD[::-1])[::-1].transpose(1, 2, 0)
    forth, back = (pair.correspondences(side, COURTYARD) for side in (0, 1))
    for found, (at, to) in zip((forth, back), truth, strict=True):
        off = np.linalg.norm(found - (pixels + to - at), axis=2)
        inside = np.all((to > 2) & (to < np.array(COURTYARD) - 3), axis=2)
        assert np.isfinite(off[inside]).mean() > 0.97
        assert np.nanmedian(off[inside]) < 0.35
        assert np.nanmean(off[inside] < 1.5) > 0.8
    near = np.rint(forth)
    inside = np.all((near >= 0) & (near <= np.array(COURTYARD) - 1), axis=2)
    x, y = near[inside].astype(int).T
    again = back[y, x] + forth[inside] - near[inside]
    assert np.nanmedian(np.linalg.norm(again - pixels[inside], axis=1)) < 0.3


def views_of(walled, **options):
    return {
        i: pinhole_view(image, walled.reconstruction, i, **options) for i, image in enumerate(walled.images)
    }


def test_undistorted_and_smaller_views_have_the_camera_of_their_pixels(walled):
    straight = make_walled(on_arc((-14.0, -5.0, 4.0, 13.0)))
    for i, view in views_of(walled).items():
        assert (view.rgb[~view.seen] == 0).all()
        assert 0.8 < view.seen.mean() <= 1.0
        apart = view.rgb.astype(float) - straight.images[i].rgb
        assert np.median(np.abs(apart[view.seen])) < 2.0
        plain = pinhole_view(straight.images[i], straight.reconstruction, i)
        assert (plain.rgb == straight.images[i].rgb).all()
    view, small = views_of(walled)[1], views_of(walled, max_side=120)[1]
    assert small.seen.shape == (SIZE[1] // 2, SIZE[0] // 2)
    X = _sparse_points(walled.reconstruction, views_of(walled)).X
    np.testing.assert_allclose(project(small.P, X), (project(view.P, X) + 0.5) / 2.0 - 0.5, atol=1e-9)
    assert np.linalg.norm(small.P[2, :3]) == pytest.approx(1.0)
    image, r = walled.images[0], walled.reconstruction
    refuses(ValueError, "metric", pinhole_view, image, replace(r, K=None), 0)
    refuses(ValueError, "px; got", pinhole_view, image, replace(r, sizes=r.sizes + 1), 0)


def test_neighbours_are_on_both_sides_with_a_baseline_and_points_at_any_scale(walled):
    views = views_of(walled)
    points = _sparse_points(walled.reconstruction, views)
    assert set(_select_neighbours(points, views, 1, 2)) == {0, 2}
    assert set(_select_neighbours(points, views, 2, 2)) == {1, 3}
    S = np.diag([1e3, 1e3, 1e3, 1.0])
    larger = {i: replace(view, P=1e3 * view.P @ np.linalg.inv(S)) for i, view in views.items()}
    farther = replace(points, X=1e3 * points.X)
    assert _select_neighbours(farther, larger, 1) == _select_neighbours(points, views, 1)
    assert not _select_neighbours(points, {0: views[0], 1: replace(views[1], P=views[0].P)}, 0)
    few = replace(points, seen=points.seen & (np.arange(points.seen.shape[1]) < 5))
    assert not _select_neighbours(few, views, 0)


def true_correspondence(P, pair, method, larger=1):
    """Correspondence from the exact disparities of a wall at depth 6 of the first view of a pair.

    It is reported for images that are ``larger`` than those matched.
    """
    a, b = P[list(pair)]
    frame = method(pair_of_cameras(a, b, SIZE, SIZE))
    y, x = np.indices(frame.size[::-1]).astype(float)
    xy = frame.original_from_rectified(0, np.stack([x, y], axis=-1).reshape(-1, 2))
    right = frame.rectified_from_original(1, project(b, wall_points(a, np.nan_to_num(xy))), within=False)
    d = np.where(np.isfinite(xy).all(axis=1), x.ravel() - right[:, 0], np.nan)
    d = d.reshape(x.shape).astype(np.float32)
    found, (w, h) = DisparityMap(d, np.isfinite(d).astype(np.float32), 0.1), SIZE
    return PairMatching()._map_back(frame, found, ((h, w),) * 2, ((larger * h, larger * w),) * 2)


def wall_points(P, xy):
    return (homogenize(xy) * 6.0 - P[:, 3]) @ np.linalg.inv(P[:, :3]).T


@pytest.mark.parametrize("method", [common_orientation, polar])
def test_exact_disparities_give_exact_depth(method):
    P = on_arc((-6.0, 6.0))
    rho, std = inverse_depths(P[0], P[1], true_correspondence(P, (0, 1), method))
    known = np.isfinite(rho)
    assert known.mean() > 0.6
    assert np.nanmedian(np.abs(6.0 * rho - 1.0)) < 1e-5
    assert np.nanquantile(np.abs(6.0 * rho - 1.0), 0.99) < 2e-4
    # 0.2 px of about f B / z = 54 px per unit of relative inverse depth.
    assert np.nanmedian(6.0 * std) == pytest.approx(0.2 / 54.0 / np.sqrt(2.0), rel=0.5)


def test_working_pixels_map_back_to_pixels_of_the_file():
    P = on_arc((-6.0, 6.0))
    own, reported = (true_correspondence(P, (0, 1), common_orientation, larger=k) for k in (1, 2))
    assert reported.sigma.shape == (2 * SIZE[1], 2 * SIZE[0])
    # The middle of four pixels is the pixel of the smaller photograph.
    four = np.mean([reported.xy[a::2, b::2] for a in (0, 1) for b in (0, 1)], axis=0)
    apart = np.abs((four + 0.5) / 2.0 - 0.5 - own.xy)
    assert np.nanmedian(apart) < 1e-3
    assert np.nanquantile(apart, 0.99) < 0.02
    assert np.nanmedian(reported.sigma[::2, ::2] / own.sigma) == pytest.approx(2.0, rel=0.01)


def test_disparities_are_interpolated_on_a_surface_and_not_across_its_edge():
    d = np.tile(np.array([1.0, 1.5, 2.0, 9.0, 9.5, np.nan], np.float32), (3, 1))
    found = DisparityMap(d, np.ones_like(d), 0.1)
    x, y = [0.5, 1.25, 2.4, 2.6, 4.4, 4.6, np.nan], [1.0, 0.5, 1.0, 1.0, 1.0, 1.0, 0.0]
    places = np.column_stack([x, y])
    values, sure = _sample_disparity(found, places)
    np.testing.assert_allclose(values, [1.25, 1.625, 2.0, 9.0, 9.5, np.nan, np.nan])
    assert (sure == np.isfinite(values)).all()


def test_brightness_is_made_alike(walled):
    views = views_of(walled)
    points = _sparse_points(walled.reconstruction, views)
    darker = np.rint(views[1].rgb * np.array([0.8, 0.7, 0.9])).astype(np.uint8)
    xy = _shared_projections(points, views[0], views[1])
    gain = brightness_gain(views[0].rgb, darker, *xy) / brightness_gain(views[0].rgb, views[1].rgb, *xy)
    np.testing.assert_allclose(gain, 1.0 / np.array([0.8, 0.7, 0.9]), rtol=0.02)
    assert (brightness_gain(views[0].rgb, darker, xy[0][:3], xy[1][:3]) == 1.0).all()


def test_links_of_a_chain_lead_from_view_to_view():
    P = on_arc((-8.0, 0.0, 8.0))
    steps = [true_correspondence(P, pair, common_orientation) for pair in ((0, 1), (1, 2))]
    linked = _concatenated(*steps)
    known = np.isfinite(linked.sigma)
    assert known.mean() > 0.3
    first = steps[0].xy[known].astype(float)
    # The wall is at depth 6 of either reference: from i to j by the one, on to k by the other.
    apart = np.linalg.norm(project(P[2], wall_points(P[1], first)) - linked.xy[known], axis=1)
    assert np.median(apart) < 1e-3
    assert np.quantile(apart, 0.98) < 0.05
    assert (linked.sigma[known] >= steps[0].sigma[known]).all()


@pytest.fixture(scope="module")
def two_maps():
    """Two views of a wall and a board, and their true depths."""
    walled, maps = make_walled(on_arc((-6.0, 6.0))), []
    for i, d in enumerate(walled.depth):
        std, views = np.full(d.shape, 5e-3, np.float32), np.ones(d.shape, np.uint8)
        maps.append(DepthMap(i, walled.reconstruction.P[i], d.astype(np.float32), std, views))
    return walled, maps


def test_holes_are_filled_from_views_that_agree(two_maps):
    walled, maps = two_maps
    views, depth, other = views_of(walled), maps[0].depth.copy(), maps[1].depth.copy()
    lacks, wrong = np.s_[60:100, 60:110], np.s_[130:160, 100:150]
    depth[lacks], depth[wrong] = np.nan, np.nan
    # The other view is wrong there: what the photographs say counts, with the planes around the gap.
    other[120:] *= 0.8
    own, offering = replace(maps[0], depth=depth), replace(maps[1], depth=other)
    found = _complete_depths(own, [offering], views)
    kept = np.isfinite(depth)
    assert (found.depth[kept] == depth[kept]).all()
    assert np.isfinite(found.depth[lacks]).mean() > 0.7
    for region in (lacks, wrong):
        error = np.abs(found.depth[region] / maps[0].depth[region] - 1.0)
        assert np.mean(error[np.isfinite(error)] < 0.02) > 0.95
    assert np.nanmedian(np.abs(found.depth[lacks] / maps[0].depth[lacks] - 1.0)) < 0.004
    assert np.isfinite(found.std[np.isfinite(found.depth)]).all()
    assert (found.views[lacks][np.isfinite(found.depth[lacks])] == 1).all()
    nothing = replace(offering, depth=np.full_like(other, np.nan))
    assert _complete_depths(own, [nothing], views) is own


def test_seen_through_and_small_pieces_are_removed(two_maps):
    maps = two_maps[1]
    depth = maps[0].depth.copy()
    depth[80:100, 20:40] *= 0.6
    depth[100, 200:203] = np.nan
    depth[101, 199:203] = np.nan
    found = _confirm_depths(replace(maps[0], depth=depth), [maps[1]])
    assert np.isnan(found.depth[80:100, 20:40]).all()
    assert np.isfinite(found.depth).mean() > 0.7
    assert (found.views == np.isfinite(found.depth)).all()
    assert np.isnan(_confirm_depths(maps[0], []).depth).all()
    lonely = np.full((250, 300), np.nan, dtype=np.float32)
    lonely[:100], lonely[150:152, 5:8] = 2.0, 3.0
    kept = _without_small_regions(DepthMap(0, np.eye(3, 4), lonely, lonely, np.ones(lonely.shape, np.uint8)))
    assert (kept.depth[:100] == 2.0).all()
    assert np.isnan(kept.depth[100:]).all()


def test_unconfirmed_depths_stay_if_they_continue_confirmed_ones(two_maps):
    one, two = two_maps[1]
    other, depth = two.depth.copy(), one.depth.copy()
    other[20:26, 60:200] = np.nan
    depth[22:25, 100:103] *= 0.98
    found = _confirm_depths(replace(one, depth=depth), [replace(two, depth=other)])
    assert np.isnan(found.depth[22:25, 100:103]).all()
    assert np.isfinite(found.depth[20:26, 110:180]).mean() > 0.95
    other[20:60, 60:200] = np.nan
    found = _confirm_depths(one, [replace(two, depth=other)])
    assert np.isnan(found.depth[35:45, 110:180]).all()

"""Undistorted views, neighbours, correspondences through rectified frames, consistency: each by itself."""

from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import refuses
from tests.stereo.depth_scenes import RADIAL, SIZE, make_walled, on_arc
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.imaging.resampling import pinhole_view
from thesisrecon.records import DepthMap, DisparityMap
from thesisrecon.stereo._depth_fusion import _concatenated, _measured
from thesisrecon.stereo._epipolar_pair import pair_of_cameras
from thesisrecon.stereo._frames import common_orientation, polar
from thesisrecon.stereo.correspondence import PairMatching, _brightness_gain, _sample_disparity
from thesisrecon.stereo.depth import (
    _complete_depths,
    _confirm_depths,
    _select_neighbours,
    _shared_projections,
    _sparse_points,
    _without_small_regions,
)


@pytest.fixture(scope="module")
def walled():
    return make_walled(on_arc((-14.0, -5.0, 4.0, 13.0)), lens=RADIAL)


def views_of(walled, **options):
    return {
        i: pinhole_view(image, walled.reconstruction, i, **options) for i, image in enumerate(walled.images)
    }


def test_an_undistorted_view_equals_the_view_without_distortion(walled):
    straight = make_walled(on_arc((-14.0, -5.0, 4.0, 13.0)))
    for i, view in views_of(walled).items():
        assert (view.rgb[~view.seen] == 0).all()
        assert 0.8 < view.seen.mean() <= 1.0
        apart = view.rgb.astype(float) - straight.images[i].rgb
        assert np.median(np.abs(apart[view.seen])) < 2.0
        plain = pinhole_view(straight.images[i], straight.reconstruction, i)
        assert (plain.rgb == straight.images[i].rgb).all()


def test_a_smaller_view_has_the_camera_of_its_pixels(walled):
    view, small = views_of(walled)[1], views_of(walled, max_side=120)[1]
    assert small.seen.shape == (SIZE[1] // 2, SIZE[0] // 2)
    X = _sparse_points(walled.reconstruction).X
    np.testing.assert_allclose(project(small.P, X), (project(view.P, X) + 0.5) / 2.0 - 0.5, atol=1e-9)
    assert np.linalg.norm(small.P[2, :3]) == pytest.approx(1.0)


def test_views_are_refused_with_a_sentence(walled):
    image, reconstruction = walled.images[0], walled.reconstruction
    refuses(ValueError, "metric", pinhole_view, image, replace(reconstruction, K=None), 0)
    with pytest.raises(ValueError, match="px; got"):
        pinhole_view(image, replace(reconstruction, sizes=reconstruction.sizes + 1), 0)


def test_neighbours_are_on_both_sides_and_do_not_depend_on_the_scale(walled):
    views, points = views_of(walled), _sparse_points(walled.reconstruction)
    assert set(_select_neighbours(points, views, 1, 2)) == {0, 2}
    assert set(_select_neighbours(points, views, 2, 2)) == {1, 3}
    S = np.diag([1e3, 1e3, 1e3, 1.0])
    larger = {i: replace(view, P=1e3 * view.P @ np.linalg.inv(S)) for i, view in views.items()}
    farther = replace(points, X=1e3 * points.X)
    assert _select_neighbours(farther, larger, 1) == _select_neighbours(points, views, 1)


def test_a_view_without_baseline_or_points_is_not_a_neighbour(walled):
    views, points = views_of(walled), _sparse_points(walled.reconstruction)
    same = {0: views[0], 1: replace(views[1], P=views[0].P)}
    assert not _select_neighbours(points, same, 0)
    few = replace(points, seen=points.seen & (np.arange(points.seen.shape[1]) < 5))
    assert not _select_neighbours(few, views, 0)


def true_correspondence(P, pair, method, larger=1):
    """Correspondence from the exact disparities of a wall at depth 6 of the first view of a pair.

    It is reported for images that are ``larger`` than those matched.
    """
    a, b = P[list(pair)]
    frame = method(pair_of_cameras(a, b, SIZE, SIZE))
    width, height = frame.size
    x, y = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
    xy = frame.original_from_rectified(0, np.stack([x, y], axis=-1).reshape(-1, 2))
    right = frame.rectified_from_original(1, project(b, wall_points(a, np.nan_to_num(xy))), within=False)
    d = np.where(np.isfinite(xy).all(axis=1), x.ravel() - right[:, 0], np.nan)
    d = d.reshape(height, width).astype(np.float32)
    found = DisparityMap(d, np.isfinite(d).astype(np.float32), 0.1)
    shape = SIZE[::-1]
    return PairMatching()._map_back(
        frame, found, (shape, shape), ((larger * shape[0], larger * shape[1]),) * 2
    )


def wall_points(P, xy):
    return (homogenize(xy) * 6.0 - P[:, 3]) @ np.linalg.inv(P[:, :3]).T


@pytest.mark.parametrize("method", [common_orientation, polar])
def test_exact_disparities_give_exact_depth(method):
    P = on_arc((-6.0, 6.0))
    rho, std = _measured(P[0], P[1], true_correspondence(P, (0, 1), method))
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
    views, points = views_of(walled), _sparse_points(walled.reconstruction)
    darker = np.rint(views[1].rgb * np.array([0.8, 0.7, 0.9])).astype(np.uint8)
    xy = _shared_projections(points, views[0], views[1])
    gain = _brightness_gain(views[0].rgb, darker, *xy) / _brightness_gain(views[0].rgb, views[1].rgb, *xy)
    np.testing.assert_allclose(gain, 1.0 / np.array([0.8, 0.7, 0.9]), rtol=0.02)
    assert (_brightness_gain(views[0].rgb, darker, xy[0][:3], xy[1][:3]) == 1.0).all()


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


def true_maps(walled):
    maps = []
    for i, d in enumerate(walled.depth):
        std, views = np.full(d.shape, 5e-3, np.float32), np.ones(d.shape, np.uint8)
        maps.append(DepthMap(i, walled.reconstruction.P[i], d.astype(np.float32), std, views))
    return maps


def test_holes_are_filled_from_views_that_agree():
    walled = make_walled(on_arc((-6.0, 6.0)))
    maps, views = true_maps(walled), views_of(walled)
    depth, other = maps[0].depth.copy(), maps[1].depth.copy()
    lacks, wrong = np.s_[60:100, 60:110], np.s_[130:160, 100:150]
    depth[lacks], depth[wrong] = np.nan, np.nan
    # The other view is wrong there: what the photographs say counts, with the planes around the gap.
    other[120:] *= 0.8
    own, offering = replace(maps[0], depth=depth), replace(maps[1], depth=other)
    found = _complete_depths(own, [offering], views)
    kept = np.isfinite(depth)
    assert (found.depth[kept] == depth[kept]).all()
    error = np.abs(found.depth[lacks] / maps[0].depth[lacks] - 1.0)
    assert np.isfinite(error).mean() > 0.7
    error = error[np.isfinite(error)]
    assert np.median(error) < 0.004
    assert np.mean(error < 0.02) > 0.95
    error = found.depth[wrong] / maps[0].depth[wrong] - 1.0
    assert np.mean(np.abs(error[np.isfinite(error)]) < 0.02) > 0.95
    assert np.isfinite(found.std[np.isfinite(found.depth)]).all()
    assert (found.views[lacks][np.isfinite(found.depth[lacks])] == 1).all()
    nothing = replace(offering, depth=np.full_like(other, np.nan))
    assert _complete_depths(own, [nothing], views) is own


def test_seen_through_and_small_pieces_are_removed():
    walled = make_walled(on_arc((-6.0, 6.0)))
    maps = true_maps(walled)
    depth = maps[0].depth.copy()
    depth[80:100, 20:40] *= 0.6
    depth[100, 200:203] = np.nan
    depth[101, 199:203] = np.nan
    found = _confirm_depths(replace(maps[0], depth=depth), [maps[1]])
    assert np.isnan(found.depth[80:100, 20:40]).all()
    assert np.isfinite(found.depth).mean() > 0.7
    assert (found.views == np.isfinite(found.depth)).all()
    alone = _confirm_depths(maps[0], [])
    assert np.isnan(alone.depth).all()
    lonely = np.full((250, 300), np.nan, dtype=np.float32)
    lonely[:100], lonely[150:152, 5:8] = 2.0, 3.0
    kept = _without_small_regions(DepthMap(0, np.eye(3, 4), lonely, lonely, np.ones(lonely.shape, np.uint8)))
    assert (kept.depth[:100] == 2.0).all()
    assert np.isnan(kept.depth[100:]).all()


def test_unconfirmed_depths_stay_if_they_continue_confirmed_ones():
    walled = make_walled(on_arc((-6.0, 6.0)))
    maps = true_maps(walled)
    other = maps[1].depth.copy()
    other[20:26, 60:200] = np.nan
    depth = maps[0].depth.copy()
    depth[22:25, 100:103] *= 0.98
    found = _confirm_depths(replace(maps[0], depth=depth), [replace(maps[1], depth=other)])
    assert np.isnan(found.depth[22:25, 100:103]).all()
    strip = np.isfinite(found.depth[20:26, 110:180])
    assert strip.mean() > 0.95
    other[20:60, 60:200] = np.nan
    found = _confirm_depths(maps[0], [replace(maps[1], depth=other)])
    assert np.isnan(found.depth[35:45, 110:180]).all()

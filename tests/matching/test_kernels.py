"""Kernels of matching against plain ones, and tracks."""

from itertools import combinations

import numpy as np
import pytest
from scipy.ndimage import affine_transform, map_coordinates

from tests.constants import with_constants
from tests.synthetic import disparity, one_by_one, photograph, sideways_fundamental, stereo_scene, texture
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.matching._prepared import _corner_patches, prepare_image
from thesisrecon.matching.growth import SeedsAndGrowth, _fit_local_affines, match_guided
from thesisrecon.matching.strength import (
    _displacement_weight,
    _relative_difference_weight,
    _strength_of_match,
)
from thesisrecon.matching.track_alignment import _align_windows
from thesisrecon.matching.tracks import (
    AlignedTracks,
    PlainTracks,
    _chain_affines,
    _union_corners,
    corners_from_matches,
)
from thesisrecon.records import Features, Image, TwoView

RNG = np.random.default_rng(0)


def unit(window):
    centred = window - window.mean()
    return np.asarray(centred / np.linalg.norm(centred))


def prepared(gray):
    image = photograph(gray) if isinstance(gray, np.ndarray) else gray
    return prepare_image(image, with_constants(HarrisCorners, spacing_rel=0.01)().detect(image))


def grid(low, high, step):
    """Positions (N, 2) of a square lattice."""
    return np.stack(np.meshgrid(np.arange(low, high, step), np.arange(low, high, step)), -1).reshape(-1, 2)


def align(one, two, xy1, start, affine, settings):
    given = (xy1, np.ones(len(xy1), np.float32), start, affine)
    return _align_windows(one.pyramid, two.pyramid, given, settings)


@pytest.mark.parametrize("affine_std", [0.0, 0.1])
def test_alignment_finds_the_true_place_under_gain_and_bias(affine_std):
    one, two = (prepared(image) for image in stereo_scene())
    xy2 = grid(40, 260, 16) + np.array([40.37, 0.37])
    xy1 = xy2 + np.stack([disparity(xy2), np.zeros(len(xy2))], 1)
    slope = 1.0 / (1.0 + 5.0 / 60.0 * np.cos(xy2[:, 0] / 60.0))
    affine = np.tile(np.eye(2), (len(xy2), 1, 1))
    affine[:, 0, 0], affine[:, 0, 1] = slope, 4.0 / 45.0 * np.sin(xy2[:, 1] / 45.0) * slope
    start = xy2 + RNG.uniform(-0.8, 0.8, xy2.shape)
    found, maps, score = align(one, two, xy1, start, affine, (12, affine_std, 3.0, 1.0))
    assert (score > 0.9).mean() > 0.95
    assert np.median(np.linalg.norm(found - xy2, axis=1)) < 0.05
    # More iterations move no window.
    further = align(one, two, xy1, start, affine, (60, affine_std, 3.0, 1.0))[0]
    assert np.linalg.norm(found - further, axis=1).max() < 0.001
    assert np.abs(np.linalg.det(maps[score > 0.9]) / slope[score > 0.9] - 1).mean() < 0.1


def test_local_affines_are_those_of_a_linear_field_despite_a_few_wrong_neighbours():
    xy, xy1 = RNG.uniform(0, 100, (12, 2)), RNG.uniform(0, 100, (80, 2))
    A = np.array([[1.1, 0.2], [-0.1, 0.9]])
    xy2, prior = xy1 @ A.T + (20, -7), np.tile(A, (80, 1, 1))
    near = np.linalg.norm(xy[:, None] - xy1[None], axis=2).argsort(axis=1)[:, :10]
    for wrong, within in ((0.0, 1e-6), (30.0, 3.0)):
        xy2[::20] += wrong
        affine, place, spread = _fit_local_affines(xy, near, xy1, xy2, prior)
        assert np.abs(place - xy @ A.T - (20, -7)).max() < within
        assert wrong or max(np.abs(affine - A).max(), spread.max()) < within


def test_corner_patches_equal_their_numpy_twin_at_every_level():
    view = prepared(texture(120, 150))
    xy = np.array([[60.3, 50.6], [70.0, 64.5], [3.0, 60.0]])
    scale = np.array([1.0, 2.0, 1.0], np.float32)
    pixels, levels, base = view.pyramid
    found = _corner_patches(pixels, levels, base, xy, scale)
    b, a = np.mgrid[-7:8, -7:8]
    for n in range(2):
        offset, height, width = levels[n]
        gray = pixels[offset : offset + height * width].reshape(height, width)
        x, y = (xy[n] + 0.5) / scale[n] - 0.5
        twin = unit(map_coordinates(gray, [y + b, x + a], order=1).ravel())
        assert np.abs(found[n] - twin).max() < 1e-4
    # The third window leaves the image.
    assert not found[2].any()


def test_guided_matches_are_the_most_alike_of_all_that_are_allowed():
    one, two = (prepared(image) for image in stereo_scene(200, 260))
    xy1, xy2 = one.features.xy, two.features.xy
    predicted = np.tile(np.eye(2), (len(xy1), 1, 1)), xy1 - (14.0, 0.0), np.full(len(xy1), 12.0)
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    index, score, second_best = match_guided(
        one.pyramid, (xy1, one.features.scale), predicted, (xy2, two.features.scale, two.patches),
        two.cells, (F, np.full(len(xy1), 1.5), 0.7),
    )  # fmt: skip
    correlation = one.patches @ two.patches.T
    found = 0
    # A window that touches the border may be inside for one and outside for the other.
    for n in np.flatnonzero((np.minimum(xy1, np.array(one.size) - 1 - xy1) > 9).all(axis=1)):
        near = np.linalg.norm(predicted[1][n] - xy2, axis=1) <= 12.0
        alike = np.where(near & (np.abs(xy1[n, 1] - xy2[:, 1]) <= 1.5), correlation[n], -1.0)
        best = int(alike.argmax())
        if alike[best] <= 0.7:
            assert (index[n], score[n], second_best[n]) == (-1, 0.0, -1.0)
            continue
        found += 1
        assert index[n] == best
        elsewhere = np.where(np.linalg.norm(xy2[best] - xy2, axis=1) > 3.0, alike, -1.0).max()
        assert (score[n], second_best[n]) == pytest.approx((alike[best], elsewhere), abs=1e-4)
    assert found > 50


def test_alignment_recovers_an_affine_map_or_gives_up():
    gray, truth = texture(240, 240, 5), np.array([[1.08, 0.06], [-0.05, 0.95]])
    B, centre = np.linalg.inv(truth), np.full(2, 120.0)
    moved = affine_transform(gray, B[::-1, ::-1], (centre - B @ centre)[::-1], order=3, mode="reflect")
    xy1 = grid(80, 160, 9.0)
    xy2, start = (xy1 - 120) @ truth.T + 120, np.tile(np.eye(2), (len(xy1), 1, 1))
    found, maps, score = align(prepared(gray), prepared(moved), xy1, xy2 + 0.4, start, (20, 0.1, 3.0, 1.0))
    assert (score > 0.95).mean() > 0.9
    assert np.median(np.linalg.norm(found - xy2, axis=1)) < 0.05
    assert np.median(np.abs(maps - truth).max(axis=(1, 2))) < 0.03
    blank, rich = prepared(np.full((100, 100), 80.0)), prepared(texture(100, 100))
    xy = np.array([[50.0, 50.0], [2.0, 50.0], [np.nan, 50.0]])
    start = np.tile(np.eye(2), (3, 1, 1))
    for one, two, kept in ((blank, rich, False), (rich, blank, False), (rich, rich, True)):
        score = align(one, two, xy, xy, start, (5, 0.1, 3.0, 1.0))[2]
        assert (score > 0.0).tolist() == [kept, False, False]
        assert score[0] > 0.99 or not kept
    straight = np.repeat(texture(1, 100, 3), 100, axis=0)
    noise = RNG.normal(scale=2.0, size=(2, 100, 100))
    for gray, kept in ((texture(100, 100, 3), True), (128 + 0.05 * (straight - 128), False)):
        one, two = prepared(gray + noise[0]), prepared(gray + noise[1])
        assert (align(one, two, xy[:1], xy[:1], start[:1], (12, 0.0, 3.0, 0.12))[2][0] > 0.0) == kept


@pytest.mark.parametrize("tolerance", [0.0, 0.3])
def test_strength_of_match_equals_its_brute_force_twin(tolerance):
    xy1, xy2 = RNG.uniform(0, 60, (25, 2)), RNG.uniform(0, 60, (30, 2))
    correlation = RNG.uniform(-1, 1, (25, 30)).astype(np.float32)
    near1, near2 = (
        np.linalg.norm(xy[:, None] - xy[None], axis=2).argsort(axis=1)[:, 1:6] for xy in (xy1, xy2)
    )
    near1[3, 2:] = -1
    index, strength = _strength_of_match(correlation, xy1, xy2, near1, near2, (30.0, 4, 0.1), tolerance)

    def agreement(u, v, m, n):
        a, b, apart = xy2[v] - xy1[u], xy2[n] - xy1[m], float(np.linalg.norm(xy1[m] - xy1[u]))
        if tolerance:
            return _relative_difference_weight(a, b, apart, tolerance)
        return _displacement_weight(a, b, 1 - apart / 30.0)

    for u in range(25):
        c = np.where(np.linalg.norm(xy2 - xy1[u], axis=1) <= 30.0, correlation[u], -1.0)
        best, expected = 0.0, -1
        for v in [v for v in np.argsort(-c)[:4] if c[v] > 0.1]:
            total = sum(
                max(max(float(correlation[m, n]), 0.0) * agreement(u, v, m, n) for n in near2[v])
                for m in near1[u][near1[u] >= 0]
            )
            if c[v] * total > best:
                best, expected = c[v] * total, v
        assert index[u] == expected
        assert strength[u] == pytest.approx(best, rel=1e-4)


def test_displacements_that_agree_weigh_one():
    a = np.array([10.0, 0.0])
    for b, closeness, weight in (
        (a, 1.0, 1.0), (0.5 * a, 1.0, 0.5), (-a, 1.0, 0.0), (np.array([10.0, 10.0]), 0.8, 0.4)
    ):  # fmt: skip
        assert _displacement_weight(a, b, closeness) == pytest.approx(weight)
    assert _displacement_weight(0.01 * a, -0.01 * a, 0.8) == pytest.approx(0.8)
    # A corner that stays has no direction that another could contradict.
    for still in (0.0 * a, 0.05 * a, -0.05 * a):
        for moved in (0.2 * a, -0.2 * a):
            for pair in ((still, moved), (moved, still)):
                assert _displacement_weight(*pair, 0.8) == pytest.approx(0.8 / np.linalg.norm(moved))
    for b, apart in ((a, 5.0), (-a, 5.0), (a + 3.0, 5.0), (a + 3.0, 50.0)):
        expected = np.exp(-0.5 * (np.linalg.norm(a - b) / (0.3 * apart + 1.0)) ** 2)
        assert _relative_difference_weight(a, b, apart, 0.3) == pytest.approx(expected)


@pytest.mark.parametrize("colour", [False, True])
@pytest.mark.parametrize("side", [7, 15])
def test_products_of_corner_windows_are_normalised_cross_correlations(colour, side):
    """The formula of section 4.2.2, each colour by itself."""
    rgb = np.stack([texture(80, 90, seed) for seed in (1, 2, 3)], axis=2).astype(np.uint8)
    image, xy = Image("a.png", rgb, (90, 80)), np.round(np.random.default_rng(2).uniform(20, 60, (12, 2)))
    features = Features(xy, np.ones(12, np.float32), np.ones(12, np.float32))
    found = prepare_image(image, features, window=side, colour=colour).patches
    planes = np.moveaxis(rgb.astype(np.float64), 2, 0) if colour else image.gray[None].astype(np.float64)
    k, (x, y) = side // 2, xy.astype(int).T
    windows = [
        planes[:, v - k : v + k + 1, u - k : u + k + 1].reshape(len(planes), -1)
        for u, v in zip(x, y, strict=True)
    ]
    for a, b in ((0, 1), (2, 2), (3, 7)):
        twin = np.mean(
            [np.corrcoef(p.ravel(), q.ravel())[0, 1] for p, q in zip(windows[a], windows[b], strict=True)]
        )
        assert found[a] @ found[b] == pytest.approx(twin, abs=1e-4)


def test_corners_are_united_one_of_a_view_and_maps_chain_along_the_matches():
    view_of = np.repeat(np.arange(5), 20)
    edges = RNG.integers(0, 100, (150, 2))
    root = _union_corners(edges, view_of, 5)
    member = [{n} for n in range(100)]
    for a, b in edges:
        together = member[a] | member[b]
        if len({view_of[n] for n in together}) == len(together):
            for n in together:
                member[n] = together
    for a, b in RNG.integers(0, 100, (500, 2)):
        assert (root[a] == root[b]) == (b in member[a])
    a = np.array([[[1.1, 0.1], [0.0, 0.9]], [[0.8, 0.0], [0.2, 1.2]]])
    xy = np.array([[10.0, 10.0], [20.0, 12.0], [31.0, 13.0]])
    # Observation 1 is the middle: edge 0 leads from 0 to 1 (walked backwards), edge 1 from 1 to 2.
    edges = np.array([[0, 1], [1, 2]])
    xy1, xy2 = xy[:2], np.array([[20.5, 12.25], [31.2, 12.9]])
    place, maps = _chain_affines(edges, xy1, xy2, a, xy, np.array([1]))
    assert np.allclose(place[0], xy1[0] + np.linalg.inv(a[0]) @ (xy[1] - xy2[0]))
    assert np.allclose(place[1:], [xy[1], xy2[1]])
    assert np.allclose(maps, [np.linalg.inv(a[0]), np.eye(2), a[1]])


SHIFTS = np.array([[0.0, 0.0], [7.3, 0.0], [15.6, 0.0], [24.1, 0.0]])


@pytest.fixture(scope="module")
def scene():
    """Four views of one plane: view i shows the scene point u at u - SHIFTS[i]."""
    wide = texture(200, 330, 9)
    y, x = np.mgrid[0:200, 0:280].astype(np.float64)
    matcher, prepared, pairs = SeedsAndGrowth(), [], []
    for dx, _ in SHIFTS:
        image = photograph(map_coordinates(wide, [y, x + dx], order=3))
        prepared.append(matcher.prepare(image, MultiScaleCorners().detect(image)))
    for i, j in combinations(range(4), 2):
        rng = np.random.default_rng(0)
        options = {"pair": (i, j), "estimate_fundamental": sideways_fundamental, "rng": rng}
        m = matcher.match(prepared[i], prepared[j], **options)
        found = (m.index1, m.index2, m.xy1, m.xy2, m.affine, len(m.xy1))
        pairs.append(TwoView(i, j, sideways_fundamental(m.xy1, m.xy2, rng).F, 0.1, *found, 0.0, True))
    return prepared, pairs


def built(variant, prepared, pairs):
    return variant.build(prepared, pairs, map_all=one_by_one, rng=np.random.default_rng(0))


def spread(view_index, point_index, xy):
    """(K,) distance of each observation, brought to the scene, from the mean of its track."""
    placed = xy + SHIFTS[view_index]
    total = np.zeros((point_index.max() + 1, 2))
    np.add.at(total, point_index, placed)
    mean = total / np.bincount(point_index)[:, None]
    return np.linalg.norm(placed - mean[point_index], axis=1)


@pytest.mark.parametrize("variant", [PlainTracks(), AlignedTracks()])
def test_tracks_are_sorted_and_seen_once_in_at_least_two_views(scene, variant):
    tracks = built(variant, *scene)
    length = np.bincount(tracks.point_index)
    assert (np.diff(tracks.point_index * 4 + tracks.view_index) > 0).all()
    assert (length >= 2).all()
    assert tracks.n_points == len(length) > 300
    assert tracks.n_views == 4
    assert (length == 4).sum() > 50
    assert (spread(tracks.view_index, tracks.point_index, tracks.xy) < 3.0).mean() > 0.98
    nothing = built(variant, scene[0], [])
    assert (nothing.n_points, len(nothing.xy), nothing.n_views) == (0, 0, 4)


def test_alignment_brings_the_observations_of_a_track_to_one_spot(scene):
    before, after = (
        np.median(spread(tracks.view_index, tracks.point_index, tracks.xy))
        for tracks in (built(PlainTracks(), *scene), built(AlignedTracks(), *scene))
    )
    assert after < 0.03
    assert after < 0.3 * before


def test_a_false_link_does_not_join_two_corners_of_one_view(scene):
    prepared, pairs = scene
    good = pairs[0]
    moved = (good.index1, np.roll(good.index2, 1), good.xy1, good.xy2, good.affine)
    wrong = TwoView(0, 1, good.F, 9.0, *(values[:50] for values in moved), 50, 0.0, True)
    with_it, without = built(PlainTracks(), prepared, [*pairs, wrong]), built(PlainTracks(), prepared, pairs)
    assert np.bincount(with_it.point_index).max() == 4
    assert abs(with_it.n_points - without.n_points) <= 50


def matched(i, j, xy1, xy2):
    """A pair of positions that are no corners."""
    xy1, xy2 = (np.array(xy, np.float64).reshape(-1, 2) for xy in (xy1, xy2))
    none, affine = np.full(len(xy1), -1), np.tile(np.eye(2), (len(xy1), 1, 1))
    return TwoView(i, j, np.eye(3), 0.1, none, none, xy1, xy2, affine, len(xy1), 0.0, accepted=True)


def test_positions_without_corners_become_corners_within_the_radius():
    rng, n = np.random.default_rng(4), 300
    scene = rng.uniform(0.0, 400.0, (n, 2))
    pairs = [
        matched(i, j, *(scene + np.array([10.0 * v, 0.0]) + rng.uniform(-0.2, 0.2, (n, 2)) for v in (i, j)))
        for i, j in combinations(range(4), 2)
    ]
    corners, numbered = corners_from_matches(pairs, 5, 0.8)
    assert corners[4].shape == (0, 2)
    for pair in numbered:
        for view, index, xy in ((pair.i, pair.index1, pair.xy1), (pair.j, pair.index2, pair.xy2)):
            assert len(np.unique(index)) == len(index) > 0.97 * n
            assert np.linalg.norm(corners[view][index] - xy, axis=1).max() < 1.6
    again, _ = corners_from_matches(pairs[::-1], 5, 0.8)
    assert all((np.sort(a, axis=0) == np.sort(b, axis=0)).all() for a, b in zip(corners, again, strict=True))
    tracks = built(PlainTracks(merge_px=0.8), [None] * 5, pairs)
    assert (np.bincount(tracks.point_index) == 4).mean() > 0.97
    assert tracks.n_points < 1.02 * n
    # Equal positions only: every pair has its own tracks.
    assert built(PlainTracks(merge_px=0.0), [None] * 5, pairs).n_points == 6 * n


def test_merging_keeps_equal_positions_joins_no_chains_and_matches_one_to_one():
    line = np.column_stack([np.arange(0.0, 30.0, 0.6), np.zeros(50)])
    corners, (pair,) = corners_from_matches([matched(0, 1, line, line * 10.0)], 2, 1.0)
    assert np.diff(np.sort(corners[0][:, 0])).min() > 0.5
    assert len(corners[0]) >= 20
    assert len(pair.xy1) == len(pair.affine) == len(np.unique(pair.index1)) == len(corners[0])
    exact = np.random.default_rng(1).uniform(0.0, 1e4, (99, 2))
    corners, _ = corners_from_matches([matched(0, 1, exact, exact), matched(0, 2, exact, exact)], 3)
    assert {tuple(xy) for xy in corners[0]} == {tuple(xy) for xy in exact}
    with pytest.raises(ValueError, match="merge_px"):
        PlainTracks(merge_px=float("nan"))

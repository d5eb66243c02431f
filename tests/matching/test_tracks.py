import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tests.synthetic import one_by_one, photograph, sideways_fundamental, texture
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.matching.tracks import AlignedTracks, PlainTracks, corners_from_matches
from thesisrecon.records import TwoView

SHIFTS = np.array([[0.0, 0.0], [7.3, 0.0], [15.6, 0.0], [24.1, 0.0]])


def panorama():
    """Four views of one plane: view i shows the scene point u at u - SHIFTS[i]."""
    wide = texture(200, 330, 9)
    y, x = np.mgrid[0:200, 0:280].astype(np.float64)
    matcher, prepared = SeedsAndGrowth(), []
    for dx, _ in SHIFTS:
        image = photograph(map_coordinates(wide, [y, x + dx], order=3))
        prepared.append(matcher.prepare(image, MultiScaleCorners().detect(image)))
    pairs = []
    for i in range(4):
        for j in range(i + 1, 4):
            estimate = {"estimate_fundamental": sideways_fundamental, "rng": np.random.default_rng(0)}
            m = matcher.match(prepared[i], prepared[j], pair=(i, j), **estimate)
            F = sideways_fundamental(m.xy1, m.xy2, np.random.default_rng(0)).F
            found = (m.index1, m.index2, m.xy1, m.xy2, m.affine, len(m.xy1))
            pairs.append(TwoView(i, j, F, 0.1, *found, 0.0, accepted=True))
    return prepared, pairs


@pytest.fixture(scope="module")
def scene():
    return panorama()


def spread(view_index, point_index, xy):
    """(K,) distance of each observation, brought to the scene, from the mean of its track."""
    placed = xy + SHIFTS[view_index]
    total = np.zeros((point_index.max() + 1, 2))
    np.add.at(total, point_index, placed)
    mean = total / np.bincount(point_index)[:, None]
    return np.linalg.norm(placed - mean[point_index], axis=1)


@pytest.mark.parametrize("variant", [PlainTracks(), AlignedTracks()])
def test_tracks_are_sorted_and_seen_once_in_at_least_two_views(scene, variant):
    tracks = variant.build(*scene, map_all=one_by_one, rng=np.random.default_rng(0))
    key = tracks.point_index * 4 + tracks.view_index
    assert (np.diff(key) > 0).all()
    assert (np.bincount(tracks.point_index) >= 2).all()
    assert tracks.n_points == tracks.point_index.max() + 1 > 300
    assert tracks.n_views == 4
    assert (np.bincount(tracks.point_index) == 4).sum() > 50
    assert (spread(tracks.view_index, tracks.point_index, tracks.xy) < 3.0).mean() > 0.98


def test_alignment_brings_the_observations_of_a_track_to_one_spot(scene):
    plain, aligned = (
        v.build(*scene, map_all=one_by_one, rng=np.random.default_rng(0))
        for v in (PlainTracks(), AlignedTracks())
    )
    before = np.median(spread(plain.view_index, plain.point_index, plain.xy))
    after = np.median(spread(aligned.view_index, aligned.point_index, aligned.xy))
    assert after < 0.03
    assert after < 0.3 * before


@pytest.mark.parametrize("variant", [PlainTracks(), AlignedTracks()])
def test_no_accepted_pair_gives_no_tracks(scene, variant):
    tracks = variant.build(scene[0], [], map_all=one_by_one, rng=np.random.default_rng(0))
    assert (tracks.n_points, len(tracks.xy), tracks.n_views) == (0, 0, 4)


def test_a_false_link_does_not_join_two_corners_of_one_view(scene):
    prepared, pairs = scene
    good = pairs[0]
    moved = (good.index1, np.roll(good.index2, 1), good.xy1, good.xy2, good.affine)
    rows = [values[:50] for values in moved]
    wrong = TwoView(0, 1, good.F, 9.0, *rows, 50, 0.0, True)
    with_it = PlainTracks().build(prepared, [*pairs, wrong], map_all=one_by_one, rng=np.random.default_rng(0))
    without = PlainTracks().build(prepared, pairs, map_all=one_by_one, rng=np.random.default_rng(0))
    assert np.array_equal(np.unique(with_it.point_index, return_counts=True)[1].max(), 4)
    assert abs(with_it.n_points - without.n_points) <= 50


def matched(i, j, xy1, xy2):
    """A pair of positions that are no corners."""
    xy1, xy2 = (np.array(xy, np.float64).reshape(-1, 2) for xy in (xy1, xy2))
    none, affine = np.full(len(xy1), -1), np.tile(np.eye(2), (len(xy1), 1, 1))
    return TwoView(i, j, np.eye(3), 0.1, none, none, xy1, xy2, affine, len(xy1), 0.0, accepted=True)


def test_positions_without_corners_become_corners_within_the_radius():
    rng, n = np.random.default_rng(4), 300
    scene = rng.uniform(0.0, 400.0, (n, 2))
    views = [scene + np.array([10.0 * v, 0.0]) for v in range(4)]
    pairs = [
        matched(i, j, *(views[v] + rng.uniform(-0.2, 0.2, (n, 2)) for v in (i, j)))
        for i in range(4)
        for j in range(i + 1, 4)
    ]
    corners, numbered = corners_from_matches(pairs, 5, 0.8)
    assert corners[4].shape == (0, 2)
    for pair in numbered:
        for view, index, xy in ((pair.i, pair.index1, pair.xy1), (pair.j, pair.index2, pair.xy2)):
            assert len(np.unique(index)) == len(index) > 0.97 * n
            assert np.linalg.norm(corners[view][index] - xy, axis=1).max() < 1.6
    again, _ = corners_from_matches(pairs[::-1], 5, 0.8)
    assert all((np.sort(a, axis=0) == np.sort(b, axis=0)).all() for a, b in zip(corners, again, strict=True))
    tracks = PlainTracks(merge_px=0.8).build([None] * 5, pairs, map_all=one_by_one, rng=rng)
    assert (np.bincount(tracks.point_index) == 4).mean() > 0.97
    assert tracks.n_points < 1.02 * n
    # Equal positions only: every pair has its own tracks.
    equal = PlainTracks(merge_px=0.0).build([None] * 5, pairs, map_all=one_by_one, rng=rng)
    assert equal.n_points == 6 * n


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

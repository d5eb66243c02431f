"""Views that cannot be placed before calibration, or were placed wrong: they wait or go, and ruin nothing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.projective.test_reconstruction import projective_error, residuals
from tests.synthetic import make_scene, true_pairs
from thesisrecon.geometry.camera_matrix import project, project_camera
from thesisrecon.projective.incremental import (
    IncrementalProjective,
    epipolar_inlier_ratios,
    find_inconsistent_view,
)
from thesisrecon.projective.initial_pair import rank_initial_pairs
from thesisrecon.projective.model import ProjectiveModel, consistent_observations, retriangulate_points
from thesisrecon.records import DegeneracyReport, Tracks

NOISE_PX = 0.3


def observe(scene, R, t):
    """The scene with cameras added at R (M, 3, 3), t (M, 3); each sees three quarters of the points."""
    rng = np.random.default_rng(99)
    old, points = scene.tracks, scene.X
    n, m = old.n_views, len(R)
    seen = rng.random((m, len(points))) < 0.75
    new_view, new_point = np.nonzero(seen)
    new_xy = np.concatenate([project_camera(scene.K[0], R[v], t[v], points[seen[v]]) for v in range(m)])
    view = np.concatenate([old.view_index, n + new_view])
    point = np.concatenate([old.point_index, new_point])
    xy = np.concatenate([old.xy, new_xy + rng.normal(0, NOISE_PX, new_xy.shape)])
    order = np.lexsort((view, point))
    return replace(
        scene,
        K=np.concatenate([scene.K, np.tile(scene.K[0], (m, 1, 1))]),
        R=np.concatenate([scene.R, R]),
        t=np.concatenate([scene.t, t]),
        sizes=np.tile(scene.sizes[0], (n + m, 1)),
        tracks=Tracks(view[order], point[order], xy[order], n + m, old.n_points),
    )


def reconstruct(scene, pairs, seed=0, **changes):
    variant = replace(IncrementalProjective(), **changes)
    return variant.reconstruct(scene.tracks, pairs, scene.sizes, rng=np.random.default_rng(seed))


def homography_like(pair, scene):
    """The pair with F and share as a front end would have them: no F where the centres are one."""
    apart = np.linalg.norm(scene.centres[pair.i] - scene.centres[pair.j])
    if apart > 0.05:
        return pair
    rng = np.random.default_rng([pair.i, pair.j])
    F = rng.normal(size=(3, 3))
    return replace(pair, F=F / np.linalg.norm(F), homography_inlier_ratio=1.0)


def test_turns_about_a_standpoint_among_the_views_harm_nothing():
    base = make_scene(points=400, sigma_px=NOISE_PX, seed=21)
    turns = Rotation.from_rotvec([[0.05, 0.0, 0.0], [0.0, 0.06, 0.02], [0.0, -0.05, 0.1]]).as_matrix()
    R = turns @ base.R[2]
    scene = observe(base, R, -np.einsum("vab,b->va", R, base.centres[2]))
    pairs = [homography_like(pair, scene) for pair in true_pairs(scene)]
    found = reconstruct(scene, pairs)
    assert found.registered.all(), found.reasons
    assert projective_error(found, scene) < 0.05
    assert residuals(found).max() < 7 * NOISE_PX * 1.01


def test_frames_almost_the_same_harm_nothing():
    base = make_scene(points=400, sigma_px=NOISE_PX, seed=22)
    rng = np.random.default_rng(3)
    R = Rotation.from_rotvec(rng.normal(0, 1e-3, (8, 3))).as_matrix() @ base.R
    centres = base.centres + rng.normal(0, 2e-3, (8, 3))
    scene = observe(base, R, -np.einsum("vab,vb->va", R, centres))
    pairs = [homography_like(pair, scene) for pair in true_pairs(scene)]
    found = reconstruct(scene, pairs)
    assert found.registered.all(), found.reasons
    assert projective_error(found, scene) < 0.05


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_views_of_one_plane_wait_and_the_others_are_as_without_them(seed):
    base = make_scene(points=400, sigma_px=NOISE_PX, seed=30 + seed)
    X = base.X.copy()
    flat = X[:, 2] < 0.0
    X[flat, 2] = -0.75
    rng = np.random.default_rng(seed)
    t = base.tracks
    xy = np.empty_like(t.xy)
    for v in range(8):
        xy[t.view_index == v] = project(base.P[v], X[t.point_index[t.view_index == v]])
    xy += rng.normal(0, NOISE_PX, xy.shape)
    keep = (t.view_index < 5) | flat[t.point_index]
    tracks = Tracks(t.view_index[keep], t.point_index[keep], xy[keep], 8, 400)
    scene = replace(base, X=X, tracks=tracks)
    pairs = [
        replace(pair, homography_inlier_ratio=1.0) if pair.i >= 5 or pair.j >= 5 else pair
        for pair in true_pairs(scene)
    ]
    found = reconstruct(scene, pairs, seed)
    np.testing.assert_array_equal(found.registered, np.arange(8) < 5)
    assert all("plane" in reason for reason in found.reasons[5:])
    assert projective_error(found, scene) < 0.1
    ungated = reconstruct(scene, pairs, seed, max_projection_std_rel=None)
    assert ungated.registered.all()


def test_a_camera_that_wrong_matches_placed_is_discarded_with_its_reason():
    scene = make_scene(points=500, sigma_px=NOISE_PX, seed=5)
    t = scene.tracks
    # What view 7 sees is where a camera elsewhere would see it: a crowd of wrong matches that agree.
    elsewhere = Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix() @ scene.R[7]
    mine = t.view_index == 7
    xy = t.xy.copy()
    xy[mine] = project_camera(scene.K[7], elsewhere, scene.t[7] + 0.8, scene.X[t.point_index[mine]])
    wrong = replace(scene, tracks=replace(t, xy=xy))
    found = reconstruct(wrong, true_pairs(scene))
    np.testing.assert_array_equal(found.registered, np.arange(8) < 7)
    assert "verified matches" in found.reasons[7]
    assert projective_error(found, scene) < 0.05
    assert reconstruct(wrong, true_pairs(scene), min_epipolar_inlier_ratio=0.0).registered.all()


def test_the_view_that_contradicts_its_pairs_is_named():
    scene = make_scene(seed=6)
    pairs, registered = true_pairs(scene), np.ones(8, dtype=bool)
    assert (epipolar_inlier_ratios(scene.P, registered, pairs, gate_px=1.0) == 1.0).all()
    assert find_inconsistent_view(scene.P, registered, pairs, gate_px=1.0, least=0.5) is None
    P = scene.P.copy()
    P[3] = P[3] + 0.05 * np.random.default_rng(0).normal(size=(3, 4)) * np.abs(P[3])
    found = find_inconsistent_view(P, registered, pairs, gate_px=1.0, least=0.5)
    assert found is not None
    assert found[0] == 3
    registered[3] = False
    shares = epipolar_inlier_ratios(P, registered, pairs, gate_px=1.0)
    assert np.isnan([share for share, pair in zip(shares, pairs, strict=True) if 3 in (pair.i, pair.j)]).all()


def test_a_beginning_in_a_corner_gives_way_to_one_that_reaches_more():
    big, small = make_scene(views=6, points=300, seed=7), make_scene(views=3, points=900, seed=8)
    t, s = big.tracks, small.tracks
    tracks = Tracks(
        np.concatenate([t.view_index, 6 + s.view_index]),
        np.concatenate([t.point_index, 300 + s.point_index]),
        np.concatenate([t.xy, s.xy]),
        9,
        1200,
    )
    pairs = true_pairs(big) + [replace(p, i=p.i + 6, j=p.j + 6) for p in true_pairs(small)]
    assert rank_initial_pairs(tracks, pairs)[0].i >= 6
    both = replace(big, tracks=tracks, sizes=np.tile(big.sizes[0], (9, 1)))
    assert reconstruct(both, pairs, max_initial_pairs=1).registered.sum() == 3
    found = reconstruct(both, pairs)
    np.testing.assert_array_equal(found.registered, np.arange(9) < 6)
    assert all("sees only 0 points" in reason or "shares no" in reason for reason in found.reasons[6:])


def test_each_attempt_begins_elsewhere_and_the_last_says_that_there_is_no_other():
    scene = make_scene(views=6)
    ranked = rank_initial_pairs(scene.tracks, true_pairs(scene))
    assert len({(pair.i, pair.j) for pair in ranked}) == 15
    first = [view for pair in ranked[:3] for view in (pair.i, pair.j)]
    assert sorted(first) == list(range(6))


def test_a_pair_whose_f_is_open_is_not_the_first_choice():
    pairs = true_pairs(make_scene())
    opened = [replace(p, degeneracy=DegeneracyReport(determined=(p.i, p.j) == (1, 4))) for p in pairs]
    best = rank_initial_pairs(make_scene().tracks, opened)[0]
    assert (best.i, best.j) == (1, 4)


def test_right_observations_are_told_from_wrong_ones_of_the_same_point():
    scene = make_scene(points=200, sigma_px=NOISE_PX, seed=9)
    t, rng = scene.tracks, np.random.default_rng(0)
    length = np.bincount(t.point_index, minlength=200)
    first = np.searchsorted(t.point_index, np.arange(200))
    wrong = np.zeros(len(t.xy), dtype=bool)
    wrong[(first + rng.integers(0, length))[length >= 4]] = True
    xy = t.xy + np.where(
        wrong[:, None], rng.choice([-1, 1], t.xy.shape) * rng.uniform(60, 400, t.xy.shape), 0
    )
    tracks = replace(t, xy=xy)
    model = ProjectiveModel.empty(tracks, scene.sizes, sigma_px=NOISE_PX, noise_floor_px=NOISE_PX)
    model.P, model.registered = scene.P.copy(), np.ones(8, dtype=bool)
    chosen = (length >= 4)[t.point_index]
    agree = consistent_observations(model, chosen, 12 * NOISE_PX)
    assert agree[chosen & ~wrong].mean() > 0.97
    assert not agree[wrong].any()
    retriangulate_points(model, 12.0)
    assert model.inlier[chosen & ~wrong].mean() > 0.97
    assert not model.inlier[wrong].any()

"""Projective reconstruction: initial pair, growth and acceptance tests."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.constants import with_constants
from tests.synthetic import make_scene, true_pairs, with_poses
from thesisrecon.api.cameras import triangulate
from thesisrecon.camera import project_camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, pixel_from_unit
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.optimize.ransac import Budget, resect_projective
from thesisrecon.projective import _model, incremental
from thesisrecon.records import DegeneracyReport, Tracks

VARIANTS = [incremental.IncrementalProjective(), incremental.SequentialProjective()]


def reprojected(found):
    t = found.tracks
    return dehomogenize(np.einsum("kab,kb->ka", found.P[t.view_index], found.X[t.point_index]))


def residuals(found):
    return np.linalg.norm((reprojected(found) - found.tracks.xy)[found.inlier], axis=1)


def projective_error(found, scene):
    """Largest distance (scene units) of the points from the truth after the best projective alignment."""
    X, Y = found.X[found.valid], scene.X[found.valid]
    rows = np.zeros((3, len(X), 4, 4))
    for a in range(3):
        rows[a, :, a], rows[a, :, 3] = X, -Y[:, a : a + 1] * X
    H = np.linalg.svd(rows.reshape(-1, 16))[2][-1].reshape(4, 4)
    return np.abs(dehomogenize(X @ H.T) - Y).max()


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: type(v).__name__)
@pytest.mark.parametrize("seed", [0, 1])
def test_exact_tracks_give_the_true_scene_up_to_a_projective_transform(variant, seed):
    scene = make_scene(seed=seed)
    found = variant.reconstruct(scene.tracks, true_pairs(scene), scene.sizes, rng=np.random.default_rng(0))
    assert found.stratum == "projective"
    assert found.registered.all()
    assert found.valid.all()
    assert found.inlier.all()
    assert residuals(found).max() < 1e-3
    assert projective_error(found, scene) < 1e-3


def test_noise_comes_back_as_residual_and_wrong_observations_are_left_out():
    scene = make_scene(seed=2, sigma_px=0.5, points=500)
    t, rng = scene.tracks, np.random.default_rng(5)
    wrong = rng.random(len(t.xy)) < 0.05
    xy = t.xy + np.where(wrong[:, None], rng.uniform(-200, 200, t.xy.shape), 0.0)
    method = incremental.IncrementalProjective()
    found = method.reconstruct(replace(t, xy=xy), true_pairs(scene), scene.sizes, rng=rng)
    assert found.registered.all()
    # Eleven unknowns of each camera and three of each point take their share of the residuals.
    left = 1.0 - (11 * t.n_views + 3 * t.n_points) / (2 * found.inlier.sum())
    assert found.sigma_px == pytest.approx(0.5 * np.sqrt(left), rel=0.1)
    longer = with_constants(incremental.IncrementalProjective, bundle_iterations=20, final_rounds=6)()
    further = longer.reconstruct(replace(t, xy=xy), true_pairs(scene), scene.sizes, rng=rng)
    moved = (reprojected(further) - reprojected(found))[found.inlier & further.inlier]
    assert np.sqrt(np.mean(moved**2)) < 0.001 * 0.5
    far = wrong & (np.linalg.norm(xy - t.xy, axis=1) > 30.0)
    assert found.inlier[far].mean() < 0.02
    assert found.inlier[~wrong].mean() > 0.9


@pytest.mark.parametrize(
    ("change", "reason"),
    [({"accepted": False}, r"(image|initial) pair"), ({"homography_inlier_ratio": 0.99}, "no parallax")],
)
@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: type(v).__name__)
def test_pairs_without_geometry_or_parallax_are_refused(variant, change, reason):
    scene, rng = make_scene(), np.random.default_rng(0)
    pairs = [replace(p, **change) for p in true_pairs(scene)]
    refuses(StageFailure, reason, variant.reconstruct, scene.tracks, pairs, scene.sizes, rng=rng)


def test_initial_cameras_have_the_fundamental_matrix_they_came_from():
    scene = make_scene()
    pair = true_pairs(scene)[0]
    for sign in (1.0, -1.0):
        P = np.stack(_model.initial_cameras(replace(pair, F=sign * pair.F), scene.sizes[:2]))
        X = triangulate(P, np.stack([pair.xy1, pair.xy2]), method="linear")
        assert (np.sign(X @ P[0, 2]) == np.sign(X @ P[1, 2])).all()
    F = fundamental_from_cameras(*_model.initial_cameras(pair, scene.sizes[:2]))
    np.testing.assert_allclose(F * np.sign(np.sum(F * pair.F)), pair.F, atol=1e-9)


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, 180.0])
@pytest.mark.parametrize("seed", range(4))
def test_initial_cameras_put_infinity_beyond_the_scene_however_the_camera_is_held(roll_deg, seed):
    scene = make_scene(seed=seed, sigma_px=1.0)
    pair = true_pairs(scene)[0]
    # The second photograph held otherwise: turned about the middle of the picture, and F with it.
    turn, middle = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix(), (scene.sizes[1] - 1) / 2.0
    turn[:2, 2] = middle - turn[:2, :2] @ middle
    held = replace(pair, xy2=pair.xy2 @ turn[:2, :2].T + turn[:2, 2], F=np.linalg.inv(turn).T @ pair.F)
    P = np.stack(_model.initial_cameras(held, scene.sizes[:2]))
    X = triangulate(P, np.stack([held.xy1, held.xy2]), method="linear")
    assert abs(np.sign(X[:, 3] * (X @ P[0, 2])).mean()) > 0.97
    # In unit-free pixels the left part is near a rotation.
    T1, T2 = pixel_from_unit(scene.sizes[:2])
    assert np.linalg.cond(np.linalg.inv(T2) @ P[1, :, :3] @ np.linalg.inv(P[0, :, :3]) @ T1) < 3.0


def test_resection_among_wrong_points_and_the_spread_of_the_gate():
    scene, rng = make_scene(), np.random.default_rng(0)
    Xh = homogenize(scene.X)
    Xh /= np.linalg.norm(Xh, axis=1, keepdims=True)
    xy = project(scene.P[1], Xh)
    wrong = np.arange(len(xy)) < 90
    xy[wrong] += rng.uniform(30, 300, (90, 2))
    P, inlier, _ = resect_projective(Xh, xy, threshold_px=2.0, budget=Budget(), rng=rng)
    np.testing.assert_array_equal(inlier, ~wrong)
    np.testing.assert_allclose(project(P, Xh[~wrong]), xy[~wrong], atol=1e-3)
    scene, rng = make_scene(), np.random.default_rng(0)
    X, P = homogenize(scene.X[:20]), scene.P[0] / np.linalg.norm(scene.P[0])
    A = 1e-5 * rng.normal(size=(12, 12)) * np.abs(P).ravel()[:, None]
    draws = P + (rng.normal(size=(20000, 12)) @ A.T).reshape(-1, 3, 4)
    seen = dehomogenize(np.einsum("dab,nb->dna", draws, X))
    measured = np.sqrt(seen.var(axis=0).mean(axis=1))
    np.testing.assert_allclose(incremental._projection_std_px(P, A @ A.T, X), measured, rtol=0.05)


def test_selected_tracks_are_the_longest_of_every_view_and_have_parallax():
    scene = make_scene(points=2000)
    keep = _model.select_tracks(scene.tracks, np.ones(2000, dtype=bool), points_per_view=100)
    seen = np.bincount(scene.tracks.view_index[keep[scene.tracks.point_index]], minlength=8)
    length = np.bincount(scene.tracks.point_index)
    assert seen.min() >= 100
    assert keep.sum() < 800
    assert length[keep].mean() > length.mean()
    scene = make_scene(points=200)
    pairs = [
        replace(p, homography_inlier_ratio=1.0 if (p.i, p.j) == (0, 1) else 0.3) for p in true_pairs(scene)
    ]
    t = scene.tracks
    only = np.bincount(t.point_index[t.view_index >= 2], minlength=200) == 0
    np.testing.assert_array_equal(_model.select_tracks_with_parallax(t, pairs), ~only)
    assert _model.select_tracks_with_parallax(
        t, [replace(p, homography_inlier_ratio=0.3) for p in pairs]
    ).all()


NOISE_PX = 0.3


def observe(scene, R, centres):
    """The scene with cameras added at R, centres (M, 3); each sees three quarters of the points."""
    rng, old = np.random.default_rng(99), scene.tracks
    n, m = old.n_views, len(R)
    new_view, new_point = np.nonzero(rng.random((m, len(scene.X))) < 0.75)
    view, point = np.append(old.view_index, n + new_view), np.append(old.point_index, new_point)
    order = np.lexsort((view, point))
    tracks = Tracks(view[order], point[order], np.zeros((len(view), 2)), n + m, old.n_points)
    K, sizes = np.tile(scene.K[0], (n + m, 1, 1)), np.tile(scene.sizes[0], (n + m, 1))
    both = replace(scene, K=K, sizes=sizes, tracks=tracks)
    both = with_poses(both, np.concatenate([scene.R, R]), np.concatenate([scene.centres, centres]))
    both.tracks.xy[:] += rng.normal(0, NOISE_PX, both.tracks.xy.shape)
    return both


def reconstruct(scene, pairs, seed=0, **changes):
    variant = with_constants(incremental.IncrementalProjective, **changes)()
    return variant.reconstruct(scene.tracks, pairs, scene.sizes, rng=np.random.default_rng(seed))


def homography_like(pair, scene):
    """The pair with F and share as a front end would have them: no F where the centres are one."""
    if np.linalg.norm(scene.centres[pair.i] - scene.centres[pair.j]) > 0.05:
        return pair
    F = np.random.default_rng([pair.i, pair.j]).normal(size=(3, 3))
    return replace(pair, F=F / np.linalg.norm(F), homography_inlier_ratio=1.0)


@pytest.mark.parametrize("kind", ["turns about a standpoint", "almost the same frames"])
def test_views_without_parallax_among_the_views_harm_nothing(kind):
    base, rng = make_scene(points=400, seed=21), np.random.default_rng(3)
    if kind == "almost the same frames":
        R = Rotation.from_rotvec(rng.normal(0, 1e-3, (8, 3))).as_matrix() @ base.R
        scene = observe(base, R, base.centres + rng.normal(0, 2e-3, (8, 3)))
    else:
        turns = Rotation.from_rotvec([[0.05, 0.0, 0.0], [0.0, 0.06, 0.02], [0.0, -0.05, 0.1]]).as_matrix()
        scene = observe(base, turns @ base.R[2], np.tile(base.centres[2], (3, 1)))
    found = reconstruct(scene, [homography_like(pair, scene) for pair in true_pairs(scene)])
    assert found.registered.all(), found.reasons
    assert projective_error(found, scene) < 0.05
    assert residuals(found).max() < 7 * NOISE_PX * 1.01


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_views_of_one_plane_wait_and_the_others_are_as_without_them(seed):
    base = make_scene(points=400, seed=30 + seed)
    flat = base.X[:, 2] < 0.0
    base.X[flat, 2] = -0.75
    t = with_poses(base, base.R, base.centres).tracks
    keep = (t.view_index < 5) | flat[t.point_index]
    xy = t.xy + np.random.default_rng(seed).normal(0, NOISE_PX, t.xy.shape)
    scene = replace(base, tracks=Tracks(t.view_index[keep], t.point_index[keep], xy[keep], 8, 400))
    pairs = [replace(p, homography_inlier_ratio=1.0) if max(p.i, p.j) >= 5 else p for p in true_pairs(scene)]
    found = reconstruct(scene, pairs, seed)
    np.testing.assert_array_equal(found.registered, np.arange(8) < 5)
    assert all("plane" in reason for reason in found.reasons[5:])
    assert projective_error(found, scene) < 0.1
    assert reconstruct(scene, pairs, seed, max_projection_std_rel=None).registered.all()


def test_a_camera_that_wrong_matches_placed_is_discarded_with_its_reason():
    scene = make_scene(points=500, sigma_px=NOISE_PX, seed=5)
    t = scene.tracks
    # View 7 has many wrong matches that agree with a camera elsewhere.
    R, mine = Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix() @ scene.R[7], t.view_index == 7
    xy = t.xy.copy()
    xy[mine] = project_camera(scene.K[7], R, scene.t[7] + 0.8, scene.X[t.point_index[mine]])
    wrong = replace(scene, tracks=replace(t, xy=xy))
    found = reconstruct(wrong, true_pairs(scene))
    np.testing.assert_array_equal(found.registered, np.arange(8) < 7)
    assert "verified matches" in found.reasons[7]
    assert projective_error(found, scene) < 0.05
    assert reconstruct(wrong, true_pairs(scene), min_epipolar_inlier_ratio=0.0).registered.all()


def test_the_view_that_contradicts_its_pairs_is_named():
    scene = make_scene(seed=6)
    pairs, registered = true_pairs(scene), np.ones(8, dtype=bool)
    assert (
        incremental._find_inconsistent_view(scene.P, registered, pairs, threshold_px=1.0, min_ratio=1.0)
        is None
    )
    P = scene.P.copy()
    P[3] = P[3] + 0.05 * np.random.default_rng(0).normal(size=(3, 4)) * np.abs(P[3])
    assert incremental._find_inconsistent_view(P, registered, pairs, threshold_px=1.0, min_ratio=0.5)[0] == 3
    registered[3] = False
    assert incremental._find_inconsistent_view(P, registered, pairs, threshold_px=1.0, min_ratio=1.0) is None


def test_a_beginning_in_a_corner_gives_way_to_one_that_reaches_more():
    big, small = make_scene(views=6, points=300, seed=7), make_scene(views=3, points=900, seed=8)
    t, s = big.tracks, small.tracks
    view, point = np.append(t.view_index, 6 + s.view_index), np.append(t.point_index, 300 + s.point_index)
    tracks = Tracks(view, point, np.concatenate([t.xy, s.xy]), 9, 1200)
    pairs = true_pairs(big) + [replace(p, i=p.i + 6, j=p.j + 6) for p in true_pairs(small)]
    assert _model.rank_initial_pairs(tracks, pairs)[0].i >= 6
    both = replace(big, tracks=tracks, sizes=np.tile(big.sizes[0], (9, 1)))
    assert reconstruct(both, pairs, max_initial_pairs=1).registered.sum() == 3
    found = reconstruct(both, pairs)
    np.testing.assert_array_equal(found.registered, np.arange(9) < 6)
    assert all("shares no points" in reason for reason in found.reasons[6:])


def test_each_attempt_starts_differently_and_neither_planar_nor_with_an_open_f():
    scene = make_scene(views=6)
    ranked = _model.rank_initial_pairs(scene.tracks, true_pairs(scene))
    assert len({(pair.i, pair.j) for pair in ranked}) == 15
    assert sorted(view for pair in ranked[:3] for view in (pair.i, pair.j)) == list(range(6))
    pairs = true_pairs(scene)
    flat = [replace(p, homography_inlier_ratio=1.0 if (p.i, p.j) != (2, 5) else 0.3) for p in pairs]
    opened = [replace(p, degeneracy=DegeneracyReport(determined=(p.i, p.j) == (1, 4))) for p in pairs]
    for doubtful, expected in ((flat, (2, 5)), (opened, (1, 4))):
        best = _model.rank_initial_pairs(scene.tracks, doubtful)[0]
        assert (best.i, best.j) == expected


def test_right_and_wrong_observations_of_a_point_are_separated():
    scene = make_scene(points=200, sigma_px=NOISE_PX, seed=9)
    t, rng = scene.tracks, np.random.default_rng(0)
    length = np.bincount(t.point_index, minlength=200)
    first = np.searchsorted(t.point_index, np.arange(200))
    wrong = np.zeros(len(t.xy), dtype=bool)
    wrong[(first + rng.integers(0, length))[length >= 4]] = True
    off = rng.choice([-1, 1], t.xy.shape) * rng.uniform(60, 400, t.xy.shape)
    tracks = replace(t, xy=t.xy + np.where(wrong[:, None], off, 0))
    model = _model.ProjectiveModel.empty(tracks, scene.sizes, sigma_px=NOISE_PX, noise_floor_px=NOISE_PX)
    model.P, model.registered = scene.P.copy(), np.ones(8, dtype=bool)
    chosen = (length >= 4)[t.point_index]
    agree = _model.consistent_observations(model, chosen, 12 * NOISE_PX)
    _model.retriangulate_points(model, 12.0)
    for kept in (agree, model.inlier):
        assert kept[chosen & ~wrong].mean() > 0.97
        assert not kept[wrong].any()


def test_points_get_the_signs_of_their_cameras_and_far_observations_are_marked():
    scene = make_scene(views=5, points=80, sigma_px=0.0, seed=2)
    t = scene.tracks
    model = _model.ProjectiveModel.empty(t, scene.sizes, sigma_px=0.5, noise_floor_px=0.3)
    rng = np.random.default_rng(4)
    signs = rng.choice([-1.0, 1.0], t.n_points)
    model.P, model.X = scene.P.copy(), signs[:, None] * np.column_stack([scene.X, np.ones(len(scene.X))])
    model.registered[:4] = True
    t.xy[::7] += 10.0
    _model.update_inliers(model, 4.0)
    assert (model.X[:, 3] > 0.0)[np.bincount(t.point_index[t.view_index < 4], minlength=t.n_points) > 0].all()
    near = (np.arange(len(t.xy)) % 7 > 0) & (t.view_index < 4)
    twice = np.bincount(t.point_index[near], minlength=t.n_points) >= 2
    np.testing.assert_array_equal(model.inlier, near & twice[t.point_index])


def test_points_all_over_a_view_count_more_than_a_crowd_in_a_corner():
    t = make_scene(views=3, points=400, sigma_px=0.5, seed=5).tracks
    cell = _model.observation_cells(t)
    assert (cell // 64 == t.view_index).all()
    few = np.flatnonzero(t.view_index == 0)[:100]
    corner = np.flatnonzero(t.view_index == 0)[np.argsort(t.xy[t.view_index == 0].sum(axis=1))[:100]]
    spread = [
        _model.coverage_of_views(cell, np.isin(np.arange(len(t.xy)), k), t.n_views)[0] for k in (few, corner)
    ]
    assert spread[0] > 1.3 * spread[1]

"""Projective reconstruction: initial pair, growth and acceptance tests."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.constants import with_constants
from tests.synthetic import make_scene, true_pairs
from thesisrecon.api.cameras import triangulate
from thesisrecon.camera import project_camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.conditioning import pixel_from_unit
from thesisrecon.optimize.robust_resection import resect_projective
from thesisrecon.projective._model import (
    ProjectiveModel,
    consistent_observations,
    initial_cameras,
    rank_initial_pairs,
    retriangulate_points,
    select_tracks,
    select_tracks_with_parallax,
)
from thesisrecon.projective.factorization import Factorization
from thesisrecon.projective.incremental import (
    IncrementalProjective,
    SequentialProjective,
    _find_inconsistent_view,
    _projection_std_px,
)
from thesisrecon.records import DegeneracyReport, Tracks

VARIANTS = [IncrementalProjective(), SequentialProjective(), Factorization()]


def residuals(found):
    t, k = found.tracks, found.inlier
    xh = np.einsum("kab,kb->ka", found.P[t.view_index[k]], found.X[t.point_index[k]])
    return np.linalg.norm(xh[:, :2] / xh[:, 2:] - t.xy[k], axis=1)


def projective_error(found, scene):
    """Largest distance (scene units) of the points from the truth after the best projective alignment."""
    valid = found.valid
    X, Y = found.X[valid], np.column_stack([scene.X[valid], np.ones(valid.sum())])
    rows = []
    for a in range(3):
        row = np.zeros((len(X), 4, 4))
        row[:, a] = X
        row[:, 3] = -Y[:, a : a + 1] * X
        rows.append(row.reshape(len(X), 16))
    H = np.linalg.svd(np.concatenate(rows))[2][-1].reshape(4, 4)
    Z = X @ H.T
    return float(np.abs(Z[:, :3] / Z[:, 3:] - scene.X[valid]).max())


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
    t = scene.tracks
    rng = np.random.default_rng(5)
    wrong = rng.random(len(t.xy)) < 0.05
    xy = t.xy + np.where(wrong[:, None], rng.uniform(-200, 200, t.xy.shape), 0.0)
    spoiled = replace(scene, tracks=replace(t, xy=xy))
    found = IncrementalProjective().reconstruct(spoiled.tracks, true_pairs(scene), scene.sizes, rng=rng)
    assert found.registered.all()
    assert found.sigma_px == pytest.approx(0.5, rel=0.25)
    far = wrong & (np.linalg.norm(xy - t.xy, axis=1) > 30.0)
    assert found.inlier[far].mean() < 0.02
    assert found.inlier[~wrong].mean() > 0.9


@pytest.mark.parametrize(
    ("change", "reason"),
    [({"accepted": False}, r"(image|initial) pair"), ({"homography_inlier_ratio": 0.99}, "no parallax")],
)
@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: type(v).__name__)
def test_pairs_without_geometry_or_parallax_are_refused(variant, change, reason):
    scene = make_scene()
    pairs = [replace(p, **change) for p in true_pairs(scene)]
    with pytest.raises(StageFailure, match=reason):
        variant.reconstruct(scene.tracks, pairs, scene.sizes, rng=np.random.default_rng(0))


def test_initial_cameras_have_the_fundamental_matrix_they_came_from():
    scene = make_scene()
    pair = true_pairs(scene)[0]
    for sign in (1.0, -1.0):
        P = np.stack(initial_cameras(replace(pair, F=sign * pair.F), scene.sizes[:2]))
        X = triangulate(P, np.stack([pair.xy1, pair.xy2]), method="linear")
        assert (np.sign(X @ P[0, 2]) == np.sign(X @ P[1, 2])).all()
    P1, P2 = initial_cameras(pair, scene.sizes[:2])
    M = P2[:, :3] @ np.linalg.inv(P1[:, :3])
    e = P2[:, 3] - M @ P1[:, 3]
    cross = np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])
    F = cross @ M
    F /= np.linalg.norm(F) * np.sign(np.sum(F * pair.F))
    np.testing.assert_allclose(F, pair.F, atol=1e-9)
    # In unit-free pixels the left part is near a rotation.
    T1, T2 = pixel_from_unit(scene.sizes[:2])
    assert np.linalg.cond(np.linalg.inv(T2) @ M @ T1) < 3.0


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, 180.0])
@pytest.mark.parametrize("seed", range(4))
def test_initial_cameras_put_infinity_beyond_the_scene_however_the_camera_is_held(roll_deg, seed):
    scene = make_scene(seed=seed, sigma_px=1.0)
    roll = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    pair = true_pairs(scene)[0]
    # The second photograph held otherwise: turned about the middle of the picture, and F with it.
    middle = (scene.sizes[1] - 1) / 2.0
    turn = np.eye(3)
    turn[:2, :2], turn[:2, 2] = roll[:2, :2], middle - roll[:2, :2] @ middle
    held = replace(pair, xy2=pair.xy2 @ turn[:2, :2].T + turn[:2, 2], F=np.linalg.inv(turn).T @ pair.F)
    P = np.stack(initial_cameras(held, scene.sizes[:2]))
    X = triangulate(P, np.stack([held.xy1, held.xy2]), method="linear")
    beyond = np.sign(X[:, 3] * (X @ P[0, 2]))
    assert abs(beyond.mean()) > 0.97
    T1, T2 = pixel_from_unit(scene.sizes[:2])
    assert np.linalg.cond(np.linalg.inv(T2) @ P[1, :, :3] @ np.linalg.inv(P[0, :, :3]) @ T1) < 3.0


def test_robust_resection_finds_the_camera_among_wrong_points():
    scene = make_scene()
    rng = np.random.default_rng(0)
    Xh = np.column_stack([scene.X, np.ones(len(scene.X))])
    Xh /= np.linalg.norm(Xh, axis=1, keepdims=True)
    xy = project(scene.P[1], Xh)
    wrong = np.arange(len(xy)) < 90
    xy[wrong] += rng.uniform(30, 300, (90, 2))
    P, inlier = resect_projective(Xh, xy, threshold_px=2.0, rng=rng)
    assert P is not None
    np.testing.assert_array_equal(inlier, ~wrong)
    np.testing.assert_allclose(project(P, Xh[~wrong]), xy[~wrong], atol=1e-3)


def test_spread_of_the_gate_is_the_spread_of_perturbed_cameras():
    scene = make_scene()
    rng = np.random.default_rng(0)
    X = np.column_stack([scene.X[:20], np.ones(20)])
    P = scene.P[0] / np.linalg.norm(scene.P[0])
    A = 1e-5 * rng.normal(size=(12, 12)) * np.abs(P).ravel()[:, None]
    draws = P + (rng.normal(size=(20000, 12)) @ A.T).reshape(-1, 3, 4)
    xh = np.einsum("dab,nb->dna", draws, X)
    measured = np.sqrt((xh[..., :2] / xh[..., 2:]).var(axis=0).mean(axis=1))
    np.testing.assert_allclose(_projection_std_px(P, A @ A.T, X), measured, rtol=0.05)


def test_selection_keeps_the_longest_tracks_of_every_view():
    scene = make_scene(points=2000)
    keep = select_tracks(scene.tracks, np.ones(2000, dtype=bool), points_per_view=100)
    seen = np.bincount(scene.tracks.view_index[keep[scene.tracks.point_index]], minlength=8)
    length = np.bincount(scene.tracks.point_index)
    assert seen.min() >= 100
    assert keep.sum() < 800
    assert length[keep].mean() > length.mean()


def test_points_of_one_standpoint_do_not_take_part():
    scene = make_scene(points=200)
    pairs = [
        replace(p, homography_inlier_ratio=1.0 if (p.i, p.j) == (0, 1) else 0.3) for p in true_pairs(scene)
    ]
    t = scene.tracks
    only = np.bincount(t.point_index[t.view_index >= 2], minlength=200) == 0
    np.testing.assert_array_equal(select_tracks_with_parallax(t, pairs), ~only)
    assert select_tracks_with_parallax(t, [replace(p, homography_inlier_ratio=0.3) for p in pairs]).all()


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
        scene, K=np.concatenate([scene.K, np.tile(scene.K[0], (m, 1, 1))]), R=np.concatenate([scene.R, R]),
        t=np.concatenate([scene.t, t]), sizes=np.tile(scene.sizes[0], (n + m, 1)),
        tracks=Tracks(view[order], point[order], xy[order], n + m, old.n_points),
    )  # fmt: skip


def reconstruct(scene, pairs, seed=0, **changes):
    variant = with_constants(IncrementalProjective, **changes)()
    return variant.reconstruct(scene.tracks, pairs, scene.sizes, rng=np.random.default_rng(seed))


def homography_like(pair, scene):
    """The pair with F and share as a front end would have them: no F where the centres are one."""
    apart = np.linalg.norm(scene.centres[pair.i] - scene.centres[pair.j])
    if apart > 0.05:
        return pair
    rng = np.random.default_rng([pair.i, pair.j])
    F = rng.normal(size=(3, 3))
    return replace(pair, F=F / np.linalg.norm(F), homography_inlier_ratio=1.0)


@pytest.mark.parametrize("kind", ["turns about a standpoint", "almost the same frames"])
def test_views_without_parallax_among_the_views_harm_nothing(kind):
    base = make_scene(points=400, sigma_px=NOISE_PX, seed=21)
    rng = np.random.default_rng(3)
    if kind == "almost the same frames":
        R = Rotation.from_rotvec(rng.normal(0, 1e-3, (8, 3))).as_matrix() @ base.R
        centres = base.centres + rng.normal(0, 2e-3, (8, 3))
    else:
        turns = Rotation.from_rotvec([[0.05, 0.0, 0.0], [0.0, 0.06, 0.02], [0.0, -0.05, 0.1]]).as_matrix()
        R, centres = turns @ base.R[2], np.tile(base.centres[2], (3, 1))
    scene = observe(base, R, -np.einsum("vab,vb->va", R, centres))
    found = reconstruct(scene, [homography_like(pair, scene) for pair in true_pairs(scene)])
    assert found.registered.all(), found.reasons
    assert projective_error(found, scene) < 0.05
    assert residuals(found).max() < 7 * NOISE_PX * 1.01


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
    # View 7 has many wrong matches that agree with a camera elsewhere.
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
    assert _find_inconsistent_view(scene.P, registered, pairs, threshold_px=1.0, min_ratio=1.0) is None
    P = scene.P.copy()
    P[3] = P[3] + 0.05 * np.random.default_rng(0).normal(size=(3, 4)) * np.abs(P[3])
    found = _find_inconsistent_view(P, registered, pairs, threshold_px=1.0, min_ratio=0.5)
    assert found is not None
    assert found[0] == 3
    registered[3] = False
    assert _find_inconsistent_view(P, registered, pairs, threshold_px=1.0, min_ratio=1.0) is None


def test_a_beginning_in_a_corner_gives_way_to_one_that_reaches_more():
    big, small = make_scene(views=6, points=300, seed=7), make_scene(views=3, points=900, seed=8)
    t, s = big.tracks, small.tracks
    tracks = Tracks(
        np.concatenate([t.view_index, 6 + s.view_index]),
        np.concatenate([t.point_index, 300 + s.point_index]), np.concatenate([t.xy, s.xy]), 9, 1200,
    )  # fmt: skip
    pairs = true_pairs(big) + [replace(p, i=p.i + 6, j=p.j + 6) for p in true_pairs(small)]
    assert rank_initial_pairs(tracks, pairs)[0].i >= 6
    both = replace(big, tracks=tracks, sizes=np.tile(big.sizes[0], (9, 1)))
    assert reconstruct(both, pairs, max_initial_pairs=1).registered.sum() == 3
    found = reconstruct(both, pairs)
    np.testing.assert_array_equal(found.registered, np.arange(9) < 6)
    assert all("shares no points" in reason for reason in found.reasons[6:])


def test_each_attempt_starts_differently_and_the_last_ends_the_search():
    scene = make_scene(views=6)
    ranked = rank_initial_pairs(scene.tracks, true_pairs(scene))
    assert len({(pair.i, pair.j) for pair in ranked}) == 15
    first = [view for pair in ranked[:3] for view in (pair.i, pair.j)]
    assert sorted(first) == list(range(6))


def test_a_planar_pair_and_one_whose_f_is_open_are_not_the_first_choice():
    pairs = true_pairs(make_scene())
    flat = [replace(p, homography_inlier_ratio=1.0 if (p.i, p.j) != (2, 5) else 0.3) for p in pairs]
    opened = [replace(p, degeneracy=DegeneracyReport(determined=(p.i, p.j) == (1, 4))) for p in pairs]
    for doubtful, expected in ((flat, (2, 5)), (opened, (1, 4))):
        best = rank_initial_pairs(make_scene().tracks, doubtful)[0]
        assert (best.i, best.j) == expected


def test_right_and_wrong_observations_of_a_point_are_separated():
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

"""Metric refinement, the completion of a metric model, and that it ends at a minimum."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import thesisrecon
from tests.conftest import refuses
from tests.metric.metric_stage import centre_error, refine, run, with_few_points
from tests.synthetic import TrueScene, make_scene, projective_reconstruction, with_poses
from thesisrecon.camera import project_camera
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.metric import refinement
from thesisrecon.metric._model import normalized_observations
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.metric.world import centres_of, constrained, placed
from thesisrecon.optimize.bundle.projection import MetricCameras
from thesisrecon.records import Tracks
from thesisrecon.selfcalibration.quadric import HypothesesAndRefinement


def test_scenes_come_back_with_their_lens_and_principal_point():
    scene = make_scene(principal_shift=(9.0, -6.0), k1=0.03, points=400)
    result = run(scene)
    assert result.trusted
    r = result.reconstruction
    assert r.stratum == "metric"
    # The prior of the principal point and of k1 pulls a little, hence not to rounding.
    np.testing.assert_allclose(r.K[:, 0, 0], 1500.0, rtol=1e-3)
    np.testing.assert_allclose(r.K[:, :2, 2] - scene.K[:, :2, 2], 0.0, atol=1.0)
    np.testing.assert_allclose(r.distortion[:, 0], 0.03, atol=1e-3)
    assert centre_error(result, scene) < 1e-3
    scene = make_scene(sigma_px=0.2, points=500, principal_shift=(120.0, -80.0), seed=3)
    K = refine(scene, cameras="shared").reconstruction.K
    np.testing.assert_allclose(K[:, :2, 2] - scene.K[:, :2, 2], 0.0, atol=3.0)
    np.testing.assert_allclose(K[:, 0, 0], 1500.0, rtol=5e-3)


@pytest.mark.parametrize("seed", [1, 2])
def test_intervals_of_the_intrinsics_contain_a_decentred_lens(seed):
    """Within noise that is not independent, the shift by a decentred lens leaves no residual of its own."""
    scene = make_scene(sigma_px=0.1, seed=seed, points=600)
    t, K = scene.tracks, scene.K[scene.tracks.view_index]
    x, y = ((t.xy - K[:, :2, 2]) / K[:, 0, :1]).T
    # The points of an image share a smooth field of errors.
    wave = np.random.default_rng(seed).normal(size=(8, 2, 2))
    field = 0.3 * np.sin(np.einsum("kab,kb->ka", wave[t.view_index], t.xy / 150.0))
    decentred = t.xy + 1.5 * (-1) ** seed * np.stack([3.0 * x**2 + y**2, 2.0 * x * y], axis=1)
    result = refine(replace(scene, tracks=replace(t, xy=decentred + field)))
    truth = {"focal_px": 1500.0, "principal_x_px": scene.K[0, 0, 2], "principal_y_px": scene.K[0, 1, 2]}
    intervals = result.intrinsics[0]
    # Without the decentring in the intervals up to 4.4.
    assert max(abs(intervals[n].value - v) / intervals[n].std for n, v in truth.items()) < 2.5


@pytest.mark.parametrize("shared", [True, False])
def test_noisy_scene_is_right_within_its_own_intervals(shared):
    scene = make_scene(sigma_px=0.5, points=500, zoom=0.0 if shared else 0.3, seed=3)
    result = run(scene, shared=shared)
    assert result.trusted, result.failed_checks
    for view, intervals in enumerate(result.intrinsics):
        focal = intervals["focal_px"]
        assert 0 < focal.std < 0.05 * focal.value
        assert abs(focal.value - scene.K[view, 0, 0]) < 4 * focal.std
        # Zoomed photographs keep their own focals.
        assert "shrunk" not in focal.source
    assert result.reconstruction.sigma_px == pytest.approx(0.5, rel=0.3)
    assert centre_error(result, scene) < 0.01


def test_a_postponed_camera_joins_by_calibrated_resection():
    scene = make_scene(sigma_px=0.3, points=400, seed=4)
    start, registered = projective_reconstruction(scene), np.arange(8) != 5
    inlier = start.inlier & registered[scene.tracks.view_index]
    reasons = tuple("waits" if v == 5 else "" for v in range(8))
    start = replace(start, registered=registered, inlier=inlier, reasons=reasons)
    result = run(scene, reconstruction=start)
    assert result.reconstruction.registered.all()
    assert result.reconstruction.reasons == ("",) * 8
    assert centre_error(result, scene) < 0.01


@pytest.mark.parametrize("kind", ["projective", "elsewhere"])
def test_a_wrong_camera_of_the_projective_stage_is_caught_and_resected(kind):
    scene = make_scene(sigma_px=0.3, points=400, seed=5)
    start = projective_reconstruction(scene)
    P = start.P.copy()
    if kind == "projective":
        P[6] = P[6] @ (np.eye(4) + 0.5 * np.random.default_rng(1).normal(size=(4, 4)))
        result = run(scene, reconstruction=replace(start, P=P))
    else:
        # A camera that is metric but elsewhere: the upgrade cannot tell, its matches can.
        P[6] = P[5]
        result = refine(scene, cameras="shared", start=replace(start, P=P))
    assert result.reconstruction.registered.all()
    assert centre_error(result, scene) < 0.01


def test_a_view_without_points_keeps_its_reason():
    lonely = with_few_points(make_scene(points=300, seed=6), 7, 0)
    start, registered = projective_reconstruction(lonely), np.arange(8) != 7
    P = np.where(registered[:, None, None], start.P, 0.0)
    reasons = ("",) * 7 + ("too little overlap with the others",)
    start = replace(start, registered=registered, reasons=reasons, P=P)
    result = run(lonely, reconstruction=start)
    assert not result.reconstruction.registered[7]
    assert result.reconstruction.reasons[7]
    assert result.intrinsics[7] == {}


def test_a_fixed_principal_point_is_reported_as_assumed_and_a_known_calibration_stays():
    scene = make_scene(sigma_px=0.3, seed=7)
    result = run(scene, options=IntrinsicsOptions(principal_point="known", k1="known"))
    interval = result.intrinsics[0]["principal_x_px"]
    assert interval.value == pytest.approx((1536 - 1) / 2)
    assert interval.source == "assumed"
    known = dict.fromkeys(("focal", "principal_point", "k1"), "known")
    options = IntrinsicsOptions(**known, focal_px=1500.0, principal_point_px=tuple(scene.K[0, :2, 2]))
    result = run(scene, options=options)
    assert result.trusted, result.failed_checks
    np.testing.assert_array_equal(result.reconstruction.K[:, 0, 0], 1500.0)
    assert result.intrinsics[0]["focal_px"].std == 0.0
    assert centre_error(result, scene) < 2e-3
    result = run(scene, options=IntrinsicsOptions(focal="known", focal_px=1500.0))
    np.testing.assert_array_equal(result.reconstruction.K[:, 0, 0], 1500.0)


def test_a_lens_of_three_coefficients_is_found_and_the_focal_with_it():
    distortion, scene = np.array([-0.03, 0.02, -0.02]), make_scene(points=500, seed=2)
    bent = with_poses(replace(scene, k1=distortion), scene.R, scene.centres)
    intrinsics, t = np.array([[1500.0, 1.0, 0.0, *scene.K[0, :2, 2], *distortion]]), bent.tracks
    cameras = MetricCameras(scene.R, scene.t, intrinsics, np.zeros(t.n_views, np.int64))
    straight = np.einsum("kab,kb->ka", scene.R[t.view_index], scene.X[t.point_index]) + scene.t[t.view_index]
    normalized = normalized_observations(cameras, t.view_index, t.xy)
    np.testing.assert_allclose(normalized, straight[:, :2] / straight[:, 2:], atol=1e-9)
    noise = 0.05 * np.random.default_rng(0).normal(size=scene.tracks.xy.shape)
    result = refine(replace(bent, tracks=replace(bent.tracks, xy=bent.tracks.xy + noise)), cameras="shared")
    r = np.linspace(0.1, 0.6, 20)
    powers = np.stack([r**2, r**4, r**6])
    np.testing.assert_allclose(result.reconstruction.distortion[0] @ powers, distortion @ powers, atol=1e-3)
    focal = result.intrinsics[0]["focal_px"]
    assert abs(focal.value - 1500.0) < 4.0 * focal.std < 6.0


def test_a_photograph_of_other_points_is_refused_with_its_share():
    scene = make_scene(sigma_px=0.3, points=500, seed=4)
    t, rng = scene.tracks, np.random.default_rng(5)
    # Two thirds of one view's matches are wrong: whatever its camera, most of them disagree.
    mine = np.flatnonzero(t.view_index == 6)
    wrong = rng.choice(mine, 2 * len(mine) // 3, replace=False)
    t.xy[wrong] = rng.uniform([0.0, 0.0], [1536.0, 1024.0], (len(wrong), 2))
    start = projective_reconstruction(scene)
    start = replace(start, inlier=start.inlier & ~np.isin(np.arange(len(t.xy)), wrong))
    result = refine(scene, cameras="shared", start=start)
    assert (result.reconstruction.registered == (np.arange(8) != 6)).all()
    assert "matches agreed" in result.reconstruction.reasons[6]
    assert not result.intrinsics[6]


def test_a_candidate_without_inliers_leaves_the_others_whole(monkeypatch):
    scene = make_scene(sigma_px=0.3, points=300, seed=4)
    start = projective_reconstruction(scene)
    prior = prior_for(start, IntrinsicsOptions())
    calibration = HypothesesAndRefinement().calibrate(start, prior=prior, rng=np.random.default_rng(0))
    best = calibration.candidates[0]
    upgraded = refinement._model.upgraded_model

    def broken(reconstruction, upgrade, *given):
        model = upgraded(reconstruction, upgrade, *given)
        return replace(model, X=np.zeros_like(model.X)) if upgrade.method == "broken" else model

    def refined(candidates, prior):
        given = replace(calibration, candidates=candidates)
        return MetricRefinement().refine(start, given, prior=prior, rng=np.random.default_rng(0))

    monkeypatch.setattr(refinement._model, "upgraded_model", broken)
    bad = replace(best, method="broken")
    found = refined((bad, best), prior)
    assert found.trusted
    assert centre_error(found, scene) < 0.01
    refuses(StageFailure, "no candidate calibration gives a metric model", refined, (bad,), prior)
    for options, advice in (
        ({"focal": "known"}, "leave it out."), ({"focal_std_rel": 0.05}, "larger focal_std_rel"),
    ):  # fmt: skip
        prior = prior_for(start, IntrinsicsOptions(focal_px=1500.0, **options))
        with pytest.raises(StageFailure, match="contradict the given focal length") as failed:
            refined((bad,), prior)
        assert advice in f"{failed.value}.".lower()


SIZE, FOCAL, K1 = (1000, 750), 850.0, -0.12


def strips(seed, *, rows=3, columns=7, points=700, noise=0.3, relief=1.5):
    """A scene of fields from cameras 80 m above them that look down, there and back."""
    rng = np.random.default_rng(seed)
    X = np.c_[rng.uniform(-90, 90, points), rng.uniform(-55, 55, points), rng.normal(0, relief, points)]
    K = np.array([[FOCAL, 0.0, 506.0], [0.0, FOCAL, 369.0], [0.0, 0.0, 1.0]])
    n = rows * columns
    R, t, xy = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, points, 2))
    for v in range(n):
        row, column = divmod(v, columns)
        down = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("z", np.pi * (row % 2)).as_matrix()
        R[v] = Rotation.from_rotvec(rng.normal(0.0, np.radians(1.5), 3)).as_matrix() @ down
        t[v] = -R[v] @ [20.0 * (column - (columns - 1) / 2), 22.0 * (row - (rows - 1) / 2), 80.0]
        xy[v] = project_camera(K, R[v], t[v], X, distortion=K1)
    xy += rng.normal(0.0, noise, xy.shape)
    inside = (xy > 0.0).all(axis=2) & (xy < np.array(SIZE) - 1.0).all(axis=2)
    inside &= inside.sum(axis=0) >= 2
    point, view = np.nonzero(inside.T)
    tracks = Tracks(view, point, xy[view, point], n, points)
    return TrueScene(np.tile(K, (n, 1, 1)), R, t, X, K1, tracks, np.tile(SIZE, (n, 1)))


@pytest.mark.parametrize("seed", [3, 4])
def test_focal_length_of_strips_is_right_and_another_adjustment_keeps_it(seed):
    scene = strips(seed)
    result = thesisrecon.reconstruct_from_tracks(scene.tracks, scene.sizes)
    assert result.metric.trusted, result.metric.failed_checks
    assert result.metric.self_check["sigmas_to_minimum"] < 0.1
    camera = next(iter(result.cameras.values()))
    focal, std = camera.K[0, 0], camera.std["focal_px"]
    assert abs(focal - FOCAL) < 3.0 * std
    free = ("focal", "principal_point", "k1", "k2", "k3")
    again = thesisrecon.bundle_adjust(result.reconstruction, free=free, prior={"k2": 0.02, "k3": 0.02})
    assert again.converged
    assert abs(again.cameras[0].K[0, 0] - focal) < 0.3 * std


def dome(reconstruction, X, length):
    """Height of the middle of a flat block over its ends after the best similarity, over its length."""
    there = reconstruction.valid
    found = reconstruction.X[there, :3] / reconstruction.X[there, 3:]
    off = estimate_similarity(found, X[there]).apply(found)[:, 2] - X[there, 2]
    x, y = (X[there, :2] / (0.5 * length)).T
    basis = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    return float(np.linalg.lstsq(basis, off, rcond=None)[0][3]) / length


@pytest.mark.parametrize("seed", [3, 4])
def test_known_positions_bound_the_doming_of_a_flat_block_and_leave_out_wrong_ones(seed):
    scene, rng = strips(seed, noise=1.0), np.random.default_rng(seed)
    prior = prior_for(projective_reconstruction(scene))
    prior = replace(prior, shared=np.zeros_like(prior.shared), kind=np.zeros_like(prior.kind))
    free = thesisrecon.reconstruct_from_tracks(scene.tracks, scene.sizes).metric
    centres = -np.einsum("vba,vb->va", scene.R, scene.t)
    positions = centres + rng.normal(0.0, 0.02, centres.shape)
    positions[4], positions[7] = [1e4, 0.0, 0.0], np.nan
    alone = placed(free, positions)
    given = {"refiner": MetricRefinement(), "prior": prior, "rng": np.random.default_rng(0)}
    found = constrained(alone, positions, 0.02, **given)
    assert not found.used[[4, 7]].any()
    assert found.used.sum() == len(centres) - 2
    X = scene.X[np.unique(scene.tracks.point_index)]
    before, after = (dome(one.result.reconstruction, X, 120.0) for one in (alone, found))
    assert abs(after) < 5e-4
    assert abs(after) < 0.5 * abs(before)
    off = (centres_of(found.result.reconstruction) - centres)[found.used]
    assert np.sqrt(np.mean(off**2)) < 0.03


def random_scene(seed):
    """Strips, or a cloud of points with shared or own intrinsics; wrong pixels in every third scene."""
    rng = np.random.default_rng(seed)
    if seed % 4 == 0:
        scene = strips(seed, rows=2, columns=6, points=500, relief=rng.uniform(1.0, 10.0))
    else:
        scene = make_scene(
            views=int(rng.integers(4, 11)), points=int(rng.integers(150, 400)), seed=seed,
            sigma_px=rng.uniform(0.05, 1.0), zoom=0.2 * (seed % 4 == 1), k1=rng.uniform(-0.1, 0.1),
        )  # fmt: skip
    xy = scene.tracks.xy.copy()
    wrong = rng.random(len(xy)) < 0.05 * (seed % 3 == 0)
    xy[wrong] += rng.normal(0.0, 20.0, (wrong.sum(), 2))
    return replace(scene, tracks=replace(scene.tracks, xy=xy)), seed % 4 != 1


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 200, 20))
def test_results_of_200_random_scenes_are_minima(first):
    solved = 0
    for seed in range(first, first + 20):
        scene, shared = random_scene(seed)
        try:
            result = run(scene, shared=shared)
        except StageFailure:
            continue
        solved += 1
        assert result.self_check["sigmas_to_minimum"] < 0.1, seed
    assert solved > 15

"""Metric refinement and the completion of a metric model."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.test_population import refine
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.camera import project_camera
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.metric import refinement
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.optimize.robust_resection import resect_calibrated
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement


def run(scene, *, shared=True, reconstruction=None, options=None):
    start = projective_reconstruction(scene) if reconstruction is None else reconstruction
    prior = prior_for(start, options or IntrinsicsOptions(cameras="shared" if shared else "per-image"))
    rng = np.random.default_rng(0)
    calibration = HypothesesAndRefinement().calibrate(start, prior=prior, rng=rng)
    return MetricRefinement().refine(start, calibration, prior=prior, rng=rng)


def centre_error(result, scene):
    """Mean camera-centre error after similarity alignment, in units of the cameras' mutual distance."""
    views = result.reconstruction.registered
    C = camera_centre(result.reconstruction.P[views])
    C = C[:, :3] / C[:, 3:]
    moved = estimate_similarity(C, scene.centres[views]).apply(C)
    spread = np.linalg.norm(scene.centres - scene.centres.mean(axis=0), axis=1).mean()
    return float(np.linalg.norm(moved - scene.centres[views], axis=1).mean() / spread)


def test_noise_free_scene_comes_back_with_its_lens():
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


@pytest.mark.parametrize("shared", [True, False])
def test_noisy_scene_is_right_within_its_own_intervals(shared):
    scene = make_scene(sigma_px=0.5, points=500, zoom=0.0 if shared else 0.3, seed=3)
    result = run(scene, shared=shared)
    assert result.trusted, result.failed_checks
    for view, intervals in enumerate(result.intrinsics):
        focal = intervals["focal_px"]
        assert 0 < focal.std < 0.05 * focal.value
        assert abs(focal.value - scene.K[view, 0, 0]) < 4 * focal.std
    assert result.reconstruction.sigma_px == pytest.approx(0.5, rel=0.3)
    assert centre_error(result, scene) < 0.01


def test_a_postponed_camera_joins_by_calibrated_resection():
    scene = make_scene(sigma_px=0.3, points=400, seed=4)
    start = projective_reconstruction(scene)
    registered = np.ones(8, dtype=bool)
    registered[5] = False
    inlier = start.inlier & registered[scene.tracks.view_index]
    reasons = tuple("waits" if v == 5 else "" for v in range(8))
    start = replace(start, registered=registered, inlier=inlier, reasons=reasons)
    result = run(scene, reconstruction=start)
    assert result.reconstruction.registered.all()
    assert result.reconstruction.reasons == ("",) * 8
    assert centre_error(result, scene) < 0.01


def test_a_wrong_camera_of_the_projective_stage_is_caught_and_resected():
    scene = make_scene(sigma_px=0.3, points=400, seed=5)
    start = projective_reconstruction(scene)
    P = start.P.copy()
    P[6] = P[6] @ (np.eye(4) + 0.5 * np.random.default_rng(1).normal(size=(4, 4)))
    result = run(scene, reconstruction=replace(start, P=P))
    assert result.reconstruction.registered.all()
    assert centre_error(result, scene) < 0.01


def test_a_view_without_points_keeps_its_reason():
    scene = make_scene(points=300, seed=6)
    t = scene.tracks
    keep = t.view_index != 7
    tracks = replace(t, view_index=t.view_index[keep], point_index=t.point_index[keep], xy=t.xy[keep])
    lonely = replace(scene, tracks=tracks)
    start = projective_reconstruction(lonely)
    registered = np.arange(8) != 7
    reasons = ("",) * 7 + ("too little overlap with the others",)
    start = replace(
        start, registered=registered, reasons=reasons, P=np.where(registered[:, None, None], start.P, 0.0)
    )
    result = run(lonely, reconstruction=start)
    assert not result.reconstruction.registered[7]
    assert result.reconstruction.reasons[7]
    assert result.intrinsics[7] == {}


def test_a_fixed_principal_point_is_reported_as_assumed():
    scene = make_scene(sigma_px=0.3, seed=7)
    result = run(scene, options=IntrinsicsOptions(principal_point="known", k1="known"))
    interval = result.intrinsics[0]["principal_x_px"]
    assert interval.value == pytest.approx((1536 - 1) / 2)
    assert interval.source == "assumed"


def test_a_known_calibration_stays_and_gives_cameras_and_points():
    scene = make_scene(sigma_px=0.3, seed=7)
    known = dict.fromkeys(("focal", "principal_point", "k1"), "known")
    options = IntrinsicsOptions(**known, focal_px=1500.0, principal_point_px=tuple(scene.K[0, :2, 2]))
    result = run(scene, options=options)
    assert result.trusted, result.failed_checks
    np.testing.assert_array_equal(result.reconstruction.K[:, 0, 0], 1500.0)
    assert result.intrinsics[0]["focal_px"].std == 0.0
    assert centre_error(result, scene) < 2e-3


def test_calibrated_resection_survives_half_wrong_points():
    scene = make_scene()
    rng = np.random.default_rng(0)
    Y = scene.X @ scene.R[0].T + scene.t[0]
    xy = Y[:, :2] / Y[:, 2:]
    wrong = np.arange(len(xy)) % 2 == 0
    xy[wrong] += rng.uniform(0.1, 0.4, (int(wrong.sum()), 2))
    pose, inliers = resect_calibrated(scene.X, xy, threshold=1e-3, rng=rng)
    np.testing.assert_allclose(pose[:, :3], scene.R[0], atol=1e-6)
    np.testing.assert_allclose(pose[:, 3], scene.t[0], atol=1e-5)
    np.testing.assert_array_equal(inliers, ~wrong)


def test_a_lens_of_three_coefficients_is_found_and_the_focal_with_it():
    scene = make_scene(points=500, seed=2)
    distortion, t = np.array([-0.03, 0.02, -0.02]), scene.tracks
    xy = np.empty_like(t.xy)
    for v in range(t.n_views):
        mine = t.view_index == v
        X = scene.X[t.point_index[mine]]
        xy[mine] = project_camera(scene.K[v], scene.R[v], scene.t[v], X, distortion=distortion)
    xy += 0.05 * np.random.default_rng(0).normal(size=xy.shape)
    result = refine(replace(scene, tracks=replace(t, xy=xy)), cameras="shared")
    r = np.linspace(0.1, 0.6, 20)
    powers = np.stack([r**2, r**4, r**6])
    np.testing.assert_allclose(result.reconstruction.distortion[0] @ powers, distortion @ powers, atol=1e-3)
    focal = result.intrinsics[0]["focal_px"]
    assert abs(focal.value - 1500.0) < 4.0 * focal.std < 6.0


def test_a_principal_point_far_off_the_middle_is_found():
    scene = make_scene(sigma_px=0.2, points=500, principal_shift=(120.0, -80.0), seed=3)
    K = refine(scene, cameras="shared").reconstruction.K
    np.testing.assert_allclose(K[:, :2, 2] - scene.K[:, :2, 2], 0.0, atol=3.0)
    np.testing.assert_allclose(K[:, 0, 0], 1500.0, rtol=5e-3)


def test_a_photograph_of_other_points_is_refused_with_its_share():
    scene = make_scene(sigma_px=0.3, points=500, seed=4)
    t, rng = scene.tracks, np.random.default_rng(5)
    # Two thirds of one view's matches are wrong: whatever its camera, most of them disagree.
    mine = np.flatnonzero(t.view_index == 6)
    wrong = rng.choice(mine, 2 * len(mine) // 3, replace=False)
    xy = t.xy.copy()
    xy[wrong] = rng.uniform([0.0, 0.0], [1536.0, 1024.0], (len(wrong), 2))
    spoiled = replace(scene, tracks=replace(t, xy=xy))
    start = projective_reconstruction(spoiled)
    inlier = start.inlier.copy()
    inlier[wrong] = False
    result = refine(spoiled, cameras="shared", start=replace(start, inlier=inlier))
    assert not result.reconstruction.registered[6]
    assert "matches agreed" in result.reconstruction.reasons[6]
    assert result.reconstruction.registered.sum() == 7
    assert not result.intrinsics[6]


def test_a_camera_made_wrong_is_sought_again():
    scene = make_scene(sigma_px=0.3, points=500, seed=5)
    start = projective_reconstruction(scene)
    # A camera that is metric but elsewhere: the upgrade cannot tell, its matches can.
    P = start.P.copy()
    P[6] = P[5]
    result = refine(scene, cameras="shared", start=replace(start, P=P))
    assert result.reconstruction.registered.all()
    C = -np.einsum("vba,vb->va", *_poses(result.reconstruction))
    truth = scene.centres
    ratio = np.linalg.norm(C[6] - C[0]) / np.linalg.norm(C[1] - C[0])
    assert abs(ratio / (np.linalg.norm(truth[6] - truth[0]) / np.linalg.norm(truth[1] - truth[0])) - 1) < 0.01


def _poses(reconstruction):
    pose = np.linalg.solve(reconstruction.K, reconstruction.P)
    return pose[:, :, :3], pose[:, :, 3]


def test_a_candidate_without_inliers_leaves_the_others_whole(monkeypatch):
    scene = make_scene(sigma_px=0.3, points=300, seed=4)
    start = projective_reconstruction(scene)
    prior = prior_for(start, IntrinsicsOptions())
    calibration = HypothesesAndRefinement().calibrate(start, prior=prior, rng=np.random.default_rng(0))
    best = calibration.candidates[0]
    upgraded = refinement.upgraded_model

    def broken(reconstruction, upgrade, *given):
        model = upgraded(reconstruction, upgrade, *given)
        return replace(model, X=np.zeros_like(model.X)) if upgrade.method == "broken" else model

    monkeypatch.setattr(refinement, "upgraded_model", broken)
    both = replace(calibration, candidates=(replace(best, method="broken"), best))
    found = MetricRefinement().refine(start, both, prior=prior, rng=np.random.default_rng(0))
    assert found.trusted
    assert centre_error(found, scene) < 0.01
    only = replace(calibration, candidates=both.candidates[:1])
    with pytest.raises(StageFailure, match="no candidate calibration gives a metric model"):
        MetricRefinement().refine(start, only, prior=prior, rng=np.random.default_rng(0))
    for known, advice in (
        (IntrinsicsOptions(focal="known", focal_px=1500.0), "Leave it out."),
        (IntrinsicsOptions(focal_px=1500.0, focal_std_rel=0.05), "larger focal_std_rel"),
    ):
        prior = prior_for(start, known)
        with pytest.raises(StageFailure, match="contradict the given focal length") as failed:
            MetricRefinement().refine(start, only, prior=prior, rng=np.random.default_rng(0))
        assert advice.lower() in f"{failed.value}.".lower()

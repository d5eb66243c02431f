"""Lenses beyond one coefficient, cropped photographs, and cameras that the rest contradicts."""

from dataclasses import replace

import numpy as np

from tests.metric.test_population import true_calibration
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.geometry.camera_matrix import project_camera
from thesisrecon.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.metric.refinement import MetricRefinement


def refine(scene, *, start=None, cameras="shared"):
    start = projective_reconstruction(scene) if start is None else start
    wish = IntrinsicsOptions(cameras="per-image" if cameras == "per-image" else "shared")
    rng = np.random.default_rng(0)
    prior = prior_for(start, wish)
    return MetricRefinement().refine(start, true_calibration(scene), prior=prior, rng=rng)


def test_a_lens_of_three_coefficients_is_found_and_the_focal_with_it():
    scene = make_scene(points=500, seed=2)
    distortion, t = np.array([-0.03, 0.02, -0.02]), scene.tracks
    xy = np.empty_like(t.xy)
    for v in range(t.n_views):
        mine = t.view_index == v
        X = scene.X[t.point_index[mine]]
        xy[mine] = project_camera(scene.K[v], scene.R[v], scene.t[v], X, distortion=distortion)
    xy += 0.05 * np.random.default_rng(0).normal(size=xy.shape)
    result = refine(replace(scene, tracks=replace(t, xy=xy)))
    r = np.linspace(0.1, 0.6, 20)
    powers = np.stack([r**2, r**4, r**6])
    assert result.reconstruction.distortion is not None
    np.testing.assert_allclose(result.reconstruction.distortion[0] @ powers, distortion @ powers, atol=1e-3)
    focal = result.intrinsics[0]["focal_px"]
    assert abs(focal.value - 1500.0) < 4.0 * focal.std < 6.0


def test_a_principal_point_far_off_the_middle_is_found():
    scene = make_scene(sigma_px=0.2, points=500, principal_shift=(120.0, -80.0), seed=3)
    K = refine(scene).reconstruction.K
    assert K is not None
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
    result = refine(spoiled, start=replace(start, inlier=inlier))
    assert not result.reconstruction.registered[6]
    assert "matches agree" in result.reconstruction.reasons[6]
    assert result.reconstruction.registered.sum() == 7
    assert not result.intrinsics[6]


def test_a_camera_made_wrong_is_sought_again():
    scene = make_scene(sigma_px=0.3, points=500, seed=5)
    start = projective_reconstruction(scene)
    # A camera that is metric but elsewhere: the upgrade cannot tell, its matches can.
    P = start.P.copy()
    P[6] = P[5]
    result = refine(scene, start=replace(start, P=P))
    assert result.reconstruction.registered.all()
    C = -np.einsum("vba,vb->va", *_poses(result.reconstruction))
    truth = scene.centres
    ratio = np.linalg.norm(C[6] - C[0]) / np.linalg.norm(C[1] - C[0])
    assert abs(ratio / (np.linalg.norm(truth[6] - truth[0]) / np.linalg.norm(truth[1] - truth[0])) - 1) < 0.01


def _poses(reconstruction):
    assert reconstruction.K is not None
    pose = np.linalg.solve(reconstruction.K, reconstruction.P)
    return pose[:, :, :3], pose[:, :, 3]

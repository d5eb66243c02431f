"""Two images of known focal length have cameras; of unknown focal length they have none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon import StageFailure
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.pipeline.large_sets import calibrate_with_core
from thesisrecon.selfcalibration.quadric import HypothesesAndRefinement

KNOWN = IntrinsicsOptions(focal="known", focal_px=1500.0)
GUESSED = IntrinsicsOptions(focal_px=1480.0, focal_std_rel=0.02)


def calibrate(start, prior):
    rng = np.random.default_rng(0)
    return calibrate_with_core(HypothesesAndRefinement(), start, prior=prior, rng=rng)


@pytest.mark.parametrize("seed", range(4))
def test_exact_views_have_the_exact_relative_pose(seed):
    scene = make_scene(views=2, seed=seed)
    start = projective_reconstruction(scene, seed=seed)
    found = calibrate(start, prior_for(start, KNOWN))
    np.testing.assert_allclose(found.K[:, 0, 0], 1500.0)
    cameras = start.P @ np.linalg.inv(found.metric_from_projective)
    M = np.linalg.solve(scene.K, cameras)
    M /= np.cbrt(np.linalg.det(M[:, :, :3]))[:, None, None]
    np.testing.assert_allclose(M[1, :, :3] @ M[0, :, :3].T, scene.R[1] @ scene.R[0].T, atol=1e-9)
    baseline = M[1, :, 3] - M[1, :, :3] @ M[0, :, :3].T @ M[0, :, 3]
    true = scene.t[1] - scene.R[1] @ scene.R[0].T @ scene.t[0]
    np.testing.assert_allclose(baseline / np.linalg.norm(baseline), true / np.linalg.norm(true), atol=1e-9)


@pytest.mark.parametrize("options", [KNOWN, GUESSED], ids=["known", "guessed"])
@pytest.mark.parametrize("seed", range(3))
def test_refined_cameras_are_inside_their_intervals(options, seed):
    scene = make_scene(views=2, sigma_px=0.5, seed=seed)
    start = projective_reconstruction(scene, seed=seed)
    prior = prior_for(start, options)
    found = MetricRefinement().refine(
        start, calibrate(start, prior), prior=prior, rng=np.random.default_rng(0)
    )
    assert found.trusted or options is GUESSED
    assert abs(found.intrinsics[0]["focal_px"].value - 1500.0) <= 3.0 * found.intrinsics[0]["focal_px"].std
    K, P = found.reconstruction.K, found.reconstruction.P
    M = np.linalg.solve(K, P)[:, :, :3]
    M /= np.cbrt(np.linalg.det(M))[:, None, None]
    off = (M[1] @ M[0].T) @ (scene.R[1] @ scene.R[0].T).T
    angle = np.linalg.norm(Rotation.from_matrix(off).as_rotvec())
    std = np.linalg.norm(found.pose_std[:, :3])
    assert angle < 4.0 * std
    assert std < 0.05 or options is GUESSED


def test_two_views_of_unknown_focal_length_are_refused_with_what_helps():
    start = projective_reconstruction(make_scene(views=2))
    with pytest.raises(StageFailure, match=r"at least 3 registered images; 2 were registered.*focal length"):
        calibrate(start, prior_for(start))

"""Self-calibration on exact and noisy scenes, shared and varying focals, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic import make_scene, projective_reconstruction, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.selfcalibration._candidates import (
    _biased_focal,
    _no_candidate_failure,
    plane_from_focals,
)
from thesisrecon.selfcalibration._frame import normalized_frame
from thesisrecon.selfcalibration._refinement import RotationCriterion
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from thesisrecon.selfcalibration.quadric import quadric_hypotheses
from thesisrecon.selfcalibration.stratified import Stratified

METHODS = [HypothesesAndRefinement(), Stratified()]


def calibrate(method, scene, *, shared=True, seed=0):
    reconstruction = projective_reconstruction(scene, seed=seed)
    prior = prior_for(reconstruction, IntrinsicsOptions(cameras="shared" if shared else "per-image"))
    return method.calibrate(reconstruction, prior=prior, rng=np.random.default_rng(seed))


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("zoom", [0.0, 0.3])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exact_cameras_give_the_exact_focal(method, zoom, seed):
    scene = make_scene(zoom=zoom, seed=seed)
    answer = calibrate(method, scene, shared=zoom == 0.0, seed=seed)
    # The weak pull on the focal moves exact data by far less than any noise would.
    np.testing.assert_allclose(answer.K[:, 0, 0], scene.K[:, 0, 0], rtol=2e-3)
    assert answer.identifiable


def test_the_upgrade_makes_every_camera_a_scaled_rotation():
    scene = make_scene(seed=4)
    reconstruction = projective_reconstruction(scene, seed=4)
    answer = calibrate(HypothesesAndRefinement(), scene, seed=4)
    P = reconstruction.P @ np.linalg.inv(answer.metric_from_projective)
    C = np.linalg.inv(answer.K) @ P[:, :, :3]
    CC = C @ C.swapaxes(1, 2)
    CC /= np.trace(CC, axis1=1, axis2=2)[:, None, None] / 3.0
    np.testing.assert_allclose(CC, np.tile(np.eye(3), (len(C), 1, 1)), atol=5e-3)


def test_points_end_in_front_of_the_cameras():
    scene = make_scene(seed=5)
    reconstruction = projective_reconstruction(scene, seed=5)
    G = calibrate(HypothesesAndRefinement(), scene, seed=5).metric_from_projective
    P = reconstruction.P @ np.linalg.inv(G)
    P *= np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
    X = reconstruction.X @ G.T
    t = scene.tracks
    depth = np.einsum("kj,kj->k", P[t.view_index, 2], X[t.point_index]) / X[t.point_index, 3]
    assert (depth > 0).all()


def test_each_closed_form_contains_the_truth():
    scene = make_scene(seed=6)
    reconstruction = projective_reconstruction(scene, seed=6)
    frame = normalized_frame(reconstruction, prior_for(reconstruction))
    f = scene.K[0, 0, 0] / 1536.0
    criterion = RotationCriterion(focal_weight=0.0)
    planes, focals = quadric_hypotheses(frame, np.array([f]))
    assert focals[0] == pytest.approx(f, rel=1e-6)
    log_f = np.full((1, 1), np.log(f))
    assert criterion.cost(frame, planes, log_f)[0] < 1e-12
    other = 0 if frame.reference != 0 else 1
    both_signs = plane_from_focals(frame, other, np.array([f]), np.array([f]))
    assert criterion.cost(frame, both_signs, np.repeat(log_f, 2, axis=0)).min() < 1e-12


def test_pure_translation_is_unidentifiable_and_a_prior_pulls_its_focal():
    scene = make_scene(seed=7)
    still = with_poses(scene, np.tile(scene.R[0], (8, 1, 1)), scene.centres)
    answer = calibrate(HypothesesAndRefinement(), still)
    assert not answer.identifiable
    assert any("translation" in reason for reason in answer.reasons)
    reconstruction = projective_reconstruction(still)
    prior = prior_for(reconstruction, IntrinsicsOptions(focal_px=1500.0, focal_std_rel=0.01))
    pulled = HypothesesAndRefinement().calibrate(reconstruction, prior=prior, rng=np.random.default_rng(0))
    np.testing.assert_allclose(pulled.K[:, 0, 0], 1500.0, rtol=0.1)


def test_a_focal_without_a_solution_is_named_and_not_requested():
    scene = make_scene(seed=3)
    reconstruction = projective_reconstruction(scene)
    prior = prior_for(reconstruction, IntrinsicsOptions(focal_px=1.0, focal_std_rel=0.05))
    with pytest.raises(StageFailure) as failure:
        HypothesesAndRefinement().calibrate(reconstruction, prior=prior, rng=np.random.default_rng(0))
    assert "near the given focal length" in str(failure.value)
    assert "1 px (+- 5.0%)" in failure.value.evidence
    assert "the images contradict it" in failure.value.advice
    assert "give the focal length" not in str(failure.value)


@pytest.mark.parametrize(
    ("focal", "words"),
    [((499.4, 499.8), "499 px"), ((500.0, 500.8), "500 to 501 px"), ((700.0, 500.0), "500 to 700 px")],
)
def test_a_failure_near_given_focal_lengths_states_them(focal, words):
    scene = make_scene(views=4)
    given = projective_reconstruction(scene)
    options = IntrinsicsOptions(cameras="per-image", focal_px=500.0, focal_std_rel=0.02)
    frame = normalized_frame(given, prior_for(given, options))
    mean = frame.prior.mean.copy()
    mean[:, 0] = [*focal, *focal]
    frame = replace(frame, prior=replace(frame.prior, mean=mean))
    failure = _no_candidate_failure(frame, given, 40)
    assert str(failure.reason).endswith("near the given focal length")
    assert failure.evidence.startswith(f"{words} (+- 2.0%) at working size was given")


def test_a_focal_length_off_that_of_bundle_adjustment_is_reported():
    scene = make_scene(views=5)
    found = calibrate(METHODS[0], scene)
    given = projective_reconstruction(scene)
    frame, best = normalized_frame(given, prior_for(given, IntrinsicsOptions())), found.candidates[0]
    assert _biased_focal(frame, best, found.identifiability) == ()
    for factor, words in ((1.2, "+20%"), (0.8, "-20%")):
        (sentence,) = _biased_focal(
            frame, replace(best, K=best.K * [[[factor], [factor], [1.0]]]), found.identifiability
        )
        assert (
            f"the focal length of this method is {words} from that of bundle adjustment, 1500 px" in sentence
        )

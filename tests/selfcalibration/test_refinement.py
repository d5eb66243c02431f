"""The criteria and their unknowns: properties that hold for all cameras, and loosely known intrinsics."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.selfcalibration.test_direct_methods import adjusted, at_distance, prior_for, reprojected
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.optimize.noise import soft_l1
from thesisrecon.selfcalibration import _refinement
from thesisrecon.selfcalibration._candidates import Candidate, distinct_candidates, square_pixel_calibrations
from thesisrecon.selfcalibration._frame import normalized_frame, solver_unknowns
from thesisrecon.selfcalibration._refinement import (
    RotationCriterion,
    dual_image_residuals,
    minimize_batch,
    refine_hypotheses,
)
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from thesisrecon.selfcalibration.kruppa import _overlapping_pairs, _pair_residuals, _plane_for_focals

FREE = RotationCriterion(focal_weight=0.0)


@settings(max_examples=25, derandomize=True, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_all_criteria_vanish_at_the_truth_in_every_frame(seed):
    scene = make_scene(views=4, points=40, seed=seed % 30)
    given = projective_reconstruction(scene, seed=seed)
    frame = normalized_frame(given, prior_for(scene))
    log_f = np.log(scene.K[:1, 0, 0] / 1536.0)
    plane, cost = _plane_for_focals(frame, FREE, log_f)
    assert cost < 1e-20
    K = square_pixel_calibrations(np.full((1, 4), log_f[0]))
    residuals = dual_image_residuals(frame, K, plane[None])
    assert np.abs(residuals).max() < 1e-9
    pairs = _overlapping_pairs(frame, given, 8)
    assert len(pairs.i) == 6
    assert np.abs(_pair_residuals(pairs, K)).max() < 1e-7


@settings(max_examples=15, derandomize=True, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_refinement_never_raises_the_cost(seed):
    rng = np.random.default_rng(seed)
    scene = make_scene(views=5, points=40, zoom=0.2, seed=seed % 30)
    frame = normalized_frame(projective_reconstruction(scene, seed=seed), prior_for(scene, shared=False))
    theta = rng.normal(size=(6, 8))
    before = FREE.cost(frame, theta[:, :3], theta[:, 3:])
    refined, after = refine_hypotheses(FREE, frame, theta)
    assert (after <= before).all()
    np.testing.assert_allclose(FREE.cost(frame, refined[:, :3], refined[:, 3:]), after)


def test_the_std_of_the_focals_is_that_of_the_normal_equations():
    scene = make_scene(views=5, seed=1)
    frame = normalized_frame(projective_reconstruction(scene, seed=1), prior_for(scene))
    theta = np.array([0.3, -0.2, 0.1, 0.0])
    r, J = (part[0] for part in FREE._linearized(frame, theta[None]))
    variance = r @ r / (5 * 5 - 4) * np.linalg.inv(J.T @ J)[3, 3]
    assert _refinement.focal_std(FREE, frame, theta) == pytest.approx(np.sqrt(variance), rel=1e-6)


def test_planes_alone_leave_the_focals():
    scene = make_scene(views=5, seed=1)
    frame = normalized_frame(projective_reconstruction(scene, seed=1), prior_for(scene))
    theta = np.random.default_rng(1).normal(size=(3, 4))
    refined, _ = refine_hypotheses(FREE, frame, theta, planes_only=True)
    np.testing.assert_array_equal(refined[:, 3:], theta[:, 3:])


def test_unknowns_are_the_free_intrinsics():
    scene = make_scene(views=4, seed=2)
    rec = projective_reconstruction(scene, seed=2)
    constant = solver_unknowns(normalized_frame(rec, prior_for(scene)), prior_for(scene))
    assert len(constant.std) == 1
    assert constant.focals.tolist() == [0]
    free = prior_for(scene, shared=False, stds=(0.1, np.inf, 30.0))
    several = solver_unknowns(normalized_frame(rec, free), free)
    assert len(several.std) == 4 + 4
    assert several.focals.tolist() == [0, 1, 2, 3]
    start = several.from_log_focals(np.log(np.tile([1.0, 1.1, 1.2, 1.3], (1, 1))))
    np.testing.assert_allclose(several.calibrations(start)[0, :, 0, 0], [1.0, 1.1, 1.2, 1.3])
    assert several.std[several.index[0, 3]] == pytest.approx(30.0 / 1536.0)
    known = prior_for(scene)
    known.mean[:, 0], known.std[:, 0] = 1500.0, 0.0
    fixed = solver_unknowns(normalized_frame(rec, known), known)
    np.testing.assert_allclose(fixed.calibrations(np.zeros((1, 0)))[0, :, 0, 0], 1500.0 / 1536.0)


def test_a_known_focal_counts_for_its_own_camera_only():
    scene = make_scene(views=6, zoom=0.3, sigma_px=0.5, seed=3)
    reported = prior_for(scene, shared=False)
    reported.mean[:2, 0], reported.std[:2, 0] = scene.K[:2, 0, 0], 0.001
    answer = HypothesesAndRefinement().calibrate(
        adjusted(scene, 3), prior=reported, rng=np.random.default_rng(0)
    )
    np.testing.assert_allclose(answer.K[:2, 0, 0], scene.K[:2, 0, 0], rtol=5e-3)
    np.testing.assert_allclose(answer.K[2:, 0, 0], scene.K[2:, 0, 0], rtol=3e-2)


def test_crops_with_a_principal_point_far_off_are_calibrated_when_it_is_left_open():
    scene = make_scene(views=9, zoom=0.3, seed=4)
    K = scene.K.copy()
    K[:, :2, 2] += np.random.default_rng(4).uniform(-150.0, 150.0, (9, 2))
    scene = replace(scene, K=K)
    scene = replace(scene, tracks=reprojected(scene))
    own = prior_for(scene, shared=False, stds=(0.0, 0.0, 150.0))
    own.shared[:, 3:5] = np.arange(9)[:, None]
    answer = HypothesesAndRefinement().calibrate(
        projective_reconstruction(scene, seed=4), prior=own, rng=np.random.default_rng(0)
    )
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-4, atol=0.5)


@pytest.mark.parametrize("focal", [350.0, 20_000.0])
def test_the_range_of_lenses_is_wider_than_any_maker_s(focal):
    scene = at_distance(make_scene(seed=5), focal)
    answer = HypothesesAndRefinement().calibrate(
        projective_reconstruction(scene, seed=5), prior=prior_for(scene), rng=np.random.default_rng(0)
    )
    np.testing.assert_allclose(answer.K[:, 0, 0], focal, rtol=2e-2)


def test_candidates_are_distinguished_by_focals_or_plane():
    scene = make_scene(views=4, points=40, seed=6)
    frame = normalized_frame(projective_reconstruction(scene, seed=6), prior_for(scene))
    K, plane = square_pixel_calibrations(np.zeros(4)), np.array([0.1, 0.2, 0.3])
    answers = [
        Candidate(plane, K, 2.0, "a"),
        Candidate(1.001 * plane, K, 1.0, "b"),
        Candidate(-plane, K, 3.0, "c"),
    ]
    assert [a.method for a in distinct_candidates(frame, answers, 9)] == ["b", "c"]
    assert [a.method for a in distinct_candidates(frame, answers, 1)] == ["b"]


def test_the_minimum_with_a_robust_loss_is_that_of_the_loss():
    data, width = np.array([-3.0, -0.1, 0.0, 0.2, 0.3, 5.0, 9.0]), 0.3
    x, cost = minimize_batch(lambda x: x - data, np.array([[0.7], [-2.0]]), iterations=200, loss_scale=width)
    grid = np.linspace(-1.0, 1.0, 200_001)
    losses = np.mean([soft_l1((grid - d) ** 2, width)[0] for d in data], axis=0)
    np.testing.assert_allclose(x[:, 0], grid[losses.argmin()], atol=2e-5)
    np.testing.assert_allclose(cost, losses.min(), rtol=1e-9)

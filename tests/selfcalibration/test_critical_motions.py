"""Critical motions, the counting argument, verdicts in words, and self-calibration by hypotheses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.constants import with_constants
from tests.synthetic import make_scene, projective_reconstruction, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.optimize.bundle.identifiability import (
    MAX_FOCAL_STD,
    MIN_INFINITY_SHIFT,
    MIN_ROTATION_SIGNIFICANCE,
    UpgradedCameras,
    _infinite_homography_shift,
    _planarity_ratio,
    excess_equations,
    identifiability_sentences,
    measure_motion,
    nearest_critical_motion,
    projective_infinity_shifts,
)
from thesisrecon.records import Tracks, Upgrade
from thesisrecon.selfcalibration import _refinement, _upgrade
from thesisrecon.selfcalibration._frame import normalized_frame
from thesisrecon.selfcalibration._refinement import rotation_cost
from thesisrecon.selfcalibration.quadric import HypothesesAndRefinement, quadric_hypotheses
from validation.scenes.critical import Motion, make_sequence, projective_estimate

CRITICAL = [motion for motion in Motion if motion is not Motion.GENERAL]


def true_cameras(scene):
    return UpgradedCameras(scene.K[:, 0, 0] / scene.sizes.max(axis=1), scene.R, scene.C, scene.X)


def report_at_the_truth(scene, cameras="shared"):
    """The verdict when self-calibration found the true answer."""
    rng = np.random.default_rng(0)
    estimate = projective_estimate(scene, rng)
    prior = prior_for(estimate, IntrinsicsOptions(cameras=cameras))
    method = with_constants(HypothesesAndRefinement, camera_subsets=0, focal_steps=17)(search=None)
    return method.calibrate(estimate, prior=prior, rng=rng).identifiability


@pytest.mark.parametrize("by_hand", [False, True], ids=["exact", "by hand"])
@pytest.mark.parametrize("motion", CRITICAL, ids=lambda m: m.value)
def test_a_critical_motion_is_named(motion, by_hand):
    for seed in range(5):
        scene = make_sequence(motion, np.random.default_rng(seed), by_hand=by_hand)
        name, nearness = nearest_critical_motion(measure_motion(true_cameras(scene)))
        assert nearness < 1.0
        alike = {Motion.TURNTABLE.value, Motion.PLANAR.value}
        assert name == motion.value or {name, motion.value} == alike
        assert by_hand or nearness < 1e-3


def test_small_motions_have_the_name_of_the_nearer_one_and_general_ones_are_far_from_all():
    scene = make_sequence(Motion.TRANSLATION, np.random.default_rng(2))
    far = scene.X + 60.0 * scene.R[0, 2] * np.linalg.norm(scene.C.std(axis=0))
    cameras = replace(true_cameras(scene), X=far)
    assert measure_motion(cameras)["centre_spread_over_distance"] < 0.03
    assert nearest_critical_motion(measure_motion(cameras))[0] == "pure translation"
    turns = Rotation.from_rotvec(np.radians(np.random.default_rng(3).normal(0.0, 2.0, (len(scene.R), 3))))
    turned = replace(cameras, R=turns.as_matrix() @ cameras.R, C=1e-3 * cameras.C)
    assert nearest_critical_motion(measure_motion(turned))[0] == "pure rotation"
    for seed in range(20):
        scene = make_sequence(Motion.GENERAL, np.random.default_rng(seed))
        assert nearest_critical_motion(measure_motion(true_cameras(scene)))[1] > 2.0
    rng = np.random.default_rng(0)
    wall = rng.uniform(-1.0, 1.0, (300, 3)) * [1.0, 1.0, 0.005]
    wall[:5] += 30.0 * rng.normal(size=(5, 3))
    assert _planarity_ratio(wall) < 0.01
    assert _planarity_ratio(rng.uniform(-1.0, 1.0, (300, 3))) > 0.5


@pytest.mark.parametrize("motion", [Motion.TRANSLATION, Motion.OPTICAL_AXIS])
def test_cameras_without_tilt_are_detected_at_any_focal(motion):
    scene = make_sequence(motion, np.random.default_rng(3), zoom=0.3)
    cameras = true_cameras(scene)
    for factor in (0.3, 1.0, 4.0):
        H = replace(cameras, focal=factor * cameras.focal).infinite_homographies()
        assert _infinite_homography_shift(H, roll=True) < 1e-9
    assert (_infinite_homography_shift(H, roll=False) < 1e-9) == (motion is Motion.TRANSLATION)


def test_missing_tilt_is_detected_from_projective_cameras():
    scene = make_scene(seed=2)
    still = with_poses(scene, np.tile(scene.R[0], (8, 1, 1)), scene.centres)
    for some, small in ((still, True), (scene, False)):
        estimate = projective_reconstruction(some, seed=2)
        frame = normalized_frame(estimate, prior_for(estimate))
        assert (projective_infinity_shifts(frame.A, frame.a)["infinity_shift"] < 1e-9) == small
        identifiability = _upgrade.identifiability_without_calibration(estimate, prior_for(estimate))
        assert not identifiability.identifiable
        assert (identifiability.motion == "pure translation") == small
        assert any("pure translation" in sentence for sentence in identifiability.sentences) == small


@pytest.mark.parametrize(
    ("known", "views", "spare"),
    [
        # m n_known + (m - 1) n_constant - 8 (methods 2.0)
        (IntrinsicsOptions(), 8, 8 * 4 + 7 - 8),
        (IntrinsicsOptions(cameras="per-image"), 8, 8 * 4 - 8),
        (IntrinsicsOptions(principal_point_std_rel=None), 8, 8 * 2 + 7 * 3 - 8),
        (IntrinsicsOptions(cameras="per-image", principal_point_std_rel=None), 3, 3 * 2 - 8),
        (IntrinsicsOptions(aspect="constant", skew="constant", principal_point_std_rel=None), 3, 2 * 5 - 8),
    ],
)
def test_the_counting_argument(known, views, spare):
    estimate = projective_reconstruction(make_scene(views=8))
    registered = np.arange(8) < views
    assert excess_equations(prior_for(estimate, known), registered) == spare


def test_missing_equations_are_reported_with_their_number():
    estimate = projective_reconstruction(make_scene(views=3))
    unknown = IntrinsicsOptions(cameras="per-image", principal_point_std_rel=None)
    sentences = _upgrade.identifiability_without_calibration(estimate, prior_for(estimate, unknown)).sentences
    assert any("2 equations are missing" in sentence for sentence in sentences)


def test_square_pixels_resolve_a_turntable_but_no_pure_roll():
    identifiability = report_at_the_truth(make_sequence(Motion.TURNTABLE, np.random.default_rng(4)))
    assert identifiability.identifiable
    assert identifiability.critical
    assert identifiability.motion == "turntable"
    evidence = identifiability.evidence
    assert evidence["focal_std_rel_free"] > 3.0 * evidence["focal_std_rel_median"]
    assert any("turntable" in sentence for sentence in identifiability.sentences)
    assert any("square pixels" in sentence for sentence in identifiability.sentences)
    for cameras in ("shared", "per-image"):
        scene = make_sequence(Motion.OPTICAL_AXIS, np.random.default_rng(5))
        identifiability = report_at_the_truth(scene, cameras)
        assert not identifiability.identifiable
        assert identifiability.motion == "rotation about the optical axis"
        assert any("point the camera in different directions" in s for s in identifiability.sentences)


def test_a_rotation_within_lens_model_error_determines_no_focal():
    """Turned by less than a tenth of a degree, thousands of points: as rectified photographs seem to be."""
    scene, rng = make_sequence(Motion.TRANSLATION, np.random.default_rng(0)), np.random.default_rng(1)
    turns = Rotation.from_rotvec(np.radians(rng.normal(0.0, 0.07, (len(scene.R), 3)))).as_matrix()
    scene = replace(scene, R=turns @ scene.R, X=rng.uniform(-0.6, 0.6, (9000, 3)), sigma_px=0.05)
    view, point = np.divmod(np.arange(len(scene.R) * len(scene.X)), len(scene.X))
    x = np.einsum("kij,kj->ki", scene.P[view], homogenize(scene.X)[point])
    xy = dehomogenize(x) + scene.sigma_px * rng.standard_normal((len(view), 2))
    tracks = Tracks(view, point, xy, len(scene.R), len(scene.X))
    identifiability = report_at_the_truth(replace(scene, tracks=tracks))
    evidence = identifiability.evidence
    assert evidence["rotation_significance"] > MIN_ROTATION_SIGNIFICANCE
    assert evidence["focal_std_rel"] < MAX_FOCAL_STD
    assert evidence["infinity_shift_beyond_roll"] < MIN_INFINITY_SHIFT
    assert not identifiability.identifiable
    assert any("errors of a lens model" in sentence for sentence in identifiability.sentences)


def test_a_general_motion_needs_no_words_and_large_residuals_are_not_identifiable():
    identifiability = report_at_the_truth(make_sequence(Motion.GENERAL, np.random.default_rng(6)))
    assert 1e-4 < identifiability.evidence["principal_point_std_free"] < 0.2
    assert identifiability.identifiable
    assert not identifiability.critical
    assert identifiability.sentences == ()
    assert identifiability.undetermined == ()
    scene = make_sequence(Motion.GENERAL, np.random.default_rng(7))
    estimate = projective_estimate(scene, np.random.default_rng(0))
    prior = prior_for(estimate)
    G = np.eye(4)
    G[3, :3] = np.linalg.svd(estimate.X[estimate.valid])[2][3][:3]
    identifiability = _upgrade.check_identifiability(estimate, Upgrade(G, scene.K, 0.0, "made up"), prior)
    assert not identifiability.identifiable
    assert identifiability.sentences


def metric_frame(estimate, scene):
    """The projective transform that takes the estimate to the true cameras: rows of P T = lambda P_true."""
    registered = np.flatnonzero(estimate.registered)
    rows = []
    for place, v in enumerate(registered):
        scale = np.zeros((12, len(registered)))
        scale[:, place] = -scene.P[v].ravel() / np.linalg.norm(scene.P[v])
        rows.append(np.hstack([np.kron(estimate.P[v] / np.linalg.norm(estimate.P[v]), np.eye(4)), scale]))
    return np.linalg.inv(np.linalg.svd(np.vstack(rows))[2][-1][:16].reshape(4, 4))


def test_noise_is_compared_with_the_projective_residual_not_a_floor():
    """Zoomed photographs that are said to have one focal length, and each its own."""
    scene = make_sequence(Motion.GENERAL, np.random.default_rng(8), zoom=0.15)
    t = scene.tracks
    exact = dehomogenize(np.einsum("kij,kj->ki", scene.P[t.view_index], homogenize(scene.X)[t.point_index]))
    scene = replace(scene, tracks=replace(t, xy=exact + 0.1 * (t.xy - exact)))
    # The floor of the stage that makes projective cameras, whatever their residuals are.
    estimate = replace(projective_estimate(scene, np.random.default_rng(0)), sigma_px=0.3)
    upgrade = Upgrade(metric_frame(estimate, scene), scene.K, 0.0, "truth")
    shared, own = (
        _upgrade.check_identifiability(estimate, upgrade, prior_for(estimate, IntrinsicsOptions(cameras=how)))
        for how in ("shared", "per-image")
    )
    assert shared.evidence["noise_ratio_to_projective"] > 3.0
    assert not shared.identifiable
    assert any("zoomed" in sentence for sentence in shared.sentences)
    assert not any("rotate the camera" in sentence or "px" in sentence for sentence in shared.sentences)
    assert own.evidence["noise_ratio_to_projective"] < 1.3
    assert own.identifiable


@pytest.mark.parametrize(
    ("given", "advice"),
    [
        (IntrinsicsOptions(), ", or give the focal length"),
        (IntrinsicsOptions(focal_px=900.0, focal_std_rel=0.5), ", or give the focal length more exactly"),
        (IntrinsicsOptions(focal_px=900.0, focal="known"), " about the vertical and a horizontal axis"),
    ],
)
def test_advice_never_asks_for_a_given_focal_length(given, advice):
    scene = make_sequence(Motion.TRANSLATION, np.random.default_rng(5))
    estimate = projective_estimate(scene, np.random.default_rng(0))
    sentences = _upgrade.identifiability_without_calibration(estimate, prior_for(estimate, given)).sentences
    assert next(s for s in sentences if "rotate the camera" in s).endswith(advice)


def test_each_reason_begins_at_its_limit():
    scene = make_sequence(Motion.GENERAL, np.random.default_rng(6))
    evidence = measure_motion(true_cameras(scene)) | {
        "excess_equations": 0.0, "critical_motion_distance": 1.0, "focal_std_rel": 0.2,
        "focal_std_rel_median": 0.1, "focal_std_rel_free": 0.21, "noise_ratio_to_projective": 2.99,
        "rotation_significance": MIN_ROTATION_SIGNIFICANCE, "infinity_shift_beyond_roll": MIN_INFINITY_SHIFT,
    }  # fmt: skip

    def codes(motion="", *, identifiable=False, **changed):
        said = {"identifiable": identifiable, "focal_std": np.inf}
        found = identifiability_sentences(motion, evidence | changed, **said)
        return [getattr(sentence, "code", "advice") for sentence in found]

    turned, shifted = 0.999 * MIN_ROTATION_SIGNIFICANCE, 0.999 * MIN_INFINITY_SHIFT
    assert codes() == ["advice"]
    assert codes(identifiable=True) == []
    assert codes(excess_equations=-1.0) == ["too-few-equations", "advice"]
    assert codes(noise_ratio_to_projective=3.0) == ["excess-noise"]
    assert codes(rotation_significance=turned, infinity_shift_beyond_roll=0.0) == ["rotations-within-noise"]
    assert codes(infinity_shift_beyond_roll=shifted) == ["small-rotations"]
    for small in ({}, {"rotation_significance": 0.0}, {"infinity_shift_beyond_roll": 0.0}):
        assert codes(focal_std_rel_median=MAX_FOCAL_STD, **small) == ["uncertain-focal"]
    assert codes("turntable") == ["advice"]
    near = {"identifiable": True, "critical_motion_distance": 0.999}
    assert codes("turntable", **near) == ["turntable", "resolved-by-square-pixels"]
    assert codes("turntable", **near, focal_std_rel_free=0.2) == ["turntable", "resolved-by-departure"]
    assert codes("planar scene", **near) == ["planar-scene", "resolved-by-prior"]
    assert codes("pure translation", **near) == ["pure-translation", "resolved-by-departure"]


def test_virtual_points_lie_where_optical_axes_meet_and_are_seen_exactly():
    scene = make_scene(seed=2)
    given = projective_reconstruction(scene)
    H = metric_frame(given, scene)
    found = _upgrade._with_virtual_points(given, Upgrade(H, scene.K, 0.0, "truth"))
    X, t, axes, C = dehomogenize(found.X @ H.T), found.tracks, scene.R[:, 2], scene.centres
    # The point of least squared distances from the axes, and a cube about it.
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    middle = np.linalg.lstsq(across.reshape(-1, 3), (across @ C[:, :, None]).ravel(), rcond=None)[0]
    half = 0.3 * np.median(np.linalg.norm(C - middle, axis=1))
    np.testing.assert_allclose((X.min(axis=0) + X.max(axis=0)) / 2.0, middle, atol=0.05 * half)
    np.testing.assert_allclose(np.ptp(X, axis=0), 2.0 * half, rtol=0.05)
    z = np.einsum("vij,nj->nvi", scene.P, homogenize(X))
    xy = dehomogenize(z)
    inside = (z[..., 2] > 0.0) & (xy >= 0.0).all(axis=2) & (xy <= scene.sizes).all(axis=2)
    assert len(X) > inside[:, 0].sum() > 0.5 * len(X)
    np.testing.assert_array_equal(np.argwhere(inside), np.column_stack([t.point_index, t.view_index]))
    np.testing.assert_allclose(t.xy, xy[inside], atol=1e-4)


def calibrate(scene, *, shared=True, seed=0):
    reconstruction = projective_reconstruction(scene, seed=seed)
    prior = prior_for(reconstruction, IntrinsicsOptions(cameras="shared" if shared else "per-image"))
    rng = np.random.default_rng(seed)
    return HypothesesAndRefinement().calibrate(reconstruction, prior=prior, rng=rng)


@pytest.mark.parametrize("zoom", [0.0, 0.3])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exact_cameras_give_the_exact_focal_and_scaled_rotations_with_points_in_front(zoom, seed):
    scene = make_scene(zoom=zoom, seed=seed)
    given, answer = projective_reconstruction(scene, seed=seed), calibrate(scene, shared=not zoom, seed=seed)
    # The weak pull on the focal moves exact data by far less than any noise would.
    np.testing.assert_allclose(answer.K[:, 0, 0], scene.K[:, 0, 0], rtol=2e-3)
    assert answer.identifiable
    G, t = answer.metric_from_projective, scene.tracks
    P, X = given.P @ np.linalg.inv(G), given.X @ G.T
    C = np.linalg.inv(answer.K) @ P[:, :, :3]
    CC = C @ C.swapaxes(1, 2)
    CC /= np.trace(CC, axis1=1, axis2=2)[:, None, None] / 3.0
    np.testing.assert_allclose(CC, np.tile(np.eye(3), (len(C), 1, 1)), atol=5e-3)
    P *= np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
    depth = np.einsum("kj,kj->k", P[t.view_index, 2], X[t.point_index]) / X[t.point_index, 3]
    assert (depth > 0).all()


def test_each_closed_form_contains_the_truth(monkeypatch):
    scene = make_scene(seed=6)
    reconstruction = projective_reconstruction(scene, seed=6)
    frame = normalized_frame(reconstruction, prior_for(reconstruction))
    f = scene.K[0, 0, 0] / 1536.0
    monkeypatch.setattr(_refinement, "FOCAL_WEIGHT", 0.0)
    planes, focals = quadric_hypotheses(frame, np.array([f]))
    assert focals[0] == pytest.approx(f, rel=1e-6)
    log_f = np.full((1, 1), np.log(f))
    assert rotation_cost(frame, planes, log_f)[0] < 1e-12
    other = 0 if frame.reference != 0 else 1
    scan = f * np.array([0.7, 1.0, 1.5])
    both_signs = _upgrade.gherardi_fusiello_planes(frame, other, scan, scan)
    cost = rotation_cost(frame, both_signs, np.tile(np.log(scan), 2)[:, None]).reshape(2, 3).min(axis=0)
    assert cost[1] < 1e-12 < 1e-6 < cost[[0, 2]].min()


def test_pure_translation_is_unidentifiable_and_a_prior_pulls_its_focal():
    scene = make_scene(seed=7)
    still = with_poses(scene, np.tile(scene.R[0], (8, 1, 1)), scene.centres)
    answer = calibrate(still)
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
    failure = _upgrade._no_candidate_failure(frame, given, 40)
    assert str(failure.reason).endswith("near the given focal length")
    assert failure.evidence.startswith(f"{words} (+- 2.0%) at working size was given")


def test_a_focal_length_off_that_of_bundle_adjustment_is_reported():
    scene = make_scene(views=5)
    found, given = calibrate(scene), projective_reconstruction(scene)
    frame, best = normalized_frame(given, prior_for(given, IntrinsicsOptions())), found.candidates[0]
    assert _upgrade._biased_focal(frame, best, found.identifiability) == ()
    for factor, words in ((1.2, "+20%"), (0.8, "-20%")):
        off = replace(best, K=best.K * [[[factor], [factor], [1.0]]])
        (sentence,) = _upgrade._biased_focal(frame, off, found.identifiability)
        assert f"the focal length of this method is {words} from that of bundle adjustment" in sentence
        assert "bundle adjustment, 1500 px" in sentence

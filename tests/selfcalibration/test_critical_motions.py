"""Critical motions by their measures and names, the counting argument, and the verdict with its sentences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.constants import with_constants
from tests.synthetic import make_scene, projective_reconstruction, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.geometry.critical_motions import (
    UpgradedCameras,
    _infinite_homography_shift,
    _planarity_ratio,
    measure_motion,
    nearest_critical_motion,
    projective_infinity_shifts,
)
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.optimize.bundle.identifiability import (
    MAX_FOCAL_STD,
    MIN_INFINITY_SHIFT,
    MIN_ROTATION_SIGNIFICANCE,
    excess_equations,
)
from thesisrecon.records import Tracks, Upgrade
from thesisrecon.selfcalibration._candidates import (
    check_identifiability,
    identifiability_without_calibration,
)
from thesisrecon.selfcalibration._frame import normalized_frame
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from validation.scenes.critical import Motion, make_sequence, projective_estimate

CRITICAL = [motion for motion in Motion if motion is not Motion.GENERAL]


def true_cameras(scene):
    return UpgradedCameras(scene.K[:, 0, 0] / scene.sizes.max(axis=1), scene.R, scene.C, scene.X)


def report_at_the_truth(scene, cameras="shared"):
    """The verdict when self-calibration found the true answer."""
    rng = np.random.default_rng(0)
    estimate = projective_estimate(scene, rng)
    known = IntrinsicsOptions(cameras="per-image" if cameras == "per-image" else "shared")
    prior = prior_for(estimate, known)
    answer = with_constants(HypothesesAndRefinement, camera_subsets=0, focal_steps=17)(search=None).calibrate(
        estimate, prior=prior, rng=rng
    )
    assert answer.identifiability is not None
    return answer.identifiability


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


def test_cameras_that_hardly_turned_nor_moved_have_the_name_of_the_nearer_motion():
    scene = make_sequence(Motion.TRANSLATION, np.random.default_rng(2))
    far = scene.X + 60.0 * scene.R[0, 2] * np.linalg.norm(scene.C.std(axis=0))
    cameras = replace(true_cameras(scene), X=far)
    assert measure_motion(cameras)["centre_spread_over_distance"] < 0.03
    assert nearest_critical_motion(measure_motion(cameras))[0] == "pure translation"
    turns = Rotation.from_rotvec(np.radians(np.random.default_rng(3).normal(0.0, 2.0, (len(scene.R), 3))))
    turned = replace(cameras, R=turns.as_matrix() @ cameras.R, C=1e-3 * cameras.C)
    assert nearest_critical_motion(measure_motion(turned))[0] == "pure rotation"


def test_general_motions_are_far_from_all():
    for seed in range(20):
        scene = make_sequence(Motion.GENERAL, np.random.default_rng(seed))
        assert nearest_critical_motion(measure_motion(true_cameras(scene)))[1] > 2.0


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
        identifiability = identifiability_without_calibration(estimate, prior_for(estimate))
        assert not identifiability.identifiable
        assert (identifiability.motion == "pure translation") == small
        assert any("pure translation" in sentence for sentence in identifiability.sentences) == small


def test_thickness_forgives_a_few_far_points():
    rng = np.random.default_rng(0)
    wall = rng.uniform(-1.0, 1.0, (300, 3)) * [1.0, 1.0, 0.005]
    wall[:5] += 30.0 * rng.normal(size=(5, 3))
    assert _planarity_ratio(wall) < 0.01
    assert _planarity_ratio(rng.uniform(-1.0, 1.0, (300, 3))) > 0.5


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
    sentences = identifiability_without_calibration(estimate, prior_for(estimate, unknown)).sentences
    assert any("2 equations are missing" in sentence for sentence in sentences)


def test_square_pixels_resolve_a_turntable_and_this_is_reported():
    identifiability = report_at_the_truth(make_sequence(Motion.TURNTABLE, np.random.default_rng(4)))
    assert identifiability.identifiable
    assert identifiability.critical
    assert identifiability.motion == "turntable"
    evidence = identifiability.evidence
    assert evidence["focal_std_rel_free"] > 3.0 * evidence["focal_std_rel_median"]
    assert any("turntable" in sentence for sentence in identifiability.sentences)
    assert any("square pixels" in sentence for sentence in identifiability.sentences)


def test_pure_roll_is_rejected_with_advice():
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


def test_a_general_motion_needs_no_words():
    identifiability = report_at_the_truth(make_sequence(Motion.GENERAL, np.random.default_rng(6)))
    assert 1e-4 < identifiability.evidence["principal_point_std_free"] < 0.2
    assert identifiability.identifiable
    assert not identifiability.critical
    assert identifiability.sentences == ()
    assert identifiability.undetermined == ()


def test_a_solution_with_large_residuals_is_not_identifiable():
    scene = make_sequence(Motion.GENERAL, np.random.default_rng(7))
    estimate = projective_estimate(scene, np.random.default_rng(0))
    prior = prior_for(estimate)
    G = np.eye(4)
    G[3, :3] = np.linalg.svd(estimate.X[estimate.valid])[2][3][:3]
    identifiability = check_identifiability(estimate, Upgrade(G, scene.K, 0.0, "made up"), prior)
    assert not identifiability.identifiable
    assert identifiability.sentences


def bent_by_zooms():
    """Verdicts on zoomed photographs that are said to have one focal length, and each its own."""
    scene = make_sequence(Motion.GENERAL, np.random.default_rng(8), zoom=0.15)
    t = scene.tracks
    exact = dehomogenize(np.einsum("kij,kj->ki", scene.P[t.view_index], homogenize(scene.X)[t.point_index]))
    scene = replace(scene, tracks=replace(t, xy=exact + 0.1 * (t.xy - exact)))
    # The floor of the stage that makes projective cameras, whatever their residuals are.
    estimate = replace(projective_estimate(scene, np.random.default_rng(0)), sigma_px=0.3)
    upgrade = Upgrade(metric_frame(estimate, scene), scene.K, 0.0, "truth")
    shared, own = (
        check_identifiability(estimate, upgrade, prior_for(estimate, IntrinsicsOptions(cameras=how)))
        for how in ("shared", "per-image")
    )
    return shared, own


def metric_frame(estimate, scene):
    """The projective transform that takes the estimate to the true cameras: rows of P T = lambda P_true."""
    registered = np.flatnonzero(estimate.registered)
    rows = []
    for place, v in enumerate(registered):
        scale = np.zeros((12, len(registered)))
        scale[:, place] = -scene.P[v].ravel() / np.linalg.norm(scene.P[v])
        rows.append(np.hstack([np.kron(estimate.P[v] / np.linalg.norm(estimate.P[v]), np.eye(4)), scale]))
    T = np.linalg.svd(np.vstack(rows))[2][-1][:16].reshape(4, 4)
    return np.asarray(np.linalg.inv(T))


def test_noise_is_compared_with_the_projective_residual_not_a_floor():
    shared, own = bent_by_zooms()
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
    sentences = identifiability_without_calibration(estimate, prior_for(estimate, given)).sentences
    assert next(s for s in sentences if "rotate the camera" in s).endswith(advice)

"""Each direct method alone, its criteria and its unknowns: exact on exact cameras, steady under noise."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.selfcalibration.stratified_scenes import calibrated, with_calibrations
from tests.synthetic import make_scene, projective_reconstruction, with_poses
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.geometry.strata import upgrade_cameras
from thesisrecon.optimize.bundle.projection import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle
from thesisrecon.optimize.least_squares import central_differences, soft_l1
from thesisrecon.records import IntrinsicsPrior
from thesisrecon.selfcalibration import _refinement, _upgrade, kruppa
from thesisrecon.selfcalibration._frame import normalized_frame, solver_unknowns
from thesisrecon.selfcalibration._refinement import (
    dual_image_residuals,
    minimize_batch,
    refine_hypotheses,
    rotation_cost,
    rotation_loss,
    rotation_residuals,
)
from thesisrecon.selfcalibration.absolute_conic import FixedPlaneQuadric
from thesisrecon.selfcalibration.quadric import (
    HypothesesAndRefinement,
    LinearQuadric,
    NonlinearQuadric,
    linear_quadric,
    minimize_quadric,
    rank_three,
)
from thesisrecon.selfcalibration.stratified import Stratified

EXACT = [NonlinearQuadric(), kruppa.KruppaEquations()]
ALONE = [LinearQuadric(), *EXACT]


@pytest.fixture(autouse=True)
def without_a_weak_prior_of_the_focal(monkeypatch):
    monkeypatch.setattr(_refinement, "FOCAL_WEIGHT", 0.0)


def name(method):
    return type(method).__name__


def prior_for(scene, *, shared=True, stds=(0.0, 0.0, 0.0)):
    """The focal unknown, common or of each view; deviations of aspect, skew (px) and principal point (px),
    0 = known to be 1, 0 and the middle of the image."""
    n = len(scene.P)
    own, common = np.arange(n), np.zeros(n, dtype=np.int64)
    columns = [common if shared else own, *[common] * 5]
    middle = (scene.sizes - 1) / 2.0
    mean = np.column_stack([np.full(n, np.nan), np.ones(n), np.zeros(n), middle, np.zeros(n)])
    std = np.tile([np.inf, stds[0], stds[1], stds[2], stds[2], 0.05], (n, 1))
    return IntrinsicsPrior(mean, std, np.stack(columns, axis=1), common)


def calibrate(method, scene, prior, *, seed=0):
    return method.calibrate(adjusted(scene, seed), prior=prior, rng=np.random.default_rng(seed))


def adjusted(scene, seed):
    """The projective bundle adjustment of the scene's observations, in a random frame."""
    rec, t = projective_reconstruction(scene, seed=seed), scene.tracks
    seen = Observations(t.view_index, t.point_index, t.xy)
    fitted = refine_projective_bundle(rec.P, rec.X, seen, max_iterations=30)
    return replace(rec, P=fitted.P, X=fitted.X)


@pytest.mark.parametrize("method", EXACT, ids=name)
@pytest.mark.parametrize("zoom", [0.0, 0.3])
def test_exact_cameras_give_the_exact_focals(method, zoom):
    scene = make_scene(zoom=zoom, seed=1)
    answer = calibrated(method, scene, prior_for(scene, shared=zoom == 0.0), seed=1)
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-8, atol=1e-5)
    assert answer.identifiable


@pytest.mark.parametrize(
    ("method", "focal", "rtol"),
    [(method, focal, 1e-5) for method in EXACT for focal in (400.0, 15000.0)]
    + [(HypothesesAndRefinement(), focal, 2e-2) for focal in (350.0, 20_000.0)],
)
def test_wide_and_long_lenses_are_found_without_a_prior(method, focal, rtol):
    """The image is as large: the scene is as much farther as the lens is longer."""
    scene = make_scene(seed=3)
    K, t = scene.K.copy(), scene.t * [1.0, 1.0, focal / 1500.0]
    K[:, 0, 0] = K[:, 1, 1] = focal
    scene = with_poses(replace(scene, K=K), scene.R, -np.einsum("vba,vb->va", scene.R, t))
    answer = calibrated(method, scene, prior_for(scene), seed=3)
    np.testing.assert_allclose(answer.K[:, 0, 0], focal, rtol=rtol)
    # The cameras are scaled rotations: the plane at infinity is that of these focal lengths.
    P = projective_reconstruction(scene, seed=3).P
    sizes = upgrade_cameras(P, answer.K, answer.metric_from_projective)[2]
    np.testing.assert_allclose(sizes, np.tile(sizes[:, 1:2], 3), rtol=5.0 * rtol)


@pytest.mark.parametrize("method", EXACT, ids=name)
def test_all_intrinsics_of_a_constant_camera_are_found(method):
    K = np.array([[1500.0, 12.0, 790.0], [0.0, 1620.0, 480.0], [0.0, 0.0, 1.0]])
    scene = with_calibrations(make_scene(seed=2), K)
    answer = calibrated(method, scene, prior_for(scene, stds=(np.inf, np.inf, np.inf)), seed=2)
    np.testing.assert_allclose(answer.K[0], K, rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize(
    "method",
    [HypothesesAndRefinement(), *EXACT, Stratified(), Stratified(refine=False)],
    ids=["hypotheses", "nonlinear quadric", "Kruppa", "stratified", "stratified alone"],
)
def test_a_known_skew_is_kept(method):
    scene = make_scene(seed=2)
    scene = with_calibrations(scene, scene.K + 150.0 * np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    prior = prior_for(scene)
    prior.mean[:, 2] = 150.0
    answer = calibrated(method, scene, prior, seed=2)
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(
    "method",
    [HypothesesAndRefinement(), *EXACT, Stratified(), Stratified(calibration=FixedPlaneQuadric())],
    ids=["hypotheses", "nonlinear quadric", "Kruppa", "stratified", "fixed plane"],
)
@pytest.mark.parametrize("focal_std", [0.0, 0.02])
def test_given_focals_are_kept_by_cameras_on_a_sphere(method, focal_std):
    """Which agree with any focal length in the Kruppa equations."""
    scene = make_scene(views=6, seed=1, seen_share=1.0)
    R = Rotation.from_euler("xyz", np.radians(np.random.default_rng(0).uniform(-25, 25, (6, 3)))).as_matrix()
    scene = with_poses(scene, R, scene.X.mean(axis=0) - 9.0 * R[:, 2])
    mean = np.tile([scene.K[0, 0, 0], 1.0, 0.0, *scene.K[0, :2, 2], 0.0], (6, 1))
    prior = IntrinsicsPrior.unshared(mean, np.tile([focal_std, 0.0, 0.0, 0.0, 0.0, 0.0], (6, 1)))
    np.testing.assert_allclose(calibrated(method, scene, prior, seed=2).K, scene.K, rtol=1e-4)


@pytest.mark.parametrize("method", [NonlinearQuadric(), kruppa.KruppaEquations()], ids=name)
def test_estimates_have_stds_of_the_size_of_their_errors(method):
    scaled = []
    for seed in range(12):
        scene = make_scene(sigma_px=0.3, seed=seed, principal_shift=(20.0, -12.0))
        answer = calibrate(method, scene, prior_for(scene, stds=(0.0, 0.0, 30.0)), seed=seed)
        K, K_std, truth = answer.K[0], answer.K_std[0], scene.K[0]
        moved = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=bool)
        assert (K_std[moved] > 0.0).all()
        assert not K_std[~moved].any()
        scaled.append((K - truth)[moved] / K_std[moved])
    # The noise of cameras is not independent, which the residuals do not know.
    assert 1.0 < np.sqrt(np.mean(np.square(scaled))) < 2.2


def test_the_noise_of_projective_cameras_is_that_of_the_matches():
    scene = make_scene(sigma_px=0.5, seed=1)
    found = _upgrade._projective_noise(adjusted(scene, 1), np.arange(len(scene.tracks.xy)))
    assert found == pytest.approx(0.5, rel=0.05)


def test_stds_are_those_of_the_prior_or_the_estimate_and_unknown_where_there_is_bias():
    scene = make_scene(sigma_px=0.3, seed=1)
    reported = calibrate(HypothesesAndRefinement(), scene, prior_for(scene, stds=(0.015, 2.0, 10.0)), seed=1)
    np.testing.assert_allclose(reported.K_std[:, :2, 2], 10.0)
    np.testing.assert_allclose(reported.K_std[:, 0, 1], 2.0)
    relative = reported.K_std / np.where(reported.K == 0.0, 1.0, reported.K)
    np.testing.assert_allclose(relative[:, 1, 1], np.hypot(relative[:, 0, 0], 0.015))
    assert (reported.K_std[:, 0, 0] > 0.0).all()
    linear = calibrate(LinearQuadric(), scene, prior_for(scene), seed=1)
    assert np.isnan(linear.K_std[:, (0, 1), (0, 1)]).all()
    assert not linear.K_std[:, 0, 1:].any()
    untold = calibrate(LinearQuadric(), scene, prior_for(scene, stds=(0.0, 0.0, np.inf)), seed=1)
    assert np.isnan(untold.K_std[:, :2, 2]).all()
    # A closed form moves the principal point, but does not say how well.
    rough = prior_for(scene, stds=(0.0, 0.0, 30.0))
    closed, refined = (calibrate(Stratified(refine=r), scene, rough, seed=1) for r in (False, True))
    assert np.abs(closed.K[:, :2, 2] - scene.K[:, :2, 2]).max() > 1e-6
    assert np.isnan(closed.K_std[:, :2, 2]).all()
    assert (refined.K_std[:, :2, 2] > 0.0).all()


def test_a_known_aspect_and_principal_point_are_normalised_away():
    scene = make_scene(seed=4, principal_shift=(150.0, -90.0))
    K = scene.K.copy()
    K[:, 1, 1] *= 1.2
    scene = with_calibrations(scene, K)
    reported = prior_for(scene)
    reported.mean[:, 1], reported.mean[:, 3:5] = 1.2, scene.K[0, :2, 2]
    for method in EXACT:
        answer = calibrated(method, scene, reported, seed=4)
        np.testing.assert_allclose(answer.K, scene.K, rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize("method", ALONE, ids=name)
def test_noise_of_a_pixel_leaves_the_focal_within_a_few_percent(method):
    errors = []
    for seed in range(3):
        scene = make_scene(sigma_px=1.0, seed=seed)
        answer = calibrate(method, scene, prior_for(scene), seed=seed)
        errors.append(np.abs(answer.K[:, 0, 0] / scene.K[:, 0, 0] - 1.0).max())
    assert np.median(errors) < (0.2 if isinstance(method, LinearQuadric) else 0.03)


@pytest.mark.parametrize("method", [*ALONE, HypothesesAndRefinement(), Stratified()], ids=name)
def test_two_cameras_are_refused_with_a_reason(method):
    scene, rng = make_scene(), np.random.default_rng(0)
    two = replace(projective_reconstruction(scene), registered=np.arange(len(scene.P)) < 2)
    refuses(StageFailure, "at least 3", method.calibrate, two, prior=prior_for(scene), rng=rng)


@pytest.mark.parametrize("method", ALONE, ids=name)
@settings(max_examples=6, derandomize=True, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(["random", "still", "same", "flat"]))
def test_no_input_escapes_as_an_error_of_a_solver(method, seed, kind):
    scene, rng = make_scene(views=4, points=40, seed=seed % 50), np.random.default_rng(seed)
    reconstruction = projective_reconstruction(scene, seed=seed)
    P = rng.normal(size=reconstruction.P.shape) if kind == "random" else reconstruction.P.copy()
    if kind == "still":
        P[:, :, :3] = P[0, :, :3]
    if kind == "same":
        P[:] = P[0]
    if kind == "flat":
        P[:, 2] = P[:, 1]
    with contextlib.suppress(StageFailure):
        answer = method.calibrate(replace(reconstruction, P=P), prior=prior_for(scene), rng=rng)
        assert np.isfinite(answer.K).all()


def test_the_linear_quadric_is_the_true_one_at_the_true_normalising_focal():
    scene = make_scene(seed=6)
    frame = normalized_frame(projective_reconstruction(scene, seed=6), prior_for(scene))
    Q, null = rank_three(linear_quadric(frame, np.array([scene.K[0, 0, 0] / 1536.0])))
    assert np.sort(np.abs(np.linalg.eigvalsh(Q[0])))[0] < 1e-12
    np.testing.assert_allclose(Q[0] @ null[0], 0.0, atol=1e-12)
    P = np.concatenate([frame.A, frame.a[:, :, None]], axis=2)
    w = P @ Q[0] @ P.swapaxes(1, 2)
    w /= w[:, 2:, 2:]
    f2 = (scene.K[0, 0, 0] / 1536.0) ** 2
    np.testing.assert_allclose(w, np.tile(np.diag([f2, f2, 1.0]), (len(w), 1, 1)), atol=1e-9)


def random_pair(seed, K1, K2):
    """F of two cameras in general position."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix()
    F = np.linalg.inv(K2).T @ cross_matrix(rng.normal(size=3)) @ R @ np.linalg.inv(K1)
    return F / np.linalg.norm(F)


def kruppa_of(F, *calibrations):
    return kruppa._kruppa_residuals(F[None], *((K @ K.T)[None, None] for K in calibrations))


@settings(max_examples=60, derandomize=True, deadline=None)
@given(seed=st.integers(0, 100_000), square=st.booleans())
def test_the_kruppa_equations_hold_at_the_truth_and_not_beside_it(seed, square):
    f = np.random.default_rng(seed).uniform(0.6, 3.0, 2)
    K1, K2 = np.diag([f[0], f[0], 1.0]), np.diag([f[1], f[1], 1.0])
    if not square:
        K1, K2 = np.array([[1.3, 0.05, 0.1], [0.0, 1.4, -0.2], [0.0, 0.0, 1.0]]), np.diag([0.7, 0.8, 1.0])
    F = random_pair(seed, K1, K2)
    assert np.abs(kruppa_of(F, K1, K2)).max() < 1e-9
    assert np.abs(kruppa_of(F, K1 @ np.diag([1.3, 1.3, 1.0]), K2)).max() > 1e-4


def test_the_kruppa_cost_is_the_square_of_small_residuals_and_linear_in_large_ones():
    K1, K2 = np.diag([1.5, 1.5, 1.0]), np.diag([0.9, 0.9, 1.0])
    F, wrong = random_pair(7, K1, K2), K1 @ np.diag([1.2, 1.2, 1.0])
    pairs, K = kruppa._Pairs(np.array([0]), np.array([1]), F[None]), np.stack([wrong, K2])[None]
    size = np.linalg.norm(kruppa_of(F, wrong, K2))
    assert size > 1e-3
    np.testing.assert_allclose(kruppa._kruppa_cost(pairs, K, loss_scale=1e3 * size), [size**2], rtol=1e-5)
    np.testing.assert_allclose(
        kruppa._kruppa_cost(pairs, K, loss_scale=1e-3 * size), [2e-3 * size**2], rtol=2e-3
    )


@settings(max_examples=25, derandomize=True, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_all_criteria_vanish_at_the_truth_in_every_frame(seed):
    scene = make_scene(views=4, points=40, seed=seed % 30)
    given = projective_reconstruction(scene, seed=seed)
    frame = normalized_frame(given, prior_for(scene))
    log_f = np.log(scene.K[:1, 0, 0] / 1536.0)
    plane, cost = kruppa._plane_for_focals(frame, log_f)
    assert cost < 1e-20
    K = _upgrade.square_pixel_calibrations(np.full((1, 4), log_f[0]))
    residuals = dual_image_residuals(frame, K, plane[None])
    assert np.abs(residuals).max() < 1e-9
    pairs = kruppa._overlapping_pairs(frame, given, 8)
    assert len(pairs.i) == 6
    assert np.abs(kruppa._pair_residuals(pairs, K)).max() < 1e-7


@settings(max_examples=15, derandomize=True, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_refinement_never_raises_the_cost(seed):
    rng = np.random.default_rng(seed)
    scene = make_scene(views=5, points=40, zoom=0.2, seed=seed % 30)
    frame = normalized_frame(projective_reconstruction(scene, seed=seed), prior_for(scene, shared=False))
    theta = rng.normal(size=(6, 8))
    before = rotation_cost(frame, theta[:, :3], theta[:, 3:])
    refined, after = refine_hypotheses(frame, theta)
    assert (after <= before).all()
    np.testing.assert_allclose(rotation_cost(frame, refined[:, :3], refined[:, 3:]), after)


def test_the_std_of_the_focals_is_that_of_the_normal_equations_and_planes_alone_leave_the_focals():
    scene = make_scene(views=5, seed=1)
    frame = normalized_frame(projective_reconstruction(scene, seed=1), prior_for(scene))
    theta = np.array([0.3, -0.2, 0.1, 0.0])
    r = rotation_residuals(frame, theta[None])
    root = np.sqrt(rotation_loss(frame, r)[1][0])
    J = root[:, None] * central_differences(lambda x: rotation_residuals(frame, x), theta[None])[0]
    r = root * r[0]
    variance = r @ r / (5 * 5 - 4) * np.linalg.inv(J.T @ J)[3, 3]
    assert _refinement.focal_std(frame, theta) == pytest.approx(np.sqrt(variance), rel=1e-6)
    theta = np.random.default_rng(1).normal(size=(3, 4))
    refined, _ = refine_hypotheses(frame, theta, planes_only=True)
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


@pytest.mark.parametrize("known", [(np.nan, np.inf), (np.nan, 0.1), (1500.0, np.inf)])
def test_a_focal_without_mean_and_deviation_is_one_of_usual_lenses(known):
    scene = make_scene(views=4, seed=2)
    prior = prior_for(scene)
    prior.mean[:, 0], prior.std[:, 0] = known
    frame = normalized_frame(projective_reconstruction(scene, seed=2), prior)
    weak = solver_unknowns(frame, prior).with_focal_prior()
    # Lenses of 24 and 90 mm before a sensor of 36 mm, then fisheyes and lenses of birdwatchers.
    off = np.abs(weak.prior_residuals(np.log(np.array([[24.0], [90.0], [8.0], [300.0]]) / 36.0))[:, 0])
    assert off[:2].max() < 1.0
    assert off[2:].min() > 1.5


@pytest.mark.parametrize("views", [3, 5])
def test_the_covariance_of_the_quadric_is_that_of_least_squares_with_five_entries_per_camera(views):
    scene = make_scene(views=views, sigma_px=0.3, seed=5)
    frame = normalized_frame(adjusted(scene, 5), prior_for(scene))
    unknown = solver_unknowns(frame, prior_for(scene))
    log_f = np.full(views, np.log(scene.K[0, 0, 0] / 1536.0))
    found = minimize_quadric(frame, unknown, kruppa._plane_for_focals(frame, log_f[:1])[0], log_f, method="")

    def residuals(x):
        K = _upgrade.square_pixel_calibrations(np.full((1, views), x[3]))
        return dual_image_residuals(frame, K, x[None, :3]).ravel()

    x = np.append(found.plane, np.log(found.K[0, 0, 0]))
    J, r = central_differences(residuals, x), residuals(x)
    # A conic has five entries up to scale; those of the reference camera vanish by the choice of the plane.
    variance = r @ r / (5 * (views - 1) - 4) * np.linalg.inv(J.T @ J)[3, 3]
    assert found.K_std[0, 0, 0] / found.K[0, 0, 0] == pytest.approx(np.sqrt(variance), rel=1e-3)


def test_a_known_focal_counts_for_its_own_camera_only():
    scene = make_scene(views=6, zoom=0.3, sigma_px=0.5, seed=3)
    reported = prior_for(scene, shared=False)
    reported.mean[:2, 0], reported.std[:2, 0] = scene.K[:2, 0, 0], 0.001
    ratio = calibrate(HypothesesAndRefinement(), scene, reported, seed=3).K[:, 0, 0] / scene.K[:, 0, 0]
    np.testing.assert_allclose(ratio[:2], 1.0, rtol=5e-3)
    np.testing.assert_allclose(ratio[2:], 1.0, rtol=3e-2)


def test_crops_with_a_principal_point_far_off_are_calibrated_when_it_is_left_open():
    scene = make_scene(views=9, zoom=0.3, seed=4)
    K = scene.K.copy()
    K[:, :2, 2] += np.random.default_rng(4).uniform(-150.0, 150.0, (9, 2))
    scene = with_calibrations(scene, K)
    own = prior_for(scene, shared=False, stds=(0.0, 0.0, 150.0))
    own.shared[:, 3:5] = np.arange(9)[:, None]
    answer = calibrated(HypothesesAndRefinement(), scene, own, seed=4)
    np.testing.assert_allclose(answer.K, K, rtol=1e-4, atol=0.5)


def test_candidates_are_distinct_minima_of_the_loss():
    scene = make_scene(views=4, points=40, seed=6)
    frame = normalized_frame(projective_reconstruction(scene, seed=6), prior_for(scene))
    K, plane = _upgrade.square_pixel_calibrations(np.zeros(4)), np.array([0.1, 0.2, 0.3])
    places = ((plane, 2.0, "a"), (1.001 * plane, 1.0, "b"), (-plane, 3.0, "c"))
    answers = [_upgrade.Candidate(p, K, cost, name) for p, cost, name in places]
    for most, kept in ((9, ["b", "c"]), (1, ["b"])):
        assert [a.method for a in _upgrade.distinct_candidates(frame, answers, most)] == kept
    data, width = np.array([-3.0, -0.1, 0.0, 0.2, 0.3, 5.0, 9.0]), 0.3
    x, cost = minimize_batch(lambda x: x - data, np.array([[0.7], [-2.0]]), iterations=200, loss_scale=width)
    grid = np.linspace(-1.0, 1.0, 200_001)
    losses = np.mean([soft_l1((grid - d) ** 2, width)[0] for d in data], axis=0)
    np.testing.assert_allclose(x[:, 0], grid[losses.argmin()], atol=2e-5)
    np.testing.assert_allclose(cost, losses.min(), rtol=1e-9)

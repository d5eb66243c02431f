"""Each direct method alone: exact on exact cameras, steady under noise, and what each refuses."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.constants import with_constants
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.api.cameras import reconstruction_from_cameras
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle
from thesisrecon.records import IntrinsicsPrior
from thesisrecon.selfcalibration._frame import normalized_frame
from thesisrecon.selfcalibration._refinement import RotationCriterion
from thesisrecon.selfcalibration.absolute_conic import FixedPlaneQuadric
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from thesisrecon.selfcalibration.kruppa import KruppaEquations, _kruppa_cost, _kruppa_residuals, _Pairs
from thesisrecon.selfcalibration.quadric import LinearQuadric, NonlinearQuadric, linear_quadric, rank_three
from thesisrecon.selfcalibration.stratified import Stratified

FREE = RotationCriterion(focal_weight=0.0)
EXACT = [with_constants(kind, criterion=FREE)() for kind in (NonlinearQuadric, KruppaEquations)]
ALONE = [LinearQuadric(), *EXACT]


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
    reconstruction = adjusted(scene, seed)
    return method.calibrate(reconstruction, prior=prior, rng=np.random.default_rng(seed))


def adjusted(scene, seed):
    """The projective bundle adjustment of the scene's observations, in a random frame."""
    rec, t = projective_reconstruction(scene, seed=seed), scene.tracks
    fitted = refine_projective_bundle(
        rec.P, rec.X, Observations(t.view_index, t.point_index, t.xy), max_iterations=30
    )
    return replace(rec, P=fitted.P, X=fitted.X)


def focal_error(answer, scene):
    return float(np.abs(answer.K[:, 0, 0] / scene.K[:, 0, 0] - 1.0).max())


@pytest.mark.parametrize("method", EXACT, ids=name)
@pytest.mark.parametrize("zoom", [0.0, 0.3])
def test_exact_cameras_give_the_exact_focals(method, zoom):
    scene = make_scene(zoom=zoom, seed=1)
    reconstruction = projective_reconstruction(scene, seed=1)
    prior = prior_for(scene, shared=zoom == 0.0)
    answer = method.calibrate(reconstruction, prior=prior, rng=np.random.default_rng(0))
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-8, atol=1e-5)
    assert answer.identifiable


@pytest.mark.parametrize("method", EXACT, ids=name)
@pytest.mark.parametrize("focal", [400.0, 15000.0])
def test_wide_and_long_lenses_are_found_without_a_prior(method, focal):
    scene = at_distance(make_scene(seed=3), focal)
    reconstruction = projective_reconstruction(scene, seed=3)
    answer = method.calibrate(reconstruction, prior=prior_for(scene), rng=np.random.default_rng(0))
    assert focal_error(answer, scene) < 1e-5


def at_distance(scene, focal):
    """The same views through another lens: the image the same size, the scene's depth that of a longer or
    shorter one."""
    K = scene.K.copy()
    K[:, 0, 0] = K[:, 1, 1] = focal
    t = scene.t.copy()
    t[:, 2] *= focal / 1500.0
    return replace(scene, K=K, t=t, tracks=reprojected(replace(scene, K=K, t=t)))


def reprojected(scene):
    tracks = scene.tracks
    x = np.einsum("kab,kb->ka", scene.R[tracks.view_index], scene.X[tracks.point_index])
    x += scene.t[tracks.view_index]
    pixel = np.einsum("kab,kb->ka", scene.K[tracks.view_index], x)
    return replace(tracks, xy=pixel[:, :2] / pixel[:, 2:])


@pytest.mark.parametrize("method", EXACT, ids=name)
def test_all_intrinsics_of_a_constant_camera_are_found(method):
    scene = make_scene(seed=2)
    K = np.array([[1500.0, 12.0, 790.0], [0.0, 1620.0, 480.0], [0.0, 0.0, 1.0]])
    scene = replace(scene, K=np.tile(K, (len(scene.P), 1, 1)))
    scene = replace(scene, tracks=reprojected(scene))
    reconstruction = projective_reconstruction(scene, seed=2)
    free = prior_for(scene, stds=(np.inf, np.inf, np.inf))
    answer = method.calibrate(reconstruction, prior=free, rng=np.random.default_rng(0))
    np.testing.assert_allclose(answer.K[0], K, rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize(
    "method",
    [HypothesesAndRefinement(), *EXACT, Stratified(), Stratified(refine=False)],
    ids=["hypotheses", "nonlinear quadric", "Kruppa", "stratified", "stratified alone"],
)
def test_a_known_skew_is_kept(method):
    scene = make_scene(seed=2)
    K = scene.K + 150.0 * np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    scene = replace(scene, K=K)
    scene = replace(scene, tracks=reprojected(scene))
    prior = prior_for(scene)
    prior.mean[:, 2] = 150.0
    answer = method.calibrate(
        projective_reconstruction(scene, seed=2), prior=prior, rng=np.random.default_rng(0)
    )
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(
    "method",
    [HypothesesAndRefinement(), *EXACT, Stratified(), Stratified(calibration=FixedPlaneQuadric())],
    ids=["hypotheses", "nonlinear quadric", "Kruppa", "stratified", "fixed plane"],
)
@pytest.mark.parametrize("focal_std", [0.0, 0.02])
def test_given_focals_are_kept_by_cameras_on_a_sphere(method, focal_std):
    """Which agree with any focal length in the Kruppa equations."""
    scene = make_scene(seed=1)
    R = Rotation.from_euler("xyz", np.radians(np.random.default_rng(0).uniform(-25, 25, (6, 3)))).as_matrix()
    t = -R @ scene.X.mean(axis=0) + [0.0, 0.0, 9.0]
    scene = replace(scene, R=R, t=t, K=scene.K[:6])
    xh = np.einsum("vij,nj->vni", scene.P, np.column_stack([scene.X, np.ones(len(scene.X))]))
    sizes = np.tile([1536, 1024], (6, 1))
    P = scene.P @ np.linalg.inv(np.random.default_rng(2).normal(size=(4, 4)))
    reconstruction = reconstruction_from_cameras(
        P, sizes=sizes, xy=xh[..., :2] / xh[..., 2:], stratum="projective"
    )
    mean = np.tile([scene.K[0, 0, 0], 1.0, 0.0, *scene.K[0, :2, 2], 0.0], (6, 1))
    prior = IntrinsicsPrior.unshared(mean, np.tile([focal_std, 0.0, 0.0, 0.0, 0.0, 0.0], (6, 1)))
    answer = method.calibrate(reconstruction, prior=prior, rng=np.random.default_rng(0))
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-4)


@pytest.mark.parametrize("method", [NonlinearQuadric(), KruppaEquations()], ids=name)
def test_estimates_have_stds_of_the_size_of_their_errors(method):
    scaled = []
    for seed in range(4):
        scene = make_scene(sigma_px=0.3, seed=seed, principal_shift=(20.0, -12.0))
        answer = calibrate(method, scene, prior_for(scene, stds=(0.0, 0.0, 30.0)), seed=seed)
        K, K_std, truth = answer.K[0], answer.K_std[0], scene.K[0]
        moved = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=bool)
        assert (K_std[moved] > 0.0).all()
        assert not K_std[~moved].any()
        scaled.append((K - truth)[moved] / K_std[moved])
    # The noise of cameras is not independent, which the residuals do not know.
    assert 0.3 < np.sqrt(np.mean(np.square(scaled))) < 4.0


def test_unestimated_intrinsics_keep_the_std_of_the_prior():
    scene = make_scene(sigma_px=0.3, seed=1)
    reported = calibrate(HypothesesAndRefinement(), scene, prior_for(scene, stds=(0.015, 2.0, 10.0)), seed=1)
    np.testing.assert_allclose(reported.K_std[:, 0, 2], 10.0)
    np.testing.assert_allclose(reported.K_std[:, 1, 2], 10.0)
    np.testing.assert_allclose(reported.K_std[:, 0, 1], 2.0)
    relative = reported.K_std / np.where(reported.K == 0.0, 1.0, reported.K)
    np.testing.assert_allclose(relative[:, 1, 1], np.hypot(relative[:, 0, 0], 0.015))
    untold = calibrate(LinearQuadric(), scene, prior_for(scene, stds=(0.0, 0.0, np.inf)), seed=1)
    assert np.isnan(untold.K_std[:, :2, 2]).all()
    assert (reported.K_std[:, 0, 0] > 0.0).all()


def test_standard_deviations_exclude_bias():
    scene = make_scene(sigma_px=0.3, seed=1)
    answer = calibrate(LinearQuadric(), scene, prior_for(scene), seed=1)
    assert np.isnan(answer.K_std[:, (0, 1), (0, 1)]).all()
    assert not answer.K_std[:, 0, 1:].any()


def test_a_principal_point_of_a_closed_form_has_no_deviation():
    scene = make_scene(sigma_px=0.3, seed=1)
    answer = calibrate(Stratified(refine=False), scene, prior_for(scene, stds=(0.0, 0.0, 30.0)), seed=1)
    assert np.abs(answer.K[:, :2, 2] - scene.K[:, :2, 2]).max() > 1e-6
    assert np.isnan(answer.K_std[:, :2, 2]).all()
    refined = calibrate(Stratified(), scene, prior_for(scene, stds=(0.0, 0.0, 30.0)), seed=1)
    assert (refined.K_std[:, :2, 2] > 0.0).all()


def test_a_known_aspect_and_principal_point_are_normalised_away():
    scene = make_scene(seed=4, principal_shift=(150.0, -90.0))
    K = scene.K.copy()
    K[:, 1, 1] *= 1.2
    scene = replace(scene, K=K)
    scene = replace(scene, tracks=reprojected(scene))
    reported = prior_for(scene)
    reported.mean[:, 1], reported.mean[:, 3:5] = 1.2, scene.K[0, :2, 2]
    reconstruction = projective_reconstruction(scene, seed=4)
    for method in EXACT:
        answer = method.calibrate(reconstruction, prior=reported, rng=np.random.default_rng(0))
        np.testing.assert_allclose(answer.K, scene.K, rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize("method", ALONE, ids=name)
def test_noise_of_a_pixel_leaves_the_focal_within_a_few_percent(method):
    bound = 0.2 if isinstance(method, LinearQuadric) else 0.03
    errors = []
    for seed in range(3):
        scene = make_scene(sigma_px=1.0, seed=seed)
        errors.append(focal_error(calibrate(method, scene, prior_for(scene), seed=seed), scene))
    assert np.median(errors) < bound


@pytest.mark.parametrize("method", [*ALONE, HypothesesAndRefinement(), Stratified()], ids=name)
def test_two_cameras_are_refused_with_a_reason(method):
    scene = make_scene()
    two = replace(projective_reconstruction(scene), registered=np.arange(len(scene.P)) < 2)
    with pytest.raises(StageFailure, match="at least 3"):
        method.calibrate(two, prior=prior_for(scene), rng=np.random.default_rng(0))


@pytest.mark.parametrize("method", ALONE, ids=name)
@settings(max_examples=6, derandomize=True, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(["random", "still", "same", "flat"]))
def test_no_input_escapes_as_an_error_of_a_solver(method, seed, kind):
    scene = make_scene(views=4, points=40, seed=seed % 50)
    reconstruction = projective_reconstruction(scene, seed=seed)
    rng = np.random.default_rng(seed)
    P = reconstruction.P.copy()
    if kind == "random":
        P = rng.normal(size=P.shape)
    elif kind == "still":
        P[:, :, :3] = P[0, :, :3]
    elif kind == "same":
        P[:] = P[0]
    else:
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
    return _kruppa_residuals(F[None], *((K @ K.T)[None, None] for K in calibrations))


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
    pairs, K = _Pairs(np.array([0]), np.array([1]), F[None]), np.stack([wrong, K2])[None]
    size = np.linalg.norm(kruppa_of(F, wrong, K2))
    assert size > 1e-3
    np.testing.assert_allclose(_kruppa_cost(pairs, K, loss_scale=1e3 * size), [size**2], rtol=1e-5)
    np.testing.assert_allclose(_kruppa_cost(pairs, K, loss_scale=1e-3 * size), [2e-3 * size**2], rtol=2e-3)

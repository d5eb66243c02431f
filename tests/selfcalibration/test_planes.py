"""The ways to the plane at infinity on exact and noisy scenes, and what they refuse."""

from dataclasses import replace

import numpy as np
import pytest

from tests.constants import with_constants
from tests.selfcalibration.stratified_scenes import CENTRED_ZOOM, NOTHING_BUT_CONSTANT, prior_for, setup
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.api.cameras import reconstruction_from_cameras
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import pixel_from_unit
from thesisrecon.selfcalibration.absolute_conic import FixedPlaneQuadric, LinearAbsoluteConic
from thesisrecon.selfcalibration.cheirality import (
    CheiralityRegion,
    CheiralitySearch,
    ModulusConstraint,
    _modulus_coefficients,
    _modulus_residuals,
    _pairs_of_constant_cameras,
    _plane_box,
)
from thesisrecon.selfcalibration.stratified import Stratified

PAIRS = [
    (plane, way)
    for plane in (CheiralitySearch(), ModulusConstraint())
    for way in (LinearAbsoluteConic(), FixedPlaneQuadric())
]


def test_the_coefficients_are_those_of_the_characteristic_polynomial():
    rng = np.random.default_rng(0)
    A, a, p = rng.normal(size=(3, 3, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    pairs = np.array([[0, 1], [1, 2], [2, 0]])
    c = _modulus_coefficients(A, a, pairs)
    H = A - a[:, :, None] * p
    for m, (i, j) in enumerate(pairs):
        for x in (-1.3, 0.2, 0.7, 2.0):
            value = sum((c[m, k, :3] @ p + c[m, k, 3]) * x**k for k in range(4))
            assert value == pytest.approx(np.linalg.det(x * H[i] - H[j]), rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_the_true_plane_satisfies_the_quartics_for_any_constant_calibration(seed):
    scene = make_scene(seed=seed, principal_shift=(80.0, -60.0))
    found, plane = setup(scene, NOTHING_BUT_CONSTANT, seed=seed)
    pairs = _pairs_of_constant_cameras(found.constraints.first)
    assert len(pairs) == 28
    c = _modulus_coefficients(found.frame.A, found.frame.a, pairs)
    l0, l1, l2, l3 = (c[:, :, :3] @ plane + c[:, :, 3]).T
    left, right = l3 * l1**3, l2**3 * l0
    assert np.abs((left - right) / (np.abs(left) + np.abs(right))).max() < 1e-9
    r, t = _modulus_residuals(c, plane[None])
    assert np.abs(r).max() < 1e-9
    R = scene.R
    angles = np.trace(R[pairs[:, 0]] @ R[pairs[:, 1]].swapaxes(1, 2), axis1=1, axis2=2)
    np.testing.assert_allclose(t[0], angles, atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_the_cheirality_bounds_hold_the_true_plane(seed):
    found, plane = setup(make_scene(seed=seed, sigma_px=0.0), seed=seed)
    region = CheiralityRegion.of(found.frame, found.reconstruction, np.random.default_rng(0))
    assert region.wrong_side_ratio(plane[None])[0] == 0.0
    planes = [np.linalg.inv(part.quasi_affine).T @ np.append(plane, 1.0) for part in region.polytopes]
    inside = [part.contains(v[None, :3] / v[3])[0] for part, v in zip(region.polytopes, planes, strict=True)]
    assert sum(inside) == 1


def test_samples_of_the_bounds_are_inside_them():
    rows = np.column_stack([np.vstack([np.eye(3), -np.eye(3)]), [1.0] * 3 + [2.0] * 3])
    np.testing.assert_allclose(_plane_box(rows), [[-1.0, 2.0]] * 3)
    found, _ = setup(make_scene(seed=2))
    region = CheiralityRegion.of(found.frame, found.reconstruction, np.random.default_rng(0))
    for part in region.polytopes:
        v = part.sample(100, np.random.default_rng(1))
        assert part.contains(v).all()
        assert (np.ptp(v, axis=0) > 0.1 * np.ptp(part.box, axis=1)).all()
        back = part.reference_planes(v)
        assert region.wrong_side_ratio(back).max() == 0.0


@pytest.mark.parametrize(("plane", "way"), PAIRS, ids=lambda v: type(v).__name__)
@pytest.mark.parametrize("seed", range(3))
def test_exact_cameras_give_the_exact_solution_in_closed_form(plane, way, seed):
    scene = make_scene(seed=seed)
    answer = Stratified(plane, way, refine=False).calibrate(
        projective_reconstruction(scene, seed=seed), prior=prior_for(scene), rng=np.random.default_rng(seed)
    )
    np.testing.assert_allclose(answer.K[:, 0, 0], 1500.0, rtol=1e-8)
    assert answer.identifiable
    assert type(plane).__name__ in answer.candidates[0].method


def test_an_unknown_constant_calibration_comes_out_whole():
    scene = make_scene(seed=4, principal_shift=(70.0, -50.0))
    answer = Stratified(ModulusConstraint(), refine=False).calibrate(
        projective_reconstruction(scene, seed=4),
        prior=prior_for(scene, NOTHING_BUT_CONSTANT),
        rng=np.random.default_rng(4),
    )
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_three_views_of_a_constant_camera_suffice(seed):
    scene = make_scene(views=3, seed=seed, seen_share=1.0)
    found, plane = setup(scene, seed=seed)
    candidates = ModulusConstraint().locate(found, np.random.default_rng(0))
    nearest = np.linalg.norm(candidates.planes - plane, axis=1).min()
    assert nearest < 1e-6
    answer = with_constants(Stratified, max_candidates=21)(ModulusConstraint()).calibrate(
        projective_reconstruction(scene, seed=seed), prior=prior_for(scene), rng=np.random.default_rng(0)
    )
    assert answer.K[0, 0, 0] == pytest.approx(1500.0, rel=1e-6)


def test_zooming_cameras_are_found_by_the_search_and_refused_by_the_modulus_constraint():
    scene = make_scene(seed=6, zoom=0.3)
    given, prior = projective_reconstruction(scene, seed=6), prior_for(scene, CENTRED_ZOOM)
    answer = Stratified(refine=False).calibrate(given, prior=prior, rng=np.random.default_rng(0))
    np.testing.assert_allclose(answer.K[:, 0, 0], scene.K[:, 0, 0], rtol=1e-8)
    with pytest.raises(StageFailure, match="three images of one camera"):
        Stratified(ModulusConstraint()).calibrate(given, prior=prior, rng=np.random.default_rng(0))


@pytest.mark.parametrize(("plane", "way"), PAIRS, ids=lambda v: type(v).__name__)
def test_noise_moves_the_focal_by_little(plane, way):
    scene = make_scene(seed=7)
    given = projective_reconstruction(scene, seed=7)
    unit = np.linalg.inv(pixel_from_unit(scene.sizes))
    P = unit @ given.P
    size = np.linalg.norm(P, axis=(1, 2), keepdims=True)
    P += 1e-4 * size * np.random.default_rng(0).normal(size=P.shape)
    noisy = replace(given, P=np.linalg.inv(unit) @ P)
    answer = Stratified(plane, way).calibrate(noisy, prior=prior_for(scene), rng=np.random.default_rng(0))
    np.testing.assert_allclose(answer.K[:, 0, 0], 1500.0, rtol=0.01)


def test_the_same_seed_gives_the_same_bytes():
    scene = make_scene(seed=9)
    given, prior = projective_reconstruction(scene, seed=9), prior_for(scene)
    for plane in (CheiralitySearch(), ModulusConstraint()):
        first, second = (
            Stratified(plane).calibrate(given, prior=prior, rng=np.random.default_rng(3)) for _ in range(2)
        )
        assert first.metric_from_projective.tobytes() == second.metric_from_projective.tobytes()


def test_copies_of_one_point_set_no_bounds():
    scene = make_scene(seed=0)
    X = np.tile([0.1, 0.2, 0.3, 1.0], (50, 1))
    xh = np.einsum("vij,nj->vni", scene.P, X)
    H = np.random.default_rng(0).normal(size=(4, 4))
    one = reconstruction_from_cameras(
        scene.P @ np.linalg.inv(H), sizes=scene.sizes, X=X @ H.T, xy=xh[..., :2] / xh[..., 2:],
        stratum="projective",
    )  # fmt: skip
    prior, rng = prior_for(scene, NOTHING_BUT_CONSTANT), np.random.default_rng(0)
    with pytest.raises(StageFailure, match="found no plane at infinity"):
        Stratified(CheiralitySearch()).calibrate(one, prior=prior, rng=rng)
    found = Stratified(ModulusConstraint()).calibrate(one, prior=prior, rng=rng)
    np.testing.assert_allclose(found.K, scene.K, rtol=1e-6, atol=1e-3)

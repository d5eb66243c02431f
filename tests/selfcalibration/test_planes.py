"""The ways to the plane at infinity on exact and noisy scenes, and the affine stratum that it gives."""

from dataclasses import replace

import numpy as np
import pytest

import thesisrecon
from tests.conftest import refuses
from tests.constants import with_constants
from tests.selfcalibration.stratified_scenes import (
    CENTRED,
    CENTRED_ZOOM,
    NOTHING_BUT_CONSTANT,
    calibrated,
    prior_for,
    setup,
)
from tests.synthetic import make_scene, projective_reconstruction, with_poses
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, pixel_from_unit
from thesisrecon.selfcalibration import cheirality
from thesisrecon.selfcalibration._upgrade import group_focals_from_planes
from thesisrecon.selfcalibration.absolute_conic import FixedPlaneQuadric, LinearAbsoluteConic
from thesisrecon.selfcalibration.stratified import Stratified, _facing, upgrade_to_affine

PAIRS = [
    (plane, way)
    for plane in (cheirality.CheiralitySearch(), cheirality.ModulusConstraint())
    for way in (LinearAbsoluteConic(), FixedPlaneQuadric())
]


@pytest.mark.parametrize("seed", range(4))
def test_the_true_plane_satisfies_the_quartics_for_any_constant_calibration(seed):
    scene = make_scene(seed=seed, principal_shift=(80.0, -60.0))
    found, plane = setup(scene, NOTHING_BUT_CONSTANT, seed=seed)
    pairs = cheirality._pairs_of_constant_cameras(found.constraints.first)
    assert len(pairs) == 28
    c = cheirality._modulus_coefficients(found.frame.A, found.frame.a, pairs)
    l0, l1, l2, l3 = (c[:, :, :3] @ plane + c[:, :, 3]).T
    left, right = l3 * l1**3, l2**3 * l0
    assert np.abs((left - right) / (np.abs(left) + np.abs(right))).max() < 1e-9
    r, t = cheirality._modulus_residuals(c, plane[None])
    assert np.abs(r).max() < 1e-9
    R = scene.R
    angles = np.trace(R[pairs[:, 0]] @ R[pairs[:, 1]].swapaxes(1, 2), axis1=1, axis2=2)
    np.testing.assert_allclose(t[0], angles, atol=1e-8)


def region_of(found):
    rng = np.random.default_rng(0)
    return cheirality.CheiralityRegion.of(found.frame, found.reconstruction, rng)


@pytest.mark.parametrize("seed", range(4))
def test_the_cheirality_bounds_hold_the_true_plane(seed):
    found, plane = setup(make_scene(seed=seed), seed=seed)
    region = region_of(found)
    assert region.wrong_side_ratio(plane[None])[0] == 0.0
    planes = [np.linalg.inv(part.quasi_affine).T @ np.append(plane, 1.0) for part in region.polytopes]
    inside = [part.contains(v[None, :3] / v[3])[0] for part, v in zip(region.polytopes, planes, strict=True)]
    assert sum(inside) == 1


@pytest.mark.parametrize(("points", "bounded"), [(7, False), (8, True)])
def test_eight_points_bound_the_plane(points, bounded):
    found, plane = setup(make_scene(points=points, seen_share=1.0, seed=1), seed=1)
    region = region_of(found)
    assert len(region.points) == points
    assert bool(region.polytopes) == bounded
    assert region.wrong_side_ratio(plane[None])[0] == 0.0


def test_the_true_plane_and_one_focal_give_those_of_all_cameras():
    scene = make_scene(seed=6, zoom=0.3)
    found, plane = setup(scene, CENTRED_ZOOM, seed=6)
    f = scene.K[:, 0, 0] / 1536.0
    log_f = group_focals_from_planes(found.frame, plane[None], f[[found.frame.reference]])
    np.testing.assert_allclose(np.exp(log_f[0, found.frame.group]), f, rtol=1e-6)


def test_local_minima_of_a_grid_are_those_of_a_search_of_all_neighbours():
    rng = np.random.default_rng(0)
    score = rng.integers(0, 12, (5, 5, 5)).astype(float)
    score[rng.random((5, 5, 5)) < 0.2] = np.inf
    steps = np.vstack([np.eye(3, dtype=int), -np.eye(3, dtype=int)])

    def is_least(cell):
        beside = [tuple(n) for n in cell + steps if (n >= 0).all() and (n < 5).all()]
        return np.isfinite(score[cell]) and all(score[cell] <= score[n] for n in beside)

    expected = [k for k, cell in enumerate(np.ndindex(5, 5, 5)) if is_least(cell)]
    assert cheirality._local_minima(score).tolist() == sorted(expected, key=lambda k: score.flat[k])


def test_samples_of_the_bounds_are_inside_them():
    rows = np.column_stack([np.vstack([np.eye(3), -np.eye(3)]), [1.0] * 3 + [2.0] * 3])
    np.testing.assert_allclose(cheirality._plane_box(rows), [[-1.0, 2.0]] * 3)
    region = region_of(setup(make_scene(seed=2))[0])
    for part in region.polytopes:
        v = part.sample(100, np.random.default_rng(1))
        assert part.contains(v).all()
        assert (np.ptp(v, axis=0) > 0.1 * np.ptp(part.box, axis=1)).all()
        assert region.wrong_side_ratio(part.reference_planes(v)).max() == 0.0


@pytest.mark.parametrize(("plane", "way"), PAIRS, ids=lambda v: type(v).__name__)
@pytest.mark.parametrize("seed", range(3))
def test_exact_cameras_give_the_exact_solution_in_closed_form(plane, way, seed):
    scene = make_scene(seed=seed)
    answer = calibrated(Stratified(plane, way, refine=False), scene, prior_for(scene), seed=seed)
    np.testing.assert_allclose(answer.K[:, 0, 0], 1500.0, rtol=1e-8)
    assert answer.identifiable
    assert type(plane).__name__ in answer.candidates[0].method


def test_an_unknown_constant_calibration_comes_out_whole_from_copies_of_a_point_too():
    scene = make_scene(seed=4, principal_shift=(70.0, -50.0))
    method, prior = (
        Stratified(cheirality.ModulusConstraint(), refine=False),
        prior_for(scene, NOTHING_BUT_CONSTANT),
    )
    np.testing.assert_allclose(calibrated(method, scene, prior, seed=4).K, scene.K, rtol=1e-7, atol=1e-4)
    scene = make_scene(seed=0)
    scene.X[:] = [0.1, 0.2, 0.3]
    one, prior = with_poses(scene, scene.R, scene.centres), prior_for(scene, NOTHING_BUT_CONSTANT)
    search = Stratified(cheirality.CheiralitySearch())
    refuses(StageFailure, "found no plane at infinity", calibrated, search, one, prior)
    found = calibrated(Stratified(cheirality.ModulusConstraint()), one, prior)
    np.testing.assert_allclose(found.K, scene.K, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_three_views_of_a_constant_camera_suffice(seed):
    scene = make_scene(views=3, seed=seed, seen_share=1.0)
    found, plane = setup(scene, seed=seed)
    candidates = cheirality.ModulusConstraint().locate(found, np.random.default_rng(0))
    assert np.linalg.norm(candidates - plane, axis=1).min() < 1e-6
    method = with_constants(Stratified, max_candidates=21)(cheirality.ModulusConstraint())
    answer = calibrated(method, scene, prior_for(scene), seed=seed)
    assert answer.K[0, 0, 0] == pytest.approx(1500.0, rel=1e-6)


def test_zooming_cameras_are_found_by_the_search_and_refused_by_the_modulus_constraint():
    scene = make_scene(seed=6, zoom=0.3)
    prior, modulus = prior_for(scene, CENTRED_ZOOM), Stratified(cheirality.ModulusConstraint())
    answer = calibrated(Stratified(refine=False), scene, prior, seed=6)
    np.testing.assert_allclose(answer.K[:, 0, 0], scene.K[:, 0, 0], rtol=1e-8)
    refuses(StageFailure, "three images of one camera", calibrated, modulus, scene, prior, seed=6)


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
    for plane in (cheirality.CheiralitySearch(), cheirality.ModulusConstraint()):
        first, second = (calibrated(Stratified(plane), scene, prior_for(scene), seed=9) for _ in range(2))
        assert first.metric_from_projective.tobytes() == second.metric_from_projective.tobytes()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "plane", [cheirality.CheiralitySearch(), cheirality.ModulusConstraint()], ids=lambda p: type(p).__name__
)
def test_the_located_plane_leaves_an_affine_map_to_the_scene(plane, seed):
    scene = make_scene(seed=seed)
    config = PipelineConfig(selfcalibration=Stratified(plane), intrinsics=CENTRED)
    affine = thesisrecon.upgrade_affine(projective_reconstruction(scene, seed=seed), config=config)
    assert affine.stratum == "affine"
    assert affine.valid.all()
    np.testing.assert_allclose(affine.X[:, 3], 1.0)
    A = np.linalg.lstsq(homogenize(scene.X), affine.X[:, :3], rcond=None)[0]
    np.testing.assert_allclose(homogenize(scene.X) @ A, affine.X[:, :3], atol=1e-7)
    estimated = -np.linalg.solve(affine.P[:, :, :3], affine.P[:, :, 3:])[..., 0]
    np.testing.assert_allclose(estimated, homogenize(scene.centres) @ A, atol=1e-6)


def test_parallels_stay_parallel_and_ratios_are_kept():
    scene, rng = make_scene(seed=1), np.random.default_rng(0)
    start, step, ratio = rng.uniform(-1, 1, (50, 3)), np.array([0.3, -0.5, 0.4]), rng.uniform(0.2, 0.8, 50)
    points = np.concatenate([start, start + step, start + ratio[:, None] * step, scene.X[150:]])
    given = projective_reconstruction(replace(scene, X=points), seed=1)
    answer = Stratified(cheirality.ModulusConstraint()).calibrate(given, prior=prior_for(scene), rng=rng)
    affine = upgrade_to_affine(given, answer.plane_at_infinity)
    a, b, c = affine.X[:150, :3].reshape(3, 50, 3)
    np.testing.assert_allclose(b - a, np.tile(b[0] - a[0], (50, 1)), atol=1e-6)
    np.testing.assert_allclose(c - a, ratio[:, None] * (b - a), atol=1e-6)
    # The projective frame keeps neither.
    p, q = dehomogenize(given.X[:100]).reshape(2, 50, 3)
    directions = (q - p) / np.linalg.norm(q - p, axis=1)[:, None]
    assert np.abs(directions - directions[0]).max() > 0.01


def test_images_stay_what_they_are_and_depths_are_positive():
    scene = make_scene(seed=2)
    given = projective_reconstruction(scene, seed=2)
    affine = upgrade_to_affine(given, np.array([0.1, -0.2, 0.05, 1.0]))
    t = scene.tracks
    before, after = (np.einsum("kij,kj->ki", r.P[t.view_index], r.X[t.point_index]) for r in (given, affine))
    np.testing.assert_allclose(before[:, :2] / before[:, 2:], after[:, :2] / after[:, 2:], rtol=1e-9)
    # Outliers behind a camera do not turn it, even if they are more than the inliers.
    away, X = np.arange(len(affine.X)) % 3 > 0, affine.X.copy()
    X[away, :3] = -2.0 * np.linalg.solve(affine.P[0, :, :3], affine.P[0, :, 3]) - X[away, :3]
    assert (_facing(replace(affine, X=X, inlier=~away[t.point_index]))[0] == affine.P[0]).all()
    true = thesisrecon.upgrade_affine(given, config=PipelineConfig(intrinsics=CENTRED))
    depth = np.einsum("kj,kj->k", true.P[t.view_index, 2], true.X[t.point_index])
    assert (depth > 0).all()
    # One camera is [I | 0] behind its nominal calibration, its points at a median depth of 1.
    units = np.linalg.solve(pixel_from_unit(true.sizes), true.P)
    units /= np.linalg.norm(units[:, 2, :3], axis=1)[:, None, None]
    view = int(np.argmin(np.abs(units - np.eye(3, 4)).max(axis=(1, 2))))
    np.testing.assert_allclose(units[view], np.eye(3, 4), atol=1e-9)
    assert np.median(true.X[t.point_index[t.view_index == view], 2]) == pytest.approx(1.0)


def test_a_plane_may_be_given_and_wrong_calls_and_hopeless_data_are_refused():
    given = projective_reconstruction(make_scene(seed=3), seed=3)
    plane = np.array([0.1, 0.0, -0.1, 1.0])
    affine = upgrade_to_affine(given, plane)
    np.testing.assert_array_equal(thesisrecon.upgrade_affine(given, plane).X, affine.X)
    # Points of the plane are at infinity, whatever the scales of the homogeneous coordinates are.
    X = given.X.copy()
    X[::50, 3] = -X[::50, :3] @ plane[:3]
    scales = np.ones(300), np.logspace(-6.0, 6.0, 300)
    one, other = (upgrade_to_affine(replace(given, X=X * scale[:, None]), plane) for scale in scales)
    np.testing.assert_array_equal(other.valid, np.arange(300) % 50 > 0)
    np.testing.assert_allclose(other.X, one.X, rtol=1e-6, atol=1e-9)
    refuses(ValueError, "affine", upgrade_to_affine, affine, np.ones(4))
    refuses(ValueError, "plane", upgrade_to_affine, given, np.zeros(4))
    few = replace(given, registered=np.arange(8) < 2)
    refuses(StageFailure, "at least 3", thesisrecon.upgrade_affine, few)

"""The image conic from exact infinite homographies, and the plane at infinity from vanishing points."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.selfcalibration import stratified_scenes as scenes
from tests.synthetic import TrueScene, make_scene, projective_reconstruction, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.strata import calibration_from_image
from thesisrecon.io._images import read_images
from thesisrecon.records import Tracks
from thesisrecon.selfcalibration._frame import (
    infinite_homographies,
    projective_scene,
    square_pixel_constraints,
)
from thesisrecon.selfcalibration.absolute_conic import (
    FixedPlaneQuadric,
    LinearAbsoluteConic,
    _largest_rotation,
    _undetermined_failure,
    dual_conic_of_constant_camera,
    solve_conic,
    solve_conic_batch,
)
from thesisrecon.selfcalibration.parallel_lines import (
    LineSegments,
    ParallelLines,
    _find_parallel_directions,
    _fit_segments,
    _normalize_segments,
    _propose_vanishing_points,
    _refine_plane,
    _refined_point,
    _triangulated_pairs,
)
from thesisrecon.selfcalibration.stratified import Stratified
from validation.scenes.real import load_fixture_scene

WAYS = [LinearAbsoluteConic(), FixedPlaneQuadric()]


def pixels(found, K):
    return found.frame.pixel_from_unit[found.frame.views] @ K


@pytest.mark.parametrize("seed", range(4))
def test_the_dual_image_is_carried_exactly_by_homographies_of_determinant_one(seed):
    scene = make_scene(seed=seed, principal_shift=(60.0, -45.0))
    found, plane = scenes.setup(scene, scenes.NOTHING_BUT_CONSTANT, seed=seed)
    H = infinite_homographies(found.frame, plane[None])[0]
    np.testing.assert_allclose(np.linalg.det(H), 1.0, atol=1e-12)
    dual, s = dual_conic_of_constant_camera(H)
    np.testing.assert_allclose(H @ dual @ H.swapaxes(1, 2), np.tile(dual, (len(H), 1, 1)), atol=1e-9)
    K = pixels(found, calibration_from_image(dual, is_dual=True)[None])[0]
    np.testing.assert_allclose(K, scene.K[0], rtol=1e-8, atol=1e-5)
    assert s[5] < 1e-10 < 1e-4 * s[4]


@pytest.mark.parametrize("way", WAYS, ids=lambda w: type(w).__name__)
@pytest.mark.parametrize(
    ("options", "zoom"),
    [(scenes.CENTRED, 0.0), (scenes.CENTRED_ZOOM, 0.3), (scenes.NOTHING_BUT_CONSTANT, 0.0)],
)
@pytest.mark.parametrize("seed", range(3))
def test_the_true_plane_gives_the_true_calibrations(way, options, zoom, seed):
    shift = (60.0, -45.0) if options is scenes.NOTHING_BUT_CONSTANT else (0.0, 0.0)
    scene = make_scene(zoom=zoom, seed=seed, principal_shift=shift)
    found, plane = scenes.setup(scene, options, seed=seed)
    K = pixels(found, way.calibrations(found, plane))
    np.testing.assert_allclose(K[:, 0, 0], scene.K[:, 0, 0], rtol=1e-8)
    np.testing.assert_allclose(K, scene.K, atol=2e-5)


def test_rough_principal_points_and_right_angles_help():
    scene = make_scene(seed=3, principal_shift=(12.0, -9.0))
    found, plane = scenes.setup(scene, IntrinsicsOptions(), seed=3)
    K = pixels(found, LinearAbsoluteConic().calibrations(found, plane))
    np.testing.assert_allclose(K[:, 0, 0], scene.K[:, 0, 0], rtol=2e-3)
    assert np.linalg.norm(K[0, :2, 2] - scene.K[0, :2, 2]) < 5.0
    # With square pixels, three vanishing points at right angles give all of K.
    scene = make_scene(seed=5, principal_shift=(40.0, 25.0))
    found, _ = scenes.setup(scene, scenes.NOTHING_BUT_CONSTANT, seed=5)
    reference = found.frame.reference
    H = np.tile(np.eye(3), (len(scene.K), 1, 1))
    v = (np.linalg.inv(found.frame.pixel_from_unit[reference]) @ scene.K[reference] @ scene.R[reference]).T
    orthogonal = np.array([[v[0], v[1]], [v[0], v[2]], [v[1], v[2]]])
    constraints = square_pixel_constraints(found.frame)
    constraints.std[:, 1:3] = np.inf
    conic = solve_conic(H, constraints, orthogonal=orthogonal)
    dual = np.linalg.inv(conic.w)
    K = found.frame.pixel_from_unit[reference] @ calibration_from_image(dual, is_dual=True)
    np.testing.assert_allclose(K, scene.K[reference], rtol=1e-8, atol=1e-5)
    assert conic.determined


@pytest.mark.parametrize("focal", [500.0, 6000.0])
def test_short_and_long_lenses_need_no_guess(focal):
    found, plane = scenes.setup(make_scene(seed=2, focal=focal), scenes.CENTRED, seed=2)
    for way in WAYS:
        K = pixels(found, way.calibrations(found, plane))
        np.testing.assert_allclose(K[:, 0, 0], focal, rtol=1e-7)


def test_the_score_of_the_right_plane_is_zero_and_grows_away_from_it():
    scene = make_scene(seed=1)
    found, plane = scenes.setup(scene, seed=1)
    planes = plane + np.array([0.0, 0.01, 0.05])[:, None] * [1.0, -0.5, 0.3]
    H = infinite_homographies(found.frame, planes)
    small = replace(found.frame, A=1e-8 * found.frame.A, a=1e-8 * found.frame.a)
    np.testing.assert_allclose(infinite_homographies(small, planes), H, atol=1e-9)
    f2, residuals = solve_conic_batch(H, square_pixel_constraints(found.frame))
    score = np.linalg.norm(residuals, axis=1)
    assert score[0] < 1e-7
    assert score[0] < score[1] < score[2]
    unit = found.frame.pixel_from_unit[0, 0, 0]
    assert np.sqrt(f2[0]) * unit == pytest.approx(1500.0, rel=1e-8)


def test_motions_and_planes_without_a_calibration_are_named():
    scene = make_scene(seed=0)
    turned = scenes.turned_about_one_axis(scene, np.linspace(-20.0, 20.0, 8))
    K, R = turned.K[0], turned.R
    angle, axis = _largest_rotation(K @ R @ R[0].T @ np.linalg.inv(K))
    assert angle == pytest.approx(40.0)
    seen = K @ R[0] @ [0.0, 1.0, 0.0]
    assert np.linalg.norm(np.cross(axis, seen / np.linalg.norm(seen))) < 1e-9
    tilted = Rotation.from_euler("x", 70.0, degrees=True).as_matrix() @ turned.R
    found, _ = scenes.setup(with_poses(turned, tilted, turned.centres), scenes.NOTHING_BUT_CONSTANT)
    unit = np.linalg.inv(found.frame.pixel_from_unit[found.frame.views]) @ K
    H = unit @ tilted @ tilted[found.frame.reference].T @ np.linalg.inv(unit[found.frame.reference])
    evidence = _undetermined_failure(found.frame, H, None).evidence
    (place,) = re.findall(r"axis at \((-?\d+), (-?\d+)\) px", evidence)
    seen = dehomogenize(K @ tilted[found.frame.reference] @ [0.0, 1.0, 0.0])
    np.testing.assert_allclose(np.array(place, dtype=float), seen, atol=1.0)
    linear, fixed = (way.calibrations for way in WAYS)
    found, plane = scenes.setup(turned, scenes.NOTHING_BUT_CONSTANT)
    refuses(StageFailure, r"same axis.*one-parameter|one-parameter.*same axis", linear, found, plane)
    refuses(StageFailure, "one-parameter", fixed, found, plane)
    still = scenes.turned_about_one_axis(scene, np.zeros(8))
    refuses(StageFailure, "do not rotate", linear, *scenes.setup(still, scenes.NOTHING_BUT_CONSTANT))
    found, plane = scenes.setup(make_scene(seed=1), seed=1)
    other = 0 if found.frame.reference else 1
    centre = -np.linalg.solve(found.frame.A[other], found.frame.a[other])
    through = plane - (plane @ centre + 1.0) / (centre @ centre) * centre
    refuses(StageFailure, "passes through a camera", linear, found, through)


def test_a_wrong_plane_without_a_real_camera_is_refused_with_its_eigenvalues():
    scene = make_scene(seed=1)
    found, plane = scenes.setup(scene, scenes.NOTHING_BUT_CONSTANT, seed=1)
    refused = 0
    for shift in np.random.default_rng(0).normal(0.0, 2.0, (20, 3)):
        try:
            LinearAbsoluteConic().calibrations(found, plane + shift)
        except StageFailure as failure:
            refused += "eigenvalues" in str(failure)
    assert refused > 0


TURN = np.array([[0.8, 0.36, 0.48], [-0.6, 0.48, 0.64], [0.0, -0.8, 0.6]])
"""Three directions at right angles, none of them along an axis."""


def vanishing_points(scene, directions, views):
    """Exact vanishing points of directions (D, 3) in the named views."""
    found = np.full((len(scene.K), len(directions), 3), np.nan)
    found[views] = directions @ (scene.K @ scene.R)[views].swapaxes(1, 2)
    return found


def drawn_segments(scene, *, sigma_px, stray, seed):
    """Segments of 40 lines along each of three directions seen by every camera, and ``stray`` of none."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1.5, 1.5, (120, 3))
    Y = X + np.repeat(TURN, 40, axis=0) * rng.uniform(0.5, 1.0, (120, 1))
    found = []
    for P in scene.P:
        ends = [np.column_stack([Z, np.ones(len(Z))]) @ P.T for Z in (X, Y)]
        true = np.concatenate([e[:, :2] / e[:, 2:] for e in ends], axis=1)
        place = rng.uniform(0.0, 1000.0, (stray, 2))
        wild = np.concatenate([place, place + rng.normal(0.0, 60.0, (stray, 2))], axis=1)
        found.append(np.concatenate([true + rng.normal(0.0, sigma_px, true.shape), wild]))
    return found


def test_more_directions_and_points_at_infinity_do_no_harm():
    scene = make_scene(seed=1)
    given = vanishing_points(scene, np.vstack([scene.R[0], [0.3, -0.2, 0.9]]), [0, 3, 6])
    assert abs(given[0, 0, 2]) < 1e-12
    found, plane = scenes.setup(scene, seed=1)
    # A direction along the baseline has epipoles for vanishing points, which determine nothing.
    baseline = np.vstack([TURN, scene.centres[1] - scene.centres[0]])
    for vanishing in (given, vanishing_points(scene, baseline, [0, 1])):
        located = ParallelLines(vanishing).locate(found, np.random.default_rng(0))
        np.testing.assert_allclose(located.planes[0], plane, atol=1e-8)


def test_directions_at_right_angles_give_the_calibration_too():
    """With three views nothing but right angles and zero skew settles K of one camera."""
    scene = make_scene(seed=2, views=3, principal_shift=(50.0, -30.0), seen_share=1.0)
    way = ParallelLines(vanishing_points(scene, TURN, [0, 1]), orthogonal_directions=True)
    prior = scenes.prior_for(scene, scenes.NOTHING_BUT_CONSTANT)
    answer = scenes.calibrated(Stratified(way, refine=False), scene, prior, seed=2)
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-7, atol=1e-3)


def test_vanishing_points_of_one_direction_are_near_the_epipolar_lines_of_each_other():
    turn = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    P = np.stack([np.eye(3, 4), np.column_stack([TURN, [1.0, 0.2, 0.1]])])
    first = np.array([[0.3, -0.2, 1.0]])
    for scale in (0.2, 1.0, 5.0):
        cameras, second = P * np.array([1.0, scale])[:, None, None], first @ TURN.T
        assert len(_triangulated_pairs(cameras, [first, second])) == 1
        assert len(_triangulated_pairs(cameras, [first, second @ turn.T])) == 0


@pytest.mark.parametrize(("sigma", "stray", "limit"), [(0.0, 0, 1e-8), (0.3, 60, 0.01)])
def test_directions_are_found_among_strays(sigma, stray, limit):
    scene = make_scene(seed=5, views=6)
    found, plane = scenes.setup(scene, seed=5)
    frame = found.frame
    segments = _normalize_segments(frame, drawn_segments(scene, sigma_px=sigma, stray=stray, seed=5))
    rng = np.random.default_rng(1)
    proposals = [_propose_vanishing_points(segments.subset(segments.camera == k), rng) for k in range(6)]
    X, direction = _find_parallel_directions(frame.P, segments, proposals, 3)
    again = _refined_point(frame.P, segments, X[0] + [1e-3, -1e-3, 1e-3, 0.0])
    np.testing.assert_allclose(again, X[0], atol=2e-4)
    truth = np.tile(np.concatenate([np.repeat([0, 1, 2], 40), np.full(stray, -1)]), 6)
    for d in range(3):
        mine = truth[direction == d]
        # A segment that runs towards two of the directions goes to the stronger one.
        right = np.bincount(mine[mine >= 0], minlength=3).max()
        assert right > max(0.7 * 240, 0.85 * len(mine))
    v = X[:, :3] / np.linalg.norm(X[:, :3], axis=1, keepdims=True)
    start = np.linalg.svd(X)[2][-1]
    refined, _, noise = _refine_plane(frame, segments, direction, start[:3] / start[3], v)
    np.testing.assert_allclose(refined, plane, atol=limit)
    assert noise == pytest.approx(sigma, rel=0.5, abs=0.01)


def test_the_detector_finds_the_sides_of_a_turned_square_and_nothing_in_noise():
    y, x = np.mgrid[0:200, 0:240].astype(np.float64)
    half, c, s = 60.0, np.cos(np.radians(17.0)), np.sin(np.radians(17.0))

    def off_the_sides(x, y):
        u, v = x - 118.3, y - 97.6
        return np.maximum(np.abs(u * c + v * s), np.abs(v * c - u * s)) - half

    gray = (60.0 + 120.0 * np.clip(0.5 - off_the_sides(x, y), 0.0, 1.0)).astype(np.float32)
    segments = LineSegments().detect(gray)
    assert len(segments) == 4
    ends = segments.reshape(4, 2, 2)
    assert (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 100.0).all()
    np.testing.assert_allclose(off_the_sides(ends[..., 0], ends[..., 1]), 0.0, atol=0.15)
    # Edge points that are denser at one end.
    xy = np.array([3.0, 7.0]) + np.linspace(0.0, 1.0, 40)[:, None] ** 2 * [40.0, 30.0]
    np.testing.assert_allclose(_fit_segments(xy, np.zeros(40, np.int64))[0], [[3.0, 7.0, 43.0, 37.0]])
    assert LineSegments().detect(np.full((50, 60), 90.0, dtype=np.float32)).shape == (0, 4)
    noise = np.random.default_rng(0).normal(128.0, 5.0, (300, 400)).astype(np.float32)
    assert len(LineSegments().detect(noise)) < 10


def courtyard(views):
    """The true cameras of the courtyard with points strewn over the yard."""
    truth, n = load_fixture_scene(), len(views)
    X = np.random.default_rng(0).uniform([-3.0, -2.5, 0.2], [3.0, -0.2, 3.0], (200, 3))
    point, view = np.indices((200, n)).reshape(2, -1)
    tracks, sizes = Tracks(view, point, np.zeros((200 * n, 2)), n, 200), np.tile([1024, 768], (n, 1))
    scene = TrueScene(truth.K[views], truth.R[views], np.zeros((n, 3)), X, 0.0, tracks, sizes)
    return with_poses(scene, scene.R, truth.C[views]), [truth.image_paths[v] for v in views]


def test_parallel_lines_are_found_in_photographs():
    scene, paths = courtyard([0, 3, 6, 9, 12])
    photographs = read_images(paths, max_size_px=1600).images
    given, prior = projective_reconstruction(scene), scenes.prior_for(scene, scenes.CENTRED)
    variant = Stratified(ParallelLines(), refine=False).with_images(photographs)
    found = projective_scene(given, prior)
    located = variant.plane.locate(found, np.random.default_rng(0))
    plane = scenes.true_plane(scene, found)
    assert np.linalg.norm(located.planes[0] - plane) < 0.02 * (1.0 + np.linalg.norm(plane))
    answer = variant.calibrate(given, prior=prior, rng=np.random.default_rng(0))
    np.testing.assert_allclose(answer.K[:, 0, 0], scene.K[0, 0, 0], rtol=0.03)


def test_a_wall_of_nothing_is_refused_with_its_directions():
    scene, paths = courtyard([0, 6, 12])
    photographs = read_images(paths, max_size_px=1600).images
    flat = [replace(image, rgb=np.full_like(image.rgb, 90)) for image in photographs]
    method = Stratified(ParallelLines()).with_images(flat)
    refuses(StageFailure, "0 directions", scenes.calibrated, method, scene, scenes.prior_for(scene))

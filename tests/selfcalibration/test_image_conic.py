"""The image conic from exact infinite homographies, constant and zooming, and the equations' properties."""

from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import refuses
from tests.selfcalibration import stratified_scenes as scenes
from tests.synthetic import make_scene
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.strata import calibration_from_image
from thesisrecon.selfcalibration._frame import infinite_homographies, square_pixel_constraints
from thesisrecon.selfcalibration.absolute_conic import (
    FixedPlaneQuadric,
    LinearAbsoluteConic,
    _largest_rotation,
    dual_conic_of_constant_camera,
    solve_conic,
    solve_conic_batch,
)

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


def test_roughly_known_principal_points_move_towards_the_truth():
    scene = make_scene(seed=3, principal_shift=(12.0, -9.0))
    found, plane = scenes.setup(scene, IntrinsicsOptions(), seed=3)
    K = pixels(found, LinearAbsoluteConic().calibrations(found, plane))
    np.testing.assert_allclose(K[:, 0, 0], scene.K[:, 0, 0], rtol=2e-3)
    assert np.linalg.norm(K[0, :2, 2] - scene.K[0, :2, 2]) < 5.0


@pytest.mark.parametrize("focal", [500.0, 6000.0])
def test_short_and_long_lenses_need_no_guess(focal):
    scene = make_scene(seed=2, focal=focal)
    found, plane = scenes.setup(scene, scenes.CENTRED, seed=2)
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


def test_right_angles_determine_the_calibration_of_cameras_that_do_not_turn():
    """With square pixels, three vanishing points at right angles give all of K."""
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


def test_turns_measures_the_rotation_and_its_axis():
    scene = scenes.turned_about_one_axis(make_scene(seed=0), np.linspace(-20.0, 20.0, 8))
    K, R = scene.K[0], scene.R
    H = K @ R @ R[0].T @ np.linalg.inv(K)
    angle, axis = _largest_rotation(H)
    assert angle == pytest.approx(40.0)
    seen = K @ R[0] @ [0.0, 1.0, 0.0]
    assert np.linalg.norm(np.cross(axis, seen / np.linalg.norm(seen))) < 1e-9


def test_one_axis_of_rotation_is_named():
    scene = make_scene(seed=0)
    turned = scenes.turned_about_one_axis(scene, np.linspace(-20.0, 20.0, 8))
    found, plane = scenes.setup(turned, scenes.NOTHING_BUT_CONSTANT)
    with pytest.raises(StageFailure, match=r"same axis.*one-parameter|one-parameter.*same axis"):
        LinearAbsoluteConic().calibrations(found, plane)
    refuses(StageFailure, "one-parameter", FixedPlaneQuadric().calibrations, found, plane)


def test_cameras_that_do_not_turn_are_named():
    turned = scenes.turned_about_one_axis(make_scene(seed=0), np.zeros(8))
    found, plane = scenes.setup(turned, scenes.NOTHING_BUT_CONSTANT)
    refuses(StageFailure, "do not rotate", LinearAbsoluteConic().calibrations, found, plane)


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


def test_a_plane_through_a_camera_is_refused():
    scene = make_scene(seed=1)
    found, plane = scenes.setup(scene, seed=1)
    other = 0 if found.frame.reference else 1
    centre = -np.linalg.solve(found.frame.A[other], found.frame.a[other])
    through = plane - (plane @ centre + 1.0) / (centre @ centre) * centre
    refuses(StageFailure, "passes through a camera", LinearAbsoluteConic().calibrations, found, through)

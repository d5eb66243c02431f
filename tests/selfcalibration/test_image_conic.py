"""The image conic from exact infinite homographies."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.selfcalibration import stratified_scenes as scenes
from tests.synthetic import make_scene, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.strata import calibration_from_image
from thesisrecon.selfcalibration import _frame, absolute_conic

WAYS = [absolute_conic.LinearAbsoluteConic(), absolute_conic.FixedPlaneQuadric()]


def pixels(found, K):
    return found.frame.pixel_from_unit[found.frame.views] @ K


@pytest.mark.parametrize("seed", range(4))
def test_the_image_of_a_constant_camera_is_carried_exactly_by_homographies_of_determinant_one(seed):
    scene = make_scene(seed=seed, principal_shift=(60.0, -45.0))
    found, plane = scenes.setup(scene, scenes.NOTHING_BUT_CONSTANT, seed=seed)
    H = _frame.infinite_homographies(found.frame, plane[None])[0]
    np.testing.assert_allclose(np.linalg.det(H), 1.0, atol=1e-12)
    conic = absolute_conic.solve_conic(H, found.constraints)
    w, s = conic.w, conic.singular_values
    np.testing.assert_allclose(absolute_conic.transferred_conics(H, w), np.tile(w, (len(H), 1, 1)), atol=1e-9)
    K = pixels(found, calibration_from_image(w)[None])[0]
    np.testing.assert_allclose(K, scene.K[0], rtol=1e-8, atol=1e-5)
    assert s[5] < 1e-10 < 1e-4 * s[4]


@pytest.mark.parametrize("way", WAYS, ids=lambda w: type(w).__name__)
@pytest.mark.parametrize(
    ("options", "zoom", "focal"),
    [
        *((scenes.CENTRED, 0.0, focal) for focal in (500.0, 1500.0, 6000.0)),
        (scenes.CENTRED_ZOOM, 0.3, 1500.0), (scenes.NOTHING_BUT_CONSTANT, 0.0, 1500.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("seed", range(3))
def test_the_true_plane_gives_the_true_calibrations_of_short_and_long_lenses(way, options, zoom, focal, seed):
    shift = (60.0, -45.0) if options is scenes.NOTHING_BUT_CONSTANT else (0.0, 0.0)
    scene = make_scene(zoom=zoom, focal=focal, seed=seed, principal_shift=shift)
    found, plane = scenes.setup(scene, options, seed=seed)
    K = pixels(found, way.calibrations(found, plane))
    np.testing.assert_allclose(K[:, 0, 0], scene.K[:, 0, 0], rtol=1e-8)
    np.testing.assert_allclose(K, scene.K, atol=2e-5)


def test_rough_principal_points_and_right_angles_help():
    scene = make_scene(seed=3, principal_shift=(12.0, -9.0))
    found, plane = scenes.setup(scene, IntrinsicsOptions(), seed=3)
    K = pixels(found, absolute_conic.LinearAbsoluteConic().calibrations(found, plane))
    np.testing.assert_allclose(K[:, 0, 0], scene.K[:, 0, 0], rtol=2e-3)
    assert np.linalg.norm(K[0, :2, 2] - scene.K[0, :2, 2]) < 5.0


def test_the_score_of_the_right_plane_is_zero_and_grows_away_from_it():
    scene = make_scene(seed=1)
    found, plane = scenes.setup(scene, seed=1)
    planes = plane + np.array([0.0, 0.01, 0.05])[:, None] * [1.0, -0.5, 0.3]
    H = _frame.infinite_homographies(found.frame, planes)
    small = replace(found.frame, A=1e-8 * found.frame.A, a=1e-8 * found.frame.a)
    np.testing.assert_allclose(_frame.infinite_homographies(small, planes), H, atol=1e-9)
    f2, residuals = absolute_conic.solve_conic_batch(H, _frame.square_pixel_constraints(found.frame))
    score = np.linalg.norm(residuals, axis=1)
    assert score[0] < 1e-7
    assert score[0] < score[1] < score[2]
    unit = found.frame.pixel_from_unit[0, 0, 0]
    assert np.sqrt(f2[0]) * unit == pytest.approx(1500.0, rel=1e-8)


def test_motions_and_planes_without_a_calibration_are_named():
    scene = make_scene(seed=0)
    turned = scenes.turned_about_one_axis(scene, np.linspace(-20.0, 20.0, 8))
    K, R = turned.K[0], turned.R
    angle, axis = absolute_conic._largest_rotation(K @ R @ R[0].T @ np.linalg.inv(K))
    assert angle == pytest.approx(40.0)
    seen = K @ R[0] @ [0.0, 1.0, 0.0]
    assert np.linalg.norm(np.cross(axis, seen / np.linalg.norm(seen))) < 1e-9
    tilted = Rotation.from_euler("x", 70.0, degrees=True).as_matrix() @ turned.R
    found, _ = scenes.setup(with_poses(turned, tilted, turned.centres), scenes.NOTHING_BUT_CONSTANT)
    unit = np.linalg.inv(found.frame.pixel_from_unit[found.frame.views]) @ K
    H = unit @ tilted @ tilted[found.frame.reference].T @ np.linalg.inv(unit[found.frame.reference])
    evidence = absolute_conic._undetermined_failure(found.frame, H, None).evidence
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
            absolute_conic.LinearAbsoluteConic().calibrations(found, plane + shift)
        except StageFailure as failure:
            refused += "eigenvalues" in str(failure)
    assert refused > 0

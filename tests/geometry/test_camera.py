"""Section 3.5: the camera, its parts, its centre, and what it sees in front."""

import numpy as np
import pytest

import thesisrecon
from tests.conftest import refuses
from tests.geometry.properties import holds_for_every, incidence_sine, random_camera, random_points
from thesisrecon.camera import compose_camera, decompose_camera, finite_cameras, project_camera, rq
from thesisrecon.geometry import camera_matrix as matrix
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize


@holds_for_every()
def test_3_16_and_3_17_the_calibration_matrix_takes_image_to_pixel_coordinates(rng):
    f_u, f_v, u_0, v_0, s = rng.uniform(1.0, 1000.0, 5)
    x, y = rng.normal(size=2)
    K = matrix.calibration_matrix(f_u, f_v, u_0, v_0, skew=s)
    np.testing.assert_allclose(K @ [x, y, 1.0], [f_u * x + s * y + u_0, f_v * y + v_0, 1.0])
    refuses(ValueError, "positive focals", matrix.calibration_matrix, -f_u, f_v, u_0, v_0)


@holds_for_every()
def test_3_18_to_3_21_cameras_from_and_to_their_parts(rng):
    P, K, R, centre = random_camera(rng)
    X = rng.normal(size=(5, 3))
    np.testing.assert_allclose(matrix.project(P, X), project_camera(K, R, -R @ centre, X))
    # The thesis' rotation is the transpose of ours: P = K [R' | -R'C] (3.21).
    thesis_R = R.T
    np.testing.assert_allclose(P, K @ np.column_stack([thesis_R.T, -thesis_R.T @ centre]), atol=1e-9)
    scale = rng.choice([-2.0, 0.5])
    K_found, R_found, t_found = decompose_camera(scale * P)
    np.testing.assert_allclose(K_found, K, atol=1e-6)
    np.testing.assert_allclose(R_found, R, atol=1e-9)
    np.testing.assert_allclose(-R_found.T @ t_found, centre, atol=1e-8)
    np.testing.assert_allclose(compose_camera(K_found, R_found, t_found), P, rtol=1e-6, atol=1e-6)
    many = matrix.camera_from_centre(np.stack([K, K]), np.stack([R, R]), np.stack([centre, centre]))
    np.testing.assert_allclose(many, np.stack([P, P]))


@holds_for_every()
def test_3_22_and_3_23_the_last_row_is_the_plane_that_projects_to_infinity(rng):
    P, K, R, centre = random_camera(rng)
    plane = P[2]
    on_plane = np.append(centre + rng.normal() * R[0] + rng.normal() * R[1], 1.0)
    assert abs((P @ on_plane)[2]) < 1e-9
    assert incidence_sine(plane, on_plane) < 1e-12
    assert incidence_sine(plane, np.append(centre, 1.0)) < 1e-12
    ahead = np.append(centre + 2.0 * R[2], 1.0)
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(matrix.principal_ray(sign * P), R[2], atol=1e-9)
        np.testing.assert_allclose(dehomogenize(sign * P @ ahead), K[:2, 2], rtol=1e-9)


@holds_for_every()
def test_3_24_to_3_26_the_centre_by_minors_is_the_null_vector(rng):
    P, _, _, centre = random_camera(rng)
    C = matrix.camera_centre(P)
    assert np.abs(P @ C).max() < 1e-12 * np.linalg.norm(P) * np.linalg.norm(C)
    np.testing.assert_allclose(dehomogenize(C), centre, rtol=1e-6, atol=1e-9)
    for k in range(4):
        assert C[k] == pytest.approx((-1.0) ** (k + 1) * np.linalg.det(np.delete(P, k, axis=1)), rel=1e-9)
    # Also where the centre is at infinity, as that of an affine camera.
    P[2] = [0.0, 0.0, 0.0, 1.0]
    C = matrix.camera_centre(P)
    assert abs(C[3]) < 1e-9 * np.linalg.norm(C)
    assert np.abs(P @ C).max() < 1e-12 * np.linalg.norm(P) * np.linalg.norm(C)


@holds_for_every()
def test_3_5_1_normalised_cameras_have_a_centre_with_last_entry_one(rng):
    P, _, _, centre = random_camera(rng)
    for scale in (1.0, -1.0, 1e-3):
        normal = matrix.normalize_camera(scale * P)
        assert np.linalg.det(normal[:, :3]) == pytest.approx(1.0)
        np.testing.assert_allclose(matrix.camera_centre(normal), np.append(centre, 1.0), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(normal, matrix.normalize_camera(P), rtol=1e-9)


def test_3_5_1_cameras_at_infinity_cannot_be_normalised():
    with pytest.raises(ValueError, match="singular"):
        matrix.normalize_camera(np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]]))
    _, R = rq(np.diag([2.0, 1.0, 0.0]))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    for refuse in (matrix.normalize_camera, decompose_camera):
        refuses(ValueError, "finite", refuse, np.full((3, 4), np.nan))


@pytest.mark.parametrize("unit", [1e-6, 1e-4, 1.0, 1e6])
def test_whether_a_camera_is_finite_does_not_depend_on_the_unit_of_the_pixels(unit):
    rng = np.random.default_rng(4)
    for _ in range(20):
        P, _, R, _ = random_camera(rng)
        rows = np.diag([1.0, 1.0, unit])
        at_infinity = P.copy()
        at_infinity[2, :3] = 0.3 * P[0, :3] - 0.2 * P[1, :3]
        assert finite_cameras(np.stack([rows @ P, rows @ at_infinity])).tolist() == [True, False]
        np.testing.assert_allclose(decompose_camera(rows @ P)[1], R, atol=1e-6)


@holds_for_every()
def test_proposition_3_5_1_in_front_is_a_positive_t_of_a_normalised_camera(rng):
    P, _, R, centre = random_camera(rng)
    X = centre + rng.normal(0.0, 5.0, (20, 3))
    normal = matrix.normalize_camera(rng.choice([-4.0, 4.0]) * P)
    in_front = (X - centre) @ R[2] > 0.0
    np.testing.assert_array_equal((homogenize(X) @ normal.T)[:, 2] > 0.0, in_front)


@holds_for_every()
def test_3_27_cheirality_is_a_sign_of_depth_that_no_scale_changes(rng):
    P, _, R, centre = random_camera(rng)
    X = random_points(rng, 20)
    true_depth = (dehomogenize(X) - centre) @ R[2]
    chi = thesisrecon.cheirality(P, X)
    np.testing.assert_array_equal(chi > 0.0, true_depth > 0.0)
    np.testing.assert_allclose(thesisrecon.cheirality(-0.5 * P, -2.0 * X), chi, rtol=1e-9)
    np.testing.assert_allclose(matrix.depth(P, X), true_depth, rtol=1e-8, atol=1e-9)
    # The magnitude is an inverse depth: t = 1/chi for a normalised camera and point.
    unit, normal = X / X[:, 3:], matrix.normalize_camera(P)
    np.testing.assert_allclose(1.0 / thesisrecon.cheirality(normal, unit), unit @ normal[2], rtol=1e-8)
    at_infinity = np.append(rng.normal(size=3), 0.0)[None]
    assert thesisrecon.cheirality(P, at_infinity)[0] == 0.0
    np.testing.assert_array_equal(thesisrecon.cheirality(P.tolist(), X.tolist()), chi)

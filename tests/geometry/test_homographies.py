"""Cameras, homographies, lines and planes, and fundamental matrices (sections 3.2, 3.5, 3.6)."""

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import thesisrecon
from tests.conftest import refuses
from tests.epipolar.pairs import angle_between, make_pair
from tests.geometry.properties import gap, holds_for_every, incidence_sine, random_camera, random_points
from thesisrecon.camera import compose_camera, decompose_camera, finite_cameras, project_camera, rq
from thesisrecon.errors import StageFailure
from thesisrecon.geometry import camera_matrix as matrix
from thesisrecon.geometry import two_view
from thesisrecon.geometry.camera_matrix import camera_centre, project
from thesisrecon.geometry.homogeneous import (
    cross_matrix,
    dehomogenize,
    homogenize,
    normalizing_transform,
    unit_normals,
)
from thesisrecon.geometry.strata import transform
from thesisrecon.geometry.two_view import homography_linear, homography_residuals, require_parallax_of_matches
from validation.scenes.rigs import random_transform


def compatibility_residual(H, F):
    """|H'F + F'H| / (|H| |F|), 0 if H is the homography of a plane for the pair (HZ 13.3)."""
    S = H.T @ F
    return np.linalg.norm(S + S.T) / (np.linalg.norm(H) * np.linalg.norm(F))


def image_from_plane(P, plane):
    """H_Pi = M - m pi' (3.29), from (x, -pi'x) to pixels, with its scale."""
    return P[:, :3] - np.outer(P[:, 3], plane[:3] / plane[3])


def _canonical(rng):
    """[I 0] and another camera of a projective frame, entries of size one."""
    scale = np.diag([1e-3, 1e-3, 1.0])
    P1, P2 = (scale @ random_camera(rng)[0] for _ in range(2))
    G = np.vstack([P1, rng.normal(size=4)])
    return np.eye(3, 4), transform(G, P2, "cameras")


@holds_for_every()
def test_theorem_3_6_1_and_3_28_the_plane_at_infinity_is_seen_alike_from_every_place(rng):
    (P1, K1, R1, _), (P2, K2, R2, _) = random_camera(rng), random_camera(rng)
    H = two_view.infinite_homography(P1, P2)
    # The thesis' R_ij' = R_j' R_i is R2 R1' with world-to-camera rotations.
    assert gap(H, K2 @ R2 @ R1.T @ np.linalg.inv(K1)) < 1e-9
    X = np.column_stack([rng.normal(size=(8, 3)), np.zeros(8)])
    assert max(gap(H @ P1 @ x, P2 @ x) for x in X) < 1e-9
    assert gap(H, two_view.plane_homography(P1, P2, np.array([0.0, 0.0, 0.0, 1.0]))) < 1e-7
    with pytest.raises(ValueError, match="finite first camera"):
        two_view.infinite_homography(np.diag([1.0, 1.0, 0.0]) @ P1, P2)


@holds_for_every()
def test_3_29_to_3_31_homographies_of_a_plane(rng):
    (P1, *_), (P2, *_) = random_camera(rng), random_camera(rng)
    plane = random_points(rng, 1)[0]
    x = rng.normal(size=(8, 3))
    X = np.column_stack([x, -x @ plane[:3] / plane[3]])
    assert incidence_sine(plane, X).max() < 1e-12
    H1, H2 = image_from_plane(P1, plane), image_from_plane(P2, plane)
    np.testing.assert_allclose(x @ H1.T, X @ P1.T, rtol=1e-8, atol=1e-8)
    H = two_view.plane_homography(P1, P2, plane)
    assert gap(H, H2 @ np.linalg.inv(H1)) < 1e-6
    assert homography_residuals(H, project(P1, X), project(P2, X)).max() < 1e-5
    # In another frame the same plane has the same homography.
    G = random_transform("projective", rng)
    moved = two_view.plane_homography(
        transform(G, P1, "cameras"), transform(G, P2, "cameras"), transform(G, plane, "planes")
    )
    assert gap(moved, H) < 1e-6


def test_3_29_planes_through_the_origin_and_through_centres():
    rng = np.random.default_rng(3)
    (P1, *_), (P2, *_) = random_camera(rng), random_camera(rng)
    X, Y = random_points(rng, 2)
    plane = camera_centre(np.stack([X, Y, [0.0, 0.0, 0.0, 1.0]]))
    plane[3] = 0.0
    H = two_view.plane_homography(P1, P2, plane)
    points = np.array([X + l * Y for l in (-1.0, 0.5, 2.0, 3.0)])
    assert homography_residuals(H, project(P1, points), project(P2, points)).max() < 1e-6
    of_first, of_second = (camera_centre(np.stack([camera_centre(P), X, Y])) for P in (P1, P2))
    refuses(ValueError, "first camera", two_view.plane_homography, P1, P2, of_first)
    assert np.linalg.cond(two_view.plane_homography(P1, P2, of_second)) > 1e9


@holds_for_every()
def test_3_33_to_3_35_epipoles_lines_and_rank(rng):
    (P1, *_), (P2, *_) = random_camera(rng), random_camera(rng)
    F = two_view.fundamental_from_cameras(P1, P2)
    X = rng.normal(size=(10, 3))
    xy1, xy2 = project(P1, X), project(P2, X)
    e1, e2 = two_view.epipoles(F)
    assert gap(e2, P2 @ camera_centre(P1)) < 1e-7
    assert gap(e1, P1 @ camera_centre(P2)) < 1e-7
    assert np.abs(np.sum(thesisrecon.epipolar_lines(F, xy1) * homogenize(xy2), axis=1)).max() < 1e-5
    assert incidence_sine(thesisrecon.epipolar_lines(F, xy1), e2).max() < 1e-7
    lines = thesisrecon.epipolar_lines(F.tolist(), xy1.tolist())
    np.testing.assert_array_equal(lines, thesisrecon.epipolar_lines(F, xy1))
    np.testing.assert_allclose(np.linalg.norm(lines[:, :2], axis=1), 1.0)
    assert not thesisrecon.epipolar_lines(F, dehomogenize(e1)[None]).any()
    assert np.abs(F.T @ e2).max() < 1e-12
    assert abs(np.linalg.det(F)) < 1e-15
    # The pair in the other order has the transposed matrix.
    assert gap(two_view.fundamental_from_cameras(P2, P1), F.T) < 1e-7


@holds_for_every()
def test_3_37_f_is_the_epipole_with_the_homography_of_any_plane(rng):
    (P1, *_), (P2, *_) = random_camera(rng), random_camera(rng)
    F = two_view.fundamental_from_cameras(P1, P2)
    e2 = P2 @ camera_centre(P1)
    X = rng.normal(size=(10, 3))
    for plane in random_points(rng, 3):
        H = two_view.plane_homography(P1, P2, plane)
        found = cross_matrix(e2 / np.linalg.norm(e2)) @ H
        assert two_view.symmetric_residuals(found, project(P1, X), project(P2, X)).max() < 1e-4
        assert gap(found, F) < 1e-6
        assert compatibility_residual(H, F) < 1e-6
    assert compatibility_residual(rng.normal(size=(3, 3)), rng.normal(size=(3, 3))) > 1e-3


@holds_for_every()
def test_3_37_to_3_40_homographies_of_planes_make_the_second_camera(rng):
    _, P2 = _canonical(rng)
    plane = random_points(rng, 1)[0]
    H, m = two_view.plane_homography(np.eye(3, 4), P2, plane), P2[:, 3]
    scale = np.sum(image_from_plane(P2, plane) * H)
    second = np.column_stack([scale * H + np.outer(m, plane[:3] / plane[3]), m])
    assert gap(second, P2) < 1e-8
    assert gap(m, two_view.epipoles(two_view.fundamental_from_cameras(np.eye(3, 4), P2))[1]) < 1e-7


@holds_for_every()
def test_theorem_3_6_2_and_3_41_every_member_is_a_homography_of_the_pair(rng):
    P1, P2 = _canonical(rng)
    F = two_view.fundamental_from_cameras(P1, P2)
    _, e2 = two_view.epipoles(F)
    x = homogenize(rng.normal(size=(8, 2)))
    for plane in (np.zeros(3), rng.normal(size=3)):
        H = two_view.canonical_cameras(F, plane=plane)[1][:, :3]
        assert compatibility_residual(H, F) < 1e-9
        np.testing.assert_allclose(np.cross(e2, x @ H.T), x @ F.T, atol=1e-9)
    # The member of (3.41) is singular: its plane holds the second centre.
    singular = two_view.canonical_cameras(F, plane=np.zeros(3))[1][:, :3]
    assert np.linalg.svd(singular, compute_uv=False)[2] < 1e-12
    # [l]x F maps x to where its epipolar line meets l (proof of 3.41): the plane that view 2 sees as l.
    assert gap(np.cross(e2, F.T).T, singular) < 1e-12


@holds_for_every()
def test_3_42_every_pair_of_the_family_has_the_fundamental_matrix(rng):
    P1, P2 = _canonical(rng)
    F = two_view.fundamental_from_cameras(P1, P2)
    for plane in (None, np.zeros(3), rng.normal(size=3)):
        A, B = two_view.canonical_cameras(F, plane=plane, scale=rng.choice([-2.0, 0.7]))
        np.testing.assert_array_equal(A, np.eye(3, 4))
        assert gap(two_view.fundamental_from_cameras(A, B), F) < 1e-7
    # The true second camera is a member as well: its reconstruction differs by a projective transform only.
    _, e2 = two_view.epipoles(F)
    scale = float(e2 @ P2[:, 3])
    s = float(np.sum(np.cross(e2, P2[:, :3].T).T * F) / np.sum(F * F))
    member = two_view.canonical_cameras(F, plane=P2[:, :3].T @ e2 / s, scale=scale / s)[1]
    assert gap(member, P2) < 1e-7
    assert np.isfinite(dehomogenize(camera_centre(member))).all()


@holds_for_every()
def test_3_2_homogeneous_coordinates_have_any_scale_and_unit_normals_measure_distances(rng):
    X = rng.normal(size=(5, 3))
    scale = rng.uniform(0.1, 5.0, (5, 1)) * rng.choice([-1.0, 1.0], (5, 1))
    np.testing.assert_allclose(dehomogenize(scale * homogenize(X)), X, rtol=1e-12)
    line, plane = rng.normal(size=3), rng.normal(size=4)
    for dual in (line, plane):
        n = unit_normals(dual)
        foot = -n[-1] * n[:-1]
        moved = foot + 2.5 * n[:-1]
        assert abs(n @ np.append(foot, 1.0)) < 1e-12
        assert abs(n @ np.append(moved, 1.0) - 2.5) < 1e-12
    np.testing.assert_array_equal(unit_normals(np.array([0.0, 0.0, 3.0])), [0.0, 0.0, 3.0])


@holds_for_every(examples=20)
def test_default_plane_keeps_the_second_camera_away_from_singular(rng):
    s = np.diag([1e3, 1e3, 1.0])
    F = two_view.unit_norm(s @ make_pair(8, rng).F @ s)
    sizes = np.linalg.svd(F, compute_uv=False)
    assert np.linalg.cond(two_view.canonical_cameras(F)[1][:, :3]) == pytest.approx(sizes[0] / sizes[1])
    assert np.linalg.cond(two_view.canonical_cameras(F, plane=np.zeros(3))[1][:, :3]) > 1e8


@holds_for_every(st.sampled_from([0.0, 1e-3]))
def test_3_42_the_default_planes_are_the_true_one_and_its_twin_where_calibration_is_the_identity(rng, noise):
    R, t = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    F = cross_matrix(t / np.linalg.norm(t)) @ R + noise * rng.normal(size=(3, 3))
    F = two_view.enforce_rank_two(rng.choice([-3.0, 0.2]) * F)

    def left(plane):
        return two_view.canonical_cameras(F, plane=plane)[1][:, :3]

    def distance_from_rotations(plane):
        """Frobenius distance of the left part from the nearest multiple of an orthogonal matrix."""
        s = np.linalg.svd(left(plane), compute_uv=False)
        return np.linalg.norm(s - s.mean())

    planes = two_view.quasi_euclidean_planes(F)
    found = [left(p) / np.cbrt(np.linalg.det(left(p))) for p in planes]
    assert min(np.linalg.norm(A - R) for A in found) < 1e-9 + 30.0 * noise
    assert np.trace(found[0]) >= np.trace(found[1])
    # No other plane gives a left part nearer to a multiple of a rotation.
    others = [distance_from_rotations(planes[0] + d) for d in 0.05 * rng.normal(size=(20, 3))]
    assert distance_from_rotations(planes[0]) <= min(others) + 1e-12


FAR = np.array([[1.0, 0, 0, -4e5], [0, 1, 0, -5e6], [0, 0, 1, -300.0], [0, 0, 0, 1]])


def test_georeferenced_cameras_have_their_f_and_wrong_pairs_are_refused():
    for seed in range(10):
        pair = make_pair(8, np.random.default_rng(seed))
        F = two_view.fundamental_from_cameras(pair.P1 @ FAR, pair.P2 @ FAR)
        assert angle_between(F, two_view.fundamental_from_cameras(pair.P1, pair.P2)) < 1e-4
    pair, fundamental = make_pair(8, np.random.default_rng(0)), two_view.fundamental_from_cameras
    same = np.diag([1.0, 2.0, 1.0]) @ pair.P1
    near = np.column_stack([pair.P2[:, :3], [1e-14, 0.0, 1e-15]])
    for cameras in ((pair.P1 @ FAR, same @ FAR), (pair.P1, near), (pair.P1, same)):
        refuses(ValueError, "different centres", fundamental, *cameras)
    refuses(ValueError, "scale", two_view.canonical_cameras, pair.F, scale=0.0)
    for shape in ((3, 2), (5, 3), (5,)):
        refuses(ValueError, "homography_linear", homography_linear, np.zeros(shape), np.zeros(shape))
    four = pair.F, pair.xy1[:4], pair.xy2[:4]
    refuses(StageFailure, "explains 90 % of 4 matches", require_parallax_of_matches, *four)


@holds_for_every()
def test_sampson_distance_is_the_distance_to_the_nearest_exact_match_to_first_order(rng):
    pair = make_pair(50, rng)
    noise = rng.normal(0.0, 1e-3, (50, 4))
    xy1, xy2 = pair.xy1 + noise[:, :2], pair.xy2 + noise[:, 2:]

    def algebraic(d):
        return two_view._algebraic_residuals(pair.F, xy1 + d[:2], xy2 + d[2:])

    gradient = np.stack([algebraic(d) - algebraic(np.zeros(4)) for d in 1e-4 * np.eye(4)], axis=1)
    expected = np.sum(noise * gradient, axis=1) / np.linalg.norm(gradient, axis=1)
    np.testing.assert_allclose(two_view.sampson_residuals(pair.F, xy1, xy2), expected, atol=1e-7)


@holds_for_every(st.floats(1e-3, 1e3))
def test_residuals_depend_neither_on_the_scale_of_f_nor_on_the_order_of_the_images(rng, scale):
    pair = make_pair(20, rng)
    xy1, xy2 = pair.xy1 + rng.normal(size=(20, 2)), pair.xy2 + rng.normal(size=(20, 2))
    for residuals in (two_view.sampson_residuals, two_view.symmetric_residuals):
        direct = np.abs(residuals(pair.F, xy1, xy2))
        for F, a, b in ((-scale * pair.F, xy1, xy2), (pair.F.T, xy2, xy1)):
            np.testing.assert_allclose(np.abs(residuals(F, a, b)), direct, rtol=1e-9, atol=1e-10)


def test_infinite_residuals_and_the_nearest_matrix_of_rank_two():
    H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    residual = homography_residuals(H, np.array([[0.0, 1.0], [1.0, 1.0]]), np.ones((2, 2)))
    assert np.isinf(residual[0])
    assert residual[1] == pytest.approx(0.0)
    M = np.random.default_rng(0).normal(size=(3, 3))
    F = two_view.enforce_rank_two(M)
    assert np.linalg.matrix_rank(F) == 2
    s = np.linalg.svd(M, compute_uv=False)
    assert np.linalg.norm(M - F * np.hypot(s[0], s[1])) == pytest.approx(s[2])
    assert angle_between(two_view.enforce_rank_two(F), F) < 1e-12


@holds_for_every()
def test_3_16_3_17_3_22_and_3_23_image_coordinates_and_the_plane_that_projects_to_infinity(rng):
    f_u, f_v, u_0, v_0, s = rng.uniform(1.0, 1000.0, 5)
    x, y = rng.normal(size=2)
    K = matrix.calibration_matrix(f_u, f_v, u_0, v_0, skew=s)
    np.testing.assert_allclose(K @ [x, y, 1.0], [f_u * x + s * y + u_0, f_v * y + v_0, 1.0])
    refuses(ValueError, "positive focals", matrix.calibration_matrix, -f_u, f_v, u_0, v_0)
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
    # Cameras at infinity cannot be normalised.
    affine = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    refuses(ValueError, "singular", matrix.normalize_camera, affine)
    _, R = rq(np.diag([2.0, 1.0, 0.0]))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


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


@pytest.mark.parametrize("far", [0.0, 1e3, -1e6])
def test_normalised_points_have_their_centroid_at_zero_and_a_mean_distance_of_root_two(far):
    xy = far + np.random.default_rng(0).normal(size=(50, 2)) * [30.0, 5.0]
    moved = dehomogenize(homogenize(xy) @ normalizing_transform(xy).T)
    np.testing.assert_allclose(moved.mean(axis=0), 0.0, atol=1e-9 * max(abs(far), 1.0))
    assert np.linalg.norm(moved, axis=1).mean() == pytest.approx(np.sqrt(2.0), rel=1e-9)

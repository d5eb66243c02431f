"""Homographies, lines and planes (sections 3.2, 3.6.1)."""

import numpy as np
import pytest

import thesisrecon
from tests.geometry.properties import gap, holds_for_every, incidence_sine, random_camera, random_points
from thesisrecon.geometry import two_view
from thesisrecon.geometry.camera_matrix import camera_centre, project
from thesisrecon.geometry.homogeneous import cross_matrix, dehomogenize, homogenize, unit_normals
from thesisrecon.geometry.strata import transform
from thesisrecon.geometry.two_view import homography_residuals
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
    with pytest.raises(ValueError, match="first camera"):
        two_view.plane_homography(P1, P2, camera_centre(np.stack([camera_centre(P1), X, Y])))
    through_second = two_view.plane_homography(P1, P2, camera_centre(np.stack([camera_centre(P2), X, Y])))
    assert np.linalg.cond(through_second) > 1e9


@holds_for_every()
def test_3_32_the_first_of_canonical_cameras_sees_every_plane_as_it_is(rng):
    P1, P2 = _canonical(rng)
    plane = random_points(rng, 1)[0]
    assert gap(two_view.plane_homography(P1, P2, plane), image_from_plane(P2, plane)) < 1e-9


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

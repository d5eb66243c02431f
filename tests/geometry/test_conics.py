"""Section 3.4.6: conics, dual conics, quadrics, dual quadrics and the absolute ones."""

import numpy as np
import pytest
from hypothesis import strategies as st

from tests.conftest import refuses
from tests.geometry import properties
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.strata import (
    ABSOLUTE_CONIC,
    ABSOLUTE_DUAL_QUADRIC,
    PLANE_AT_INFINITY,
    bilinear_form,
    calibration_from_image,
    curvature_sign,
    dual,
    image_of_absolute_conic,
    intersect_line,
    transform,
)
from validation.scenes.rigs import random_transform

dimensions = st.sampled_from([3, 4])


def _round(rng, d, n):
    """An ellipse or ellipsoid (d, d) about the origin and n of its points (n, d)."""
    T = np.eye(d)
    T[:-1] += 0.3 * rng.uniform(-1.0, 1.0, (d - 1, d))
    unit = rng.normal(size=(n, d - 1))
    x = homogenize(unit / np.linalg.norm(unit, axis=1, keepdims=True)) @ T.T
    return transform(T, np.diag([1.0] * (d - 1) + [-1.0]), "conics"), x


@properties.holds_for_every()
def test_3_2_absolute_conic_has_no_real_points(rng):
    x = rng.normal(size=(20, 3))
    assert (bilinear_form(ABSOLUTE_CONIC, x, x) > 0.0).all()
    imaginary = np.array([1.0, 1j, 0.0])
    assert imaginary @ ABSOLUTE_CONIC @ imaginary == 0.0


@properties.holds_for_every(dimensions)
def test_3_4_and_3_10_tangents_belong_to_the_inverse(rng, d):
    C, x = _round(rng, d, 6)
    assert properties.gap(dual(C), np.linalg.inv(C)) < 1e-9
    assert properties.incidence_residual(dual(C), x @ C).max() < 1e-12
    assert properties.incidence_residual(dual(C), rng.normal(size=(6, d))).max() > 1e-6
    assert properties.gap(dual(dual(C)), C) < 1e-9


def test_3_4_the_dual_of_two_lines_is_their_point():
    l, m = np.array([1.0, 0.0, -2.0]), np.array([0.0, 1.0, 3.0])
    meet = np.cross(l, m)
    assert properties.gap(dual(np.outer(l, m) + np.outer(m, l)), np.outer(meet, meet)) < 1e-12


@properties.holds_for_every(dimensions)
def test_3_5_and_3_6_lines_meet_in_two_points_or_touch_or_miss(rng, d):
    C, x = _round(rng, d, 2)
    inside, away = np.ones(d), rng.normal(size=d - 1)
    far = np.append(50.0 * away / np.linalg.norm(away), 1.0)
    inside[:-1] = (x[0] + x[1])[:-1] / 2.0
    other = far.copy()
    other[:-1] += np.linalg.svd(far[None, :-1])[2][1]
    found = intersect_line(C, inside, far)
    assert found.shape == (2, d)
    assert properties.incidence_residual(C, found).max() < 1e-10
    assert intersect_line(C, far, other).shape == (0, d)
    through_both = intersect_line(C, x[0], x[1])
    assert min(properties.gap(through_both[0], x[0]), properties.gap(through_both[0], x[1])) < 1e-7


@properties.holds_for_every(dimensions)
def test_3_7_the_tangent_touches_in_its_point_alone(rng, d):
    C, x = _round(rng, d, 1)
    t = C @ x[0]
    assert properties.incidence_sine(t, x[0]) < 1e-12
    along = np.cross(t, rng.normal(size=3)) if d == 3 else np.linalg.svd(t[None])[2][1]
    touching = intersect_line(C, x[0], along)
    assert len(touching) >= 1
    assert max(properties.gap(point, x[0]) for point in touching) < 1e-5


@properties.holds_for_every()
def test_3_11_infinity_is_imaged_without_regard_to_the_centre(rng):
    P, K, R, _ = properties.random_camera(rng)
    np.testing.assert_allclose(P[:, :3], K @ R)
    G = np.eye(4)
    G[:3, 3] = rng.normal(size=3)
    np.testing.assert_allclose(transform(G, P, "cameras")[:, :3], P[:, :3], rtol=1e-9)
    x = rng.normal(size=3)
    np.testing.assert_allclose(P @ np.append(x, 0.0), P[:, :3] @ x, rtol=1e-9)


@properties.holds_for_every()
def test_3_12_to_3_15_images_of_the_absolute_conic_are_those_of_the_calibration(rng):
    P, K, _, _ = properties.random_camera(rng)
    H, image, dual_image = P[:, :3], image_of_absolute_conic(K), image_of_absolute_conic(K, is_dual=True)
    scale = rng.choice([-3.0, 3.0])
    assert properties.gap(transform(H, ABSOLUTE_CONIC, "conics"), image) < 1e-7
    assert properties.gap(transform(H, ABSOLUTE_CONIC, "dual conics"), dual_image) < 1e-12
    assert properties.gap(P @ ABSOLUTE_DUAL_QUADRIC @ P.T, dual_image) < 1e-12
    assert properties.gap(np.linalg.inv(image), dual_image) < 1e-7
    np.testing.assert_allclose(calibration_from_image(scale * dual_image, is_dual=True), K, atol=1e-6)
    np.testing.assert_allclose(calibration_from_image(scale * image), K, atol=1e-3)


def test_3_14_conics_of_no_camera_are_refused():
    for wrong in (np.diag([1.0, -1.0, 1.0]), np.diag([1.0, 1.0, 0.0]), np.full((3, 3), np.nan)):
        for is_dual in (False, True):
            refuses(ValueError, "conic", calibration_from_image, wrong, is_dual=is_dual)


@properties.holds_for_every()
def test_3_9_the_plane_at_infinity_is_the_null_vector_of_the_absolute_dual_quadric(rng):
    G = random_transform("projective", rng)
    Q = transform(G, ABSOLUTE_DUAL_QUADRIC, "dual conics")
    infinity = transform(G, PLANE_AT_INFINITY, "planes")
    assert np.linalg.norm(Q @ infinity) < 1e-12 * np.linalg.norm(infinity)
    assert np.linalg.matrix_rank(Q) == 3


@properties.holds_for_every(dimensions)
def test_3_4_2_intersection_and_tangency_of_surfaces_are_kept_by_projective_transforms(rng, d):
    C, x = _round(rng, d, 3)
    # A shear of the last row keeps the surface finite, which a general transform need not.
    G = np.eye(d)
    G[:-1] += 0.3 * rng.normal(size=(d - 1, d))
    G[-1, :-1] = 0.2 * rng.uniform(-1.0, 1.0, d - 1)
    plane = C @ x[0]
    touching = C + rng.uniform(0.5, 2.0) * np.outer(plane, plane)
    moved, moved_touching = transform(G, C, "conics"), transform(G, touching, "conics")
    y = x @ G.T
    # The two surfaces share x[0] with its tangent plane, before and after.
    assert properties.gap(moved @ y[0], transform(G, plane, "planes")) < 1e-9
    assert properties.gap(moved_touching @ y[0], transform(G, plane, "planes")) < 1e-9
    assert properties.incidence_residual(dual(moved), moved @ y[0]) < 1e-9
    # A line through two points of the surface meets it in their images, one that misses it still does.
    assert properties.incidence_residual(moved, y[1]) < 1e-9
    for start, end in ((x[1], x[2]), rng.normal(size=(2, d))):
        assert len(intersect_line(C, start, end)) == len(intersect_line(moved, G @ start, G @ end))


def test_the_dual_is_the_adjugate_with_its_sign():
    for C in (np.diag([1.0, 2.0, -3.0]), np.diag([-1.0, -2.0, -3.0]), np.diag([1.0, 2.0, 3.0, -4.0])):
        np.testing.assert_allclose(dual(C), np.linalg.det(C) * np.linalg.inv(C), atol=1e-12)


@pytest.mark.parametrize(
    ("centre", "radius"), [(100.0, 1.0), (-1e4, 2.0), (5e6, 1e3), (0.0, 1e5), (0.0, 1e-3)]
)
def test_the_sign_of_the_curvature_depends_neither_on_the_place_nor_on_the_unit(centre, radius):
    away = np.eye(4)
    away[:3, 3] = -centre * np.array([1.0, -0.3, 0.2])
    square = radius**2
    forms = {1: [1, 1, 1, -square], -1: [1, 1, -1, -square], 0: [1, 1, -1, 0]}
    for sign, form in forms.items():
        assert curvature_sign(away.T @ np.diag(form) @ away) == sign
    assert curvature_sign(away.T @ np.diag([1.0, 1.0, 0.0, -square]) @ away) == 0


@pytest.mark.parametrize("radius", [0.5, 10.0, 300.0])
def test_secants_tangents_and_misses_of_a_circle_far_from_the_origin(radius):
    away = np.array([[1.0, 0, -1e4], [0, 1, -1e4], [0, 0, 1]])
    C = away.T @ np.diag([1.0, 1.0, -(radius**2)]) @ away
    for height, expected in ((0.0, 2), (0.99, 2), (1.0, 1), (1.01, 0), (3.0, 0)):
        y = 1e4 + height * radius
        for start, end in ((0.0, 2e4), (1e4 - 0.3 * radius, 1e4 + 2.0 * radius)):
            found = intersect_line(C, np.array([start, y, 1.0]), np.array([end, y, 1.0]))
            assert len(found) == expected
            half = radius * np.sqrt(max(1.0 - height**2, 0.0))
            for x in dehomogenize(found):
                np.testing.assert_allclose([abs(x[0] - 1e4), x[1]], [half, y], atol=1e-6 * radius)

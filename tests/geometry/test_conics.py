"""Section 3.4.6: conics, dual conics, quadrics, dual quadrics and the absolute ones."""

import numpy as np
import pytest
from hypothesis import strategies as st

from tests.geometry.properties import (
    gap,
    holds_for_every,
    incidence_residual,
    incidence_sine,
    random_camera,
    random_points,
)
from thesisrecon.geometry.conics import (
    ABSOLUTE_CONIC,
    ABSOLUTE_DUAL_QUADRIC,
    absolute_angle,
    bilinear_form,
    calibration_from_image,
    conic_through,
    dual,
    image_of_absolute_conic,
    intersect_line,
    plane_at_infinity,
    project_dual_quadric,
    tangency_discriminant,
    tangent,
)
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.lines_and_planes import join
from thesisrecon.geometry.strata import random_transform, transform

dimensions = st.sampled_from([3, 4])


def _round(rng, d, n):
    """An ellipse or ellipsoid (d, d) about the origin and n of its points (n, d)."""
    T = np.eye(d)
    T[:-1] += 0.3 * rng.uniform(-1.0, 1.0, (d - 1, d))
    unit = rng.normal(size=(n, d - 1))
    x = homogenize(unit / np.linalg.norm(unit, axis=1, keepdims=True)) @ T.T
    return transform(T, np.diag([1.0] * (d - 1) + [-1.0]), "conics"), x


@holds_for_every()
def test_3_1_five_points_determine_a_conic(rng):
    C, x = _round(rng, 3, 9)
    found = conic_through(x[:5])
    assert incidence_residual(C, x).max() < 1e-14
    assert incidence_residual(found, x[:5]).max() < 1e-12
    assert gap(conic_through(x), C) < 1e-5


def test_3_1_points_that_leave_a_conic_free_are_refused():
    on_line = homogenize(np.column_stack([np.arange(5.0), np.arange(5.0)]))
    with pytest.raises(ValueError, match="determine one conic"):
        conic_through(on_line)
    with pytest.raises(ValueError, match="N >= 5"):
        conic_through(on_line[:4])


@holds_for_every()
def test_3_2_absolute_conic_has_no_real_points(rng):
    x = rng.normal(size=(20, 3))
    assert (bilinear_form(ABSOLUTE_CONIC, x, x) > 0.0).all()
    imaginary = np.array([1.0, 1j, 0.0])
    assert imaginary @ ABSOLUTE_CONIC @ imaginary == 0.0


@holds_for_every(dimensions)
def test_3_4_and_3_10_tangents_belong_to_the_inverse(rng, d):
    C, x = _round(rng, d, 6)
    assert gap(dual(C), np.linalg.inv(C)) < 1e-9
    assert incidence_residual(dual(C), tangent(C, x)).max() < 1e-12
    assert incidence_residual(dual(C), rng.normal(size=(6, d))).max() > 1e-6
    assert gap(dual(dual(C)), C) < 1e-9


def test_3_4_the_dual_of_two_lines_is_their_point():
    l, m = np.array([1.0, 0.0, -2.0]), np.array([0.0, 1.0, 3.0])
    meet = np.cross(l, m)
    assert gap(dual(np.outer(l, m) + np.outer(m, l)), np.outer(meet, meet)) < 1e-12


@holds_for_every(dimensions)
def test_3_5_and_3_6_lines_meet_in_two_points_or_touch_or_miss(rng, d):
    C, x = _round(rng, d, 2)
    inside, away = np.ones(d), rng.normal(size=d - 1)
    far = np.append(50.0 * away / np.linalg.norm(away), 1.0)
    inside[:-1] = (x[0] + x[1])[:-1] / 2.0
    other = far.copy()
    other[:-1] += np.linalg.svd(far[None, :-1])[2][1]
    assert tangency_discriminant(C, inside, far) > 0.0
    found = intersect_line(C, inside, far)
    assert found.shape == (2, d)
    assert incidence_residual(C, found).max() < 1e-10
    assert tangency_discriminant(C, far, other) < 0.0
    assert intersect_line(C, far, other).shape == (0, d)
    through_both = intersect_line(C, x[0], x[1])
    assert min(gap(through_both[0], x[0]), gap(through_both[0], x[1])) < 1e-7


@holds_for_every(dimensions)
def test_3_7_the_tangent_touches_in_its_point_alone(rng, d):
    C, x = _round(rng, d, 1)
    t = tangent(C, x[0])
    assert incidence_sine(t, x[0]) < 1e-12
    along = np.cross(t, rng.normal(size=3)) if d == 3 else np.linalg.svd(t[None])[2][1]
    assert abs(tangency_discriminant(C, x[0], along)) < 1e-9 * (along @ along)
    touching = intersect_line(C, x[0], along)
    assert len(touching) >= 1
    assert max(gap(point, x[0]) for point in touching) < 1e-5


@holds_for_every()
def test_3_9_planes_of_outline_tangents_touch_the_quadric(rng):
    Q, _ = _round(rng, 4, 1)
    P, *_ = random_camera(rng)
    outline = dual(project_dual_quadric(P, dual(Q)))
    inside = np.linalg.inv(outline)[:, 2]
    on_outline = intersect_line(outline, inside, inside + inside[2] * np.array([50.0, 80.0, 0.0]))
    assert len(on_outline) == 2
    planes = tangent(outline, on_outline) @ P
    scaled = planes / np.linalg.norm(planes, axis=1, keepdims=True)
    assert np.abs(bilinear_form(dual(Q), scaled, scaled)).max() < 1e-6 * np.linalg.norm(dual(Q))


@holds_for_every()
def test_3_11_infinity_is_imaged_without_regard_to_the_centre(rng):
    P, K, R, _ = random_camera(rng)
    np.testing.assert_allclose(P[:, :3], K @ R)
    G = np.eye(4)
    G[:3, 3] = rng.normal(size=3)
    np.testing.assert_allclose(transform(G, P, "cameras")[:, :3], P[:, :3], rtol=1e-9)
    x = rng.normal(size=3)
    np.testing.assert_allclose(P @ np.append(x, 0.0), P[:, :3] @ x, rtol=1e-9)


@holds_for_every()
def test_3_12_to_3_15_images_of_the_absolute_conic_are_those_of_the_calibration(rng):
    P, K, _, _ = random_camera(rng)
    H, dual_image = P[:, :3], K @ K.T
    scale = rng.choice([-3.0, 3.0])
    assert gap(transform(H, ABSOLUTE_CONIC, "conics"), image_of_absolute_conic(K)) < 1e-7
    assert gap(transform(H, ABSOLUTE_CONIC, "dual conics"), dual_image) < 1e-12
    assert gap(project_dual_quadric(P, ABSOLUTE_DUAL_QUADRIC), dual_image) < 1e-12
    assert gap(np.linalg.inv(image_of_absolute_conic(K)), dual_image) < 1e-7
    np.testing.assert_allclose(calibration_from_image(scale * dual_image, is_dual=True), K, atol=1e-6)
    np.testing.assert_allclose(calibration_from_image(scale * image_of_absolute_conic(K)), K, atol=1e-3)


def test_3_14_conics_of_no_camera_are_refused():
    for wrong in (np.diag([1.0, -1.0, 1.0]), np.diag([1.0, 1.0, 0.0]), np.full((3, 3), np.nan)):
        for is_dual in (False, True):
            with pytest.raises(ValueError, match="conic"):
                calibration_from_image(wrong, is_dual=is_dual)


@holds_for_every()
def test_3_14_the_dual_quadric_of_a_projective_frame_projects_to_every_calibration(rng):
    P1, K1, *_ = random_camera(rng)
    P2, K2, *_ = random_camera(rng)
    G = np.vstack([P1 / 1000.0, rng.normal(size=4)])
    first, second = transform(G, P1 / 1000.0, "cameras"), transform(G, P2, "cameras")
    np.testing.assert_allclose(first, np.eye(3, 4), atol=1e-9)
    plane = transform(G, np.array([0.0, 0.0, 0.0, 1.0]), "planes")
    # Q* = [[K K', -K K'p], [-p'K K', p'K K'p]] (Triggs 1997; HZ 19.2).
    lift = np.vstack([np.eye(3), -plane[:3] / plane[3]])
    Q = transform(G, ABSOLUTE_DUAL_QUADRIC, "dual conics")
    assert gap(lift @ K1 @ K1.T @ lift.T, Q) < 1e-6
    assert gap(project_dual_quadric(second, Q), K2 @ K2.T) < 1e-6


@holds_for_every()
def test_3_9_the_absolute_dual_quadric_gives_its_plane_and_angles_in_any_frame(rng):
    G = random_transform("projective", rng)
    Q = transform(G, ABSOLUTE_DUAL_QUADRIC, "dual conics")
    infinity = transform(G, np.array([0.0, 0.0, 0.0, 1.0]), "planes")
    assert gap(plane_at_infinity(Q), infinity) < 1e-7
    planes = random_points(rng, 2)
    a, b = planes[:, :3] / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    true = np.arccos(np.clip(a @ b, -1.0, 1.0))
    assert absolute_angle(-2.0 * Q, *transform(G, planes, "planes")) == pytest.approx(true, abs=1e-6)


@holds_for_every()
def test_3_13_the_image_of_the_absolute_conic_measures_angles_of_rays(rng):
    P, K, R, _ = random_camera(rng)
    directions = rng.normal(size=(2, 3))
    x, y = directions @ R.T @ K.T
    a, b = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert absolute_angle(image_of_absolute_conic(K), x, y) == pytest.approx(np.arccos(a @ b), abs=1e-6)
    assert incidence_sine(join(x, y), x) < 1e-9
    assert gap(P[:, :3] @ directions[0], x) < 1e-9


@holds_for_every(dimensions)
def test_3_4_2_intersection_and_tangency_of_surfaces_are_kept_by_projective_transforms(rng, d):
    C, x = _round(rng, d, 3)
    # A shear of the last row keeps the surface finite, which a general transform need not.
    G = np.eye(d)
    G[:-1] += 0.3 * rng.normal(size=(d - 1, d))
    G[-1, :-1] = 0.2 * rng.uniform(-1.0, 1.0, d - 1)
    plane = tangent(C, x[0])
    touching = C + rng.uniform(0.5, 2.0) * np.outer(plane, plane)
    moved, moved_touching = transform(G, C, "conics"), transform(G, touching, "conics")
    y = x @ G.T
    # The two surfaces share x[0] with its tangent plane, before and after.
    assert gap(tangent(moved, y[0]), transform(G, plane, "planes")) < 1e-9
    assert gap(tangent(moved_touching, y[0]), transform(G, plane, "planes")) < 1e-9
    assert abs(bilinear_form(dual(moved), tangent(moved, y[0]), tangent(moved, y[0]))) < 1e-9
    # A line through two points of the surface meets it in their images, one that misses it still does.
    assert abs(bilinear_form(moved, y[1], y[1])) < 1e-9
    for start, end in ((x[1], x[2]), rng.normal(size=(2, d))):
        before = tangency_discriminant(C, start, end)
        after = tangency_discriminant(moved, G @ start, G @ end)
        assert np.sign(before) == np.sign(after)


def test_the_dual_is_the_adjugate_with_its_sign():
    for C in (np.diag([1.0, 2.0, -3.0]), np.diag([-1.0, -2.0, -3.0]), np.diag([1.0, 2.0, 3.0, -4.0])):
        np.testing.assert_allclose(dual(C), np.linalg.det(C) * np.linalg.inv(C), atol=1e-12)

"""Table 3.3 and section 3.4: transforms of each stratum and their invariants, conics and quadrics."""

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.geometry import properties
from tests.geometry.properties import gap, holds_for_every, incidence_sine, random_camera, random_points
from thesisrecon.geometry import strata
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.strata import (
    ABSOLUTE_CONIC,
    ABSOLUTE_DUAL_QUADRIC,
    bilinear_form,
    calibration_from_image,
    dual,
    image_of_absolute_conic,
    intersect_line,
    transform,
)
from validation.scenes.rigs import random_transform

groups = st.sampled_from(["projective", "affine", "metric", "euclidean"])


def length(X, Y):
    return np.linalg.norm(dehomogenize(X) - dehomogenize(Y), axis=-1)


def angle(X):
    """Angle at the first of three points (3, 4)."""
    a, b = (v / np.linalg.norm(v) for v in dehomogenize(X[1:]) - dehomogenize(X[0]))
    return np.arccos(a @ b)


def line(X, Y):
    """Pluecker matrix of the line through two points, or the dual one of the line on two planes."""
    return np.outer(X, Y) - np.outer(Y, X)


def volume(X):
    """Signed volume of a tetrahedron (4, 4), times 6."""
    corners = dehomogenize(X)
    return np.linalg.det(corners[1:] - corners[0])


@holds_for_every(groups)
def test_3_4_2_cross_ratios_are_kept_by_all_transforms_and_by_images(rng, group):
    G = random_transform(group, rng)
    base, direction = random_points(rng, 2)
    x = base + np.array([-1.0, 0.2, 1.1, 2.7])[:, None] * direction
    true = (-1.0 - 1.1) * (0.2 - 2.7) / ((-1.0 - 2.7) * (0.2 - 1.1))
    P, *_ = random_camera(rng)
    for points, rel in ((x, 1e-6), (strata.transform(G, x, "points"), 1e-6), (x @ P.T / 1000.0, 1e-4)):
        assert strata.cross_ratio(points) == pytest.approx(true, rel=rel)
    x = np.vstack([x[:3], direction])
    assert strata.cross_ratio(x[[0, 1, 2, 0]]) == np.inf
    refuses(ValueError, "three of the four", strata.cross_ratio, x[[0, 0, 0, 1]])
    refuses(ValueError, "collinear", strata.cross_ratio, np.eye(4))
    refuses(ValueError, "four finite points", strata.cross_ratio, np.eye(3))


@holds_for_every(groups)
def test_table_3_3_images_do_not_change_and_planes_and_lines_keep_their_points(rng, group):
    G, (P, *_), X = random_transform(group, rng), random_camera(rng), random_points(rng, 6)
    moved = strata.transform(G, X, "points") @ strata.transform(G, P, "cameras").T
    np.testing.assert_allclose(moved, X @ P.T, rtol=1e-9, atol=1e-9 * np.abs(P).max())
    centre = camera_centre(strata.transform(G, P, "cameras"))
    assert gap(centre, strata.transform(G, camera_centre(P), "points")) < 1e-7
    G, X = random_transform(group, rng), random_points(rng, 3)
    Y = strata.transform(G, X, "points")
    assert incidence_sine(strata.transform(G, camera_centre(X), "planes"), Y).max() < 1e-12
    assert gap(strata.transform(G, line(*X[:2]), "dual conics"), line(*Y[:2])) < 1e-7
    dual_line, moved = (line(*np.linalg.svd(Z[:2])[2][2:]) for Z in (X, Y))
    assert gap(strata.transform(G, dual_line, "conics"), moved) < 1e-7


@holds_for_every()
def test_the_similarity_is_the_least_squares_one_and_lines_determine_none(rng):
    X, R = rng.normal(3.0, 1.0, (6, 3)), Rotation.random(random_state=rng).as_matrix()
    Y = 2.5 * X @ R.T + [40.0, -7.0, 3.0]
    np.testing.assert_allclose(strata.estimate_similarity(X, Y).apply(X), Y, atol=1e-12)
    # A mirrored target has no exact one: no similarity nearby is better than the one that is found.
    noisy = Y * rng.choice([-1.0, 1.0], 3) + 0.3 * rng.normal(size=Y.shape)
    best = strata.estimate_similarity(X, noisy)
    assert np.linalg.det(best.R) == pytest.approx(1.0)
    cost = np.sum((best.apply(X) - noisy) ** 2)
    for step in 1e-2 * rng.normal(size=(20, 7)):
        turned = Rotation.from_rotvec(step[:3]).as_matrix() @ best.R
        other = strata.Similarity(best.scale * np.exp(step[6]), turned, best.t + step[3:6])
        assert np.sum((other.apply(X) - noisy) ** 2) > cost
    line = rng.normal(size=3) + rng.normal(size=(6, 1)) * rng.normal(size=3)
    for source, target in ((line, Y), (X, line), (line, line), (X, np.ones((6, 3)))):
        refuses(ValueError, "do not all lie on one line", strata.estimate_similarity, source, target)


def test_an_unknown_kind_of_entity_is_refused():
    one = strata.transform, np.eye(4), np.ones(4), "point"
    refuses(ValueError, "unknown kind of entity .*point.*mean points", *one)


@holds_for_every(groups)
def test_3_4_3_affine_invariants_are_kept_by_affine_transforms_only(rng, group):
    G, X = random_transform(group, rng), random_points(rng, 8)
    Y = strata.transform(G, X, "points")
    plane = rng.normal(size=4)
    parallel = strata.transform(G, np.stack([plane, plane + 1.7 * strata.PLANE_AT_INFINITY]), "planes")
    x, y = X[0] / X[0, 3], X[1] / X[1, 3]
    on_line = strata.transform(G, np.stack([x, y, x + 0.3 * (y - x)]), "points")
    centroid, moved_centroid = (homogenize(dehomogenize(Z).mean(axis=0)) for Z in (X, Y))
    changes = [
        gap(*parallel[:, :3]),
        abs(volume(Y[:4]) / volume(Y[4:]) / (volume(X[:4]) / volume(X[4:])) - 1.0),
        abs(length(on_line[0], on_line[2]) / length(on_line[0], on_line[1]) - 0.3),
        gap(strata.transform(G, centroid, "points"), moved_centroid),
        gap(strata.transform(G, strata.PLANE_AT_INFINITY, "planes"), strata.PLANE_AT_INFINITY),
    ]
    if group == "projective":
        assert min(changes) > 1e-6
    else:
        assert max(changes) < 1e-9


@holds_for_every(groups)
def test_3_4_4_and_3_4_5_metric_invariants_and_lengths_are_kept_by_their_groups_only(rng, group):
    G, X = random_transform(group, rng), random_points(rng, 3)
    Y = strata.transform(G, X, "points")
    ratios = length(*Y[:2]) / length(*Y[1:]) / (length(*X[:2]) / length(*X[1:])) - 1.0
    changes = abs(ratios), abs(angle(Y) - angle(X))
    quadric = gap(strata.transform(G, ABSOLUTE_DUAL_QUADRIC, "dual conics"), ABSOLUTE_DUAL_QUADRIC)
    if group in ("projective", "affine"):
        assert min(changes) > 1e-7
        assert quadric > 1e-4
    else:
        assert max(changes) < 1e-9
        assert quadric < 1e-12
        conic = strata.transform(G[:3, :3], ABSOLUTE_CONIC, "conics")
        assert gap(conic, ABSOLUTE_CONIC) < 1e-12
    G, (X, Y) = random_transform(group, rng), random_points(rng, 2)
    change = float(length(strata.transform(G, X, "points"), strata.transform(G, Y, "points")) / length(X, Y))
    assert (abs(change - 1.0) < 1e-9) == (group == "euclidean")


@holds_for_every()
def test_3_4_3_projective_to_affine(rng):
    plane = rng.normal(size=4)
    G = strata.affine_from_projective(plane)
    assert gap(strata.transform(G, plane, "planes"), strata.PLANE_AT_INFINITY) < 1e-9
    np.testing.assert_allclose(G[3], plane / plane[3])
    # Planes through the origin, or nearly, have an upgrade too.
    for last in ([1.0, 2.0, -1.0, 0.0], [0.0, 0.0, 2.0, 1e-9], [0.0, 0.0, 0.0, -4.0]):
        G = strata.affine_from_projective(np.array(last))
        assert np.linalg.cond(G) < 1.001
        assert gap(strata.transform(G, np.array(last), "planes"), strata.PLANE_AT_INFINITY) < 1e-12
    refuses(ValueError, "not zero", strata.affine_from_projective, np.zeros(4))


@holds_for_every()
def test_3_4_1_and_3_9_stratified_and_direct_upgrades_restore_ratios_of_lengths(rng):
    truth, G = random_points(rng, 6), random_transform("projective", rng)
    X = strata.transform(G, truth, "points")
    quadric = strata.transform(G, ABSOLUTE_DUAL_QUADRIC, "dual conics") * rng.choice([-2.0, 2.0])
    direct = strata.metric_from_projective(quadric)
    assert np.linalg.det(direct) > 0.0
    # The plane at infinity is the null vector of the absolute dual quadric.
    to_affine = strata.affine_from_projective(np.linalg.svd(quadric)[2][3])
    affine_quadric = strata.transform(to_affine, quadric, "dual conics")
    to_metric = strata.metric_from_affine(np.linalg.inv(affine_quadric[:3, :3]))
    for upgrade in (direct, to_metric @ to_affine):
        Y = strata.transform(upgrade, X, "points")
        scale = length(Y[0], Y[1]) / length(truth[0], truth[1])
        np.testing.assert_allclose(length(Y[2:4], Y[4:6]), scale * length(truth[2:4], truth[4:6]), rtol=1e-6)
        assert np.isfinite(dehomogenize(Y)).all()
    refuses(ValueError, "definite", strata.metric_from_affine, np.diag([1.0, 1.0, -1.0]))
    refuses(ValueError, "semi-definite", strata.metric_from_projective, np.diag([1.0, 1.0, -1.0, 0.0]))


@properties.holds_for_every()
def test_3_2_absolute_conic_has_no_real_points(rng):
    x = rng.normal(size=(20, 3))
    assert (bilinear_form(ABSOLUTE_CONIC, x, x) > 0.0).all()
    imaginary = np.array([1.0, 1j, 0.0])
    assert imaginary @ ABSOLUTE_CONIC @ imaginary == 0.0


dimensions = st.sampled_from([3, 4])


@properties.holds_for_every(dimensions)
def test_3_4_and_3_10_tangents_belong_to_the_inverse(rng, d):
    C, x = properties.random_round(rng, d, 6)
    np.testing.assert_allclose(dual(C), np.linalg.det(C) * np.linalg.inv(C), atol=1e-9)
    assert properties.incidence_residual(dual(C), x @ C).max() < 1e-12
    assert properties.incidence_residual(dual(C), rng.normal(size=(6, d))).max() > 1e-6
    assert properties.gap(dual(dual(C)), C) < 1e-9
    # That of two lines is their point.
    l, m = rng.normal(size=(2, 3))
    meet = np.cross(l, m)
    assert properties.gap(dual(np.outer(l, m) + np.outer(m, l)), np.outer(meet, meet)) < 1e-9


@properties.holds_for_every(dimensions)
def test_3_5_and_3_6_lines_meet_in_two_points_or_touch_or_miss(rng, d):
    C, x = properties.random_round(rng, d, 2)
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
    for wrong in (np.diag([1.0, -1.0, 1.0]), np.diag([1.0, 1.0, 0.0]), np.full((3, 3), np.nan)):
        for is_dual in (False, True):
            refuses(ValueError, "conic", calibration_from_image, wrong, is_dual=is_dual)


@properties.holds_for_every(dimensions)
def test_table_3_3_and_3_4_2_surfaces_duals_intersection_and_tangency_are_kept(rng, d):
    C, x = properties.random_round(rng, d, 3)
    # A shear of the last row keeps the surface finite, which a general transform need not.
    G = np.eye(d)
    G[:-1] += 0.3 * rng.normal(size=(d - 1, d))
    G[-1, :-1] = 0.2 * rng.uniform(-1.0, 1.0, d - 1)
    plane = C @ x[0]
    touching = C + rng.uniform(0.5, 2.0) * np.outer(plane, plane)
    moved, moved_touching = transform(G, C, "conics"), transform(G, touching, "conics")
    y = transform(G, x, "points")
    # The two surfaces share x[0] with its tangent plane, before and after.
    for surface in (moved, moved_touching):
        assert properties.gap(surface @ y[0], transform(G, plane, "planes")) < 1e-9
    assert properties.gap(transform(G, dual(C), "dual conics"), dual(moved)) < 1e-9
    assert properties.incidence_residual(dual(moved), moved @ y[0]) < 1e-9
    # A line through two points of the surface meets it in their images, one that misses it still does.
    assert properties.incidence_residual(moved, y[1]) < 1e-9
    for start, end in ((x[1], x[2]), rng.normal(size=(2, d))):
        assert len(intersect_line(C, start, end)) == len(intersect_line(moved, G @ start, G @ end))


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

"""Table 3.3 and section 3.4: each stratum's transforms keep its own invariants and break the next one's."""

import numpy as np
import pytest
from hypothesis import strategies as st

from tests.conftest import refuses
from tests.geometry.properties import (
    gap,
    holds_for_every,
    incidence_residual,
    incidence_sine,
    random_camera,
    random_points,
)
from thesisrecon.geometry import strata
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.strata import ABSOLUTE_CONIC, ABSOLUTE_DUAL_QUADRIC, curvature_sign, dual
from validation.scenes.rigs import random_transform

groups = st.sampled_from(list(strata.DEGREES_OF_FREEDOM))
ORDER = list(strata.DEGREES_OF_FREEDOM)


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
def test_table_3_3_images_do_not_change(rng, group):
    G, (P, *_), X = random_transform(group, rng), random_camera(rng), random_points(rng, 6)
    moved = strata.transform(G, X, "points") @ strata.transform(G, P, "cameras").T
    np.testing.assert_allclose(moved, X @ P.T, rtol=1e-9, atol=1e-9 * np.abs(P).max())
    centre = camera_centre(strata.transform(G, P, "cameras"))
    assert gap(centre, strata.transform(G, camera_centre(P), "points")) < 1e-7


@holds_for_every(groups)
def test_table_3_3_planes_and_lines_keep_their_points(rng, group):
    G, X = random_transform(group, rng), random_points(rng, 3)
    Y = strata.transform(G, X, "points")
    assert incidence_sine(strata.transform(G, camera_centre(X), "planes"), Y).max() < 1e-12
    assert gap(strata.transform(G, line(*X[:2]), "dual conics"), line(*Y[:2])) < 1e-7
    dual_line, moved = (line(*np.linalg.svd(Z[:2])[2][2:]) for Z in (X, Y))
    assert gap(strata.transform(G, dual_line, "conics"), moved) < 1e-7


@holds_for_every(st.sampled_from([3, 4]))
def test_table_3_3_conics_quadrics_and_their_duals(rng, d):
    A = rng.normal(size=(d, d))
    G = np.eye(d) + 0.4 * A / np.linalg.norm(A)
    # A sphere-like conic or quadric, moved anywhere, and points on it.
    T = np.eye(d) + 0.3 * rng.normal(size=(d, d)) / d
    C = strata.transform(T, np.diag([1.0] * (d - 1) + [-1.0]), "conics")
    unit = rng.normal(size=(5, d - 1))
    x = np.column_stack([unit / np.linalg.norm(unit, axis=1, keepdims=True), np.ones(5)]) @ T.T
    tangents = x @ C
    assert incidence_residual(C, x).max() < 1e-12
    moved_x, moved_tangents = strata.transform(G, x, "points"), strata.transform(G, tangents, "planes")
    assert incidence_residual(strata.transform(G, C, "conics"), moved_x).max() < 1e-12
    assert incidence_residual(strata.transform(G, dual(C), "dual conics"), moved_tangents).max() < 1e-12
    assert gap(strata.transform(G, dual(C), "dual conics"), dual(strata.transform(G, C, "conics"))) < 1e-7
    assert gap(moved_x @ strata.transform(G, C, "conics"), moved_tangents) < 1e-7


@holds_for_every(groups)
def test_3_4_each_group_holds_its_members_and_is_closed(rng, group):
    G, H = random_transform(group, rng), random_transform(group, rng)
    assert strata.group_of(G) == group
    assert strata.group_of(-3.0 * G) == group
    assert ORDER.index(strata.group_of(G @ H)) >= ORDER.index(group)
    assert ORDER.index(strata.group_of(np.linalg.inv(G))) >= ORDER.index(group)


def test_3_4_a_reflection_is_affine_only_and_wrong_matrices_are_refused():
    assert strata.group_of(np.diag([1.0, 1.0, -1.0, 1.0])) == "affine"
    assert strata.group_of(np.eye(4)) == "euclidean"
    for wrong in (np.eye(3), np.full((4, 4), np.nan), np.diag([1.0, 1.0, 1.0, 0.0])):
        refuses(ValueError, "group_of", strata.group_of, wrong)


def test_3_4_groups_do_not_depend_on_the_unit_of_length():
    G = np.eye(4)
    G[0, 3], G[3, 0] = 1e6, 1e-4
    unit = np.diag([1e3, 1e3, 1e3, 1.0])
    for one in (G, unit @ G @ np.linalg.inv(unit), np.linalg.inv(G)):
        assert strata.group_of(one) == "projective"
    G[0, 3], G[3, 0] = 1e9, 0.0
    assert strata.group_of(G) == "euclidean"


def test_an_unknown_kind_of_entity_is_named():
    one = strata.transform, np.eye(4), np.ones(4), "point"
    refuses(ValueError, "unknown kind of entity .*point.*mean points", *one)


def _tangent_vectors(group, rng):
    """Small moves away from the identity within a group, without its scale."""
    moves = []
    for _ in range(40):
        move = rng.normal(size=(4, 4))
        if group != "projective":
            move[3] = 0.0
        if group in ("metric", "euclidean"):
            skew = move[:3, :3] - move[:3, :3].T
            move[:3, :3] = skew + (rng.normal() * np.eye(3) if group == "metric" else 0.0)
        moves.append((move - move[3, 3] * np.eye(4)).ravel())
    return np.array(moves)


@pytest.mark.parametrize("group", ORDER)
def test_3_4_degrees_of_freedom(group):
    moves = _tangent_vectors(group, np.random.default_rng(0))
    assert np.linalg.matrix_rank(moves) == strata.DEGREES_OF_FREEDOM[group]
    for move in moves[:5]:
        stepped = strata.group_of(np.eye(4) + 1e-5 * move.reshape(4, 4), tolerance=1e-8)
        assert ORDER.index(stepped) >= ORDER.index(group)


@holds_for_every(groups)
def test_3_4_2_projective_invariants_are_kept_by_all(rng, group):
    G = random_transform(group, rng)
    base, direction = random_points(rng, 2)
    x = base + np.array([-1.0, 0.2, 1.1, 2.7])[:, None] * direction
    true = (-1.0 - 1.1) * (0.2 - 2.7) / ((-1.0 - 2.7) * (0.2 - 1.1))
    assert strata.cross_ratio(x) == pytest.approx(true, rel=1e-6)
    assert strata.cross_ratio(strata.transform(G, x, "points")) == pytest.approx(true, rel=1e-6)
    P, *_ = random_camera(rng)
    assert strata.cross_ratio(x @ P.T / 1000.0) == pytest.approx(true, rel=1e-4)
    for signature, sign in (
        ([1, 1, 1, -1], 1),
        ([1, 1, -1, -1], -1),
        ([1, -1, -1, -1], 1),
        ([1, 1, 0, -1], 0),
    ):
        Q = np.diag(np.array(signature, dtype=float))
        assert curvature_sign(strata.transform(G, Q, "conics")) == sign


def test_3_4_2_cross_ratio_at_the_base_point_and_where_it_does_not_exist():
    base, direction = np.array([0.0, 1.0, 2.0, 1.0]), np.array([1.0, 0.0, 0.5, 0.0])
    x = base + np.array([0.0, 1.0, 3.0, 0.0])[:, None] * direction
    x[3] = direction
    assert strata.cross_ratio(x) == pytest.approx(3.0 / 2.0)
    assert strata.cross_ratio(x[[0, 1, 2, 0]]) == np.inf
    refuses(ValueError, "three of the four", strata.cross_ratio, x[[0, 0, 0, 1]])
    refuses(ValueError, "collinear", strata.cross_ratio, np.eye(4))
    refuses(ValueError, "four finite points", strata.cross_ratio, np.eye(3))


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
def test_3_4_4_metric_invariants_are_kept_by_metric_transforms_only(rng, group):
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


@holds_for_every(groups)
def test_3_4_5_lengths_are_kept_by_euclidean_transforms_only(rng, group):
    G, (X, Y) = random_transform(group, rng), random_points(rng, 2)
    change = float(length(strata.transform(G, X, "points"), strata.transform(G, Y, "points")) / length(X, Y))
    assert (abs(change - 1.0) < 1e-9) == (group == "euclidean")


@holds_for_every()
def test_3_4_3_projective_to_affine(rng):
    plane = rng.normal(size=4)
    G = strata.affine_from_projective(plane)
    assert gap(strata.transform(G, plane, "planes"), strata.PLANE_AT_INFINITY) < 1e-9
    np.testing.assert_allclose(G[3], plane / plane[3])


@pytest.mark.parametrize("plane", [[1.0, 2.0, -1.0, 0.0], [0.0, 0.0, 2.0, 1e-9], [0.0, 0.0, 0.0, -4.0]])
def test_3_4_3_planes_through_the_origin_have_an_upgrade_too(plane):
    G = strata.affine_from_projective(np.array(plane))
    assert np.linalg.cond(G) < 1.001
    assert gap(strata.transform(G, np.array(plane), "planes"), strata.PLANE_AT_INFINITY) < 1e-12
    refuses(ValueError, "not zero", strata.affine_from_projective, np.zeros(4))


@holds_for_every()
def test_3_4_1_stratified_and_direct_upgrades_restore_ratios_of_lengths(rng):
    truth = random_points(rng, 6)
    G = random_transform("projective", rng)
    X = strata.transform(G, truth, "points")
    quadric = strata.transform(G, ABSOLUTE_DUAL_QUADRIC, "dual conics") * rng.choice([-2.0, 2.0])
    direct = strata.metric_from_projective(quadric)
    assert np.linalg.det(direct) > 0.0
    to_affine = strata.affine_from_projective(np.linalg.svd(quadric)[2][3])
    affine_quadric = strata.transform(to_affine, quadric, "dual conics")
    to_metric = strata.metric_from_affine(np.linalg.inv(affine_quadric[:3, :3]))
    for upgrade in (direct, to_metric @ to_affine):
        Y = strata.transform(upgrade, X, "points")
        scale = length(Y[0], Y[1]) / length(truth[0], truth[1])
        np.testing.assert_allclose(length(Y[2:4], Y[4:6]), scale * length(truth[2:4], truth[4:6]), rtol=1e-6)
        assert np.isfinite(dehomogenize(Y)).all()


def test_3_4_4_conics_of_no_metric_frame_are_refused():
    refuses(ValueError, "definite", strata.metric_from_affine, np.diag([1.0, 1.0, -1.0]))
    refuses(ValueError, "semi-definite", strata.metric_from_projective, np.diag([1.0, 1.0, -1.0, 0.0]))

"""Section 3.2: incidence, joins and meets."""

import numpy as np

from tests.geometry.properties import gap, holds_for_every, random_camera, random_points
from thesisrecon.geometry.homogeneous import cross_matrix, dehomogenize, homogenize
from thesisrecon.geometry.lines_and_planes import (
    back_project_lines,
    dual_line,
    incidence_sine,
    join_of_line_and_point,
    join_points,
    line_through,
    lines_meet_residual,
    meet_of_line_and_plane,
    meet_of_lines,
    meet_of_planes,
    plane_through,
    project_line,
    unit_normals,
)


@holds_for_every()
def test_3_2_homogeneous_coordinates_mean_the_same_at_every_scale(rng):
    X = rng.normal(size=(5, 3))
    scale = rng.uniform(0.1, 5.0, (5, 1)) * rng.choice([-1.0, 1.0], (5, 1))
    np.testing.assert_allclose(dehomogenize(scale * homogenize(X)), X, rtol=1e-12)


@holds_for_every()
def test_3_2_join_of_points_and_meet_of_lines_are_dual(rng):
    x, y, z = random_points(rng, 3, 3)
    l, m = line_through(x, y), line_through(x, z)
    assert incidence_sine(l, x) < 1e-14
    assert incidence_sine(l, y) < 1e-14
    assert incidence_sine(l, z) > 1e-9
    assert gap(meet_of_lines(l, m), x) < 1e-7


@holds_for_every()
def test_3_2_parallel_lines_meet_at_infinity(rng):
    a, b, c, d = rng.normal(size=4)
    point = meet_of_lines(np.array([a, b, c]), np.array([a, b, d]))
    assert point[2] == 0.0
    assert gap(point[:2], np.array([-b, a])) < 1e-12


@holds_for_every()
def test_3_2_unit_normals_measure_distances(rng):
    line, plane = rng.normal(size=3), rng.normal(size=4)
    for dual in (line, plane):
        n = unit_normals(dual)
        foot = -n[-1] * n[:-1]
        moved = foot + 2.5 * n[:-1]
        assert abs(n @ np.append(foot, 1.0)) < 1e-12
        assert abs(n @ np.append(moved, 1.0) - 2.5) < 1e-12
    np.testing.assert_array_equal(unit_normals(np.array([0.0, 0.0, 3.0])), [0.0, 0.0, 3.0])


@holds_for_every()
def test_3_2_three_points_span_a_plane_and_three_planes_meet_in_a_point(rng):
    X, Y, Z, other = random_points(rng, 4)
    plane = plane_through(X, Y, Z)
    assert max(incidence_sine(plane, p) for p in (X, Y, Z)) < 1e-13
    assert incidence_sine(plane, other) > 1e-9
    planes = rng.normal(size=(3, 4))
    assert incidence_sine(planes, meet_of_planes(*planes)).max() < 1e-13
    assert np.abs(plane_through(X, Y, X + 2.0 * Y)).max() < 1e-13 * np.abs(plane).max() + 1e-12


@holds_for_every()
def test_3_2_lines_of_space_join_and_meet(rng):
    X, Y, Z = random_points(rng, 3)
    L = join_points(X, Y)
    plane = join_of_line_and_point(L, Z)
    assert gap(plane, plane_through(X, Y, Z)) < 1e-6
    assert np.abs(join_of_line_and_point(L, 0.3 * X + Y)).max() < 1e-12
    through_x = plane_through(X, Z, rng.normal(size=4))
    assert gap(meet_of_line_and_plane(L, through_x), X) < 1e-6
    assert np.abs(meet_of_line_and_plane(L, plane)).max() < 1e-9


@holds_for_every()
def test_3_2_the_line_of_two_planes_is_dual_to_that_of_two_points(rng):
    X, Y, Z, W = random_points(rng, 4)
    L = join_points(X, Y)
    of_planes = join_points(plane_through(X, Y, Z), plane_through(X, Y, W))
    assert gap(dual_line(L), of_planes) < 1e-6
    np.testing.assert_array_equal(dual_line(dual_line(L)), L)


@holds_for_every()
def test_3_2_two_lines_of_space_meet_only_where_they_share_a_point(rng):
    X, Y, Z, W = random_points(rng, 4)
    L = join_points(X, Y)
    assert lines_meet_residual(L, join_points(0.7 * X + Y, Z)) < 1e-13
    direction = np.append(dehomogenize(Y) - dehomogenize(X), 0.0)
    assert lines_meet_residual(L, join_points(Z, direction)) < 1e-13
    assert lines_meet_residual(L, join_points(Z, W)) > 1e-9


@holds_for_every()
def test_3_2_lines_project_to_the_lines_of_their_points(rng):
    P, *_ = random_camera(rng)
    X, Y = random_points(rng, 2)
    L = join_points(X, Y)
    l = project_line(P, L)
    assert gap(l, line_through(P @ X, P @ Y)) < 1e-9
    assert gap(cross_matrix(l), P @ L @ P.T) < 1e-9
    plane = back_project_lines(P, l)
    assert incidence_sine(plane, X) < 1e-12
    assert incidence_sine(plane, Y) < 1e-12

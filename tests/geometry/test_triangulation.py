"""Triangulation and resection (sections 6.3, 6.4)."""

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import thesisrecon
from tests.conftest import refuses
from tests.geometry import properties as twins
from tests.geometry.properties import holds_for_every, random_camera
from thesisrecon.api.cameras import triangulate
from thesisrecon.camera import compose_camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry import triangulation
from thesisrecon.geometry.camera_matrix import camera_centre, orient_signs, project
from thesisrecon.geometry.homogeneous import homogenize, unit_normals
from thesisrecon.geometry.polynomial_triangulation import correct_matches, triangulate_polynomial
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.lens import distort, undistort
from thesisrecon.optimize.bundle.partial import minimize_reprojection

METHODS = ["polynomial", "linear", "midpoint", "iterated", "optimal"]

KINDS = [
    "general", "forward", "rectified", "epipole at infinity", "near the epipoles", "far points",
    "points at infinity", "short baseline", "projective frame",
]  # fmt: skip

K = np.array([[1200.0, 0.0, 640.0], [0.0, 1200.0, 480.0], [0.0, 0.0, 1.0]])

RELATIVE, ROUNDING_PX = 1e-9, 1e-11
"""Costs are equal to 1e-9 of themselves, or where the distances they are made of agree to rounding."""


def two_views(kind, rng, n=40):
    """P (2, 3, 4) and exact points X (n, 4) of one kind of geometry."""
    R = Rotation.from_rotvec(rng.normal(0.0, 0.2, 3)).as_matrix()
    c = rng.normal(size=3)
    X = np.column_stack([rng.uniform(-2.0, 2.0, (n, 2)), rng.uniform(3.0, 9.0, n), np.ones(n)])
    if kind in ("forward", "near the epipoles"):
        c = np.append(rng.normal(0.0, 0.1, 2), 1.0)
        R = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3)).as_matrix()
    if kind == "near the epipoles":
        X[:, :3] = c * rng.uniform(1.5, 6.0, (n, 1))
        X[:, :3] += rng.normal(size=(n, 3)) * 10 ** rng.uniform(-6, -1.5, (n, 1))
    if kind == "rectified":
        c, R = np.array([1.0, 0.0, 0.0]), np.eye(3)
    if kind == "epipole at infinity":
        c[2] = 0.0
    if kind == "short baseline":
        c *= 1e-4
    if kind == "far points":
        X[:, :3] *= 10 ** rng.uniform(0.0, 8.0, (n, 1))
    if kind == "points at infinity":
        X[:, 3] = 0.0
    P = compose_camera(np.stack([K, K]), np.stack([np.eye(3), R]), np.stack([np.zeros(3), -R @ c]))
    if kind == "projective frame":
        G = np.eye(4) + 0.25 * rng.normal(size=(4, 4))
        P, X = P @ np.linalg.inv(G), X @ G.T
    return P, X


def images(P, X):
    return np.stack([project(camera, X) for camera in P])


def excess(cost, least):
    """Largest excess of costs over others, less what rounding of distances explains, as a share of them."""
    allowed = 2.0 * np.sqrt(least) * ROUNDING_PX + ROUNDING_PX**2
    return float(np.max((cost - least - allowed) / (least + 1e-300)))


def polished(P, X, xy):
    """X after as many descent steps as lower the reprojection error, from X itself."""
    n = xy.shape[1]
    view, point = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    return minimize_reprojection(P, X, view, point, xy.reshape(-1, 2))


@holds_for_every(st.sampled_from(KINDS), st.sampled_from([1e-2, 1.0, 30.0]), examples=120)
def test_6_3_3_polynomial_cost_is_the_optimum_in_every_geometry(rng, kind, sigma_px):
    P, X = two_views(kind, rng)
    xy = images(P, X)
    xy = xy + sigma_px * rng.normal(size=xy.shape)
    found = triangulate_polynomial(P, xy)
    cost = twins.reprojection_costs(P, found, xy)
    # No descent gets lower from there, and none from the linear answer gets below.
    assert excess(cost, twins.reprojection_costs(P, polished(P, found, xy), xy)) < RELATIVE
    many = twins.reprojection_costs(P, triangulate(P, xy, method="optimal"), xy)
    assert excess(cost, many) < RELATIVE
    # Nor does any of many epipolar planes, each with the two lines' distances.
    assert np.all(cost <= cost_of_planes(P, xy) * (1.0 + RELATIVE) + ROUNDING_PX)
    if kind != "near the epipoles" and sigma_px <= 1.0:
        assert excess(many, cost) < RELATIVE


def cost_of_planes(P, xy):
    """Least sum of squared distances over a pencil of 4000 epipolar planes, per match."""
    centres = camera_centre(P)
    N = np.linalg.svd(centres / np.linalg.norm(centres, axis=1, keepdims=True))[2][2:]
    angles = np.linspace(0.0, np.pi, 4000)
    planes = np.column_stack([np.cos(angles), np.sin(angles)]) @ N
    total = 0.0
    for camera, pixels in zip(P, xy, strict=True):
        lines = unit_normals(planes @ np.linalg.pinv(camera))
        total = total + (homogenize(pixels) @ lines.T) ** 2
    return total.min(axis=1)


def test_the_frame_of_points_at_infinity_does_not_depend_on_their_rounding():
    rng = np.random.default_rng(0)
    P, X = two_views("points at infinity", rng)
    xy = images(P, X)
    view, point = np.repeat([0, 1], len(X)), np.tile(np.arange(len(X)), 2)
    order = np.argsort(point, kind="stable")
    start = X / np.linalg.norm(X, axis=1, keepdims=True)
    # One more unit in the last place than before made such a point one of the scene, at a distance of 1e15.
    start[:, 3] = 3e-16 * rng.choice([-1.0, 1.0], len(X)) * (np.arange(len(X)) == 3)
    found = minimize_reprojection(P, start, view[order], point[order], xy.reshape(-1, 2)[order])
    assert np.abs(images(P, found) - xy).max() < 1e-7


@holds_for_every(st.sampled_from(KINDS))
def test_6_3_3_exact_matches_are_left_where_they_are_and_points_found(rng, kind):
    P, X = two_views(kind, rng)
    xy = images(P, X)
    for method in ("polynomial", "optimal"):
        assert np.abs(images(P, triangulate(P, xy, method=method)) - xy).max() < 1e-7
    corrected = np.stack(correct_matches(fundamental_from_cameras(*P), *xy))
    assert np.abs(corrected - xy).max() < 1e-6


def test_6_3_3_matches_on_epipoles_are_exact():
    P, X = two_views("forward", np.random.default_rng(3))
    xy = images(P, X)
    e1, e2 = project(P[0], camera_centre(P[1])[None])[0], project(P[1], camera_centre(P[0])[None])[0]
    xy[0, :2], xy[1, 1:3] = e1, e2
    corrected = np.stack(correct_matches(fundamental_from_cameras(*P), *xy))
    np.testing.assert_allclose(corrected[:, :3], xy[:, :3], atol=1e-9)
    # Both on epipoles: some point of the baseline, seen where it should be.
    found = triangulate_polynomial(P, xy)
    np.testing.assert_allclose(images(P, found[1:2]), xy[:, 1:2], atol=1e-6)
    # Without rounding: motion along the axis, the epipoles at 0 in the middle of the points.
    xy = np.array([[0.0, 0.0], [0.0, 0.0], [2.0, 2.0], [-2.0, 2.0], [2.0, -2.0], [-2.0, -2.0]])
    for a, b in ((xy, xy[[0, 2, 1, 3, 4, 5]]), (xy[[0, 2, 1, 3, 4, 5]], xy)):
        np.testing.assert_allclose(correct_matches(np.cross(np.eye(3), [0.0, 0.0, 1.0]), a, b), (a, b))


@holds_for_every(st.sampled_from(["general", "forward", "near the epipoles", "rectified"]))
def test_6_3_optimal_methods_do_not_depend_on_the_frame_of_space(rng, kind):
    P, X = two_views(kind, rng)
    xy = images(P, X) + rng.normal(size=(2, 40, 2))
    G = np.eye(4) + 0.2 * rng.normal(size=(4, 4))
    moved = P @ np.linalg.inv(G) * rng.uniform(-3.0, 3.0, (2, 1, 1))
    a, b = (twins.reprojection_costs(p, triangulate_polynomial(p, xy), xy) for p in (P, moved))
    np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-11)


def several_views(rng, sigma_px, n=12):
    """Five cameras about the origin and noisy pixels (5, n, 2), a third of them not seen."""
    P = np.stack([random_camera(rng)[0] for _ in range(5)]) * rng.uniform(0.2, 5.0, (5, 1, 1))
    X = np.column_stack([rng.uniform(-1.0, 1.0, (n, 3)), np.ones(n)])
    xy = images(P, X) + sigma_px * rng.normal(size=(5, n, 2))
    hidden = rng.random((5, n)) < 0.3
    hidden[:2] = False
    xy[hidden] = np.nan
    return P, xy


@holds_for_every(st.sampled_from([0.0, 1.0, 10.0, 100.0]))
def test_the_compiled_methods_are_their_plain_twins(rng, sigma_px):
    P, xy = several_views(rng, sigma_px)
    scale, every = twins.view_scales(P, xy), range(xy.shape[1])
    for method, twin in (("linear", twins.linear_point), ("iterated", twins.iterated_point)):
        found = triangulate(P, xy, method=method)
        expected = np.stack([twin(P, scale, xy[:, n]) for n in every])
        np.testing.assert_allclose(np.abs(np.sum(found * expected, axis=1)), 1.0, atol=1e-10)
    found = triangulate(P, xy, method="midpoint")
    np.testing.assert_allclose(found[:, :3], [twins.midpoint(P, xy[:, n]) for n in every], atol=1e-7)


@holds_for_every(st.sampled_from([1.0, 10.0]), examples=10)
def test_6_3_n_view_method_reaches_the_least_squares_optimum(rng, sigma_px):
    P, xy = several_views(rng, sigma_px)
    found = triangulate(P, xy, method="optimal")
    cost = twins.reprojection_costs(P, found, xy)
    for n in range(xy.shape[1]):
        seen = np.isfinite(xy[:, n, 0])
        assert cost[n] <= twins.least_reprojection_cost(P[seen], xy[seen, n], found[n]) * (1.0 + RELATIVE)


def test_6_3_2_midpoint_degrades_in_a_projective_frame_and_the_optimal_methods_do_not():
    rng = np.random.default_rng(0)
    P, X = two_views("general", rng, 400)
    xy = images(P, X) + rng.normal(size=(2, 400, 2))
    # A plane across the points goes to infinity: some rays are parallel in this frame.
    G = np.eye(4)
    G[3] = [0.5, 0.3, -0.1, 0.2]
    rms = {}
    for frame, H in (("metric", np.eye(4)), ("projective", G)):
        cameras = P @ np.linalg.inv(H)
        for method in METHODS:
            costs = twins.reprojection_costs(cameras, triangulate(cameras, xy, method=method), xy)
            rms[frame, method] = np.sqrt(costs.mean())
    assert rms["metric", "midpoint"] < 1.1 * rms["metric", "polynomial"]
    assert rms["projective", "midpoint"] > 1.4 * rms["metric", "midpoint"]
    for method in ("polynomial", "iterated", "optimal"):
        assert rms["projective", method] == pytest.approx(rms["metric", method], rel=1e-5)


@pytest.mark.parametrize("far", [(2.0, 3.0), (300.0, 1000.0), (1000.0, 300.0)])
def test_6_3_3_of_perpendicular_points_the_nearer_one_goes_to_its_epipole(far):
    """Lines through the epipoles correspond by their angle: all but one are farther off."""
    e1, e2, angle = np.array([400.0, 300.0]), np.array([-50.0, 20.0]), 0.3
    along, across = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    F = np.zeros((3, 3))
    F[0, 1], F[1, 0] = 1.0, -1.0
    to1, to2 = (np.array([[1.0, 0.0, -e[0]], [0.0, 1.0, -e[1]], [0.0, 0.0, 1.0]]) for e in (e1, e2))
    xy1, xy2 = (e1 + far[0] * along)[None], (e2 + far[1] * across)[None]
    found1, found2 = correct_matches(to2.T @ F @ to1, xy1, xy2)
    first = far[0] < far[1]
    np.testing.assert_allclose(found1, e1[None] if first else xy1, atol=1e-6)
    np.testing.assert_allclose(found2, xy2 if first else e2[None], atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_scales_of_the_cameras_have_no_effect_and_nan_means_not_seen(method):
    P, X = two_views("general", np.random.default_rng(0))
    xy = images(P, X)
    found = triangulate(P * np.array([1e-5, -1e5])[:, None, None], xy, method=method)
    np.testing.assert_allclose(found[:, :3] / found[:, 3:], X[:, :3], atol=1e-6)
    xy[1, 3], xy[0, 5, 1] = np.nan, np.nan
    found = thesisrecon.triangulate(P, xy, method=method)
    assert not found[[3, 5]].any()
    keep = np.delete(np.arange(40), [3, 5])
    np.testing.assert_allclose(found[keep, :3] / found[keep, 3:], X[keep, :3], atol=1e-6)
    assert thesisrecon.triangulate(P, np.full((2, 4, 2), np.nan), method=method).tolist() == [[0.0] * 4] * 4
    assert thesisrecon.triangulate(P, np.empty((2, 0, 2)), method=method).shape == (0, 4)
    one = thesisrecon.triangulate(P, xy[:, :1], method=method)
    np.testing.assert_allclose(one[:, :3] / one[:, 3:], X[:1, :3], atol=1e-6)


@pytest.mark.parametrize("method", ["linear", "midpoint", "iterated", "optimal"])
@pytest.mark.parametrize("sigma_px", [0.0, 1.0])
def test_points_observed_from_one_centre_are_zeros(method, sigma_px):
    rng = np.random.default_rng(0)
    R = Rotation.from_rotvec(0.1 * rng.normal(size=(4, 3))).as_matrix()
    for centre in (np.zeros(3), np.array([0.3, -2.0, 0.7]), np.array([4e5, 5e6, 300.0])):
        C = centre + np.array([[0.0] * 3, [0.0] * 3, [0.0] * 3, [1.0, 0.2, 0.1]])
        P = compose_camera(K, R, -np.einsum("vij,vj->vi", R, C)) * rng.uniform(0.5, 2.0, (4, 1, 1))
        X = centre + np.column_stack([rng.uniform(-2.0, 2.0, (20, 2)), rng.uniform(6.0, 12.0, 20)])
        xy = np.stack([project(p, X) for p in P]) + sigma_px * rng.normal(size=(4, 20, 2))
        xy[3, ::2] = np.nan
        found = triangulate(P, xy, method=method)
        assert not found[::2].any()
        assert (np.linalg.norm(project(P[0], found[1::2]) - xy[0, 1::2], axis=1) < 0.1 + 5.0 * sigma_px).all()


@pytest.mark.parametrize("views", [2, 3, 5, 20, 60])
def test_mid_points_of_parallel_rays_are_zeros(views):
    rng = np.random.default_rng(0)
    R = Rotation.from_rotvec(0.1 * rng.normal(size=(views, 3))).as_matrix()
    P = compose_camera(K, R, rng.normal(size=(views, 3)))
    far = np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), np.ones(200), np.zeros(200)])
    assert not triangulate(P, np.stack([project(p, far) for p in P]), method="midpoint").any()
    far[:, 3] = 1e-5
    found = triangulate(P, np.stack([project(p, far) for p in P]), method="midpoint")
    np.testing.assert_allclose(found[:, :3], far[:, :3] / far[:, 3:], rtol=1e-3, atol=1.0)


def test_6_3_1_any_order_of_observations_and_near_singular_values():
    rng = np.random.default_rng(1)
    P, xy = several_views(rng, 1.0)
    view, point = np.nonzero(np.isfinite(xy[:, :, 0]))
    shuffled = rng.permutation(len(view))
    view, point = view[shuffled], point[shuffled]
    found = triangulation.triangulate_observations(P, view, point, xy[view, point], 14)
    np.testing.assert_allclose(found[:12], triangulate(P, xy, method="linear"), atol=1e-12)
    assert not found[12:].any()
    rng = np.random.default_rng(0)
    for ratio in (0.0, 1e-8, 0.5, 0.9, 0.999, 1.0):
        U, V = (np.linalg.qr(rng.normal(size=(4, 4)))[0] for _ in range(2))
        R = np.linalg.qr((U * [3.0, 2.0, 1.0, ratio]) @ V.T)[1]
        x = np.empty(4)
        triangulation._least_singular_vector(np.ascontiguousarray(R), x)
        assert np.linalg.norm(R @ x) == pytest.approx(ratio, abs=1e-14)
        assert np.linalg.norm(x) == pytest.approx(1.0)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_rejects_invalid_input(method):
    P, X = two_views("general", np.random.default_rng(0))
    xy = images(P, X)
    for cameras, pixels, words in (
        (P[0], xy, r"P \(V, 3, 4\)"),
        (P, xy[:1], r"xy \(V, N, 2\)"),
        (P[:1], xy[:1], "two cameras"),
        (np.where(np.arange(2)[:, None, None] == 1, 0.0, P), xy, "not all zero"),
        (np.where(np.arange(4) == 1, np.nan, P), xy, "finite"),
        (P, np.where(xy > xy.mean(), np.inf, xy), "infinite"),
        (P.astype(complex), xy, "real"),
    ):
        refuses(ValueError, words, triangulate, cameras, pixels, method=method)


def test_single_methods_reject_their_own_failures():
    P, X = two_views("general", np.random.default_rng(0))
    xy = images(P, X)
    F, four = fundamental_from_cameras(*P), np.concatenate([P, P])
    one_centre = np.stack([P[0], np.diag([1.0, 2.0, 3.0]) @ P[0]])
    affine = np.stack([P[0], np.eye(3, 4) * [[1.0], [1.0], [0.0]] + [0, 0, 0, 1.0]])
    for words, call, given, options in (
        ("different centres", triangulate_polynomial, (one_centre, xy), {}),
        ("rank 3", triangulate_polynomial, (np.stack([P[0], P[1] * [[1.0], [1.0], [0.0]]]), xy), {}),
        ("exactly two", triangulate, (four, np.concatenate([xy, xy])), {"method": "polynomial"}),
        ("finite cameras", triangulate, (affine, xy), {"method": "midpoint"}),
        ("polynomial, linear, midpoint, iterated, optimal", triangulate, (P, xy), {"method": "guess"}),
        ("rank 2", correct_matches, (np.outer([1.0, 2.0, 3.0], [2.0, 1.0, 1.0]), *xy), {}),
        (r"xy2 \(N, 2\)", correct_matches, (F, xy[0], xy[1][:3]), {}),
    ):
        refuses(ValueError, words, call, *given, **options)
    np.testing.assert_array_equal(triangulate(P, xy), triangulate(P, xy, method="polynomial"))
    three, xy3 = four[:3], np.concatenate([xy, xy[:1]])
    np.testing.assert_array_equal(triangulate(three, xy3), triangulate(three, xy3, method="optimal"))


def test_three_point_pose_contains_the_truth():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(500, 3, 3))
    R = Rotation.random(500, random_state=1).as_matrix()
    t = 0.5 * rng.normal(size=(500, 3)) + [0.0, 0.0, 5.0]
    Y = np.einsum("bij,bkj->bki", R, X) + t[:, None]
    found = triangulation.pose_from_three_points(X, Y / np.linalg.norm(Y, axis=2, keepdims=True))
    error = np.abs(found[:, None] - np.concatenate([R, t[:, :, None]], axis=2)).max(axis=(2, 3))
    assert error.min(axis=0).max() < 1e-6
    np.testing.assert_allclose(np.linalg.det(found[:, :, :3]), 1.0)
    collinear = np.array([[[1.0, 0.0, 5.0], [1.0, 0.0, 5.0], [2.0, 0.0, 5.0]]])
    assert np.isfinite(triangulation.pose_from_three_points(collinear, collinear)).all()


def test_orientation_makes_depths_positive_to_the_end_of_a_long_row_of_views():
    rng = np.random.default_rng(0)
    first = np.repeat(np.arange(78), 10)
    X = np.column_stack([first + rng.uniform(0.0, 2.0, 780), rng.uniform(-1.0, 1.0, 780), np.full(780, 5.0)])
    X = np.append(homogenize(X) * rng.choice([-1.0, 1.0], (780, 1)), np.ones((1, 4)), axis=0)
    P = np.stack([np.column_stack([np.eye(3), [-v, 0.0, 0.0]]) for v in range(80)])
    P *= rng.choice([-1.0, 1.0], (80, 1, 1))
    view, point = (first[:, None] + np.arange(3)).ravel(), np.repeat(np.arange(780), 3)
    views, points, share = orient_signs(P, X, view, point)
    assert points[-1] == 1.0  # without observations
    w = np.einsum("kj,kj->k", P[view, 2] * views[view, None], X[point] * points[point, None])
    assert share == 1.0
    assert (w > 0.0).all()


def test_undistortion_inverts_distortion_where_it_can():
    xy = np.random.default_rng(0).uniform(-0.6, 0.6, (100, 2))
    np.testing.assert_allclose(distort(xy, np.array([0.15])), distort(xy, 0.15), rtol=1e-15)
    for k1 in (-0.2, 0.0, 0.15, np.array([-0.1, 0.05, -0.02]), np.tile([-0.1, 0.05], (100, 1))):
        np.testing.assert_allclose(undistort(distort(xy, k1), k1), xy, atol=1e-14)
    # r - 0.3 r^3 is never above 0.703.
    far = np.array([[3.0, 0.0], [0.6, 0.6], [0.0, 0.0]])
    np.testing.assert_array_equal(undistort(far, -0.3), far)


GIVEN_K = np.array([[900.0, 2.0, 400.0], [0.0, 910.0, 290.0], [0.0, 0.0, 1.0]])
R = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
R *= np.linalg.det(R)
T = np.array([0.3, -0.2, 6.0])
P = compose_camera(GIVEN_K, R, T)


def points(n, rng, *, flat=False):
    X = rng.uniform(-1.5, 1.5, (n, 3)) * [1.0, 1.0, 0.0 if flat else 1.0]
    return X, project(P, X)


@pytest.mark.parametrize("threshold_px", [1.0, None])
@pytest.mark.parametrize(("given", "n"), [(None, 6), (None, 40), (GIVEN_K, 4), (GIVEN_K, 40)])
def test_exact_points_give_the_camera(given, n, threshold_px):
    X, xy = points(n, np.random.default_rng(n))
    found = thesisrecon.resect(X, xy, given, threshold_px=threshold_px)
    np.testing.assert_allclose(found.P, P, atol=1e-4, rtol=1e-6)
    np.testing.assert_allclose(found.P, compose_camera(found.K, found.R, found.t), atol=1e-9)
    np.testing.assert_allclose(found.K, GIVEN_K, atol=1e-3)
    assert found.inliers.all()


def test_a_calibrated_camera_is_found_from_a_plane_and_points_that_cannot_work_are_named():
    X, xy = points(30, np.random.default_rng(0), flat=True)
    np.testing.assert_allclose(thesisrecon.resect(X, xy, GIVEN_K).t, T, atol=1e-6)
    refuses(StageFailure, "lie in one plane; add points off it, or give", thesisrecon.resect, X, xy)
    resect, (X, xy) = thesisrecon.resect, points(20, np.random.default_rng(0))
    wrong = np.random.default_rng(1).uniform(0.0, 800.0, xy.shape)
    refuses(StageFailure, "too few points for resection; 5 points, 6 are needed", resect, X[:5], xy[:5])
    refuses(StageFailure, "no camera explains the points", resect, X, wrong)
    refuses(StageFailure, "no camera explains the points", resect, X, wrong, GIVEN_K)
    refuses(ValueError, r"needs X \(N, 3\), xy \(N, 2\)", resect, xy, X)
    refuses(ValueError, "threshold_px must be positive", resect, X, xy, threshold_px=-1.0)
    negative = np.diag([-1.0, -1.0, 1.0]) @ GIVEN_K
    for no_K in (2.0 * GIVEN_K, np.diag([900.0, 0.0, 1.0]), negative, GIVEN_K.T):
        refuses(ValueError, "needs K upper triangular with positive", resect, X, xy, no_K)


@pytest.mark.parametrize("given", [None, GIVEN_K])
def test_noise_inliers_and_covariance_are_those_of_the_errors(given):
    ratios, sigmas = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        X, xy = points(100, rng)
        xy += rng.normal(0.0, 0.5, xy.shape)
        xy[:30] += rng.uniform(20.0, 200.0, (30, 2))
        found = thesisrecon.resect(X, xy, given, threshold_px=2.0, seed=seed)
        assert found.inliers[30:].mean() > 0.88
        assert not found.inliers[:30].any()
        sigmas.append(found.sigma_px)
        if given is None:
            # Of other points: entries of P have second-order errors beyond their smallest deviations.
            X, xy = points(50, rng)
            Xh = np.column_stack([X, np.ones(50)]) / (np.column_stack([X, np.ones(50)]) @ found.P[2])[:, None]
            J = np.einsum("nc,nrs->nrsc", Xh, np.eye(3)[:2] - project(found.P, X)[:, :, None] * np.eye(3)[2])
            J = J.reshape(50, 2, 12)
            variance = np.einsum("nri,ij,nrj->nr", J, found.covariance, J)
            ratios.append(np.mean((project(found.P, X) - xy) ** 2 / variance))
            continue
        # x -> exp(w) x + d of the camera frame, to first order.
        turn = R @ found.R.T
        w = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        values, vectors = np.linalg.eigh(found.covariance)
        ratios.append(np.mean((vectors.T @ np.append(w, T - turn @ found.t)) ** 2 / values))
    assert 0.45 < np.mean(sigmas) < 0.55
    assert 0.7 < np.mean(ratios) < 1.6


def test_the_mirrored_pose_of_a_small_plane_is_given_where_noise_explains_it():
    X = np.array([[x, y, 0.0] for x in np.linspace(-0.1, 0.1, 7) for y in np.linspace(-0.1, 0.1, 7)])
    named = {3.0: 0, 30.0: 0}
    for distance in named:
        for seed in range(12):
            rng = np.random.default_rng(seed)
            R = Rotation.from_euler(
                "xyz", rng.uniform([20, -20, -20], [50, 20, 20]), degrees=True
            ).as_matrix()
            xy = project(compose_camera(GIVEN_K, R, np.array([0.0, 0.0, 0.4 * distance])), X)
            found = thesisrecon.resect(X, xy + 0.3 * rng.normal(size=xy.shape), GIVEN_K)
            poses = [found.R, *found.competing_poses[:, :, :3]]
            off = [np.degrees(Rotation.from_matrix(one @ R.T).magnitude()) for one in poses]
            assert min(off) < (1.0 if distance == 3.0 else 15.0)
            named[distance] += len(poses) - 1
    assert named[3.0] == 0
    assert named[30.0] >= 6


def test_all_poses_that_few_points_leave_possible_are_given():
    wrong = 0
    for seed in range(24):
        rng = np.random.default_rng(seed)
        X, R = (
            rng.uniform(-1.0, 1.0, (4, 3)) * [1.0, 1.0, 0.03],
            Rotation.random(random_state=seed).as_matrix(),
        )
        P = compose_camera(GIVEN_K, R, np.array([0.0, 0.0, 30.0]))
        found = thesisrecon.resect(
            X, project(P, X) + 0.5 * rng.normal(size=(4, 2)), GIVEN_K, threshold_px=None
        )
        poses = [found.R, *found.competing_poses[:, :, :3]]
        off = [np.degrees(Rotation.from_matrix(one @ R.T).magnitude()) for one in poses]
        wrong += off[0] > 20.0
        assert min(off) < 20.0
    assert wrong > 0


@pytest.mark.parametrize("threshold_px", [1.0, None])
def test_mirrored_points_equal_pixels_and_points_without_a_pose_have_no_camera(threshold_px):
    X, xy = points(30, np.random.default_rng(0))
    same, line = np.tile([100.0, 200.0], (30, 1)), np.outer([0.0, 1.0, 2.0, 3.0], [1.0, 1.0, 0.5])
    line += 1e-5 * np.random.default_rng(0).normal(size=(4, 3))
    corners = np.array([[100.0, 100.0], [700.0, 150.0], [120.0, 500.0], [650.0, 520.0]])
    for words, given in (
        ("", (X * [1.0, 1.0, -1.0], xy)),
        ("; all 30 pixels are equal", (X, same)),
        ("; all 30 pixels are equal", (X, same, GIVEN_K)),
        ("; 0 of 4", (line, corners, GIVEN_K)),
    ):
        message = f"no camera explains the points{words}"
        refuses(StageFailure, message, thesisrecon.resect, *given, threshold_px=threshold_px)
    xy[:20] = 100.0
    found = thesisrecon.resect(X, xy, GIVEN_K, threshold_px=threshold_px)
    assert np.linalg.det(found.R) == pytest.approx(1.0)

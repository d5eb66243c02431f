"""Triangulation and resection on exact data, and the signs of cheirality."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.geometry.camera_matrix import (
    camera_centre,
    cheirality,
    decompose_camera,
    depth,
    distort,
    orient_signs,
    project,
    undistort,
)
from thesisrecon.geometry.resection import pose_from_three_points, resect_linear
from thesisrecon.geometry.triangulation import triangulate, triangulate_linear, triangulate_observations


def test_linear_triangulation_is_exact_on_exact_data():
    scene = make_scene()
    t = scene.tracks
    X = triangulate_observations(scene.P, t.view_index, t.point_index, t.xy, t.n_points)
    np.testing.assert_allclose(X[:, :3] / X[:, 3:], scene.X, atol=1e-6)


def test_triangulation_leaves_points_seen_once_at_zero():
    scene = make_scene(points=20)
    xy = np.full((8, 20, 2), np.nan)
    xy[scene.tracks.view_index, scene.tracks.point_index] = scene.tracks.xy
    xy[1:, 3] = np.nan
    X = triangulate_linear(scene.P, xy)
    assert not X[3].any()
    keep = np.arange(20) != 3
    np.testing.assert_allclose(X[keep, :3] / X[keep, 3:], scene.X[keep], atol=1e-6)


def test_triangulation_refuses_wrong_shapes():
    with pytest.raises(ValueError, match="triangulate needs"):
        triangulate_linear(np.zeros((2, 3, 4)), np.zeros((3, 5, 2)))


def test_linear_resection_recovers_the_camera():
    scene = make_scene()
    Xh = np.column_stack([scene.X, np.ones(len(scene.X))])
    P = resect_linear(Xh[:10], project(scene.P[2], Xh[:10]))
    np.testing.assert_allclose(project(P, Xh), project(scene.P[2], Xh), atol=1e-5)


def test_three_point_pose_contains_the_truth():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(500, 3, 3))
    R = Rotation.random(500, random_state=1).as_matrix()
    t = 0.5 * rng.normal(size=(500, 3)) + [0.0, 0.0, 5.0]
    Y = np.einsum("bij,bkj->bki", R, X) + t[:, None]
    found_R, found_t, sample = pose_from_three_points(X, Y / np.linalg.norm(Y, axis=2, keepdims=True))
    error = np.abs(found_R - R[sample]).max(axis=(1, 2)) + np.abs(found_t - t[sample]).max(axis=1)
    best = np.full(500, np.inf)
    np.minimum.at(best, sample, error)
    assert best.max() < 1e-6
    np.testing.assert_allclose(np.linalg.det(found_R), 1.0)


def test_three_point_pose_gives_nothing_for_collinear_points():
    X = np.array([[[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [2.0, 0.0, 5.0]]])
    X[:, 1] = X[:, 0]
    rays = X / np.linalg.norm(X, axis=2, keepdims=True)
    R, t, _ = pose_from_three_points(X, rays)
    assert np.isfinite(R).all()
    assert np.isfinite(t).all()


def test_orientation_makes_every_depth_positive():
    scene = make_scene()
    reconstruction = projective_reconstruction(scene, seed=3)
    t = scene.tracks
    views, points, share = orient_signs(reconstruction.P, reconstruction.X, t.view_index, t.point_index)
    P = reconstruction.P * views[:, None, None]
    X = reconstruction.X * points[:, None]
    w = np.einsum("kj,kj->k", P[t.view_index, 2], X[t.point_index])
    assert share == 1.0
    assert (w > 0).all() or (w < 0).all()


def test_cheirality_has_the_sign_of_depth_and_ignores_scale():
    scene = make_scene()
    X = np.column_stack([scene.X, np.ones(len(scene.X))])
    X[0, :3] = scene.centres[0] - 3.0 * scene.R[0][2]
    chi, z = cheirality(X, scene.P[0]), depth(X, scene.P[0])
    assert z[0] < 0 < z[1:].min()
    np.testing.assert_array_equal(np.sign(chi), np.sign(z))
    np.testing.assert_allclose(cheirality(-2.0 * X, -0.5 * scene.P[0]), chi)
    np.testing.assert_allclose(z[1:], (scene.X[1:] @ scene.R[0].T + scene.t[0])[:, 2])


def test_camera_parts_and_centre_by_minors():
    scene = make_scene()
    for v in range(3):
        K, R, t = decompose_camera(-3.0 * scene.P[v])
        np.testing.assert_allclose(K, scene.K[v], atol=1e-8)
        np.testing.assert_allclose(R, scene.R[v], atol=1e-10)
        np.testing.assert_allclose(t, scene.t[v], atol=1e-8)
        C = camera_centre(scene.P[v])
        np.testing.assert_allclose(C[:3] / C[3], scene.centres[v], atol=1e-9)
        assert np.abs(scene.P[v] @ C).max() < 1e-6 * np.abs(C).max() * np.abs(scene.P[v]).max()


def test_a_camera_at_infinity_is_refused():
    with pytest.raises(ValueError, match="finite camera"):
        decompose_camera(np.eye(3, 4) * np.array([[1.0], [1.0], [0.0]]))


def test_undistortion_inverts_distortion():
    xy = np.random.default_rng(0).uniform(-0.6, 0.6, (100, 2))
    np.testing.assert_allclose(distort(xy, np.array([0.15])), distort(xy, 0.15), rtol=1e-15)
    for k1 in (-0.2, 0.0, 0.15, np.array([-0.1, 0.05, -0.02])):
        np.testing.assert_allclose(undistort(distort(xy, k1), k1), xy, atol=1e-14)
    each = np.tile([-0.1, 0.05], (100, 1))
    np.testing.assert_allclose(undistort(distort(xy, each), each), xy, atol=1e-14)


def test_what_no_distortion_reaches_stays_where_it_is():
    # r - 0.3 r^3 is never above 0.703.
    far = np.array([[3.0, 0.0], [0.6, 0.6], [0.0, 0.0]])
    np.testing.assert_array_equal(undistort(far, -0.3), far)


def _two_views(sigma_px, n=200):
    scene = make_scene(points=n, seed=9)
    P = scene.P[:2]
    xy = np.stack([project(P[0], scene.X), project(P[1], scene.X)])
    return P, xy + sigma_px * np.random.default_rng(1).normal(size=xy.shape), scene.X


@pytest.mark.parametrize("method", ["polynomial", "linear", "midpoint"])
def test_every_method_is_exact_on_exact_images(method):
    P, xy, X = _two_views(0.0)
    found = triangulate(P, xy, method=method)
    np.testing.assert_allclose(found[:, :3] / found[:, 3:], X, atol=1e-5)


def test_polynomial_method_reaches_the_least_reprojection_error():
    P, xy, _ = _two_views(2.0, n=25)
    found = triangulate(P, xy)
    for n in range(25):
        start = found[n, :3] / found[n, 3]

        def residual(x, n=n):
            return np.concatenate([project(P[v], x[None])[0] - xy[v, n] for v in range(2)])

        best = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert np.sum(residual(start) ** 2) <= 2.0 * best.cost * (1 + 1e-6) + 1e-9


def test_polynomial_method_does_not_change_with_the_projective_frame():
    P, xy, _ = _two_views(1.0)
    G = np.eye(4) + 0.3 * np.random.default_rng(2).normal(size=(4, 4))
    X, Y = triangulate(P, xy), triangulate(P @ np.linalg.inv(G), xy) @ np.linalg.inv(G).T
    np.testing.assert_allclose(project(P[0], X), project(P[0], Y), atol=1e-4)


def test_unknown_method_is_refused():
    P, xy, _ = _two_views(0.0, n=5)
    with pytest.raises(ValueError, match="polynomial, linear, midpoint"):
        triangulate(P, xy, method="guess")
    with pytest.raises(ValueError, match="exactly two"):
        triangulate(np.concatenate([P, P]), np.concatenate([xy, xy]))

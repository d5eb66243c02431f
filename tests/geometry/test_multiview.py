"""Theorems of section 3.6 on random cameras and points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.epipolar.pairs import angle_between, make_pair
from thesisrecon.geometry.camera_matrix import camera_centre, project
from thesisrecon.geometry.homogeneous import cross_matrix, dehomogenize, homogenize
from thesisrecon.geometry.two_view import (
    algebraic_residuals,
    canonical_cameras,
    enforce_rank_two,
    epipolar_distances,
    epipolar_lines,
    epipoles,
    estimate_homography,
    fundamental_from_cameras,
    homography_residuals,
    quasi_euclidean_planes,
    sampson_residuals,
    symmetric_residuals,
    unit_norm,
)

seeds = st.integers(0, 2**31)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds)
def test_matches_satisfy_the_epipolar_constraint_of_their_cameras(seed):
    pair = make_pair(20, np.random.default_rng(seed))
    assert np.linalg.norm(pair.F) == pytest.approx(1.0)
    assert abs(np.linalg.det(pair.F)) < 1e-15
    assert symmetric_residuals(pair.F, pair.xy1, pair.xy2).max() < 1e-8
    lines = epipolar_lines(pair.F, pair.xy1)
    distance = np.sum(lines * homogenize(pair.xy2), axis=1)
    assert np.abs(distance).max() < 1e-8


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds)
def test_epipoles_are_images_of_the_other_centre(seed):
    pair = make_pair(8, np.random.default_rng(seed))
    e1, e2 = epipoles(pair.F)
    for e, image in ((e1, pair.P1 @ camera_centre(pair.P2)), (e2, pair.P2 @ camera_centre(pair.P1))):
        image /= np.linalg.norm(image)
        assert min(np.linalg.norm(e - image), np.linalg.norm(e + image)) < 1e-7


def test_default_plane_keeps_the_second_camera_away_from_singular():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        s = np.diag([1e-3, 1e-3, 1.0])
        F = unit_norm(np.linalg.inv(s).T @ make_pair(8, rng).F @ np.linalg.inv(s))
        _, P2 = canonical_cameras(F)
        singular_values = np.linalg.svd(F, compute_uv=False)
        assert np.linalg.cond(P2[:, :3]) == pytest.approx(singular_values[0] / singular_values[1])
        _, singular = canonical_cameras(F, plane=np.zeros(3))
        assert np.linalg.cond(singular[:, :3]) > 1e8


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds, st.sampled_from([0.0, 1e-3]))
def test_3_42_the_default_planes_are_the_true_one_and_its_twisted_twin_where_calibration_is_the_identity(
    seed, noise
):
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    t = rng.normal(size=3)
    F = cross_matrix(t / np.linalg.norm(t)) @ R + noise * rng.normal(size=(3, 3))
    F = enforce_rank_two(rng.choice([-3.0, 0.2]) * F)
    found = []
    for plane in quasi_euclidean_planes(F):
        A = canonical_cameras(F, plane=plane)[1][:, :3]
        found.append(A * np.sign(np.linalg.det(A)) / np.cbrt(abs(np.linalg.det(A))))
    near = min(np.linalg.norm(A - R) for A in found)
    assert near < 1e-9 + 30.0 * noise
    assert np.trace(found[0]) >= np.trace(found[1])
    # No other plane gives a left part nearer to a multiple of a rotation.
    residual = [
        _distance_from_rotations(F, quasi_euclidean_planes(F)[0] + d) for d in 0.05 * rng.normal(size=(20, 3))
    ]
    assert _distance_from_rotations(F, quasi_euclidean_planes(F)[0]) <= min(residual) + 1e-12


def _distance_from_rotations(F, plane):
    """Frobenius distance of the left part from the nearest multiple of an orthogonal matrix."""
    s = np.linalg.svd(canonical_cameras(F, plane=plane)[1][:, :3], compute_uv=False)
    return float(np.linalg.norm(s - s.mean()))


def test_cameras_with_one_centre_have_no_fundamental_matrix():
    pair = make_pair(8, np.random.default_rng(0))
    with pytest.raises(ValueError, match="different centres"):
        fundamental_from_cameras(pair.P1, np.diag([1.0, 2.0, 1.0]) @ pair.P1)
    with pytest.raises(ValueError, match="scale"):
        canonical_cameras(pair.F, scale=0.0)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds)
def test_sampson_distance_is_the_distance_to_the_nearest_exact_match_to_first_order(seed):
    rng = np.random.default_rng(seed)
    pair = make_pair(50, rng)
    noise = rng.normal(0.0, 1e-3, (50, 4))
    xy1, xy2 = pair.xy1 + noise[:, :2], pair.xy2 + noise[:, 2:]
    h, residuals = 1e-4, algebraic_residuals(pair.F, xy1, xy2)
    gradient = np.stack(
        [(algebraic_residuals(pair.F, xy1 + d[:2], xy2 + d[2:]) - residuals) / h for d in h * np.eye(4)],
        axis=1,
    )
    normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    expected = np.sum(noise * normal, axis=1)
    np.testing.assert_allclose(sampson_residuals(pair.F, xy1, xy2), expected, atol=1e-7)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds, st.floats(1e-3, 1e3), st.booleans())
def test_residuals_depend_neither_on_the_scale_of_f_nor_on_the_order_of_the_images(seed, scale, negative):
    rng = np.random.default_rng(seed)
    pair = make_pair(20, rng)
    xy1, xy2 = pair.xy1 + rng.normal(size=(20, 2)), pair.xy2 + rng.normal(size=(20, 2))
    G = (-scale if negative else scale) * pair.F
    for residuals in (sampson_residuals, symmetric_residuals):
        direct = np.abs(residuals(pair.F, xy1, xy2))
        np.testing.assert_allclose(np.abs(residuals(G, xy1, xy2)), direct, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(np.abs(residuals(pair.F.T, xy2, xy1)), direct, rtol=1e-9, atol=1e-10)


def test_symmetric_residual_is_the_root_of_the_two_squared_line_distances():
    rng = np.random.default_rng(3)
    pair = make_pair(20, rng)
    xy1, xy2 = pair.xy1 + rng.normal(size=(20, 2)), pair.xy2
    in2 = np.sum(epipolar_lines(pair.F, xy1) * homogenize(xy2), axis=1)
    in1 = np.sum(epipolar_lines(pair.F.T, xy2) * homogenize(xy1), axis=1)
    np.testing.assert_allclose(symmetric_residuals(pair.F, xy1, xy2), np.hypot(in1, in2), rtol=1e-9)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds, st.integers(4, 30))
def test_a_plane_is_seen_through_one_homography(seed, n):
    pair = make_pair(n, np.random.default_rng(seed), planar=True)
    H = estimate_homography(pair.xy1, pair.xy2)
    assert homography_residuals(H, pair.xy1, pair.xy2).max() < 1e-4
    assert np.linalg.norm(H) == pytest.approx(1.0)


def test_homography_residual_is_infinite_where_the_point_goes_to_infinity():
    H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    residual = homography_residuals(H, np.array([[0.0, 1.0], [1.0, 1.0]]), np.ones((2, 2)))
    assert np.isinf(residual[0])
    assert residual[1] == pytest.approx(0.0)


@pytest.mark.parametrize("shape", [(3, 2), (5, 3), (5,)])
def test_homography_refuses_wrong_shapes(shape):
    with pytest.raises(ValueError, match="estimate_homography"):
        estimate_homography(np.zeros(shape), np.zeros(shape))


def test_nearest_matrix_of_rank_two():
    M = np.random.default_rng(0).normal(size=(3, 3))
    F = enforce_rank_two(M)
    assert np.linalg.matrix_rank(F) == 2
    s = np.linalg.svd(M, compute_uv=False)
    assert np.linalg.norm(M - F * np.hypot(s[0], s[1])) == pytest.approx(s[2])
    assert angle_between(enforce_rank_two(F), F) < 1e-12


def test_canonical_cameras_project_as_the_true_cameras():
    pair = make_pair(30, np.random.default_rng(5))
    P1, P2 = canonical_cameras(pair.F)
    A = np.concatenate(
        [xy[:, i, None] * P[2] - P[i] for P, xy in ((P1, pair.xy1), (P2, pair.xy2)) for i in (0, 1)]
    ).reshape(4, 30, 4)
    X = np.linalg.svd(np.moveaxis(A, 0, 1))[2][:, 3]
    assert np.abs(project(P2, X) - pair.xy2).max() < 1e-5
    assert np.abs(dehomogenize(X @ P1.T) - pair.xy1).max() < 1e-5


def test_3_34_the_pair_in_the_other_order_has_the_transpose():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        P1, P2 = rng.normal(size=(2, 3, 4))
        F, back = fundamental_from_cameras(P1, P2), fundamental_from_cameras(P2, P1)
        assert min(np.linalg.norm(F - back.T), np.linalg.norm(F + back.T)) < 1e-9
        X = rng.normal(size=(10, 3))
        distances = epipolar_distances(F, project(P1, X), project(P2, X))
        assert np.abs(distances).max() < 1e-6 * max(
            1.0, np.abs(project(P2, X)).max(), np.abs(project(P1, X)).max()
        )

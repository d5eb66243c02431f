"""Theorems of section 3.6 on random cameras and points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.epipolar.pairs import angle_between, make_pair
from thesisrecon.errors import StageFailure
from thesisrecon.geometry import two_view
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.geometry.two_view import (
    homography_linear,
    homography_residuals,
    require_parallax_of_matches,
)

seeds = st.integers(0, 2**31)


def test_default_plane_keeps_the_second_camera_away_from_singular():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        s = np.diag([1e-3, 1e-3, 1.0])
        F = two_view.unit_norm(np.linalg.inv(s).T @ make_pair(8, rng).F @ np.linalg.inv(s))
        _, P2 = two_view.canonical_cameras(F)
        singular_values = np.linalg.svd(F, compute_uv=False)
        assert np.linalg.cond(P2[:, :3]) == pytest.approx(singular_values[0] / singular_values[1])
        _, singular = two_view.canonical_cameras(F, plane=np.zeros(3))
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
    F = two_view.enforce_rank_two(rng.choice([-3.0, 0.2]) * F)
    found = []
    for plane in two_view.quasi_euclidean_planes(F):
        A = two_view.canonical_cameras(F, plane=plane)[1][:, :3]
        found.append(A * np.sign(np.linalg.det(A)) / np.cbrt(abs(np.linalg.det(A))))
    near = min(np.linalg.norm(A - R) for A in found)
    assert near < 1e-9 + 30.0 * noise
    assert np.trace(found[0]) >= np.trace(found[1])
    # No other plane gives a left part nearer to a multiple of a rotation.
    residual = [
        _distance_from_rotations(F, two_view.quasi_euclidean_planes(F)[0] + d)
        for d in 0.05 * rng.normal(size=(20, 3))
    ]
    assert _distance_from_rotations(F, two_view.quasi_euclidean_planes(F)[0]) <= min(residual) + 1e-12


def _distance_from_rotations(F, plane):
    """Frobenius distance of the left part from the nearest multiple of an orthogonal matrix."""
    s = np.linalg.svd(two_view.canonical_cameras(F, plane=plane)[1][:, :3], compute_uv=False)
    return float(np.linalg.norm(s - s.mean()))


FAR = np.array([[1.0, 0, 0, -4e5], [0, 1, 0, -5e6], [0, 0, 1, -300.0], [0, 0, 0, 1]])


def test_cameras_of_a_georeferenced_frame_have_their_fundamental_matrix():
    for seed in range(10):
        pair = make_pair(8, np.random.default_rng(seed))
        F = two_view.fundamental_from_cameras(pair.P1 @ FAR, pair.P2 @ FAR)
        assert angle_between(F, two_view.fundamental_from_cameras(pair.P1, pair.P2)) < 1e-4


def test_cameras_with_one_centre_have_no_fundamental_matrix():
    pair = make_pair(8, np.random.default_rng(0))
    with pytest.raises(ValueError, match="different centres"):
        two_view.fundamental_from_cameras(pair.P1 @ FAR, np.diag([1.0, 2.0, 1.0]) @ pair.P1 @ FAR)
    with pytest.raises(ValueError, match="different centres"):
        two_view.fundamental_from_cameras(pair.P1, np.column_stack([pair.P2[:, :3], [1e-14, 0.0, 1e-15]]))
    with pytest.raises(ValueError, match="different centres"):
        two_view.fundamental_from_cameras(pair.P1, np.diag([1.0, 2.0, 1.0]) @ pair.P1)
    refuses(ValueError, "scale", two_view.canonical_cameras, pair.F, scale=0.0)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds)
def test_sampson_distance_is_the_distance_to_the_nearest_exact_match_to_first_order(seed):
    rng = np.random.default_rng(seed)
    pair = make_pair(50, rng)
    noise = rng.normal(0.0, 1e-3, (50, 4))
    xy1, xy2 = pair.xy1 + noise[:, :2], pair.xy2 + noise[:, 2:]
    h, residuals = 1e-4, two_view._algebraic_residuals(pair.F, xy1, xy2)
    gradient = np.stack(
        [
            (two_view._algebraic_residuals(pair.F, xy1 + d[:2], xy2 + d[2:]) - residuals) / h
            for d in h * np.eye(4)
        ],
        axis=1,
    )
    normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    expected = np.sum(noise * normal, axis=1)
    np.testing.assert_allclose(two_view.sampson_residuals(pair.F, xy1, xy2), expected, atol=1e-7)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds, st.floats(1e-3, 1e3), st.booleans())
def test_residuals_depend_neither_on_the_scale_of_f_nor_on_the_order_of_the_images(seed, scale, negative):
    rng = np.random.default_rng(seed)
    pair = make_pair(20, rng)
    xy1, xy2 = pair.xy1 + rng.normal(size=(20, 2)), pair.xy2 + rng.normal(size=(20, 2))
    G = (-scale if negative else scale) * pair.F
    for residuals in (two_view.sampson_residuals, two_view.symmetric_residuals):
        direct = np.abs(residuals(pair.F, xy1, xy2))
        np.testing.assert_allclose(np.abs(residuals(G, xy1, xy2)), direct, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(np.abs(residuals(pair.F.T, xy2, xy1)), direct, rtol=1e-9, atol=1e-10)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds, st.integers(4, 30))
def test_a_plane_is_seen_through_one_homography(seed, n):
    pair = make_pair(n, np.random.default_rng(seed), planar=True)
    H = homography_linear(pair.xy1, pair.xy2)
    assert homography_residuals(H, pair.xy1, pair.xy2).max() < 1e-4
    assert np.linalg.norm(H) == pytest.approx(1.0)


def test_homography_residual_is_infinite_where_the_point_goes_to_infinity():
    H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    residual = homography_residuals(H, np.array([[0.0, 1.0], [1.0, 1.0]]), np.ones((2, 2)))
    assert np.isinf(residual[0])
    assert residual[1] == pytest.approx(0.0)


def test_four_matches_show_no_parallax():
    pair = make_pair(4, np.random.default_rng(2))
    matches = pair.F, pair.xy1, pair.xy2
    refuses(StageFailure, "explains 90 % of 4 matches", require_parallax_of_matches, *matches)


@pytest.mark.parametrize("shape", [(3, 2), (5, 3), (5,)])
def test_homography_refuses_wrong_shapes(shape):
    refuses(ValueError, "homography_linear", homography_linear, np.zeros(shape), np.zeros(shape))


def test_nearest_matrix_of_rank_two():
    M = np.random.default_rng(0).normal(size=(3, 3))
    F = two_view.enforce_rank_two(M)
    assert np.linalg.matrix_rank(F) == 2
    s = np.linalg.svd(M, compute_uv=False)
    assert np.linalg.norm(M - F * np.hypot(s[0], s[1])) == pytest.approx(s[2])
    assert angle_between(two_view.enforce_rank_two(F), F) < 1e-12

"""The tensor of a virtual camera is that of the scene seen again."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from thesisrecon.camera import compose_camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix, project
from thesisrecon.geometry.conditioning import unit_tensor
from thesisrecon.geometry.three_view import tensor_from_cameras
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.views import tensor
from thesisrecon.views.tensor_synthesis import _transfer_rows

exact = settings(derandomize=True, deadline=None, max_examples=60)


def _camera(draw_angles, f, middle):
    K = calibration_matrix(f, 1.03 * f, *middle, skew=2.0)
    return K, Rotation.from_rotvec(draw_angles).as_matrix()


def _number(low, high):
    """Of a millionth, for numbers next to nothing are none that cameras have."""
    return st.floats(low, high).map(lambda value: round(value, 6))


angles = st.tuples(*[_number(-0.3, 0.3)] * 3)
focals = _number(500.0, 2000.0)
shifts = st.tuples(*[_number(-0.8, 0.8)] * 3)
middles = st.tuples(_number(300.0, 700.0), _number(200.0, 500.0))
baselines = st.tuples(_number(0.4, 1.0), _number(-0.5, 0.5), _number(-0.5, 0.5), st.booleans())


def _scene(seed, n=60):
    rng = np.random.default_rng(seed)
    return rng.uniform((-3, -2, 4), (3, 2, 9), (n, 3))


def _pair(turn, baseline, f1=1000.0, f2=1200.0):
    K1, _ = _camera((0, 0, 0), f1, (500.0, 350.0))
    K2, R = _camera(turn, f2, (480.0, 370.0))
    t = np.array(baseline[:3]) * (-1.0 if baseline[3] else 1.0)
    return tensor.CalibratedPair(K1, K2, R, t / np.linalg.norm(t))


def _images(pair, X):
    return project(pair.K1 @ np.eye(3, 4), X), project(compose_camera(pair.K2, pair.R, pair.t), X)


@exact
@given(angles, baselines, angles, shifts, focals, middles, st.integers(0, 1000))
def test_the_virtual_camera_sees_the_scene_projected_again(turn, baseline, R, t, f, middle, seed):
    pair, X = _pair(turn, baseline), _scene(seed)
    K, R = _camera(R, f, middle)
    X2 = X @ pair.R.T + pair.t
    X3 = X2 @ R.T + t
    virtual = tensor.seed_of_two(pair).moved(R, np.array(t), K=K)
    xy, inverse_depth = virtual.transfer(*_images(pair, X))
    np.testing.assert_allclose(xy, project(K @ np.eye(3, 4), X3), rtol=1e-10, atol=1e-8)
    np.testing.assert_allclose(inverse_depth, 1.0 / X3[:, 2], rtol=1e-9)


@exact
@given(angles, baselines, angles, shifts)
def test_the_tensor_is_that_of_the_three_cameras(turn, baseline, R, t):
    pair = _pair(turn, baseline)
    R = Rotation.from_rotvec(R).as_matrix()
    virtual = tensor.seed_of_two(pair).moved(R, np.array(t))
    third = compose_camera(pair.K2, R @ pair.R, R @ pair.t + t)
    cameras = tensor_from_cameras(pair.K1 @ np.eye(3, 4), compose_camera(pair.K2, pair.R, pair.t), third)
    ours = unit_tensor(virtual.T)
    # tensor_from_cameras knows no sign of the frame.
    np.testing.assert_allclose(ours * np.sign(np.sum(ours * cameras)), cameras, atol=1e-10)


def _fundamental(pair):
    return fundamental_from_cameras(pair.K1 @ np.eye(3, 4), compose_camera(pair.K2, pair.R, pair.t))


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.05, -0.2, 0.1), (0.1, 0.3, 2.0), (0.0, 0.0, np.pi)])
@pytest.mark.parametrize("baseline", [(0.7, 0.1, 0.2, False), (0.5, 0.4, 0.5, True)])
def test_the_pair_of_f_is_the_one_that_made_it(turn, baseline):
    pair = _pair(turn, baseline)
    xy1, xy2 = _images(pair, _scene(1))
    found = tensor.pair_from_fundamental(-_fundamental(pair), xy1, xy2, K1=pair.K1, K2=pair.K2)
    np.testing.assert_allclose(found.R, pair.R, atol=1e-9)
    np.testing.assert_allclose(found.t, pair.t, atol=1e-9)


def test_wrong_intrinsics_leave_f_and_both_photographs_as_they_are():
    """New views are then right but for a projective transform: what both see stays one point."""
    pair = _pair((0.02, -0.1, 0.03), (0.7, 0.1, 0.2, False))
    xy1, xy2 = _images(pair, _scene(1))
    F, guess = _fundamental(pair), calibration_matrix(1300.0, 1300.0, 499.5, 349.5)
    found = tensor.pair_from_fundamental(F, xy1, xy2, K1=guess, K2=guess)
    again = _fundamental(found)
    np.testing.assert_allclose(again * np.sign(np.sum(again * F)), F, atol=1e-9)
    # As it stands where the first photograph was taken, and where the second one was.
    seed = tensor.seed_of_two(found)
    back = seed.moved(found.R.T, found.centre2, K=found.K1)
    np.testing.assert_allclose(back.transfer(xy1, xy2)[0], xy1, atol=1e-6)
    np.testing.assert_allclose(seed.transfer(xy1, xy2)[0], xy2, atol=1e-6)
    np.testing.assert_allclose(found.K2, guess, rtol=0.2, atol=150.0)


def test_matches_beside_their_epipolar_lines_go_where_their_nearest_place_on_it_goes():
    pair = _pair((0.05, -0.2, 0.1), (0.7, 0.1, 0.2, False))
    xy1, xy2 = _images(pair, _scene(2))
    virtual = tensor.seed_of_two(pair).moved(np.eye(3), np.array([0.2, 0.3, 0.1]))
    lines = virtual._perpendicular_lines(xy1, xy2)
    across = np.stack([lines[:, 1], -lines[:, 0]], axis=1)
    np.testing.assert_allclose(
        virtual.transfer(xy1, xy2 + 2.0 * across)[0], virtual.transfer(xy1, xy2)[0], atol=1e-7
    )


def test_disparities_of_nearness_are_their_differences():
    pair, X = _pair((0.05, -0.2, 0.1), (0.5, 0.2, 0.6, False)), _scene(8)
    virtual = tensor.seed_of_two(pair).moved(np.eye(3), np.array([0.2, 0.3, -1.0]))
    xy1, xy2 = _images(pair, X)
    inverse_depth = virtual.transfer(xy1, xy2)[1]
    xy1_again, farther = _images(pair, 1.0001 * X)
    np.testing.assert_allclose(xy1_again, xy1, atol=1e-9)
    change = np.abs(virtual.transfer(xy1, farther)[1] - inverse_depth)
    expected = np.linalg.norm(farther - xy2, axis=1) / change
    np.testing.assert_allclose(virtual.disparity_per_inverse_depth(xy1, xy2), expected, rtol=1e-3)


def test_points_behind_the_virtual_camera_have_no_place():
    pair = _pair((0.05, -0.2, 0.1), (0.7, 0.1, 0.2, False))
    X = _scene(4)
    xy, inverse_depth = (
        tensor.seed_of_two(pair).moved(np.eye(3), np.array([0.0, 0.0, -6.0])).transfer(*_images(pair, X))
    )
    behind = (X @ pair.R.T + pair.t)[:, 2] < 6.0
    assert 5 < behind.sum() < 55
    np.testing.assert_array_equal(np.isnan(inverse_depth), behind)
    np.testing.assert_array_equal(np.isnan(xy[:, 0]), behind)


@pytest.mark.parametrize(("ahead", "sign"), [(1.5, 1.0), (-1.5, -1.0)])
def test_inverse_depth_orders_pixels_as_mcmillan_paints_them(ahead, sign):
    """Towards the epipole of the new camera where it is in front of view 1, else away from it: what is
    painted last is nearest."""
    pair = _pair((0.0, -0.1, 0.0), (0.7, 0.1, 0.2, False))
    centre = np.array([0.2, -0.1, ahead])
    X = centre + np.linspace(3.0, 8.0, 9)[:, None] * np.array([0.1, 0.15, 1.0])
    xy1, xy2 = _images(pair, X)
    virtual = tensor.seed_of_two(pair).moved(np.eye(3), -pair.R @ centre - pair.t)
    xy, inverse_depth = virtual.transfer(xy1, xy2)
    np.testing.assert_allclose(xy, np.broadcast_to(xy[0], xy.shape), atol=1e-6)
    from_epipole = np.linalg.norm(xy1 - project(pair.K1 @ np.eye(3, 4), centre[None]), axis=1)
    assert (sign * np.diff(from_epipole) > 0.0).all()
    assert (np.diff(inverse_depth) < 0.0).all()


def test_the_kernel_is_its_numpy_twin():
    rng = np.random.default_rng(5)
    pair = _pair((0.05, -0.2, 0.1), (0.7, 0.1, 0.2, False))
    virtual = tensor.seed_of_two(pair).moved(np.eye(3), np.array([0.2, 0.3, -2.0]))
    places = rng.uniform(0, 600, (20, 30, 2)).astype(np.float32)
    places[3, 4] = np.nan
    xy, inverse_depth = np.empty((20, 30, 2)), np.empty((20, 30), np.float32)
    _transfer_rows(virtual.T, virtual.P2, places, 7, xy, inverse_depth)
    x, y = np.meshgrid(np.arange(30.0), 7 + np.arange(20.0))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    expected = virtual.transfer(pixels, places.reshape(-1, 2).astype(np.float64))
    assert 100 < np.isfinite(inverse_depth).sum() < 600
    np.testing.assert_allclose(xy.reshape(-1, 2), expected[0], rtol=2e-5)
    np.testing.assert_allclose(inverse_depth.ravel(), expected[1], rtol=2e-5, atol=1e-6)


def _bad_pair(problem):
    pair, X = _pair((0.05, -0.2, 0.1), (0.7, 0.1, 0.2, False)), _scene(6)
    xy1, xy2 = _images(pair, X)
    F = _fundamental(pair)
    if problem == "of others":
        F = _fundamental(_pair((0.0, 0.3, 0.0), (-0.1, 1.0, 0.2, False)))
    if problem == "turned":
        noise = np.random.default_rng(7).normal(0.0, 0.3, xy1.shape)
        xy2 = project(compose_camera(pair.K2, pair.R, np.zeros(3)), X) + noise
    if problem == "behind":
        # One half of the scene is behind both cameras.
        xy1, xy2 = _images(pair, X * np.where(np.arange(len(X)) % 2, 1.0, -1.0)[:, None])
    return {"F": F, "xy1": xy1, "xy2": xy2, "K1": pair.K1, "K2": pair.K2}


@pytest.mark.parametrize(
    ("problem", "sentence"),
    [
        ("of others", "the fundamental matrix does not fit the matches"),
        ("turned", "show no parallax"),
        ("behind", "the scene is not in front of both cameras"),
    ],
)
def test_pairs_that_cannot_work_are_refused_with_a_sentence(problem, sentence):
    with pytest.raises(StageFailure, match=sentence) as failure:
        tensor.pair_from_fundamental(**_bad_pair(problem))
    assert "\n" not in str(failure.value)


@pytest.mark.parametrize(
    ("rotation", "translation", "K", "sentence"),
    [
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), None, "det -1"),
        (np.eye(3) + 0.01, np.zeros(3), None, "off by"),
        (np.full((3, 3), np.nan), np.zeros(3), None, "finite"),
        (np.eye(3), np.zeros(2), None, "three finite numbers"),
        (np.eye(3), np.zeros(3), np.diag([-1.0, 1.0, 1.0]), "positive focal lengths"),
        (np.eye(3), np.zeros(3), np.eye(4), r"needs K \(3, 3\); got \(4, 4\)"),
    ],
)
def test_invalid_motions_are_value_errors(rotation, translation, K, sentence):
    with pytest.raises(ValueError, match=sentence):
        tensor.VirtualCamera(rotation, translation, np.eye(3) if K is None else K, (640, 480))


def test_intrinsics_are_guessed_from_the_size():
    K = tensor.default_intrinsics((1000, 700))
    np.testing.assert_array_equal(K, [[1000.0, 0.0, 499.5], [0.0, 1000.0, 349.5], [0.0, 0.0, 1.0]])

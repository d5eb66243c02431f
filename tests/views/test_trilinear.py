"""The tensor of a virtual camera is that of the scene seen again, and the views that it makes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon.camera import compose_camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix, project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, unit_normals, unit_tensor
from thesisrecon.geometry.three_view import tensor_from_cameras
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.views import tensor
from thesisrecon.views.tensor import CalibratedPair, VirtualCamera, camera_at, prepare_synthesis, seed_of_two

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


STANDARD = (0.05, -0.2, 0.1), (0.7, 0.1, 0.2, False)
"""Turn and baseline of a usual pair."""


def _scene(seed):
    return np.random.default_rng(seed).uniform((-3, -2, 4), (3, 2, 9), (60, 3))


def _pair(turn, baseline):
    K1, _ = _camera((0, 0, 0), 1000.0, (500.0, 350.0))
    K2, R = _camera(turn, 1200.0, (480.0, 370.0))
    t = np.array(baseline[:3]) * (-1.0 if baseline[3] else 1.0)
    return tensor.CalibratedPair(K1, K2, R, t / np.linalg.norm(t))


def _cameras(pair):
    return pair.K1 @ np.eye(3, 4), compose_camera(pair.K2, pair.R, pair.t)


def _images(pair, X):
    return [project(P, X) for P in _cameras(pair)]


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
    pair, R = _pair(turn, baseline), Rotation.from_rotvec(R).as_matrix()
    ours = unit_tensor(tensor.seed_of_two(pair).moved(R, np.array(t)).T)
    third = compose_camera(pair.K2, R @ pair.R, R @ pair.t + t)
    cameras = tensor_from_cameras(*_cameras(pair), third)
    # tensor_from_cameras knows no sign of the frame.
    np.testing.assert_allclose(ours * np.sign(np.sum(ours * cameras)), cameras, atol=1e-10)


def _fundamental(pair):
    return fundamental_from_cameras(*_cameras(pair))


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
    pair = _pair(*STANDARD)
    xy1, xy2 = _images(pair, _scene(2))
    virtual = tensor.seed_of_two(pair).moved(np.eye(3), np.array([0.2, 0.3, 0.1]))
    across = unit_normals(np.cross(virtual.P2[:, 3], homogenize(xy1) @ virtual.P2[:, :3].T))[:, :2]
    beside = xy2 + 2.0 * across
    np.testing.assert_allclose(virtual.transfer(xy1, beside)[0], virtual.transfer(xy1, xy2)[0], atol=1e-7)


def test_points_behind_have_no_place_and_disparities_are_differences_of_nearness():
    pair, X = _pair(*STANDARD), _scene(4)
    virtual = tensor.seed_of_two(pair).moved(np.eye(3), np.array([0.0, 0.0, -6.0]))
    xy, inverse_depth = virtual.transfer(*_images(pair, X))
    behind = (X @ pair.R.T + pair.t)[:, 2] < 6.0
    assert 5 < behind.sum() < 55
    np.testing.assert_array_equal(np.isnan(inverse_depth), behind)
    np.testing.assert_array_equal(np.isnan(xy[:, 0]), behind)
    pair, X = _pair((0.05, -0.2, 0.1), (0.5, 0.2, 0.6, False)), _scene(8)
    virtual = tensor.seed_of_two(pair).moved(np.eye(3), np.array([0.2, 0.3, -1.0]))
    xy1, xy2 = _images(pair, X)
    inverse_depth = virtual.transfer(xy1, xy2)[1]
    xy1_again, farther = _images(pair, 1.0001 * X)
    np.testing.assert_allclose(xy1_again, xy1, atol=1e-9)
    change = np.abs(virtual.transfer(xy1, farther)[1] - inverse_depth)
    expected = np.linalg.norm(farther - xy2, axis=1) / change
    np.testing.assert_allclose(virtual.disparity_per_inverse_depth(xy1, xy2), expected, rtol=1e-3)


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


def test_pairs_that_cannot_work_are_refused_with_a_sentence():
    pair, X = _pair(*STANDARD), _scene(6)
    (xy1, xy2), F = _images(pair, X), _fundamental(pair)
    others = _fundamental(_pair((0.0, 0.3, 0.0), (-0.1, 1.0, 0.2, False)))
    turned = project(compose_camera(pair.K2, pair.R, np.zeros(3)), X)
    turned += np.random.default_rng(7).normal(0.0, 0.3, xy1.shape)
    # One half of the scene is behind both cameras.
    behind = _images(pair, X * np.where(np.arange(len(X)) % 2, 1.0, -1.0)[:, None])
    for sentence, *matches in (
        ("the fundamental matrix does not fit the matches", others, xy1, xy2),
        ("show no parallax", F, xy1, turned),
        ("the scene is not in front of both cameras", F, *behind),
    ):
        with pytest.raises(StageFailure, match=sentence) as failure:
            tensor.pair_from_fundamental(*matches, K1=pair.K1, K2=pair.K2)
        assert "\n" not in str(failure.value)


def test_unknown_intrinsics_have_the_long_side_as_focal_length():
    K = tensor.default_intrinsics((1000, 700))
    np.testing.assert_array_equal(K, [[1000.0, 0.0, 499.5], [0.0, 1000.0, 349.5], [0.0, 0.0, 1.0]])


SIZE = (160, 120)
K = calibration_matrix(150.0, 150.0, 81.0, 58.0)
PAIR = CalibratedPair(
    K, K, Rotation.from_rotvec([0.01, -0.08, 0.02]).as_matrix(), np.array([-0.98, 0.15, 0.1])
)


STILL = np.eye(3), np.zeros(3)
BLACK = np.zeros((2, *SIZE[::-1], 3))


def _seen(R, t, K=K):
    """Colours (H, W, 3) and points X_1 (H, W, 3) seen by a camera: a wall that leans, a disc before it."""
    x, y = np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1])))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T @ R
    centre, wall = -R.T @ t, np.array([0.2, 0.1, 1.0])
    X = centre + rays * ((9.0 - wall @ centre) / (rays @ wall))[..., None]
    disc = centre + rays * ((5.0 - centre[2]) / rays[..., 2])[..., None]
    hit = np.hypot(disc[..., 0] - 0.3, disc[..., 1]) < 1.0
    X[hit] = disc[hit]
    k = np.array([2.0, 3.0, 2.5])
    waves = np.sin(k * (X[..., :1] + X[..., 2:])) + np.cos(2.2 * X[..., 1:2] - k)
    return 120.0 + 30.0 * waves + 25.0 * hit[..., None], X


def _photographs():
    """Images of the pair, the places of their pixels in the other one, and which it does not see."""
    (one, X1), (two, X2) = _seen(*STILL), _seen(PAIR.R, PAIR.t)
    to = (PAIR.R, PAIR.t), STILL
    places, hidden = ([f(X, *pose) for X, pose in zip((X1, X2), to, strict=True)] for f in (_places, _hidden))
    return (one, two), places, hidden


def _places(X, R, t):
    return dehomogenize((X @ R.T + t) @ K.T).astype(np.float32)


def _hidden(X, R, t):
    """Whether the camera sees something else where X (H, W, 3) is."""
    at = np.rint(_places(X, R, t)).astype(int).clip(0, np.array(SIZE) - 1)
    return np.linalg.norm(_seen(R, t)[1][at[..., 1], at[..., 0]] - X, axis=2) > 0.5


@pytest.fixture(scope="module")
def synthesis():
    images, places, _ = _photographs()
    return prepare_synthesis(PAIR, images, places)


def _truth(camera):
    return _seen(camera.rotation @ PAIR.R, camera.rotation @ PAIR.t + camera.translation, camera.K)[0]


def _psnr(picture, truth):
    return 10.0 * np.log10(255.0**2 / np.mean((picture - truth) ** 2))


@pytest.mark.parametrize(
    ("s", "least_db"), [(0.0, 40.0), (0.3, 38.0), (0.5, 38.0), (1.0, 40.0), (1.5, 29.0), (-0.5, 29.0)]
)
def test_synthesis_on_the_baseline_and_beyond_matches_a_camera_there(synthesis, s, least_db):
    camera = camera_at(PAIR, s, sizes=(SIZE, SIZE))
    picture = synthesis.render(camera)
    assert _psnr(picture, _truth(camera)) > least_db
    np.testing.assert_array_equal(synthesis.render(camera, threads=3), picture)


@pytest.mark.parametrize("translation", [(0.0, -0.4, 0.0), (0.3, 0.3, -3.0), (0.4, 0.0, 1.5)])
def test_off_the_baseline_too(synthesis, translation):
    turned = Rotation.from_rotvec([0.03, 0.02, -0.1]).as_matrix()
    camera = VirtualCamera(turned, np.array(translation), calibration_matrix(140.0, 145.0, 80.0, 60.0), SIZE)
    picture = synthesis.render(camera)
    inner = (slice(25, -25), slice(35, -35))
    assert _psnr(picture[inner], _truth(camera)[inner]) > 30.0


def test_hidden_pixels_come_from_the_other_image_and_exposures_go_over(synthesis):
    wide = calibration_matrix(40.0, 40.0, 140.0, 100.0)
    picture = synthesis.render(VirtualCamera(*STILL, wide, SIZE))
    assert 0.02 < (picture == 0).all(axis=2).mean() < 0.1
    assert picture[90:110, 130:150].min() > 0
    images, places, hidden = _photographs()
    for known, not_seen in zip(places, hidden, strict=True):
        assert 100 < not_seen.sum() < 0.4 * not_seen.size
        known[not_seen] = np.nan
    camera = camera_at(PAIR, 0.5, sizes=(SIZE, SIZE))
    assert _psnr(prepare_synthesis(PAIR, images, places).render(camera), _truth(camera)) > 33.0
    (one, two), places, _ = _photographs()
    synthesis = prepare_synthesis(PAIR, (one, 0.64 * two), places, gain=np.full(3, 1.0 / 0.64))
    for s, exposure in ((0.0, 1.0), (0.5, 0.8), (1.0, 0.64)):
        camera = camera_at(PAIR, s, sizes=(SIZE, SIZE))
        assert _psnr(synthesis.render(camera), exposure * _truth(camera)) > 36.0


def test_the_way_goes_from_one_photograph_to_the_other_with_the_second_ones_size():
    places = [-0.5, 0.0, 0.5, 1.0, 1.5]
    path = [camera_at(PAIR, s, sizes=(SIZE, SIZE)) for s in places]
    centres = [-(c.rotation @ PAIR.R).T @ (c.rotation @ PAIR.t + c.translation) for c in path]
    np.testing.assert_allclose(centres, np.outer(places, PAIR.centre2), atol=1e-12)
    np.testing.assert_allclose(path[1].rotation @ PAIR.R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(path[3].rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(path[3].translation, 0.0, atol=1e-12)
    wide = CalibratedPair(calibration_matrix(300.0, 300.0, 160.0, 120.0), K, PAIR.R, PAIR.t)
    for s in (0.0, 0.5, 1.0):
        camera = camera_at(wide, s, sizes=((320, 240), SIZE))
        np.testing.assert_array_equal(camera.K, K)
        assert camera.size == SIZE


def test_cameras_shapes_and_places_that_do_not_fit_are_refused(synthesis):
    for rotation, translation in (
        (np.eye(3), (0.0, 0.0, -20.0)),
        (np.diag([-1.0, 1.0, -1.0]), (0.0, 0.0, 0.0)),
        (np.eye(3), (90.0, 0.0, 0.0)),
    ):
        camera = VirtualCamera(rotation, np.array(translation), K, SIZE)
        refuses(StageFailure, "sees almost nothing of the scene", synthesis.render, camera)
    image, nowhere = np.zeros((6, 8, 3)), np.full((6, 8, 2), np.nan, np.float32)
    both = (image, image), (nowhere, nowhere)
    refuses(StageFailure, "no dense correspondence", prepare_synthesis, PAIR, *both)
    refuses(ValueError, "at least 1 x 1", VirtualCamera, np.eye(3), np.zeros(3), K, (0, 5))
    # Photographs that contradict each other.
    places = _photographs()[1]
    places[0] += 50.0
    words = "no pixel of image 1 has a known correspondence"
    refuses(StageFailure, words, prepare_synthesis, PAIR, BLACK, places)


def test_the_tensor_of_a_moved_camera_contains_it():
    third = np.column_stack([Rotation.from_rotvec([0.05, 0.1, 0.0]).as_matrix(), [0.3, 0.2, -0.5]])
    moved = seed_of_two(PAIR).moved(third[:, :3] @ PAIR.R.T, third[:, 3] - third[:, :3] @ PAIR.R.T @ PAIR.t)
    # Points of the tensor's frame are (K X_1, 1).
    change = np.eye(4)
    change[:3, :3] = np.linalg.inv(K)
    np.testing.assert_allclose(moved.P3, K @ third @ change, atol=1e-9)


@pytest.mark.parametrize("reported", ["nothing", "the foreground"])
def test_hidden_pixels_are_found_out_and_take_the_background(reported):
    _, places, hidden = _photographs()
    inside = [np.all((there > 0.0) & (there < np.array(SIZE) - 1.0), axis=2) for there in places]
    given = [there.copy() for there in places]
    for side in (0, 1):
        given[side][hidden[side]] = np.nan
        if reported == "the foreground":
            # As a matcher does that fattens what is in front.
            given[side][hidden[side] & inside[side]] = places[side][60, 80]
    made = prepare_synthesis(PAIR, BLACK, given)
    for side in (0, 1):
        known = made.levels[side][..., 3] > 0.5
        assert known[inside[side] & ~hidden[side]].mean() > 0.97
        assert known[hidden[side]].mean() < 0.03
        off = np.linalg.norm(made.places[side] - places[side], axis=2)
        assert np.isfinite(off).all()
        assert np.mean(off[hidden[side] & inside[side]] < 2.0) > 0.9
        np.testing.assert_array_equal(made.places[side][known], given[side][known])

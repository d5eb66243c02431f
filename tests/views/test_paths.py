"""Camera paths: even, upright, clear of the model, and exact at their ends."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.surface.sphere import K, looking_at_origin
from thesisrecon.camera import Camera
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.records import TexturedMesh
from thesisrecon.views import paths

SIZE = (160, 120)
UP = np.array([0.0, -1.0, 0.0])  # of cameras whose y axis points down


def ring(angles, height=-1.0, distance=3.5):
    """Upright cameras about the origin."""
    return [Camera.from_matrix(looking_at_origin(a, height, distance), SIZE) for a in angles]


def ball(count=2000, seed=0):
    """Points on the unit sphere."""
    X = np.random.default_rng(seed).normal(size=(count, 3))
    return X / np.linalg.norm(X, axis=1, keepdims=True)


def moved(cameras, turn, shift):
    """The same cameras in a world that is turned and shifted."""
    return [Camera(c.K, c.R @ turn.T, c.t - c.R @ turn.T @ shift, c.size) for c in cameras]


def turns_of(path):
    """Angles (rad) between neighbouring cameras."""
    return [Rotation.from_matrix(b.R @ a.R.T).magnitude() for a, b in pairwise(path)]


def centres_of(path):
    return np.array([camera.centre for camera in path])


def test_all_round_the_scene_the_orbit_is_a_circle_at_constant_speed():
    cameras = ring(np.linspace(0, 2 * np.pi, 10)[:-1])
    path = paths.orbit(cameras, ball(), 40)
    centres = centres_of(path)
    np.testing.assert_allclose(centres[:, 1], centres[0, 1])
    steps = np.linalg.norm(np.roll(centres, -1, axis=0) - centres, axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(centres[:, [0, 2]], axis=1), 3.5, atol=0.1)
    np.testing.assert_allclose(centres[0], cameras[0].centre, atol=0.1)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_orbit_looks_at_the_middle_upright_and_turns_with_the_world(seed):
    rng = np.random.default_rng(seed)
    arc = rng.uniform(0.3, 2 * np.pi)
    cameras = ring(np.sort(rng.uniform(0, arc, 8)), rng.uniform(-1.2, 0.5), rng.uniform(3.0, 5.0))
    turn = Rotation.random(random_state=seed).as_matrix()
    shift, X = rng.normal(size=3), ball(800, seed)
    path = paths.orbit(moved(cameras, turn, shift), X @ turn.T + shift, 12)
    middle, up = paths._geometric_median(X @ turn.T + shift), turn @ UP
    # The weight of the axes turns the estimated direction, on short arcs most (Davis and Kahan's bound).
    rows, _, axis = np.array([camera.R for camera in cameras]).transpose(1, 0, 2)
    weighted = paths.TILT_WEIGHT * axis.T @ axis
    rolled = np.linalg.norm(weighted @ UP) / np.linalg.eigvalsh(rows.T @ rows + weighted)[1]
    for camera in path:
        np.testing.assert_allclose(project(camera.P, middle[None])[0], [79.5, 59.5], atol=1e-6)
        assert abs(camera.R[0] @ up) < rolled + 1e-9
        assert -camera.R[1] @ up > 0.1
        assert np.linalg.norm(camera.centre - shift) > 1.2
    # A swing has no first camera to start from, but what it passes is the same.
    same = paths.orbit(cameras, X, 12)
    np.testing.assert_allclose((centres_of(path) - shift) @ turn, centres_of(same), atol=1e-6)


def test_an_orbit_stays_on_the_side_of_its_cameras_and_avoids_obstacles():
    centres = centres_of(paths.orbit(ring(np.radians([-50.0, -20.0, 5.0, 45.0])), ball(), 61))
    seen = np.degrees(np.arctan2(centres[:, 0], -centres[:, 2]))
    np.testing.assert_allclose([seen.min(), seen.max()], [-50.0, 45.0], atol=2.0)
    steps = np.linalg.norm(np.roll(centres, -1, axis=0) - centres, axis=1)
    assert steps[-1] < 1.1 * steps.max()
    # A long wall: at its ends the cameras' median distance would lead through it.
    wall = np.random.default_rng(0).uniform([-6, -1, -0.2], [6, 1, 0.2], (3000, 3))
    cameras = ring(np.radians(np.arange(0, 360, 30.0)), -0.5, 5.0)
    for camera in paths.orbit(cameras, wall, 36):
        assert cKDTree(wall).query(camera.centre)[0] > 0.5
        xy, front = project(camera.P, wall[::50]), (camera.R @ wall[::50].T + camera.t[:, None])[2] > 0
        shown = front & ((xy > -0.5) & (xy < np.array(SIZE) - 0.5)).all(axis=1)
        assert shown.mean() > 0.4


def test_far_points_do_not_move_the_middle_and_points_lie_on_the_surface():
    X = np.vstack([ball(), np.full((300, 3), 500.0), np.full((5, 3), np.nan)])
    for camera in paths.orbit(ring(np.linspace(0, 6, 9)), X, 5):
        assert np.abs(project(camera.P, np.zeros((1, 3))) - [79.5, 59.5]).max() < 25
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [5, 3, 0], [8, 0, 0]])
    mesh = TexturedMesh(vertices, np.array([[0, 1, 2], [3, 4, 5], [0, 0, 1]]))
    X = paths.sample_surface(mesh, 1000)
    small = X[:, 0] < 2
    assert small.mean() == pytest.approx(0.1, abs=0.005)
    assert (X[small, :2].sum(axis=1) <= 1.0 + 1e-12).all()
    np.testing.assert_allclose(X[small].mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.02)
    assert len(paths.sample_surface(TexturedMesh(vertices, np.array([[0, 0, 1]])))) == 0


@pytest.mark.parametrize("frames", [1, 2, 7])
def test_one_camera_swings_a_little(frames):
    (camera,) = ring(np.array([0.4]))
    path = paths.orbit([camera], ball(), frames)
    assert len(path) == frames
    np.testing.assert_allclose(path[0].centre, camera.centre, atol=0.1)
    if frames == 7:
        spread = np.ptp(centres_of(path) @ camera.R[0])
        assert 1.0 < spread < 3.0


def test_cameras_in_the_middle_that_look_away_see_their_surroundings():
    """Photographs from the middle of a room, outwards."""
    away = [Camera(K, c.R, np.zeros(3), SIZE) for c in ring(np.linspace(0, 5, 7), 0.0)]
    for camera in paths.orbit(away, 5.0 * ball(), 10):
        assert 0.1 < np.linalg.norm(camera.centre) < 2.5
        assert abs(camera.R[0] @ UP) < 1e-6
    about = np.diag([-1.0, 1, -1])
    behind = [Camera(c.K, about @ c.R, about @ c.t, SIZE) for c in ring(np.zeros(3))]
    for camera in paths.orbit(behind, ball(), 4):
        np.testing.assert_allclose(camera.t, [0, 0, np.linalg.norm(camera.t)], atol=0.2)


def test_up_is_that_of_the_scene_though_cameras_are_tilted_and_rolled():
    rng = np.random.default_rng(1)
    cameras = []
    for camera in ring(np.linspace(-1, 1, 12), -6.0):
        roll = Rotation.from_rotvec([0, 0, rng.normal(0.0, 0.06)]).as_matrix()
        cameras.append(Camera(K, roll @ camera.R, roll @ camera.t, SIZE))
    assert np.degrees(np.arccos(paths.estimate_up(cameras) @ UP)) < 4.0
    (one,) = ring(np.array([0.7]))
    np.testing.assert_allclose(paths.estimate_up([one]), -one.R[1], atol=1e-9)
    # Of cameras that look straight down it is behind them.
    down = []
    for c, s in ((np.cos(a), np.sin(a)) for a in 2 * np.pi * np.arange(8) / 8):
        R = np.array([[c, 0, s], [s, 0, -c], [0, 1.0, 0]])
        down.append(Camera(K, R, -R @ np.array([0.5 * c, -4.0, 0.5 * s]), SIZE))
    np.testing.assert_allclose(paths.estimate_up(down), UP, atol=1e-9)
    assert all(camera.centre[1] < -3.0 for camera in paths.orbit(down, ball(), 6))


def test_interpolation_ends_at_the_real_cameras_and_passes_all():
    cameras = ring(np.array([0.0, 0.3, 0.5, 1.1, 1.3]), -1.0)
    cameras[2] = Camera(1.2 * K * [[1], [1], [1 / 1.2]], cameras[2].R, cameras[2].t, SIZE)
    path = paths.interpolate_cameras(cameras, 400)
    for real, frame in ((cameras[0], path[0]), (cameras[-1], path[-1])):
        np.testing.assert_allclose(frame.P, real.P)
    centres = centres_of(path)
    for camera in cameras:
        nearest = int(np.argmin(np.linalg.norm(centres - camera.centre, axis=1)))
        np.testing.assert_allclose(centres[nearest], camera.centre, atol=0.02)
        np.testing.assert_allclose(path[nearest].R, camera.R, atol=0.02)
        np.testing.assert_allclose(path[nearest].K, camera.K, rtol=0.02, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_upright_cameras_at_one_height_stay_upright_and_level_between(seed):
    angles = np.cumsum(np.random.default_rng(seed).uniform(0.02, 0.8, 6))
    for camera in paths.interpolate_cameras(ring(angles, 0.0), 30):
        np.testing.assert_allclose(camera.R[1], -UP, atol=1e-9)
        np.testing.assert_allclose(camera.centre[1], 0.0, atol=1e-9)
        assert np.linalg.det(camera.R) == pytest.approx(1.0)


def test_turning_takes_its_time_and_coincident_cameras_stand_still():
    still = [Camera(K, c.R, np.zeros(3), SIZE) for c in ring(np.linspace(0, 1, 4), 0.0)]
    np.testing.assert_allclose(turns_of(paths.interpolate_cameras(still, 31)), 1.0 / 30, rtol=1e-6)
    # Half a turn at one place of a way: no frame jumps.
    far = [Camera(K, c.R, -c.R @ np.array([3.0 * k, 0, 0]), SIZE) for k, c in enumerate(still)]
    turned = Camera(K, -far[1].R * [[1], [-1], [1]], far[1].t * [-1, 1, -1], SIZE)
    assert max(turns_of(paths.interpolate_cameras([*far[:2], turned, *far[2:]], 100))) < 0.25
    camera = ring(np.array([0.3]))[0]
    for cameras in ([camera], [camera] * 3):
        path = paths.interpolate_cameras(cameras, 5)
        assert len(path) == 5
        for frame in path:
            np.testing.assert_allclose(frame.P, camera.P, atol=1e-12)
    moving = ring(np.array([0.0, 0.0, 0.5, 0.5, 1.0]))
    steps = np.linalg.norm(np.diff(centres_of(paths.interpolate_cameras(moving, 50)), axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.05)


def test_other_shapes_of_pictures_show_all_that_the_camera_saw():
    (camera,) = ring(np.array([0.3]))
    corners = np.array([[-0.5, 159.5, -0.5, 159.5], [-0.5, -0.5, 119.5, 119.5], [1, 1, 1, 1]])
    for size in ((320, 240), (400, 100), (30, 90)):
        x = (paths._fit_to_size(camera, size).K @ np.linalg.inv(camera.K) @ corners)[:2]
        assert (x > -0.5 - 1e-9).all()
        assert (x.T - size < -0.5 + 1e-9).all()
        assert (np.ptp(x, axis=1) / size).max() == pytest.approx(1.0)
    turned = Camera(K, camera.R, camera.t, (120, 160))
    assert {frame.size for frame in paths.interpolate_cameras([camera, turned], 5)} == {SIZE}
    assert {frame.size for frame in paths.orbit([camera, turned], ball(), 5, size=(70, 50))} == {(70, 50)}


def test_an_orbit_of_no_extent_is_refused():
    cameras = ring(np.array([0.0]))
    here = np.tile(cameras[0].centre, (4, 1))
    refuses(ValueError, "all points and cameras coincide", paths.orbit, cameras, here, 5)

"""Trilinear view synthesis and completion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.views.tensor import CalibratedPair, VirtualCamera, camera_at, seed_of_two
from thesisrecon.views.tensor_synthesis import prepare_synthesis

SIZE = (160, 120)
K = calibration_matrix(150.0, 150.0, 81.0, 58.0)
PAIR = CalibratedPair(
    K, K, Rotation.from_rotvec([0.01, -0.08, 0.02]).as_matrix(), np.array([-0.98, 0.15, 0.1])
)


STILL = np.eye(3), np.zeros(3)
BLACK = np.zeros((2, *SIZE[::-1], 3))


def _scene(R, t, K=K):
    """Colours (H, W, 3) and points X_1 (H, W, 3) seen by a camera: a wall that leans, a disc before it."""
    x, y = np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1])))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T @ R
    centre = -R.T @ t
    wall = np.array([0.2, 0.1, 1.0])
    X = centre + rays * ((9.0 - wall @ centre) / (rays @ wall))[..., None]
    disc = centre + rays * ((5.0 - centre[2]) / rays[..., 2])[..., None]
    hit = np.hypot(disc[..., 0] - 0.3, disc[..., 1]) < 1.0
    X[hit] = disc[hit]
    waves = np.stack(
        [np.sin(k * X[..., 0] + k * X[..., 2]) + np.cos(2.2 * X[..., 1] - k) for k in (2.0, 3.0, 2.5)], -1
    )
    return 120.0 + 30.0 * waves + 25.0 * hit[..., None], X


def _places(X, R, t):
    return dehomogenize((X @ R.T + t) @ K.T).astype(np.float32)


def _hidden(X, R, t):
    """Whether the camera sees something else where X (H, W, 3) is."""
    at = np.rint(_places(X, R, t)).astype(int).clip(0, np.array(SIZE) - 1)
    return np.linalg.norm(_scene(R, t)[1][at[..., 1], at[..., 0]] - X, axis=2) > 0.5


@pytest.fixture(scope="module")
def synthesis():
    (one, X1), (two, X2) = _scene(*STILL), _scene(PAIR.R, PAIR.t)
    return prepare_synthesis(PAIR, (one, two), (_places(X1, PAIR.R, PAIR.t), _places(X2, *STILL)))


def _truth(camera):
    return _scene(camera.rotation @ PAIR.R, camera.rotation @ PAIR.t + camera.translation, camera.K)[0]


def _psnr(picture, truth):
    return 10.0 * np.log10(255.0**2 / np.mean((picture - truth) ** 2))


@pytest.mark.parametrize(
    ("s", "least_db"), [(0.0, 40.0), (0.3, 38.0), (0.5, 38.0), (1.0, 40.0), (1.5, 29.0), (-0.5, 29.0)]
)
def test_synthesis_on_the_baseline_and_beyond_matches_a_camera_there(synthesis, s, least_db):
    camera = camera_at(PAIR, s, sizes=(SIZE, SIZE))
    assert _psnr(synthesis.render(camera), _truth(camera)) > least_db


@pytest.mark.parametrize("translation", [(0.0, -0.4, 0.0), (0.3, 0.3, -3.0), (0.4, 0.0, 1.5)])
def test_off_the_baseline_too(synthesis, translation):
    turned = Rotation.from_rotvec([0.03, 0.02, -0.1]).as_matrix()
    camera = VirtualCamera(turned, np.array(translation), calibration_matrix(140.0, 145.0, 80.0, 60.0), SIZE)
    picture = synthesis.render(camera)
    inner = (slice(25, -25), slice(35, -35))
    assert _psnr(picture[inner], _truth(camera)[inner]) > 30.0


def test_pixels_that_see_nothing_in_any_direction_are_black(synthesis):
    wide = calibration_matrix(40.0, 40.0, 140.0, 100.0)
    picture = synthesis.render(VirtualCamera(*STILL, wide, SIZE))
    assert 0.02 < (picture == 0).all(axis=2).mean() < 0.1
    assert picture[90:110, 130:150].min() > 0


def test_the_picture_does_not_depend_on_the_threads(synthesis):
    camera = camera_at(PAIR, 0.4, sizes=(SIZE, SIZE))
    np.testing.assert_array_equal(synthesis.render(camera, threads=3), synthesis.render(camera))


def test_pixels_hidden_in_one_image_are_taken_from_the_other():
    (one, X1), (two, X2) = _scene(*STILL), _scene(PAIR.R, PAIR.t)
    places = [_places(X1, PAIR.R, PAIR.t), _places(X2, *STILL)]
    hidden = _hidden(X1, PAIR.R, PAIR.t), _hidden(X2, *STILL)
    for known, not_seen in zip(places, hidden, strict=True):
        assert 100 < not_seen.sum() < 0.4 * not_seen.size
        known[not_seen] = np.nan
    camera = camera_at(PAIR, 0.5, sizes=(SIZE, SIZE))
    assert _psnr(prepare_synthesis(PAIR, (one, two), tuple(places)).render(camera), _truth(camera)) > 33.0


def test_exposures_go_over_into_each_other():
    (one, X1), (two, X2) = _scene(*STILL), _scene(PAIR.R, PAIR.t)
    places = _places(X1, PAIR.R, PAIR.t), _places(X2, *STILL)
    synthesis = prepare_synthesis(PAIR, (one, 0.64 * two), places, gain=np.full(3, 1.0 / 0.64))
    for s, exposure in ((0.0, 1.0), (0.5, 0.8), (1.0, 0.64)):
        camera = camera_at(PAIR, s, sizes=(SIZE, SIZE))
        assert _psnr(synthesis.render(camera), exposure * _truth(camera)) > 36.0


def test_the_way_goes_from_one_photograph_to_the_other_and_beyond():
    places = [-0.5, 0.0, 0.5, 1.0, 1.5]
    path = [camera_at(PAIR, s, sizes=(SIZE, SIZE)) for s in places]
    centres = [-(c.rotation @ PAIR.R).T @ (c.rotation @ PAIR.t + c.translation) for c in path]
    np.testing.assert_allclose(centres, np.outer(places, PAIR.centre2), atol=1e-12)
    np.testing.assert_allclose(path[1].rotation @ PAIR.R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(path[3].rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(path[3].translation, 0.0, atol=1e-12)


def test_other_sizes_keep_the_second_ones_camera():
    wide = CalibratedPair(calibration_matrix(300.0, 300.0, 160.0, 120.0), K, PAIR.R, PAIR.t)
    for s in (0.0, 0.5, 1.0):
        camera = camera_at(wide, s, sizes=((320, 240), SIZE))
        np.testing.assert_array_equal(camera.K, K)
        assert camera.size == SIZE


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [
        (np.eye(3), (0.0, 0.0, -20.0)),
        (np.diag([-1.0, 1.0, -1.0]), (0.0, 0.0, 0.0)),
        (np.eye(3), (90.0, 0.0, 0.0)),
    ],
)
def test_cameras_beyond_the_scene_or_that_look_away_are_refused(synthesis, rotation, translation):
    with pytest.raises(StageFailure, match="sees almost nothing of the scene"):
        synthesis.render(VirtualCamera(rotation, np.array(translation), K, SIZE))


def test_shapes_and_places_that_do_not_fit_are_refused():
    image, places = np.zeros((6, 8, 3)), np.full((6, 8, 2), np.nan, np.float32)
    with pytest.raises(StageFailure, match="no dense correspondence"):
        prepare_synthesis(PAIR, (image, image), (places, places))
    refuses(ValueError, "at least 1 x 1", VirtualCamera, np.eye(3), np.zeros(3), K, (0, 5))


def test_the_tensor_of_a_moved_camera_contains_it():
    third = np.column_stack([Rotation.from_rotvec([0.05, 0.1, 0.0]).as_matrix(), [0.3, 0.2, -0.5]])
    moved = seed_of_two(PAIR).moved(third[:, :3] @ PAIR.R.T, third[:, 3] - third[:, :3] @ PAIR.R.T @ PAIR.t)
    # Points of the tensor's frame are (K X_1, 1).
    change = np.eye(4)
    change[:3, :3] = np.linalg.inv(K)
    np.testing.assert_allclose(moved.P3, K @ third @ change, atol=1e-9)
    np.testing.assert_allclose(
        seed_of_two(PAIR).swapped.T, seed_of_two(PAIR.swapped, first=True).T, atol=1e-9
    )


def _true_places():
    (_, X1), (_, X2) = _scene(*STILL), _scene(PAIR.R, PAIR.t)
    places = _places(X1, PAIR.R, PAIR.t), _places(X2, *STILL)
    return places, (_hidden(X1, PAIR.R, PAIR.t), _hidden(X2, *STILL))


@pytest.mark.parametrize("reported", ["nothing", "the foreground"])
def test_hidden_pixels_are_found_out_and_take_the_background(reported):
    places, hidden = _true_places()
    given = [there.copy() for there in places]
    for side in (0, 1):
        inside = np.all((places[side] > 0.0) & (places[side] < np.array(SIZE) - 1.0), axis=2)
        given[side][hidden[side]] = np.nan
        if reported == "the foreground":
            # As a matcher does that fattens what is in front.
            given[side][hidden[side] & inside] = places[side][60, 80]
    made = prepare_synthesis(PAIR, BLACK, (given[0], given[1]))
    complete, known = made.places, [levels[..., 3] > 0.5 for levels in made.levels]
    for side in (0, 1):
        inside = np.all((places[side] > 0.0) & (places[side] < np.array(SIZE) - 1.0), axis=2)
        assert known[side][inside & ~hidden[side]].mean() > 0.97
        assert known[side][hidden[side]].mean() < 0.03
        off = np.linalg.norm(complete[side] - places[side], axis=2)
        assert np.isfinite(off).all()
        assert np.mean(off[hidden[side] & inside] < 2.0) > 0.9
        np.testing.assert_array_equal(complete[side][known[side]], given[side][known[side]])


def test_photographs_that_contradict_each_other_have_no_correspondence():
    places, _ = _true_places()
    with pytest.raises(StageFailure, match="no pixel of image 1 has a known correspondence"):
        prepare_synthesis(PAIR, BLACK, (places[0] + 50.0, places[1]))

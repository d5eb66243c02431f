import dataclasses

import numpy as np

from tests.report.synthetic import made_up_cameras, made_up_run
from thesisrecon.report.figures import build_scene, upright_rotation


def rotation(axis, angle):
    """Rodrigues' formula."""
    a = axis / np.linalg.norm(axis)
    A = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * A + (1 - np.cos(angle)) * A @ A)


def test_up_is_found_whatever_the_frame_of_the_reconstruction():
    rotations, _ = made_up_cameras(7)
    turn = rotation(np.array([0.3, -1.0, 0.7]), 2.1)
    upright = upright_rotation(rotations @ turn.T)
    assert np.allclose(upright @ upright.T, np.eye(3))
    assert np.isclose(np.linalg.det(upright), 1)
    # In the made-up world y points down and the wall is along +z.
    assert (upright @ turn @ [0, -1, 0])[2] > 0.99
    assert (upright @ turn @ [0, 0, 1])[1] > 0.99


def test_up_of_a_ring_of_cameras_is_its_axis():
    level = [rotation(np.array([0.0, 1.0, 0.0]), angle) for angle in np.linspace(0, 2 * np.pi, 9)[:-1]]
    tilted = np.stack([rotation(np.array([1.0, 0.0, 0.0]), -0.4) @ R for R in level])
    assert (upright_rotation(tilted) @ [0, -1, 0])[2] > 0.999


def test_parallel_cameras_and_cameras_that_look_down_have_an_up():
    ahead = np.tile(np.eye(3), (4, 1, 1))
    assert (upright_rotation(ahead) @ [0, -1, 0])[2] > 0.999
    single = upright_rotation(np.eye(3)[None])
    assert (single @ [0, 0, 1])[1] > 0.999


def test_strays_are_left_out_and_many_points_are_thinned():
    data = made_up_run(points=600)
    assert data.metric is not None
    before = data.metric.reconstruction
    X = before.X.copy()
    X[5, :3] = 1e5
    scene = build_scene(dataclasses.replace(before, X=X), max_points=200)
    assert scene is not None
    assert 150 <= len(scene.points) <= 200
    assert 5 not in scene.index
    assert (scene.high - scene.low).max() < 20


def test_the_pyramids_point_at_what_the_cameras_saw():
    data = made_up_run(points=300)
    assert data.metric is not None
    scene = build_scene(data.metric.reconstruction)
    assert scene is not None
    assert scene.views.tolist() == list(range(8))
    gaze = scene.corners.mean(axis=1) - scene.centres
    towards = scene.points.mean(axis=0) - scene.centres
    cosine = np.sum(gaze * towards, axis=1) / np.linalg.norm(gaze, axis=1) / np.linalg.norm(towards, axis=1)
    assert (cosine > 0.95).all()
    # The first two corners are those of the upper edge, and up is z.
    assert (scene.corners[:, :2, 2].mean(axis=1) > scene.corners[:, 2:, 2].mean(axis=1)).all()


def test_nothing_registered_gives_no_scene():
    data = made_up_run(points=50)
    assert data.metric is not None
    nothing = np.zeros_like(data.metric.reconstruction.registered)
    assert build_scene(dataclasses.replace(data.metric.reconstruction, registered=nothing)) is None


def test_a_scene_without_points_still_shows_its_cameras():
    data = made_up_run(points=50)
    assert data.metric is not None
    nothing = np.zeros_like(data.metric.reconstruction.valid)
    scene = build_scene(dataclasses.replace(data.metric.reconstruction, valid=nothing))
    assert scene is not None
    assert len(scene.points) == 0
    assert len(scene.centres) == 8

"""The last adjustment reaches the minimum: strips over flat ground, a valley of focal, height and lens."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import thesisrecon
from tests.metric.test_metric_refinement import run
from tests.synthetic import TrueScene, make_scene
from thesisrecon.camera import project_camera
from thesisrecon.errors import StageFailure
from thesisrecon.records import Tracks

SIZE, FOCAL, K1 = (1000, 750), 850.0, -0.12


def strips(seed, *, rows=3, columns=7, points=700, noise=0.3, relief=1.5):
    """A scene of fields from cameras 80 m above them that look down, there and back."""
    rng = np.random.default_rng(seed)
    X = np.c_[rng.uniform(-90, 90, points), rng.uniform(-55, 55, points), rng.normal(0, relief, points)]
    K = np.array([[FOCAL, 0.0, 506.0], [0.0, FOCAL, 369.0], [0.0, 0.0, 1.0]])
    n = rows * columns
    R, t, xy = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, points, 2))
    for v in range(n):
        row, column = divmod(v, columns)
        down = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("z", np.pi * (row % 2)).as_matrix()
        R[v] = Rotation.from_rotvec(rng.normal(0.0, np.radians(1.5), 3)).as_matrix() @ down
        t[v] = -R[v] @ [20.0 * (column - (columns - 1) / 2), 22.0 * (row - (rows - 1) / 2), 80.0]
        xy[v] = project_camera(K, R[v], t[v], X, distortion=K1)
    xy += rng.normal(0.0, noise, xy.shape)
    inside = (xy > 0.0).all(axis=2) & (xy < np.array(SIZE) - 1.0).all(axis=2)
    inside &= inside.sum(axis=0) >= 2
    point, view = np.nonzero(inside.T)
    tracks = Tracks(view, point, xy[view, point], n, points)
    return TrueScene(np.tile(K, (n, 1, 1)), R, t, X, K1, tracks, np.tile(SIZE, (n, 1)))


@pytest.mark.parametrize("seed", [3, 4])
def test_focal_length_of_strips_is_right_and_another_adjustment_keeps_it(seed):
    scene = strips(seed)
    result = thesisrecon.reconstruct_from_tracks(scene.tracks, scene.sizes)
    assert result.metric.trusted, result.metric.failed_checks
    assert result.metric.self_check["sigmas_to_minimum"] < 0.1
    camera = next(iter(result.cameras.values()))
    focal, std = camera.K[0, 0], camera.std["focal_px"]
    assert abs(focal - FOCAL) < 3.0 * std
    free = ("focal", "principal_point", "k1", "k2", "k3")
    again = thesisrecon.bundle_adjust(result.reconstruction, free=free, prior={"k2": 0.02, "k3": 0.02})
    assert again.converged
    assert abs(again.cameras[0].K[0, 0] - focal) < 0.3 * std


def random_scene(seed):
    """Strips, or a cloud of points with shared or own intrinsics; wrong pixels in every third scene."""
    rng = np.random.default_rng(seed)
    if seed % 4 == 0:
        scene = strips(seed, rows=2, columns=6, points=500, relief=rng.uniform(1.0, 10.0))
    else:
        scene = make_scene(
            views=int(rng.integers(4, 11)), points=int(rng.integers(150, 400)), seed=seed,
            sigma_px=rng.uniform(0.05, 1.0), zoom=0.2 * (seed % 4 == 1), k1=rng.uniform(-0.1, 0.1),
        )  # fmt: skip
    xy = scene.tracks.xy.copy()
    wrong = rng.random(len(xy)) < 0.05 * (seed % 3 == 0)
    xy[wrong] += rng.normal(0.0, 20.0, (wrong.sum(), 2))
    return replace(scene, tracks=replace(scene.tracks, xy=xy)), seed % 4 != 1


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 200, 20))
def test_results_of_200_random_scenes_are_minima(first):
    solved = 0
    for seed in range(first, first + 20):
        scene, shared = random_scene(seed)
        try:
            result = run(scene, shared=shared)
        except StageFailure:
            continue
        solved += 1
        assert result.self_check["sigmas_to_minimum"] < 0.1, seed
    assert solved > 15

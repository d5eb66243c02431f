"""The last adjustment reaches the minimum: strips over flat ground, a valley of focal, height and lens."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import thesisrecon
from thesisrecon.geometry.camera_matrix import project_camera

SIZE, FOCAL, K1 = (1000, 750), 850.0, -0.12


def strips(seed, *, rows=3, columns=7, points=700, noise=0.3, relief=1.5):
    """Pixels (V, N, 2) of cameras 80 m above fields that look down, there and back."""
    rng = np.random.default_rng(seed)
    X = np.c_[rng.uniform(-90, 90, points), rng.uniform(-55, 55, points), rng.normal(0, relief, points)]
    K = np.array([[FOCAL, 0.0, 506.0], [0.0, FOCAL, 369.0], [0.0, 0.0, 1.0]])
    xy = np.empty((rows * columns, points, 2))
    for v in range(len(xy)):
        row, column = divmod(v, columns)
        down = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("z", np.pi * (row % 2)).as_matrix()
        R = Rotation.from_rotvec(rng.normal(0.0, np.radians(1.5), 3)).as_matrix() @ down
        centre = np.array([20.0 * (column - (columns - 1) / 2), 22.0 * (row - (rows - 1) / 2), 80.0])
        xy[v] = project_camera(K, R, -R @ centre, X, distortion=K1)
    xy += rng.normal(0.0, noise, xy.shape)
    inside = (xy > 0.0).all(axis=2) & (xy < np.array(SIZE) - 1.0).all(axis=2)
    return np.where(inside[..., None], xy, np.nan)


@pytest.mark.parametrize("seed", [3, 4])
def test_focal_length_of_strips_is_right_and_another_adjustment_keeps_it(seed):
    xy = strips(seed)
    result = thesisrecon.reconstruct_from_tracks(xy, [SIZE] * len(xy))
    assert result.metric.trusted, result.metric.failed_checks
    assert result.metric.self_check["sigmas_to_minimum"] < 0.1
    camera = next(iter(result.cameras.values()))
    focal, std = camera.K[0, 0], camera.std["focal_px"]
    assert abs(focal - FOCAL) < 3.0 * std
    free = ("focal", "principal_point", "k1", "k2", "k3")
    again = thesisrecon.bundle_adjust(result.reconstruction, free=free, prior={"k2": 0.02, "k3": 0.02})
    assert again.converged
    assert abs(again.cameras[0].K[0, 0] - focal) < 0.3 * std

"""Five views of a cloud of points with noise: matches as another program would give them."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon import Camera, Tracks

SIZE = (640, 480)
ANGLES = [[0, -30, 5], [25, -15, 0], [-5, 0, 20], [15, 15, 0], [-20, 25, 5]]


class GivenScene(NamedTuple):
    cameras: list
    X: np.ndarray
    keypoints: list
    matches: dict
    sizes: list
    noise_px: float

    @property
    def tracks(self):
        views, points = len(self.cameras), len(self.X)
        xy = np.concatenate(self.keypoints)
        return Tracks(
            np.repeat(np.arange(views), points), np.tile(np.arange(points), views), xy, views, points
        )


def given_scene(points=200, noise_px=0.3, focal=900.0):
    rng = np.random.default_rng(0)
    K = np.array([[focal, 0, 319.5], [0, focal, 239.5], [0, 0, 1]])
    X = rng.uniform(-1, 1, (points, 3))
    rotations = Rotation.from_euler("xyz", np.radians(ANGLES)).as_matrix()
    cameras = [Camera(K, R, np.array([0, 0, 6.0]), SIZE) for R in rotations]
    keypoints = [camera.project(X) + rng.normal(0, noise_px, (points, 2)) for camera in cameras]
    same = np.repeat(np.arange(points)[:, None], 2, axis=1)
    pairs = {(i, j): same for i in range(5) for j in range(i + 1, 5)}
    return GivenScene(cameras, X, keypoints, pairs, [SIZE] * 5, noise_px)

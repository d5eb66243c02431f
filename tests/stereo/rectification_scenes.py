"""Pairs of cameras in every relative position, with points in front of both."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import calibration_matrix, camera_from_centre, project
from thesisrecon.geometry.two_view import fundamental_from_cameras

SIZE = (640, 480)
MOTIONS = (
    "beside", "toed in", "rolled", "upwards", "parallel", "behind", "forward", "diagonal", "half forward",
)  # fmt: skip
PLANAR = MOTIONS[:6]


@dataclass(frozen=True)
class PairOfCameras:
    """``P`` (2, 3, 4), points ``X`` (N, 3), their pixels, ``depth`` (N,) in view 0, ``sizes``."""

    P: F64
    X: F64
    xy1: F64
    xy2: F64
    depth: F64
    sizes: tuple[tuple[int, int], tuple[int, int]]

    @property
    def F(self):
        return fundamental_from_cameras(self.P[0], self.P[1])


def make_pair(motion, rng, *, noise_px=0.0, points=300):
    """Two cameras about 8 from a cloud of points; the second one moved as ``motion`` says."""
    centre, turn = {
        "beside": ((1.5, 0.1, 0.05), (0.01, 0.03, 0.02)), "toed in": ((2.5, 0.2, 0.1), (0.0, -0.3, 0.05)),
        "rolled": ((-1.5, 0.3, 0.1), (0.05, 0.1, 0.9)), "upwards": ((0.1, -1.5, 0.2), (-0.15, 0.0, 0.0)),
        "parallel": ((1.5, 0.0, 0.0), (0.0, 0.0, 0.0)), "behind": ((-2.0, 0.0, -0.5), (0.0, 0.15, 0.0)),
        "forward": ((0.1, 0.05, 2.0), (0.01, 0.02, 0.05)),
        "half forward": ((1.2, 0.1, 2.0), (0.0, -0.3, 0.0)),
        "diagonal": ((0.8, 0.1, 2.0), (0.0, -0.05, 0.1)),
    }[motion]  # fmt: skip
    size2 = SIZE if motion == "parallel" else (600, 500)
    K1 = calibration_matrix(700.0, 700.0, 322.0, 236.0)
    K2 = K1 if motion == "parallel" else calibration_matrix(640.0, 640.0, 295.0, 255.0)
    R2 = Rotation.from_rotvec(turn).as_matrix()
    P = np.stack(
        [camera_from_centre(K1, np.eye(3), np.zeros(3)), camera_from_centre(K2, R2, np.array(centre))]
    )
    X = np.column_stack(
        [rng.uniform(-4, 4, 9 * points), rng.uniform(-3, 3, 9 * points), rng.uniform(5, 11, 9 * points)]
    )
    x1, x2 = project(P[0], X), project(P[1], X)
    seen = (X @ P[1, 2, :3] + P[1, 2, 3] > 0.1) & inside(x1, SIZE) & inside(x2, size2)
    X, x1, x2 = X[seen][:points], x1[seen][:points], x2[seen][:points]
    noise = noise_px * rng.normal(size=(2, len(X), 2))
    return PairOfCameras(P, X, x1 + noise[0], x2 + noise[1], X[:, 2], (SIZE, size2))


def inside(xy, size):
    """Whether pixels (N, 2) lie in an image."""
    return ((xy >= 0.0) & (xy <= np.array(size) - 1.0)).all(axis=1)

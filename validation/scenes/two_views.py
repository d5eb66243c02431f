"""Two cameras before points: general, one plane, a camera that only turned, one that only moved."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.geometry.camera_matrix import camera_from_centre, project

K = np.array([[1200.0, 0.0, 640.0], [0.0, 1200.0, 480.0], [0.0, 0.0, 1.0]])


class TwoViews(NamedTuple):
    """Cameras (3, 4), points X (N, 3) and their exact pixels (N, 2)."""

    P1: F64
    P2: F64
    X: F64
    xy1: F64
    xy2: F64


def make_two_views(kind: Configuration, n: int, rng: np.random.Generator) -> TwoViews:
    """n points about 5 units away in 1280x960 px; a baseline of 1 and 10 degrees of turn where there are."""
    X = rng.uniform(-1.2, 1.2, (n, 3))
    R = Rotation.from_rotvec(rng.normal((0.0, 0.15, 0.0), 0.05)).as_matrix()
    centre = np.array([1.0, 0.0, 0.0]) + rng.normal(0.0, 0.1, 3)
    if kind is Configuration.PLANE:
        X[:, 2] = X[:, :2] @ rng.uniform(-0.5, 0.5, 2)
    if kind is Configuration.ROTATION:
        centre = np.zeros(3)
    if kind is Configuration.TRANSLATION:
        R, centre = np.eye(3), rng.normal(size=3)
        centre *= np.array([1.0, 1.0, 0.7]) / float(np.linalg.norm(centre))
    X[:, 2] += 5.0
    P1, P2 = K @ np.eye(3, 4), camera_from_centre(K, R, centre)
    return TwoViews(P1, P2, X, project(P1, X), project(P2, X))

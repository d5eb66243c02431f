"""A general cloud of points before cameras turned and placed as a hand would, with exact truth."""

from __future__ import annotations

import numpy as np

from validation.scenes.pose import look_at
from validation.scenes.rigs import Rig

SIZE = (1536, 1024)
FOCAL_PX = 1500.0
SEEN = 0.75
"""Share of the points in a view's sight that it has an observation of."""


def make_cloud(views: int, rng: np.random.Generator, *, points: int = 500) -> Rig:
    """``points`` uniform in a box of 4 x 3 x 3.2, ``views`` cameras 6 to 9 off on a cap of 80 by 40 degrees.

    The principal point is off the image's middle by a normal deviate of half a percent of the long side.
    """
    X = rng.uniform([-2.0, -1.5, -1.6], [2.0, 1.5, 1.6], (points, 3))
    angles = rng.uniform([-0.7, -0.35], [0.7, 0.35], (views, 2))
    azimuth, height = angles.T
    direction = np.column_stack(
        [np.sin(azimuth) * np.cos(height), -np.cos(azimuth) * np.cos(height), np.sin(height)]
    )
    C = rng.uniform(6.0, 9.0, (views, 1)) * direction
    R = np.stack([look_at(c, rng.normal(0.0, 0.3, 3), float(rng.uniform(-0.15, 0.15))) for c in C])
    shift = rng.normal(0.0, 0.005 * SIZE[0], 2)
    K = np.array([[FOCAL_PX, 0.0, 767.5 + shift[0]], [0.0, FOCAL_PX, 511.5 + shift[1]], [0.0, 0.0, 1.0]])
    seen = rng.random((views, points)) < SEEN
    return Rig(np.tile(K, (views, 1, 1)), R, C, X, seen, SIZE)

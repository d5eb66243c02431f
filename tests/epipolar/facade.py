"""Facades: one plane with rows of windows, a little relief, and matches shifted by whole windows.

The matches of the plane leave the epipoles free, those of the relief fix them, and those from one window to
its neighbour agree with an epipolar geometry of their own: parallax along the row, which the plane does not
contradict. With little relief it has more matches than the right one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import B8, F64
from thesisrecon.camera import compose_camera
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.two_view import fundamental_from_cameras

SIZE = np.array([1280.0, 960.0])
K = np.array([[1200.0, 0.0, 639.5], [0.0, 1200.0, 479.5], [0.0, 0.0, 1.0]])
DISTANCE = 10.0
RELIEF_LEVELS = (0.0, 0.0, 0.0, 0.5, 1.0)
"""Wall, frames and panes: set back by so much of the relief, the wall three times as often."""


@dataclass(frozen=True)
class Facade:
    """Matches (N, 2) with noise, which are right, F, and the exact points of the right ones."""

    xy1: F64
    xy2: F64
    right: B8
    F: F64
    exact1: F64
    exact2: F64


@dataclass(frozen=True)
class FacadeMaker:
    """Parameters of a random facade.

    Parameters
    ----------
    matches : how many, right and wrong.
    relief : depth of the panes behind the wall, in distances from the camera.
    off_plane : share of the right matches on things before or behind it, up to a fifth of the distance.
    wrong : share of the matches that are wrong; of these ``repeated`` lead to another window, the rest
        anywhere.
    sigma_px : noise of every coordinate.
    """

    matches: int = 400
    relief: float = 0.01
    off_plane: float = 0.05
    wrong: float = 0.3
    repeated: float = 0.5
    sigma_px: float = 0.5

    def make(self, rng: np.random.Generator) -> Facade:
        """A facade before two cameras that moved by a tenth to a third of the distance."""
        P1, P2, turned = _cameras(rng)
        period = rng.uniform(0.6, 1.6, 2)
        X = self._points(period, rng) @ turned.T + [0.0, 0.0, DISTANCE]
        wrong = rng.random(self.matches) < self.wrong
        shift = np.zeros((self.matches, 3))
        shifted = wrong & (rng.random(self.matches) < self.repeated)
        shift[shifted, :2] = _whole_periods(int(shifted.sum()), rng) * period
        exact1, seen2 = project(P1, X), project(P2, X + shift @ turned.T)
        anywhere = wrong & ~shifted
        seen2[anywhere] = rng.uniform((0.0, 0.0), SIZE, (int(anywhere.sum()), 2))
        noise = rng.normal(0.0, self.sigma_px, (2, self.matches, 2))
        xy1, xy2 = exact1 + noise[0], seen2 + noise[1]
        inside = np.all([(xy > -0.5) & (xy < SIZE - 0.5) for xy in (xy1, xy2)], axis=(0, 2))
        right = ~wrong[inside]
        return Facade(
            xy1[inside],
            xy2[inside],
            right,
            fundamental_from_cameras(P1, P2),
            exact1[inside][right],
            project(P2, X[inside][right]),
        )

    def _points(self, period: F64, rng: np.random.Generator) -> F64:
        """Return window corners, in a few positions each, and points off the wall."""
        kinds = rng.random((12, 2))
        depth = self.relief * DISTANCE * rng.choice(RELIEF_LEVELS, 12)
        kind = rng.integers(0, 12, self.matches)
        cell = rng.integers(-5, 6, (self.matches, 2))
        X = np.column_stack([(cell + kinds[kind]) * period, depth[kind]])
        free = rng.random(self.matches) < self.off_plane
        X[free] = _things(int(free.sum()), rng)
        return X


def _things(n: int, rng: np.random.Generator) -> F64:
    """n points on one to four boards before or behind the wall: cars, trees, balconies, a side street."""
    boards = int(rng.integers(1, 5))
    centre = rng.uniform((-4.0, -3.0, -0.2 * DISTANCE), (4.0, 3.0, 0.1 * DISTANCE), (boards, 3))
    size = rng.uniform(0.3, 1.2, (boards, 2))
    tilt = rng.uniform(-0.3, 0.3, (boards, 2))
    board = rng.integers(0, boards, n)
    on_board = rng.uniform(-1.0, 1.0, (n, 2)) * size[board]
    place: F64 = centre[board] + np.column_stack([on_board, np.sum(on_board * tilt[board], axis=1)])
    return place


def _cameras(rng: np.random.Generator) -> tuple[F64, F64, F64]:
    """Two cameras (3, 4) and the rotation (3, 3) of the facade, whose normal is its third column."""
    direction = rng.normal(size=3) * [1.0, 0.4, 0.4]
    centre = direction / np.linalg.norm(direction) * rng.uniform(0.1, 0.33) * DISTANCE
    # The second camera turns back toward the facade.
    back = np.array([centre[1], -centre[0], 0.0]) / DISTANCE
    R = Rotation.from_rotvec(back + rng.normal(0.0, 0.03, 3)).as_matrix()
    turned = Rotation.from_rotvec(rng.normal(0.0, [0.15, 0.3, 0.05])).as_matrix()
    P1 = compose_camera(K, np.eye(3), np.zeros(3))
    return P1, compose_camera(K, R, -R @ centre), turned


def _whole_periods(n: int, rng: np.random.Generator) -> F64:
    """Steps (n, 2) to another window: mostly to the next of the row, seldom of another floor; never 0."""
    along = rng.random(n) < 0.8
    steps = rng.choice([-2.0, -1.0, -1.0, 1.0, 1.0, 2.0], n)
    return np.column_stack([np.where(along, steps, 0.0), np.where(along, 0.0, steps)])

"""The thesis' cube sequence (5.5, figure 5.7): points on three faces, 27 cameras, perfect projections."""

from __future__ import annotations

from itertools import combinations
from math import cos, pi, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.camera_matrix import camera_from_centre
from validation.scenes.pose import look_at
from validation.scenes.two_views import TwoViews

SIZE = (800, 600)
K = np.array([[842.0, 0.0, 411.0], [0.0, 842.0, 290.0], [0.0, 0.0, 1.0]])
POINTS_PER_FACE = 120
HALF_SIDE = 1.0
AZIMUTHS_DEG, ELEVATIONS_DEG, DISTANCES = (-6.0, 45.0, 96.0), (4.0, 32.0, 58.0), (4.6, 6.0, 7.4)


class CubeSequence(NamedTuple):
    """``face`` (N,): 0 1 2 for x y z; ``xy`` (27, N, 2) px, NaN where a point is turned away or outside."""

    K: F64
    R: F64
    C: F64
    X: F64
    face: NDArray[np.int64]
    xy: F64

    @property
    def visible(self) -> B8:
        """(27, N) whether a view sees a point."""
        return ~np.isnan(self.xy[..., 0])

    def faces_seen(self) -> NDArray[np.int64]:
        """(27,) faces that each view sees: 1 does not determine a projective camera."""
        seen = [[bool(v[self.face == f].any()) for f in range(3)] for v in self.visible]
        return np.array([sum(faces) for faces in seen], dtype=np.int64)


def _points(rng: np.random.Generator) -> tuple[F64, NDArray[np.int64]]:
    blocks = []
    for axis in range(3):
        place = np.round((2.0 * rng.random((POINTS_PER_FACE, 2)) - 1.0) * HALF_SIDE, 4)
        blocks.append(np.insert(place, axis, HALF_SIDE, axis=1))
    return np.concatenate(blocks), np.repeat(np.arange(3), POINTS_PER_FACE)


def _cameras(rng: np.random.Generator) -> tuple[F64, F64]:
    centres, rotations = [], []
    for distance in DISTANCES:
        for elevation in ELEVATIONS_DEG:
            for azimuth in AZIMUTHS_DEG:
                shake = 2.0 * rng.random(7) - 1.0
                a, e = (azimuth + 2.5 * shake[0]) * pi / 180, (elevation + 2.5 * shake[1]) * pi / 180
                d = distance + 0.4 * shake[2]
                C = np.array([round(v, 4) for v in (d * cos(e) * cos(a), d * cos(e) * sin(a), d * sin(e))])
                target = np.round(0.35 * shake[3:6], 4)
                centres.append(C)
                rotations.append(look_at(C, target, round(0.12 * float(shake[6]), 4)))
    return np.array(rotations), np.array(centres)


def project_exactly(K: F64, R: F64, C: F64, X: F64) -> F64:
    """Pixels (N, 2) of X (N, 3), written out elementwise so that no library's summation order enters."""
    d = X - C
    x, y, z = (R[i, 0] * d[:, 0] + R[i, 1] * d[:, 1] + R[i, 2] * d[:, 2] for i in range(3))
    return np.stack([K[0, 0] * (x / z) + K[0, 2], K[1, 1] * (y / z) + K[1, 2]], axis=1)


def make_cube() -> CubeSequence:
    """The sequence; always the same numbers. The cameras stand on a perturbed 3 x 3 x 3 grid of azimuth,
    elevation and distance. Most see two or three faces, and six (low, at either side) a single one.
    """
    rng = np.random.Generator(np.random.PCG64(1900))
    X, face = _points(rng)
    R, C = _cameras(rng)
    xy = np.stack([project_exactly(K, R[i], C[i], X) for i in range(len(C))])
    inside = (xy >= -0.5).all(axis=2) & (xy[..., 0] <= SIZE[0] - 0.5) & (xy[..., 1] <= SIZE[1] - 0.5)
    facing = C[:, face] > HALF_SIDE
    xy[~(inside & facing)] = np.nan
    return CubeSequence(K, R, C, X, face, xy)


OFF_FACE = 20  # Minimum number of common points off the face that holds most of them


def cube_pairs(cube: CubeSequence) -> list[TwoViews]:
    """Return the pairs of cameras whose common points do not lie on one face, with these points."""
    P = camera_from_centre(np.tile(cube.K, (len(cube.R), 1, 1)), cube.R, cube.C)
    pairs = []
    for i, j in combinations(range(len(P)), 2):
        both = cube.visible[i] & cube.visible[j]
        on_face = np.bincount(cube.face[both], minlength=3)
        if on_face.sum() - on_face.max() >= OFF_FACE:
            pairs.append(TwoViews(P[i], P[j], cube.X[both], cube.xy[i, both], cube.xy[j, both]))
    return pairs

"""A synthetic walk along a street, as long as wanted, for bundle adjustment alone.

One camera observes a facade every half metre; points are seen by 3 to 10 neighbouring images.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from validation.scenes.pose import perturb

SIZE = (1000, 750)
STEP, SHORTEST, LONGEST = 0.5, 3, 10
INTRINSICS = (1000.0, 1.0, 0.0, 500.0, 375.0, 0.02)


class Walk(NamedTuple):
    """True cameras, points and observations."""

    cameras: MetricCameras
    X: F64
    seen: Observations

    def start(self, rng: np.random.Generator, *, size: float = 0.02) -> tuple[MetricCameras, F64]:
        """Return cameras and points with small random errors, from which adjustment starts."""
        return perturb(self.cameras, self.X, rng, turned=size / 6.0, moved=size, zoomed=1.01)


def make_walk(n: int, rng: np.random.Generator, *, sigma_px: float = 0.5, denser: int = 1) -> Walk:
    """n images with noise ``sigma_px`` in each coordinate, some 60 points for each, or ``denser``."""
    R, t = _poses(n, rng)
    points = denser * (200 * n // 3)
    away, height = rng.uniform(3.0, 8.0, points), rng.uniform(-2.0, 2.0, points)
    X = np.column_stack([rng.uniform(-3.0, n * STEP + 3.0, points), away, height])
    view, point = _tracks(R, t, X, rng)
    used, point = np.unique(point, return_inverse=True)
    X = X[used]
    cameras = MetricCameras(R, t, np.array([INTRINSICS]), np.zeros(n, dtype=np.int64))
    exact = project(cameras, X, view, point)
    seen = Observations(view, point.astype(np.int64), exact + sigma_px * rng.normal(size=exact.shape))
    return Walk(cameras, X, seen)


def project(cameras: MetricCameras, X: F64, view: I64, point: I64) -> F64:
    """Pixels (K, 2) of the observations."""
    Y = np.einsum("kab,kb->ka", cameras.R[view], X[point]) + cameras.t[view]
    f, _, _, cx, cy, k1 = cameras.intrinsics[cameras.group[view]].T
    ab = Y[:, :2] / Y[:, 2:]
    scale = f * (1.0 + k1 * np.sum(ab**2, axis=1))
    return np.asarray(ab * scale[:, None] + np.column_stack([cx, cy]))


def _poses(n: int, rng: np.random.Generator) -> tuple[F64, F64]:
    along = np.arange(n) * STEP
    centres = np.column_stack([along, 0.2 * np.sin(along), 0.1 * rng.normal(size=n)])
    heading = 0.3 * np.sin(along / 7.0)
    forward = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(n)])
    down = np.tile([0.0, 0.0, -1.0], (n, 1))
    R = np.stack([np.cross(down, forward), down, forward], axis=1)
    return R, -np.einsum("vab,vb->va", R, centres)


def _tracks(R: F64, t: F64, X: F64, rng: np.random.Generator) -> tuple[I64, I64]:
    """Views and points of all observations: of the views that see a point, 3 to 10 neighbours."""
    pairs = []
    for v in range(len(R)):
        Y = X @ R[v].T + t[v]
        near = np.flatnonzero((Y[:, 2] > 1.0) & (Y[:, 2] < 9.0))
        xy = INTRINSICS[0] * Y[near, :2] / Y[near, 2:]
        inside = (np.abs(xy) < np.array(SIZE) / 2.0).all(axis=1) & (rng.random(len(near)) < 0.8)
        pairs.append(np.column_stack([near[inside], np.full(int(inside.sum()), v)]))
    point, view = np.concatenate(pairs).T
    order = np.lexsort((view, point))
    point, view = point[order], view[order]
    start = np.searchsorted(point, np.arange(len(X) + 1))
    counts = np.diff(start)
    length = np.where(counts < SHORTEST, 0, np.minimum(counts, rng.integers(SHORTEST, LONGEST + 1, len(X))))
    first = start[:-1] + rng.integers(0, counts - length + 1)
    place = np.arange(len(point))
    kept = (place >= first[point]) & (place < (first + length)[point])
    return view[kept], point[kept]

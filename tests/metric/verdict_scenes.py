"""Simulated tracks whose cameras differ from the camera model: what a trusted focal length must withstand."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64


@dataclass(frozen=True)
class Observed:
    """Pixels (V, N, 2), NaN where a point is not seen, the size of all images, and the true focal length."""

    xy: F64
    size: tuple[int, int]
    focal: float


def project(X: F64, R: F64, C: F64, focal: float, size: tuple[int, int], centre: F64) -> F64:
    """Return pixels (V, N, 2), NaN outside the images; ``centre`` (V, 2)."""
    Y = np.einsum("vab,vnb->vna", R, X - C[:, None])
    xy = focal * Y[..., :2] / np.where(Y[..., 2:] > 0.05, Y[..., 2:], np.nan) + centre[:, None]
    inside = ((xy > 0) & (xy < np.array(size) - 1)).all(axis=2)
    return np.where(inside[..., None], xy, np.nan)


def stabilised_arc(seed: int, views: int = 4) -> Observed:
    """A phone whose stabilisation moves the principal point by 1.3 % of the long side, on a level arc."""
    rng, size, focal = np.random.default_rng(seed), (4032, 3024), 3300.0
    X = rng.uniform([-4.0, -2.0, -2.5], [4.0, 4.0, 2.5], (800, 3))
    angle = np.radians(np.linspace(-12.5, 12.5, views))
    C = np.column_stack([9.0 * np.sin(angle), -9.0 * np.cos(angle), np.zeros(views)])
    R = np.array([looking([rng.normal(0.0, 0.1), 0.0, 0.0] - c) for c in C])
    centre = (np.array(size) - 1) / 2 + rng.normal(0.0, 0.013 * size[0], (views, 2))
    xy = project(X, R, C, focal, size, centre)
    return Observed(xy + rng.normal(0.0, 0.6, xy.shape), size, focal)


def rolling_video(seed: int, views: int = 20, readout: float = 0.6) -> Observed:
    """A hand-held video of two seconds whose rows are read during ``readout`` of a frame."""
    rng, size, focal = np.random.default_rng(seed), (640, 480), 520.9
    X = rng.uniform([-3.0, 2.0, -2.0], [3.0, 6.0, 2.0], (1500, 3))
    time, phase = np.linspace(0.0, 1.0, views), rng.uniform(0.0, 6.0, 6)

    def smooth(phases: F64, size: float) -> F64:
        slow = np.sin(0.8 * np.pi * time[:, None] + phases)
        return size * (slow + 0.4 * np.sin(3.0 * np.pi * time[:, None] + 2.0 * phases))

    C = smooth(phase[:3], 0.25) - [0.0, 1.0, 0.0]
    turn = Rotation.from_rotvec(smooth(phase[3:], np.radians(4.25)))
    R = turn.as_matrix() @ looking(np.array([0.0, 1.0, 0.0]))
    speed, spin = np.gradient(C, axis=0), np.gradient(turn.as_rotvec(), axis=0)
    centre = np.tile([325.1, 249.7], (views, 1))
    xy = project(X, R, C, focal, size, centre)
    for _ in range(3):
        row = np.nan_to_num(xy[..., 1] / size[1] - 0.5) * readout
        Y = np.einsum("vab,vnb->vna", R, X - C[:, None] - row[..., None] * speed[:, None])
        Y = Rotation.from_rotvec((row[..., None] * spin[:, None]).reshape(-1, 3)).apply(Y.reshape(-1, 3))
        Y = Y.reshape(*row.shape, 3)
        xy = np.where(np.isfinite(xy), focal * Y[..., :2] / Y[..., 2:] + centre[:, None], np.nan)
    return Observed(xy + rng.normal(0.0, 0.3, xy.shape), size, focal)


def fisheye_rig(seed: int, views: int = 16) -> Observed:
    """Equidistant fisheye cameras that drive through a room and rotate by a degree or two."""
    rng, size, focal = np.random.default_rng(seed), (752, 480), 351.0
    X, wall = rng.uniform(-1.0, 1.0, (1500, 3)), rng.integers(0, 3, 1500)
    X[np.arange(1500), wall] = np.sign(X[np.arange(1500), wall])
    X *= [8.0, 8.0, 4.0]
    k = np.arange(views)
    C = np.column_stack([-3.0 + 0.35 * k, 0.4 * np.sin(k), 0.3 * np.cos(1.7 * k)])
    shake = Rotation.from_rotvec(np.radians(rng.normal(0.0, 0.7, (views, 3)))).as_matrix()
    R = shake @ looking(np.array([1.0, 0.2, 0.0]))
    Y = np.einsum("vab,vnb->vna", R, X - C[:, None])
    r = np.linalg.norm(Y[..., :2], axis=2)
    theta = np.arctan2(r, Y[..., 2])
    xy = (
        focal * Y[..., :2] * (theta / np.maximum(r, 1e-12))[..., None]
        + (np.array(size) - 1) / 2
        + [4.0, -3.0]
    )
    inside = (theta < np.radians(85.0)) & ((xy > 0) & (xy < np.array(size) - 1)).all(axis=2)
    return Observed(np.where(inside[..., None], xy, np.nan) + rng.normal(0.0, 0.3, xy.shape), size, focal)


def two_sides(seed: int, alike: float) -> Observed:
    """Eight images of one side of an object and five of the other, joined by matches between them.

    The share ``alike`` of the points is at the same place on both sides, the others nearly so.
    """
    rng, size, focal, n = np.random.default_rng(seed), (800, 600), 900.0, 600
    X = rng.uniform([-2.0, -1.2, -2.0], [2.0, -0.2, 2.0], (n, 3))
    other = X + np.where(rng.random(n) < alike, 0.0, 0.25)[:, None] * rng.normal(size=(n, 3))

    def arc(angle: F64, height: F64) -> tuple[F64, F64]:
        C = np.column_stack([8.0 * np.sin(angle), -8.0 * np.cos(angle), height])
        return np.array([looking(-c) for c in C]), C

    a, b = np.radians(np.linspace(-35.0, 35.0, 8)), np.radians(np.linspace(-20.0, 30.0, 5))
    centre = np.tile((np.array(size) - 1) / 2, (8, 1))
    one = project(X, *arc(a, 0.8 * np.sin(3.0 * a)), focal, size, centre)
    two = project(other, *arc(b, 0.7 * np.cos(4.0 * b)), focal, size, centre[:5])
    joined = np.where((rng.random(n) < 0.15)[:, None], two, np.nan)
    rest = np.where(np.isnan(joined), two, np.nan)
    xy = np.concatenate([np.hstack([one, np.full_like(one, np.nan)]), np.hstack([joined, rest])])
    return Observed(xy + rng.normal(0.0, 0.3, xy.shape), size, focal)


def looking(direction: F64) -> F64:
    """Return the rotation of a camera with level rows that looks along ``direction``."""
    z = np.asarray(direction) / np.linalg.norm(direction)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])

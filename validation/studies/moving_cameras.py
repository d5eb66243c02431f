"""Stated focal lengths of cars that turn a corner and of hand-held videos, with known truth.

The camera is as assumed (square pixels, radial distortion, all rows at once), or slightly different. The
errors in stated standard deviations should have mean 0 and standard deviation 1 if it is as assumed, and
95 % intervals should contain the truth if it is slightly different.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon import reconstruct_from_tracks
from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from validation.runs.study import Part
from validation.runs.tables import text_table

CAR, PHONE = (1241, 376), (640, 480)


class Lens(NamedTuple):
    """``centre``: principal point off, in widths; ``readout``: time of all rows over that of an image."""

    k1: float = 0.0
    aspect: float = 1.0
    centre: float = 0.0
    tangential: tuple[float, float] = (0.0, 0.0)
    readout: float = 0.0


class Moving(NamedTuple):
    """Pixels (V, N, 2), NaN where a point is not seen, the size of all images, and the true focal length."""

    xy: F64
    size: tuple[int, int]
    focal: float


def drive(seed: int, lens: Lens, views: int = 17) -> Moving:
    """A car turns a corner of 45 to 100 degrees between house fronts; 0.3 px of noise."""
    rng, focal = np.random.default_rng([7, seed]), 718.9
    R, C, ahead = _corner(rng, views)
    X = np.concatenate([_street(C[0], ahead[0], -5.0, rng), _street(C[-1], ahead[-1], -20.0, rng)])
    near = np.linalg.norm(X[:, None, :2] - C[None, :, :2], axis=2).min(axis=1)
    X = X[(near > 4.0) | (X[:, 2] == 0.0)]
    xy = _tracked(_project(X, R, C, focal, CAR, lens), rng, 350, 0.8)
    return Moving(xy + rng.normal(0.0, 0.3, xy.shape), CAR, focal)


def _corner(rng: np.random.Generator, views: int) -> tuple[F64, F64, F64]:
    """R (V, 3, 3), C and the directions ahead (V, 3) of a car that turns a corner."""
    corner = np.radians(rng.choice([-1, 1]) * rng.uniform(45.0, 100.0))
    share = np.clip((np.arange(views) - 0.2 * views) / (0.6 * views), 0.0, 1.0)
    heading = corner * share**2 * (3.0 - 2.0 * share)
    ahead = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(views)])
    C = np.cumsum(rng.uniform(0.6, 1.1) * ahead, axis=0)
    C[:, 2] = 1.65 + rng.normal(0.0, 0.01, views)
    pitch_roll = Rotation.from_euler("zx", np.radians(rng.normal(0.0, 0.3, (views, 2)))).as_matrix()
    return pitch_roll @ np.array([_level(z) for z in ahead]), C, ahead


def hand_held(seed: int, lens: Lens, views: int = 20, path: float = 0.4) -> Moving:
    """Two seconds of a shaking hand: smooth rotations of 17 degrees, ``path`` metres; 0.5 px of noise."""
    rng, focal, time = np.random.default_rng([11, seed]), 520.9, np.linspace(0.0, 2.0, views)
    X = rng.uniform([-3.0, 1.2, -1.0], [3.0, 4.0, 3.2], (6000, 3))
    X[:2400, 1] = 4.0
    X[2400:3600, 2] = 0.4
    C, turn = (_shake(rng, time) for _ in range(2))
    C *= path / max(float(np.linalg.norm(C - c, axis=1).max()) for c in C)
    C[:, 2] += 1.2
    turn *= np.radians(17.0) / max(float(np.linalg.norm(turn - w, axis=1).max()) for w in turn)
    R = Rotation.from_rotvec(turn).as_matrix() @ _level(np.array([0.0, 1.0, 0.0]))
    xy = _tracked(_project(X, R, C, focal, PHONE, lens), rng, 300, 0.93)
    return Moving(xy + rng.normal(0.0, 0.5, xy.shape), PHONE, focal)


def _level(z: F64) -> F64:
    """Rotation of a camera with level rows that looks along the level direction ``z``."""
    return np.array([[z[1], -z[0], 0.0], [0.0, 0.0, -1.0], z])


def _shake(rng: np.random.Generator, time: F64) -> F64:
    waves = [(0.25, 1.0), (0.6, 0.5), (1.3, 0.2), (2.5, 0.06)]
    phase = 2.0 * np.pi * rng.uniform(size=(len(waves), 3))
    return np.asarray(
        sum(a * np.sin(2.0 * np.pi * f * time[:, None] + p) for (f, a), p in zip(waves, phase, strict=True))
    )


def _street(start: F64, ahead: F64, first: float, rng: np.random.Generator, count: int = 9000) -> F64:
    """Points of two rows of houses that stand back by up to two metres, and of the road between them."""
    along, side = rng.uniform(first, 60.0, count), rng.choice([-1, 1], count)
    away = 7.0 + 2.0 * np.sin(12.9898 * np.floor(along / 8.0) * side) + rng.choice([0.0, 0.2, -0.3], count)
    height, road = rng.uniform(0.0, 8.0, count), rng.random(count) < 0.25
    away = side * np.where(road, rng.uniform(0.0, 7.0, count), away)
    height[road] = 0.0
    flat = start[:2] + along[:, None] * ahead[:2] + away[:, None] * [-ahead[1], ahead[0]]
    return np.column_stack([flat, height])


def _project(X: F64, R: F64, C: F64, focal: float, size: tuple[int, int], lens: Lens) -> F64:
    centre = (np.array(size) - 1) / 2 + lens.centre * size[0] * np.array([1.0, 0.3])
    turn = Rotation.from_matrix(R[1:] @ R[:-1].transpose(0, 2, 1)).as_rotvec()
    spin = 0.5 * (np.concatenate([turn[:1], turn]) + np.concatenate([turn, turn[-1:]]))
    speed, row = np.gradient(C, axis=0), np.zeros((len(R), len(X)))
    for _ in range(4 if lens.readout else 1):
        Y = np.einsum("vab,vnb->vna", R, X - C[:, None] - row[..., None] * speed[:, None])
        if lens.readout:
            turned = Rotation.from_rotvec((row[..., None] * spin[:, None]).reshape(-1, 3))
            Y = turned.apply(Y.reshape(-1, 3)).reshape(Y.shape)
        z = np.where((Y[..., 2] > 0.05) & (Y[..., 2] < 50.0), Y[..., 2], np.nan)
        a, b, (p, q) = Y[..., 0] / z, Y[..., 1] / z, lens.tangential
        r = a * a + b * b
        x = a * (1.0 + lens.k1 * r) + 2.0 * p * a * b + q * (r + 2.0 * a * a)
        y = b * (1.0 + lens.k1 * r) + p * (r + 2.0 * b * b) + 2.0 * q * a * b
        xy = focal * np.stack([x, lens.aspect * y], axis=2) / np.sqrt(lens.aspect) + centre
        row = np.clip(np.nan_to_num(xy[..., 1] / size[1] - 0.5), -0.5, 0.5) * lens.readout
    inside = ((xy > 0.0) & (xy < np.array(size) - 1)).all(axis=2)
    return np.where(inside[..., None], xy, np.nan)


def _tracked(xy: F64, rng: np.random.Generator, per_view: int, survival: float) -> F64:
    """Keep ``per_view`` points of each image; a track ends after each image with 1 - ``survival``."""
    seen, out = np.isfinite(xy[..., 0]), np.full_like(xy, np.nan)
    alive, fresh = np.zeros(xy.shape[1], dtype=bool), np.ones(xy.shape[1], dtype=bool)
    for v in range(len(xy)):
        alive &= seen[v] & (rng.random(len(alive)) < survival)
        new = rng.permutation(np.flatnonzero(seen[v] & fresh))[: max(per_view - int(alive.sum()), 0)]
        alive[new], fresh[new] = True, False
        out[v, alive] = xy[v, alive]
    return out[:, np.isfinite(out[..., 0]).sum(axis=0) >= 2]


CASES: dict[str, tuple[Callable[[int, Lens], Moving], Lens]] = {
    "car, camera as assumed": (drive, Lens()),
    "car, k1 = 0.015": (drive, Lens(k1=0.015)),
    "car, k1 = -0.015": (drive, Lens(k1=-0.015)),
    "car, aspect ratio 1.005": (drive, Lens(aspect=1.005)),
    "car, principal point 2 % off": (drive, Lens(centre=0.02)),
    "car, p1 = 0.001, p2 = 0.0005": (drive, Lens(tangential=(0.001, 0.0005))),
    "hand-held, camera as assumed": (hand_held, Lens()),
    "hand-held, readout 5 ms": (hand_held, Lens(readout=0.05)),
    "hand-held, readout 25 ms": (hand_held, Lens(readout=0.25)),
}  # Images of the hand-held videos are 0.1 s apart


def measure(scene: Moving) -> F64 | None:
    """Trusted (0 or 1), relative error of the focal length and its relative standard deviation."""
    try:
        result = reconstruct_from_tracks(scene.xy, [scene.size] * len(scene.xy))
    except StageFailure:
        return None
    camera = next(iter(result.cameras.values()))
    assert result.metric is not None
    assert camera.std is not None
    focal, std = camera.K[0, 0], camera.std["focal_px"]
    return np.array([result.metric.trusted, focal / scene.focal - 1.0, std / scene.focal])


def moving_cameras_study(trials: int = 60) -> Iterator[Part]:
    """Check focal lengths of cars that turn and of hand-held videos, with slightly wrong lenses too."""
    head = ["camera", "results", "trusted", "of these: mean z", "standard deviation of z", "within 95 %",
            "largest z", "median error, %", "median standard deviation, %"]  # fmt: skip
    rows = []
    for name, (make, lens) in CASES.items():
        found = [r for r in (measure(make(k, lens)) for k in range(trials)) if r is not None]
        trusted, error, std = np.array([r for r in found if r[0]]).reshape(-1, 3).T
        z = error / std
        rows.append([
            name, f"{len(found)} of {trials}", len(trusted), f"{z.mean():.2f}", f"{z.std():.2f}",
            f"{np.mean(np.abs(z) < 1.96):.0%}", f"{np.abs(z).max():.1f}",
            f"{100.0 * np.median(np.abs(error)):.2f}", f"{100.0 * np.median(std):.2f}",
        ])  # fmt: skip
    yield text_table(head, rows)

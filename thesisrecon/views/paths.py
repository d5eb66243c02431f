"""Ways of a camera past a model: around its middle, and along the cameras of the photographs (1.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.records import TexturedMesh

ROUND_GAP = np.radians(120.0)
"""Cameras that leave no wider gap stand all round the scene, and an orbit closes the circle."""

LEAST_SWING = np.radians(30.0)
"""An orbit that does not close swings over at least this much."""

TILT_WEIGHT = 0.02
"""Squared ratio of how much a photographer rolls the camera to how much it is tilted (about 3 and 20 deg)."""

STEEPEST = 0.1
"""Least horizontal distance of an orbit in units of its distance: nearer to the axis up is not defined."""

GROWTH = 1.1 ** np.arange(13)
"""Factors of the radius that are tried, in this order, until the orbit is clear and shows the model."""

CLEARANCE = 0.5
"""How near to the model an orbit may come, in units of the median distance of the cameras from it."""

SHOWN = 0.9
"""How much of the model each picture must show, in units of the median over the cameras."""

TURNING = 3.0
"""Where a camera turns this many times faster for its way than on the whole path, it slows down."""

STEPS = 64
"""Pieces of each stretch between two cameras in which its length is measured."""

SAMPLE = 5000
"""Points of the model that are looked at to choose an orbit."""


def fitted(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera with a picture of ``size`` (width, height): all that it saw, as large as fits, with more at
    two sides where the shapes differ."""
    factor = min(size[0] / camera.size[0], size[1] / camera.size[1])
    S = np.diag([factor, factor, 1.0])
    S[:2, 2] = 0.5 * (np.array(size) - 1.0) - factor * 0.5 * (np.array(camera.size) - 1.0)
    return Camera(S @ camera.K, camera.R, camera.t, size)


def orbit(
    cameras: Sequence[Camera], X: F64, frames: int, *, size: tuple[int, int] | None = None
) -> list[Camera]:
    """Cameras on a circle about the middle of the scene, all looking at it, upright.

    The middle is the geometric median of X; radius and height above it are medians over the cameras, the
    field of view is that of the first. Where the cameras stand all round (no gap over 120 deg) the path is a
    full circle, begun at the first camera; else it swings to and fro once over the arc that they cover, at
    least 30 deg: what no photograph saw is not shown. Either way the frames may be repeated without a jump.
    The circle is widened, up to three times, until no camera on it is nearer to X than half the median
    distance of the real ones, and each has about as much of X in its picture as they have.

    Parameters
    ----------
    cameras : at least one.
    X : (N, 3) points of the scene, evenly spread over its surface where it has one; not finite ones are left
        out.
    frames : how many, at least 1.
    size : (width, height) of the pictures, by default of the first camera.

    Raises
    ------
    ValueError : without a camera, a frame or a finite point, and where all points and cameras are in one
        place.
    """
    _check(cameras, frames)
    X = _sample(X)
    size = size or cameras[0].size
    middle, up = geometric_median(X), upward(cameras)
    offset = np.array([camera.centre for camera in cameras]) - middle
    radius, height = _typical(offset, up, float(np.median(np.linalg.norm(X - middle, axis=1))))
    K = fitted(cameras[0], size).K.copy()
    K[:2, 2] = 0.5 * (np.array(size) - 1.0)
    right, ahead = _level_axes(up)
    azimuth = _azimuths(np.arctan2(offset @ ahead, offset @ right), frames)

    def circle(factor: float) -> list[Camera]:
        around = np.outer(np.cos(azimuth), right) + np.outer(np.sin(azimuth), ahead)
        # Below the middle the camera stays where it is: the ground may be there.
        lift = height * (factor if height > 0.0 else 1.0)
        return [_looking_at(K, middle + factor * radius * a + lift * up, middle, up, size) for a in around]

    return circle(_widening(circle, [fitted(camera, size) for camera in cameras], X))


def interpolate(
    cameras: Sequence[Camera], frames: int, *, size: tuple[int, int] | None = None
) -> list[Camera]:
    """Cameras on a smooth way through ``cameras`` in their order, from the first to the last.

    Centres run on a centripetal Catmull-Rom spline (Yuksel et al. 2011), which makes no loops, at a constant
    speed; where a camera turns more than three times faster for its way than on the whole path, on the spot
    for instance, the turn sets the time. Rotations are interpolated on the sphere of quaternions, K linearly,
    after all were brought to pictures of ``size`` (by default of the first camera).

    Raises ``ValueError`` without a camera or a frame. One camera, or one frame, gives the first camera.
    """
    _check(cameras, frames)
    shown = [fitted(camera, size or cameras[0].size) for camera in cameras]
    if len(shown) == 1 or frames == 1:
        return [shown[0]] * frames
    centres = np.array([camera.centre for camera in shown])
    turns = scipy.spatial.transform.Rotation.from_matrix(np.array([camera.R for camera in shown]))
    place = _evenly(centres, (turns[1:] * turns[:-1].inv()).magnitude(), frames)
    R = scipy.spatial.transform.Slerp(np.arange(len(shown)), turns)(place).as_matrix()
    K = np.array([camera.K for camera in shown])
    start = np.minimum(place.astype(np.int64), len(shown) - 2)
    share = (place - start)[:, None, None]
    K = (1.0 - share) * K[start] + share * K[start + 1]
    t = -np.einsum("nij,nj->ni", R, _spline(centres, place))
    between = [Camera(K[n], R[n], t[n], shown[0].size) for n in range(1, frames - 1)]
    return [shown[0], *between, shown[-1]]


def upward(cameras: Sequence[Camera]) -> F64:
    """Unit vector (3,) that points up in the scene.

    It is the one to which the rows of the pictures are most nearly at right angles, and the optical axes a
    little: people tilt cameras and hardly roll them. On the side of the pictures' own ups, or where these
    cancel, of who looks down.
    """
    rows, down, axis = np.array([camera.R for camera in cameras]).transpose(1, 0, 2)
    up = np.linalg.eigh(rows.T @ rows + TILT_WEIGHT * axis.T @ axis)[1][:, 0]
    side = -down.sum(axis=0) - np.sqrt(TILT_WEIGHT) * axis.sum(axis=0)
    return np.asarray(up * (-1.0 if up @ side < 0.0 else 1.0))


def geometric_median(X: F64, rounds: int = 100) -> F64:
    """The point (3,) with the least sum of distances to X (N, 3): half of them may be anywhere without moving
    it far (Weiszfeld's iteration)."""
    middle = X.mean(axis=0)
    least = 1e-9 * float(np.abs(X - middle).max())
    if not least > 0.0:
        return np.asarray(middle)
    for _ in range(rounds):
        weight = 1.0 / np.maximum(np.linalg.norm(X - middle, axis=1), least)
        middle = weight @ X / weight.sum()
    return np.asarray(middle)


def surface_points(mesh: TexturedMesh, count: int = SAMPLE) -> F64:
    """``count`` points (count, 3) spread over the surface by its area, the same each time; none where it has
    no area."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if not len(area) or not area[-1] > 0.0:
        return np.empty((0, 3))
    place = (np.arange(count) + 0.5) / count
    face = np.searchsorted(area, place * area[-1])
    # Multiples of two irrational shares fill the square evenly, the half beyond its diagonal is folded back.
    u, v = (np.arange(count)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]) % 1.0).T
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u)[:, None], np.where(folded, 1.0 - v, v)[:, None]
    a, b, c = a[face], b[face], c[face]
    return np.asarray(a + u * (b - a) + v * (c - a))


def _check(cameras: Sequence[Camera], frames: int) -> None:
    if not cameras:
        raise ValueError("a path needs at least one camera; got none")
    if frames < 1:
        raise ValueError(f"a path needs at least one frame; got {frames}")


def _sample(X: F64) -> F64:
    X = np.asarray(X, dtype=np.float64).reshape(-1, 3)
    X = X[np.isfinite(X).all(axis=1)]
    if not len(X):
        raise ValueError("an orbit needs at least one point of the scene; got none that is finite")
    return X[:: -(-len(X) // SAMPLE)]


def _typical(offset: F64, up: F64, spread: float) -> tuple[float, float]:
    """Radius and height of a circle from ``offset`` (V, 3) of cameras from the middle; ``spread`` of the
    scene is the distance where the cameras stand in its middle."""
    height = float(np.median(offset @ up))
    radius = float(np.median(np.linalg.norm(offset - np.outer(offset @ up, up), axis=1)))
    least = STEEPEST * max(np.hypot(radius, height), spread)
    if not least > 0.0:
        raise ValueError("an orbit needs a distance; all points and cameras are in one place")
    return max(radius, least), height


def _level_axes(up: F64) -> tuple[F64, F64]:
    """Two unit vectors at right angles to ``up`` and each other; up turns the first into the second."""
    right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    right /= np.linalg.norm(right)
    return right, np.cross(up, right)


def _azimuths(of_cameras: F64, frames: int) -> F64:
    """(frames,) angles (rad) round the circle, or to and fro over the arc of the cameras."""
    ordered = np.sort(of_cameras)
    gaps = np.diff(ordered, append=ordered[0] + 2.0 * np.pi)
    phase = 2.0 * np.pi * np.arange(frames) / frames
    widest = int(np.argmax(gaps))
    if gaps[widest] <= ROUND_GAP:
        return np.asarray(of_cameras[0] + phase)
    arc = 2.0 * np.pi - gaps[widest]
    start = ordered[(widest + 1) % len(ordered)]
    return np.asarray(start + 0.5 * arc + 0.5 * max(arc, LEAST_SWING) * np.sin(phase))


def _looking_at(K: F64, centre: F64, target: F64, up: F64, size: tuple[int, int]) -> Camera:
    axis = (target - centre) / np.linalg.norm(target - centre)
    row = np.cross(axis, up)
    row /= np.linalg.norm(row)
    R = np.stack([row, np.cross(axis, row), axis])
    return Camera(K, R, -R @ centre, size)


def _widening(circle: Callable[[float], list[Camera]], cameras: Sequence[Camera], X: F64) -> float:
    """The first factor of the radius that keeps clear of X and shows enough of it; else, of those that keep
    clear, the one that shows most; else the largest."""
    tree, nearest = scipy.spatial.cKDTree(X), [1 + len(X) // 1000]

    def distances(path: Sequence[Camera]) -> F64:
        # Not the very nearest: single points float before every reconstruction.
        return np.asarray(tree.query([camera.centre for camera in path], k=nearest)[0])

    def shares(path: Sequence[Camera]) -> F64:
        return np.array([_share_in_view(camera, X) for camera in path])

    clear, shown = CLEARANCE * np.median(distances(cameras)), SHOWN * np.median(shares(cameras))
    best, most = float(GROWTH[-1]), -1.0
    for factor in GROWTH.tolist():
        path = circle(factor)
        if distances(path).min() < clear:
            continue
        share = float(shares(path[:: -(-len(path) // 24)]).min())
        if share >= shown:
            return float(factor)
        if share > most:
            best, most = factor, share
    return best


def _share_in_view(camera: Camera, X: F64) -> float:
    """Share of the points X (N, 3) that the camera has in its picture, hidden or not."""
    x, y, z = camera.K @ (camera.R @ X.T + camera.t[:, None])
    width, height = camera.size
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = x / z, y / z
        inside = (z > 0.0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    return float(inside.mean())


def _spline(centres: F64, place: F64) -> F64:
    """Points (F, 3) at ``place`` (F,) in [0, n - 1] of the centripetal Catmull-Rom spline through centres
    (n, 3), which it passes at whole numbers. It stands still between centres in one place."""
    apart = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    differ = apart > 1e-9 * max(apart.sum(), float(np.abs(centres).max()))
    if not differ.any():
        return np.tile(centres[0], (len(place), 1))
    place = np.interp(place, np.arange(len(centres)), np.concatenate([[0], np.cumsum(differ)]))
    centres, gap = centres[np.append(True, differ)], np.sqrt(apart[differ])
    padded = np.vstack([2.0 * centres[0] - centres[1], centres, 2.0 * centres[-1] - centres[-2]])
    gap = np.concatenate([gap[:1], gap, gap[-1:]])[:, None]
    chord = np.diff(padded, axis=0) / gap
    tangent = (gap[1:] * chord[:-1] + gap[:-1] * chord[1:]) / (gap[:-1] + gap[1:])
    k = np.minimum(place.astype(np.int64), len(centres) - 2)
    u = (place - k)[:, None]
    start, end = tangent[k] * gap[k + 1], tangent[k + 1] * gap[k + 1]
    rise = u * u * (3.0 - 2.0 * u)
    bend = u * (1.0 - u) * ((1.0 - u) * start - u * end)
    return np.asarray((1.0 - rise) * centres[k] + rise * centres[k + 1] + bend)


def _evenly(centres: F64, turning: F64, frames: int) -> F64:
    """(frames,) places on the spline at equal times; ``turning`` (n - 1,) rad between neighbours."""
    place = np.linspace(0.0, len(centres) - 1, STEPS * (len(centres) - 1) + 1)
    way = np.linalg.norm(np.diff(_spline(centres, place), axis=0), axis=1)
    turn = np.repeat(turning / STEPS, STEPS)
    if not way.sum() > 0.0:
        time = turn
    else:
        time = np.maximum(way, turn * way.sum() / max(TURNING * turn.sum(), 1e-300))
    if not time.sum() > 0.0:
        time = np.ones(len(time))
    elapsed = np.concatenate([[0.0], np.cumsum(time)])
    return np.asarray(np.interp(np.linspace(0.0, elapsed[-1], frames), elapsed, place))

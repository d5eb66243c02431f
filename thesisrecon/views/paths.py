"""Camera paths around a model and along the registered cameras (thesis, section 1.2)."""

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.records import TexturedMesh

TILT_WEIGHT = 0.02
"""Squared ratio of typical roll to typical tilt of hand-held cameras (about 3 and 20 degrees)."""
GROWTH = 1.1 ** np.arange(13)
"""Radius factors, tried in this order until the orbit keeps clear of the model and shows it."""
SHOWN = 0.9  #: minimum visible share of the model, in units of the median over the cameras
TURNING = 3.0
"""Where the rotation per path length exceeds this multiple of its mean, it determines the speed."""
SAMPLE = 5000  #: model points that are used to choose an orbit


def _fit_to_size(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera with another image size: the whole field of view, as large as possible, centred."""
    factor = min(size[0] / camera.size[0], size[1] / camera.size[1])
    S = np.diag([factor, factor, 1.0])
    S[:2, 2] = 0.5 * (np.array(size) - 1.0) - factor * 0.5 * (np.array(camera.size) - 1.0)
    return Camera(S @ camera.K, camera.R, camera.t, size)


def orbit(
    cameras: Sequence[Camera], X: F64, frames: int, *, size: tuple[int, int] | None = None
) -> list[Camera]:
    """Place cameras on a circle about the centre of the scene, upright and looking at it.

    The centre is the geometric median of X; radius and height are medians over the cameras; the field of view
    is that of the first camera. If the cameras surround the scene the path is a full circle from the first
    camera; otherwise it swings over the arc that they cover. The radius grows up to threefold until the
    circle keeps clear of X and every frame shows about as much of X as the cameras do.
    """
    X = np.asarray(X, dtype=np.float64).reshape(-1, 3)
    X = X[np.isfinite(X).all(axis=1)]
    X = X[:: -(-len(X) // SAMPLE)]
    size = size or cameras[0].size
    middle, up = _geometric_median(X), estimate_up(cameras)
    offset = np.array([camera.centre for camera in cameras]) - middle
    radius, height = _typical(offset, up, float(np.median(np.linalg.norm(X - middle, axis=1))))
    K = _fit_to_size(cameras[0], size).K.copy()
    K[:2, 2] = 0.5 * (np.array(size) - 1.0)
    right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    right /= np.linalg.norm(right)
    ahead = np.cross(up, right)
    azimuth = _azimuths(np.arctan2(offset @ ahead, offset @ right), frames)

    def circle(factor: float) -> list[Camera]:
        around = np.outer(np.cos(azimuth), right) + np.outer(np.sin(azimuth), ahead)
        # Below the middle the camera stays where it is: the ground may be there.
        lift = height * (factor if height > 0.0 else 1.0)
        return [_looking_at(K, middle + factor * radius * a + lift * up, middle, up, size) for a in around]

    return circle(_widening(circle, [_fit_to_size(camera, size) for camera in cameras], X))


def interpolate_cameras(
    cameras: Sequence[Camera], frames: int, *, size: tuple[int, int] | None = None
) -> list[Camera]:
    """Interpolate a smooth camera path through the cameras, from the first to the last.

    Centres follow a centripetal Catmull-Rom spline (Yuksel et al. 2011) at constant speed, slower where the
    rotation per path length is large; rotations are interpolated as quaternions, K linearly.
    """
    shown = [_fit_to_size(camera, size or cameras[0].size) for camera in cameras]
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


def estimate_up(cameras: Sequence[Camera]) -> F64:
    """Estimate the up direction of the scene: perpendicular to image rows, and slightly to optical axes.

    Hand-held cameras are tilted but hardly rolled. The sign is that of the image up directions or, if these
    cancel, follows from cameras that look down.
    """
    rows, down, axis = np.array([camera.R for camera in cameras]).transpose(1, 0, 2)
    up = np.linalg.eigh(rows.T @ rows + TILT_WEIGHT * axis.T @ axis)[1][:, 0]
    side = -down.sum(axis=0) - np.sqrt(TILT_WEIGHT) * axis.sum(axis=0)
    return np.asarray(up * (-1.0 if up @ side < 0.0 else 1.0))


def _geometric_median(X: F64) -> F64:
    """The point (3,) with the least sum of distances to X (N, 3), by Weiszfeld's iteration."""
    middle = X.mean(axis=0)
    least = 1e-9 * float(np.abs(X - middle).max())
    if not least > 0.0:
        return np.asarray(middle)
    for _ in range(100):
        weight = 1.0 / np.maximum(np.linalg.norm(X - middle, axis=1), least)
        middle = weight @ X / weight.sum()
    return np.asarray(middle)


def sample_surface(mesh: TexturedMesh, count: int = SAMPLE) -> F64:
    """Sample points evenly over the area of a mesh, the same points each time."""
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


def _typical(offset: F64, up: F64, spread: float) -> tuple[float, float]:
    """Radius and height of the orbit from camera offsets (V, 3) and the ``spread`` of the scene."""
    # Minimum horizontal distance of an orbit relative to its distance: on the vertical axis up is undefined.
    min_horizontal_distance = 0.1
    height = float(np.median(offset @ up))
    radius = float(np.median(np.linalg.norm(offset - np.outer(offset @ up, up), axis=1)))
    least = min_horizontal_distance * max(np.hypot(radius, height), spread)
    if not least > 0.0:
        raise ValueError("an orbit needs a distance; all points and cameras coincide")
    return max(radius, least), height


def _azimuths(of_cameras: F64, frames: int) -> F64:
    """Angles (frames,) in rad, around the full circle or back and forth over the arc of the cameras."""
    # Cameras without a wider gap in azimuth surround the scene; the orbit is then a full circle.
    round_gap = np.radians(120.0)
    min_arc = np.radians(30.0)  # Minimum arc of an orbit that is not a full circle
    ordered = np.sort(of_cameras)
    gaps = np.diff(ordered, append=ordered[0] + 2.0 * np.pi)
    phase = 2.0 * np.pi * np.arange(frames) / frames
    widest = int(np.argmax(gaps))
    if gaps[widest] <= round_gap:
        return np.asarray(of_cameras[0] + phase)
    arc = 2.0 * np.pi - gaps[widest]
    start = ordered[(widest + 1) % len(ordered)]
    return np.asarray(start + 0.5 * arc + 0.5 * max(arc, min_arc) * np.sin(phase))


def _looking_at(K: F64, centre: F64, target: F64, up: F64, size: tuple[int, int]) -> Camera:
    axis = (target - centre) / np.linalg.norm(target - centre)
    row = np.cross(axis, up)
    row /= np.linalg.norm(row)
    R = np.stack([row, np.cross(axis, row), axis])
    return Camera(K, R, -R @ centre, size)


def _widening(circle: Callable[[float], list[Camera]], cameras: Sequence[Camera], X: F64) -> float:
    """The first radius factor that keeps clear of X and shows enough; else the clear one that shows most."""
    clearance = 0.5  # Minimum distance to the model, in units of the median distance of the cameras
    tree, nearest = scipy.spatial.cKDTree(X), [1 + len(X) // 1000]

    def distances(path: Sequence[Camera]) -> F64:
        # Not the nearest point: every reconstruction has single wrong points near its cameras.
        return np.asarray(tree.query([camera.centre for camera in path], k=nearest)[0])

    def shares(path: Sequence[Camera]) -> F64:
        return np.array([_share_in_view(camera, X) for camera in path])

    clear, shown = clearance * np.median(distances(cameras)), SHOWN * np.median(shares(cameras))
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
    """Share of the points X (N, 3) that project into the image, occluded or not."""
    x, y, z = camera.K @ (camera.R @ X.T + camera.t[:, None])
    width, height = camera.size
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = x / z, y / z
        inside = (z > 0.0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    return float(inside.mean())


def _spline(centres: F64, place: F64) -> F64:
    """Points (F, 3) at parameters ``place`` of the centripetal Catmull-Rom spline."""
    apart = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    differ = apart > 1e-9 * max(apart.sum(), float(np.abs(centres).max()))
    if not differ.any():
        return np.tile(centres[0], (len(place), 1))
    knots = np.concatenate([[0.0], np.cumsum(np.where(differ, np.sqrt(apart), 0.0))])
    at = np.interp(place, np.arange(len(centres)), knots)
    centres, knots = centres[np.append(True, differ)], knots[np.append(True, differ)]
    padded = np.vstack([2.0 * centres[0] - centres[1], centres, 2.0 * centres[-1] - centres[-2]])
    gap = np.pad(np.diff(knots), 1, mode="edge")[:, None]
    chord = np.diff(padded, axis=0) / gap
    tangent = (gap[1:] * chord[:-1] + gap[:-1] * chord[1:]) / (gap[:-1] + gap[1:])
    return np.asarray(scipy.interpolate.CubicHermiteSpline(knots, centres, tangent)(at))


def _evenly(centres: F64, turning: F64, frames: int) -> F64:
    """Spline parameters (frames,) at equal times; ``turning`` (n - 1,): rotations in rad."""
    steps = 64  # Samples per spline segment for measuring its length
    place = np.linspace(0.0, len(centres) - 1, steps * (len(centres) - 1) + 1)
    way = np.linalg.norm(np.diff(_spline(centres, place), axis=0), axis=1)
    turn = np.repeat(turning / steps, steps)
    if not way.sum() > 0.0:
        time = turn
    else:
        time = np.maximum(way, turn * way.sum() / max(TURNING * turn.sum(), 1e-300))
    if not time.sum() > 0.0:
        time = np.ones(len(time))
    elapsed = np.concatenate([[0.0], np.cumsum(time)])
    return np.asarray(np.interp(np.linspace(0.0, elapsed[-1], frames), elapsed, place))

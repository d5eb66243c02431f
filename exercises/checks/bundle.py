"""Checks of the bundle adjustment."""

from types import SimpleNamespace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import thesisrecon
from checks.scene import courtyard, divided

UNIT, CASES = "px", 3
RETURNS = [("r", ("V", 3)), ("t", ("V", 3)), ("X", ("N", 3))]
V, N, SIGMA = 3, 25, 0.5


def data(rng):
    scene = courtyard(rng, (4, 6, 8), N)
    xy = scene.xy + rng.normal(0, SIGMA, scene.xy.shape)
    r = Rotation.from_matrix(scene.R).as_rotvec() + rng.normal(0, 0.005, (V, 3))
    t, X = (one + rng.normal(0, 0.03, one.shape) for one in (scene.t, scene.X))
    return SimpleNamespace(inputs=(scene.K[0], r, t, X, xy), exact=scene.xy, K=scene.K[0])


def _pixels(K, r, t, X):
    R = Rotation.from_rotvec(r).as_matrix()
    return divided((X @ R.transpose(0, 2, 1) + t[:, None]) @ K.T)


def _distances(K, r, t, X, xy):
    return np.linalg.norm(_pixels(K, r, t, X) - xy, axis=2)


def error(output, case):
    return np.sqrt(np.mean(np.sum((_pixels(case.K, *output) - case.exact) ** 2, axis=2)))


def bound(_):
    # 6 V + 3 N - 7 parameters share the noise of 2 V N numbers.
    return SIGMA * np.sqrt((6 * V + 3 * N - 7) / (V * N))


def ours(case):
    K, r, t, X, xy = case.inputs
    cameras = (np.stack([K] * V), Rotation.from_rotvec(r).as_matrix(), t)
    found = thesisrecon.bundle_adjust(cameras, X, xy, sizes=(1024, 768), free=())
    r = np.stack([Rotation.from_matrix(camera.R).as_rotvec() for camera in found.cameras])
    return r, np.stack([camera.t for camera in found.cameras]), found.X


def faults(output, case):
    K, *_, xy = case.inputs
    own, best = (_distances(K, *one, xy) for one in (output, solve(*case.inputs)))  # noqa: F821
    if np.sum(own**2) <= 1.001 * np.sum(best**2):
        return []
    r, t, X = output
    R = Rotation.from_rotvec(r)
    readings = {"R' X + t": (-r, t), "R (X - t)": (r, -R.apply(t)), "R (X + t)": (r, R.apply(t))}
    for words, (turned, moved) in readings.items():
        if np.sum(_distances(K, turned, moved, X, xy) ** 2) < np.sum(own**2) / 4:
            return [f"the residuals are those of {words}, not of R X + t"]
    if np.sum(own**4) < np.sum(best**4):
        return ["the squares are squared again: least_squares takes the residuals, and squares them itself"]
    if np.sum(own) < np.sum(best):
        return ["the sum of distances is least, not that of their squares"]
    return ["the sum of squared residuals is not at its minimum"]


def vector(output, case):
    """Pixels: independent of the frame."""
    return np.clip(np.ravel(_pixels(case.K, *output)), -1e4, 1e4)


def _minimised(*free):
    """Adjust only some of r, t, X."""

    def wrong(_, K, *given):
        *start, xy = given

        def parts(p):
            cuts = np.cumsum([start[k].size for k in free])[:-1]
            found = dict(zip(free, np.split(p, cuts), strict=True))
            return [found.get(k, one).reshape(-1, 3) for k, one in enumerate(start)]

        first = np.concatenate([start[k].ravel() for k in free])
        return tuple(
            parts(least_squares(lambda p: np.ravel(_pixels(K, *parts(p)) - xy), first, x_scale="jac").x)
        )

    return wrong


MISTAKES = {
    "the initial values are returned": lambda solve, K, r, t, X, xy: (r, t, X),
    "only the points are adjusted": _minimised(2),
    "only the cameras are adjusted": _minimised(0, 1),
    "the rotations are not adjusted": _minimised(1, 2),
    "the translations are not adjusted": _minimised(0, 2),
    "x and y are swapped": lambda solve, K, r, t, X, xy: solve(K, r, t, X, xy[..., ::-1]),
    "the adjusted points are not returned": lambda solve, *given: (*solve(*given)[:2], given[3]),
    "the adjusted rotations are not returned": lambda solve, *given: (given[1], *solve(*given)[1:]),
    "the adjusted translations are not returned": lambda solve, *given: (lambda r, _, X: (r, given[2], X))(
        *solve(*given)
    ),
    "the adjusted cameras are not returned": lambda solve, *given: (*given[1:3], solve(*given)[2]),
}

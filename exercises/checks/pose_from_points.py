"""Checks of the resection."""

from types import SimpleNamespace

import numpy as np
from solutions.camera_from_points import dlt

import thesisrecon
from checks.scene import courtyard, degrees, rotation_faults

UNIT, RETURNS = "degrees", [("R", (3, 3)), ("t", (3,))]
N, SIGMA = 60, 0.5


def data(rng):
    scene = courtyard(rng, (rng.integers(3, 10),), N)
    xy = scene.xy[0] + rng.normal(0, SIGMA, (N, 2))
    return SimpleNamespace(inputs=(scene.X, xy, scene.K[0]), R=scene.R[0], t=scene.t[0])


def error(output, case):
    """Rotation, and position as an angle: its error over the distance of the scene."""
    R, t = output
    return float(
        np.hypot(degrees(R, case.R), np.degrees(np.linalg.norm(t - case.t) / np.linalg.norm(case.t)))
    )


def ours(case):
    X, xy, K = case.inputs
    found = thesisrecon.resect(X, xy, K, threshold_px=None)
    return found.R, found.t


def vector(output, _):
    R, t = output
    return np.concatenate([np.ravel(R), t / max(3, np.linalg.norm(t) / 10)])


def faults(output, _):
    return rotation_faults(output[0])


def _with(change):
    def wrong(_, X, xy, K):
        P = np.linalg.inv(K) @ dlt(X, xy)
        P = P * np.sign(np.linalg.det(P[:, :3]))
        U, s, Vt = np.linalg.svd(P[:, :3])
        return change(P, U @ Vt, s)

    return wrong


MISTAKES = {
    "R is not a rotation: take U V' of its SVD": _with(
        lambda P, R, s: (P[:, :3] / s.mean(), P[:, 3] / s.mean())
    ),
    "R is not a rotation, and s is not divided out": _with(lambda P, R, s: (P[:, :3], P[:, 3])),
    "t is not divided by the mean singular value": _with(lambda P, R, s: (R, P[:, 3])),
    "t is multiplied by the mean singular value": _with(lambda P, R, s: (R, P[:, 3] * s.mean())),
    "R is not a rotation: det R = -1": _with(lambda P, R, s: (-R, -P[:, 3] / s.mean())),
    "t has the wrong sign": _with(lambda P, R, s: (R, -P[:, 3] / s.mean())),
    "R is transposed: it turns world to camera": _with(lambda P, R, s: (R.T, P[:, 3] / s.mean())),
    "t is the camera centre: it is -R centre": _with(lambda P, R, s: (R, -R.T @ P[:, 3] / s.mean())),
    "K is not used: the DLT gives K [R t]": lambda solve, X, xy, K: solve(X, xy, np.eye(3)),
    "P is multiplied by K, not by inv(K)": lambda solve, X, xy, K: solve(X, xy, np.linalg.inv(K)),
}

"""Checks of the relative pose."""

from types import SimpleNamespace

import numpy as np

import thesisrecon
from checks.scene import courtyard, degrees, divided, homogeneous, rotation_faults

UNIT, RETURNS = "degrees", [("R", (3, 3)), ("t", (3,))]
N, SIGMA = 40, 0.5
PAIRS = [(4, 8), (9, 5), (2, 6), (10, 7), (3, 1)]


def data(rng):
    scene = courtyard(rng, PAIRS[rng.integers(len(PAIRS))], N)
    xy = scene.xy + rng.normal(0, SIGMA, scene.xy.shape)
    K = scene.K[0]
    x1, x2 = divided(homogeneous(xy) @ np.linalg.inv(K).T)
    E = thesisrecon.estimate_essential(*xy, K, threshold_px=None).E
    # Either of the two rotations comes first.
    U, _, Vt = np.linalg.svd(E)
    E = U @ np.diag([1, 1 + rng.choice([-1e-6, 1e-6]), 0]) @ Vt
    R = scene.R[1] @ scene.R[0].T
    t = scene.t[1] - R @ scene.t[0]
    sign = rng.choice([-1, 1]) * rng.uniform(0.5, 2)
    return SimpleNamespace(inputs=(sign * E, x1, x2), R=R, t=t / np.linalg.norm(t))


def error(output, case):
    R, t = output
    return float(np.hypot(degrees(R, case.R), np.degrees(np.linalg.norm(t - case.t))))


def ours(case):
    found = thesisrecon.decompose_essential(*case.inputs)
    return found.R[0], found.t[0]


def faults(output, _):
    R, t = output
    return rotation_faults(R) + ([] if abs(np.linalg.norm(t) - 1) < 1e-6 else ["t has not unit length"])


def _changed(change):
    return lambda solve, E, x1, x2: change(*solve(E, x1, x2))


def _twisted(R, t):
    """The rotation turned by 180 degrees about the baseline."""
    return (2 * np.outer(t, t) - np.eye(3)) @ R


MISTAKES = {
    "wrong cheirality: t has the wrong sign": _changed(lambda R, t: (R, -t)),
    "wrong cheirality: R is the other rotation": _changed(lambda R, t: (_twisted(R, t), t)),
    "wrong cheirality: R is the other rotation, and t has the wrong sign": _changed(
        lambda R, t: (_twisted(R, t), -t)
    ),
    "R is not a rotation: det R = -1": _changed(lambda R, t: (-R, t)),
    "R is not a rotation: det R = -1, and t has the wrong sign": _changed(lambda R, t: (-R, -t)),
    "R and t are the inverse pose, from camera 2 to camera 1": _changed(lambda R, t: (R.T, -R.T @ t)),
    "R is transposed": _changed(lambda R, t: (R.T, t)),
    "t is the camera centre: it is -R centre": _changed(lambda R, t: (R, -R.T @ t)),
}

"""Checks of the camera calibration."""

from types import SimpleNamespace

import numpy as np
from scipy.linalg import rq
from solutions.camera_from_points import dlt

import thesisrecon
from checks.scene import courtyard, project, rotation_faults

UNIT, RETURNS = "px", [("K", (3, 3)), ("R", (3, 3)), ("t", (3,))]
N, SIGMA = 40, 0.5


def data(rng):
    scene = courtyard(rng, (6,), N)
    xy = scene.xy[0] + rng.normal(0, SIGMA, (N, 2))
    return SimpleNamespace(inputs=(scene.X, xy), X=scene.X, exact=scene.xy[0])


def error(output, case):
    K, R, t = output
    off = project(K @ np.column_stack([R, t]), case.X) - case.exact
    return np.sqrt(np.mean(np.sum(off**2, axis=1)))


def bound(_):
    # 11 parameters share the noise of 2 N numbers.
    return SIGMA * np.sqrt(11 / N)


def ours(case):
    found = thesisrecon.resect(*case.inputs, threshold_px=None)
    return found.K, found.R, found.t


def vector(output, _):
    K, R, t = output
    return np.concatenate([K.ravel() / 500, R.ravel(), t / 3])


def faults(output, case):
    K, R, _t = output
    M = dlt(*case.inputs)[:, :3]
    if abs(np.sum(R @ K * M)) > (1 - 1e-6) * np.linalg.norm(R @ K) * np.linalg.norm(M):
        return ["the QR decomposition is P = R K; it must be RQ, P = K R"]
    found = rotation_faults(R)
    if np.abs(np.tril(K, -1)).max() > 1e-6 * np.abs(K).max():
        found.append("K is not upper triangular")
    if np.diag(K).min() <= 0:
        found.append("a focal length is negative: change the signs of columns of K and of rows of R")
    return found + ([] if abs(K[2, 2] - 1) < 1e-6 else ["K[2, 2] is not 1: divide K by it"])


def _negative(solve, X, xy):
    K, R, t = solve(X, xy)
    S = np.diag([-1, -1, 1])
    return K @ S, S @ R, S @ t


def _first(solve, X, xy):
    """As the RQ decomposition returns it."""
    P = dlt(X, xy)
    K, R = rq(P[:, :3])
    return K / K[2, 2], R, np.linalg.inv(K) @ P[:, 3]


def _unscaled(solve, X, xy):
    P = dlt(X, xy)
    K, R, _ = solve(X, xy)
    P = P * np.sign(np.linalg.det(P[:, :3]))
    return K * np.cbrt(np.linalg.det(P[:, :3]) / np.linalg.det(K)), R, np.linalg.inv(K) @ P[:, 3]


def _t_of_unscaled(solve, X, xy):
    return (*solve(X, xy)[:2], np.linalg.inv(solve(X, xy)[0]) @ dlt(X, xy)[:, 3])


def _t_with(change):
    def wrong(solve, X, xy):
        K, R, t = solve(X, xy)
        return K, R, change(K, R, t)

    return wrong


MISTAKES = {
    "R is transposed: it turns world to camera": lambda solve, X, xy: (lambda K, R, t: (K, R.T, t))(
        *solve(X, xy)
    ),
    "t is the camera centre: it is -R centre": _t_with(lambda K, R, t: -R.T @ t),
    "t has the wrong sign": _t_with(lambda K, R, t: -t),
    "t is the fourth column of K [R t]: multiply by inv(K)": _t_with(lambda K, R, t: K @ t),
    "t has another scale than K [R t]: take the K before the division by K[2, 2]": _t_of_unscaled,
    "the focal lengths are negative: change the signs of columns of K and of rows of R": _negative,
    "signs are as the decomposition returns them; make the diagonal of K positive, and det R = 1": _first,
    "K is not divided by K[2, 2]": _unscaled,
    "x and y are swapped": lambda solve, X, xy: solve(X, xy[:, ::-1]),
}

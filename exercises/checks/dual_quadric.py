"""Checks of the self-calibration."""

from types import SimpleNamespace

import numpy as np

from checks.scene import courtyard

UNIT, RETURNS, FLOOR = "per cent of f", [("the result", ("V",))], 1e-3


def data(rng):
    """Cameras of the courtyard in a random projective frame, pixels relative to the principal point."""
    scene = courtyard(rng, range(2, 10), 1)
    T = np.array([[1e-3, 0, -0.5289], [0, 1e-3, -0.3678], [0, 0, 1]])
    H = np.eye(4) + rng.normal(0, 0.2, (4, 4))
    P = T @ scene.P @ H
    P = P * rng.uniform(0.5, 2, (len(P), 1, 1)) * rng.choice([-1, 1], (len(P), 1, 1))
    return SimpleNamespace(inputs=(P,), f=scene.K[0, 0, 0] / 1000)


def error(f, case):
    return 100 * np.sqrt(np.mean((f / case.f - 1) ** 2))


def _half(_, P):
    """The linear equations with each entry off the diagonal once."""
    i, j = np.triu_indices(4)
    P = P / np.linalg.norm(P, axis=(1, 2), keepdims=True)
    w = P[:, :, None, i] * P[:, None, :, j]
    rows = [w[:, 0, 1], w[:, 0, 2], w[:, 1, 2], w[:, 0, 0] - w[:, 1, 1]]
    Q = np.zeros((4, 4))
    Q[i, j] = Q[j, i] = np.linalg.svd(np.concatenate(rows))[2][-1]
    w = P @ Q @ P.swapaxes(1, 2)
    return np.sqrt(np.abs(w[:, 0, 0] / w[:, 2, 2]))


MISTAKES = {
    "Q is symmetric: its entries off the diagonal occur twice in each equation": _half,
    "the root is missing: w00 / w22 is f^2": lambda solve, P: solve(P) ** 2,
    "f is inverted: it is sqrt(w00 / w22)": lambda solve, P: 1 / solve(P),
    "f is inverted, and the root is missing": lambda solve, P: solve(P) ** -2,
    "the sign of f is wrong": lambda solve, P: -solve(P),
    "f is in pixels; it is of order 1 as P": lambda solve, P: 1000 * solve(P),
    "the fourth root is taken": lambda solve, P: np.sqrt(solve(P)),
}

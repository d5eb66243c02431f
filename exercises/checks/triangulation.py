"""Checks of the triangulation."""

from types import SimpleNamespace

import numpy as np

import thesisrecon
from checks.scene import courtyard, homogeneous

UNIT, RETURNS = "m", [("the result", ("N", 3))]
N, SIGMA = 40, 0.5


def data(rng):
    scene = courtyard(rng, (4, 8), N)
    return SimpleNamespace(inputs=(*scene.P, *(scene.xy + rng.normal(0, SIGMA, scene.xy.shape))), X=scene.X)


def error(X, case):
    return np.sqrt(np.mean(np.sum((X - case.X) ** 2, axis=1)))


def ours(case):
    P1, P2, xy1, xy2 = case.inputs
    X = thesisrecon.triangulate(np.stack([P1, P2]), np.stack([xy1, xy2]))
    return X[:, :3] / X[:, 3:]


def vector(X, _):
    return np.ravel(X / np.maximum(np.linalg.norm(X, axis=1, keepdims=True) / 20, 1))


def _unit(solve, *inputs):
    X = homogeneous(solve(*inputs))
    return X[:, :3] / np.linalg.norm(X, axis=1, keepdims=True)


def _singular(take, divide=True):
    def wrong(solve, P1, P2, xy1, xy2):
        found = []
        for (x1, y1), (x2, y2) in zip(xy1, xy2, strict=True):
            rows = [x1 * P1[2] - P1[0], y1 * P1[2] - P1[1], x2 * P2[2] - P2[0], y2 * P2[2] - P2[1]]
            X = take(np.linalg.svd(np.array(rows))[2])
            found.append(X[:3] / (X[3] if divide else 1))
        return np.array(found)

    return wrong


MISTAKES = {
    "the points are not divided by their fourth coordinate": _singular(lambda Vt: Vt[-1], divide=False),
    "the points have unit length; divide them by their fourth coordinate": _unit,
    "the cameras are swapped": lambda solve, P1, P2, a, b: solve(P2, P1, a, b),
    "x and y are swapped": lambda solve, P1, P2, a, b: solve(P1, P2, a[:, ::-1], b[:, ::-1]),
    "the column of Vt is taken: the singular vectors are its rows": _singular(lambda Vt: Vt[:, -1]),
    "the first singular vector is taken: it is that of the least singular value": _singular(lambda Vt: Vt[0]),
    "x and y are swapped in image 1": lambda solve, P1, P2, a, b: solve(P1, P2, a[:, ::-1], b),
    "x and y are swapped in image 2": lambda solve, P1, P2, a, b: solve(P1, P2, a, b[:, ::-1]),
    "both pixels are used with P1": lambda solve, P1, P2, a, b: solve(P1, P1, a, b),
    "the sign of the points is wrong": lambda solve, *inputs: -solve(*inputs),
}

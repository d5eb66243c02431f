"""Checks of the homography."""

from types import SimpleNamespace

import numpy as np
from grader import up_to_scale
from solutions.homography import normalise

import thesisrecon
from checks.scene import divided, homogeneous

UNIT, RETURNS = "px", [("H", (3, 3))]
SCALE = np.diag([3e-4, 3e-4, 1.0])
N, SIGMA = 12, 0.5


def data(rng):
    H = np.array([[0.9, -0.1, 80.0], [0.15, 1.05, -40.0], [1e-4, 5e-5, 1.0]])
    H += rng.normal(0, [[0.05, 0.05, 20], [0.05, 0.05, 20], [3e-5, 3e-5, 0]])
    xy1 = rng.uniform((3400, 2200), (3900, 2600), (N, 2))
    exact = divided(homogeneous(xy1) @ H.T)
    return SimpleNamespace(inputs=(xy1, exact + rng.normal(0, SIGMA, (N, 2))), exact=exact)


def error(H, case):
    return np.sqrt(np.mean(np.sum((divided(homogeneous(case.inputs[0]) @ H.T) - case.exact) ** 2, axis=1)))


def bound(_):
    # 8 parameters share the noise of 2 N numbers.
    return SIGMA * np.sqrt(8 / N)


def ours(case):
    return thesisrecon.estimate_homography(*case.inputs, threshold_px=None).H


def vector(H, _):
    return up_to_scale(SCALE @ H @ np.linalg.inv(SCALE))


def _plain(solve, xy1, xy2):
    x1, x2 = homogeneous(xy1), homogeneous(xy2)
    zero = np.zeros_like(x1)
    A = np.vstack([np.hstack([zero, -x1, x2[:, 1:2] * x1]), np.hstack([x1, zero, -x2[:, :1] * x1])])
    return np.linalg.svd(A)[2][-1].reshape(3, 3)


def _in_normalised(solve, xy1, xy2):
    T1, T2 = normalise(xy1)[1], normalise(xy2)[1]
    return T2 @ solve(xy1, xy2) @ np.linalg.inv(T1)


def _swapped_transforms(solve, xy1, xy2):
    T1, T2 = normalise(xy1)[1], normalise(xy2)[1]
    return np.linalg.inv(T1) @ _in_normalised(solve, xy1, xy2) @ T2


def _transposed(solve, xy1, xy2):
    T1, T2 = normalise(xy1)[1], normalise(xy2)[1]
    return np.linalg.inv(T2) @ _in_normalised(solve, xy1, xy2).T @ T1


def _affine(solve, xy1, xy2):
    return np.vstack([np.linalg.lstsq(homogeneous(xy1), xy2)[0].T, [0, 0, 1]])


MISTAKES = {
    "H is affine: its last row is not 0 0 1": _affine,
    "H is inverted: it maps image 2 to image 1": lambda solve, a, b: solve(b, a),
    "H is transposed: reshape h by rows": lambda solve, a, b: solve(a, b).T,
    "H is transposed: reshape h by rows, before the normalisation is undone": _transposed,
    "the points are not normalised before the SVD": _plain,
    "the normalisation is not undone: return inv(T2) H T1": _in_normalised,
    "the normalisation is undone by the wrong transforms: it is inv(T2) H T1": _swapped_transforms,
    "x and y are swapped": lambda solve, a, b: solve(a[:, ::-1], b[:, ::-1]),
    "only the first four matches are used": lambda solve, a, b: solve(a[:4], b[:4]),
}

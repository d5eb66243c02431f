"""Checks of the eight-point algorithm."""

from types import SimpleNamespace

import numpy as np
from grader import up_to_scale
from solutions.homography import normalise

import thesisrecon
from checks.scene import courtyard, epipolar_rms, homogeneous

UNIT, RETURNS = "px", [("F", (3, 3))]
SCALE = np.diag([500.0, 500.0, 1.0])
N, SIGMA = 40, 0.5


def data(rng):
    scene = courtyard(rng, (5, 7), N)
    return SimpleNamespace(inputs=tuple(scene.xy + rng.normal(0, SIGMA, scene.xy.shape)), exact=scene.xy)


def error(F, case):
    return epipolar_rms(F, *case.exact)


def bound(_):
    # 7 parameters share N distances, whose variance is that of both images.
    return SIGMA * np.sqrt(14 / N)


def ours(case):
    return thesisrecon.estimate_fundamental(*case.inputs, method="eight-point", threshold_px=None).F


def vector(F, _):
    return up_to_scale(SCALE @ F @ SCALE)


def faults(F, _):
    s = np.linalg.svd(SCALE @ F @ SCALE)[1]
    return ["the rank of F is not 2: set its least singular value to zero"] if s[2] > 1e-9 * s[0] else []


def _linear(x1, x2, rank=2):
    U, s, Vt = np.linalg.svd(
        np.linalg.svd(np.einsum("ni,nj->nij", x2, x1).reshape(-1, 9))[2][-1].reshape(3, 3)
    )
    s[rank:] = 0
    return (U * s) @ Vt


def _rank_three(solve, xy1, xy2):
    (x1, T1), (x2, T2) = normalise(xy1), normalise(xy2)
    return T2.T @ _linear(x1, x2, 3) @ T1


def _in_normalised(solve, xy1, xy2):
    return _linear(normalise(xy1)[0], normalise(xy2)[0])


def _inverse_transform(solve, xy1, xy2):
    (x1, T1), (x2, T2) = normalise(xy1), normalise(xy2)
    return np.linalg.inv(T2) @ _linear(x1, x2) @ T1


def _swapped_transforms(solve, xy1, xy2):
    (x1, T1), (x2, T2) = normalise(xy1), normalise(xy2)
    return T1.T @ _linear(x1, x2) @ T2


MISTAKES = {
    "F is transposed: in x2' F x1 = 0, image 2 is on the left": lambda solve, a, b: solve(a, b).T,
    "the points are not normalised before the SVD": (
        lambda solve, a, b: _linear(homogeneous(a), homogeneous(b))
    ),
    "the points are not normalised, and the rank of F is not 2": (
        lambda solve, a, b: _linear(homogeneous(a), homogeneous(b), 3)
    ),
    "the rank of F is not 2: set its least singular value to zero": _rank_three,
    "the normalisation is not undone: return T2' F T1": _in_normalised,
    "the normalisation is undone as that of a homography: it is T2' F T1": _inverse_transform,
    "the normalisation is undone by the wrong transforms: it is T2' F T1": _swapped_transforms,
    "x and y are swapped": lambda solve, a, b: solve(a[:, ::-1], b[:, ::-1]),
    "only the first eight matches are used": lambda solve, a, b: solve(a[:8], b[:8]),
}

"""Checks of RANSAC."""

from types import SimpleNamespace

import numpy as np
from solutions.eight_point import eight_point
from solutions.ransac import sampson as _sampson

import thesisrecon
from checks.scene import courtyard

UNIT, RETURNS, CASES, LIMIT = "per cent classified wrong", [("the result", ("N",))], 3, 1.5
N, SIGMA, THRESHOLD = 100, 0.3, 2.0
FLOOR = 15.0


def data(rng):
    scene = courtyard(rng, (4, 8), N)
    xy = scene.xy + rng.normal(0, SIGMA, scene.xy.shape)
    good = np.arange(N) < 0.7 * N
    xy[1, ~good] = rng.uniform((0, 0), (1024, 768), ((~good).sum(), 2))
    return SimpleNamespace(inputs=(*xy, THRESHOLD, eight_point, np.random.default_rng(1)), good=good)


def error(inliers, case):
    return 100 * np.mean(inliers.astype(bool) != case.good)


def ours(case):
    found = thesisrecon.estimate_fundamental(*case.inputs[:2], threshold_px=THRESHOLD)
    return found.inliers


def vector(inliers, _):
    return inliers.astype(float)


MISTAKES = {
    "the mask is inverted: True are inliers": lambda solve, *inputs: ~solve(*inputs),
    "all matches are inliers: is the distance compared with the threshold?": (
        lambda solve, a, b, *_: np.ones(len(a), bool)
    ),
    "F is of all matches, without samples": lambda solve, a, b, threshold, fit, rng: (
        _sampson(fit(a, b), a, b) < threshold
    ),
    "the first sample is kept: compare the numbers of inliers": lambda solve, a, b, threshold, fit, rng: (
        lambda some: _sampson(fit(a[some], b[some]), a, b) < threshold
    )(rng.choice(len(a), 8, replace=False)),
    "no match is an inlier": lambda solve, a, *_: np.zeros(len(a), bool),
    "F is transposed in the distance": lambda solve, a, b, threshold, fit, rng: solve(
        a, b, threshold, lambda x, y: fit(x, y).T, rng
    ),
}

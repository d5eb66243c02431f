"""Checks of RANSAC."""

from types import SimpleNamespace

import numpy as np
from solutions.eight_point import eight_point
from solutions.ransac import sampson as _sampson

import thesisrecon
from checks.scene import courtyard, homogeneous

UNIT, RETURNS, CASES, LIMIT = "per cent classified wrong", [("the result", ("N",))], 3, 1.5
N, SIGMA, THRESHOLD = 100, 0.5, 2.0
FLOOR = 15.0


def data(rng):
    scene = courtyard(rng, (4, 8), N)
    xy = scene.xy + rng.normal(0, SIGMA, scene.xy.shape)
    good = np.arange(N) < 0.7 * N
    xy[1, ~good] = rng.uniform((0, 0), (1024, 768), ((~good).sum(), 2))
    calls = []

    def recorded(xy1, xy2):
        calls.append((len(xy1), eight_point(xy1, xy2)))
        return calls[-1][1]

    given = (*xy, THRESHOLD, recorded, np.random.default_rng(1))
    return SimpleNamespace(inputs=given, good=good, calls=calls)


def error(inliers, case):
    return 100 * np.mean(inliers.astype(bool) != case.good)


def ours(case):
    found = thesisrecon.estimate_fundamental(*case.inputs[:2], threshold_px=THRESHOLD)
    return found.inliers


def vector(inliers, _):
    return inliers.astype(float)


def _measures(F, a, b):
    """The distance, and what is taken for it."""
    d, x1, x2 = _sampson(F, a, b), homogeneous(a), homogeneous(b)
    product = np.sum(x2 * (x1 @ F.T), axis=1)
    yield d, None
    yield d**2, "the square of the distance is compared with the threshold"
    yield np.copysign(d, product), "the distance has a sign: take its absolute value"
    yield np.copysign(d, -product), "the distance has a sign, and that of -F: take its absolute value"
    for scale, words in (
        (1, ""),
        (np.linalg.norm(F), ", also with F of unit norm"),
        (F[2, 2], ", with F[2, 2] = 1"),
    ):
        yield np.abs(product / scale), f"x2' F x1 is not a distance{words}: divide it by the root"


def seen(inliers, case):
    """The F that were estimated tell how the matches were chosen."""
    a, b, threshold = case.inputs[:3]
    sizes = {size for size, _ in case.calls}
    if sizes - {7, 8} and len(case.calls) > 20:
        return [f"samples have {max(sizes)} matches, not eight: most hold a wrong one"]
    if all(inliers):
        return []
    if 1 < len(case.calls) < 100:
        return [f"{len(case.calls)} samples are few: often each has a wrong match"]
    masks = {}
    for _, F in case.calls:
        for values, words in _measures(F, a, b):
            masks.setdefault(words, []).append(values < threshold)
    kept = None
    for words, every in masks.items():
        counts = [np.sum(mask) for mask in every]
        same = [k for k, mask in enumerate(every) if np.array_equal(mask, inliers)]
        if any(counts[k] == max(counts) for k in same):
            return [] if words is None else [words]
        if words is None and not any(inliers) and same:
            kept = "sample with fewest inliers"
        elif words is None and len(same) == 1:
            kept = "last sample" if same[-1] == len(counts) - 1 else f"sample {same[0] + 1}"
    return [] if kept is None else [f"the {kept} is kept, not that with most inliers"]


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

"""Checks of the disparities."""

from types import SimpleNamespace

import numpy as np
from PIL import Image
from solutions.disparity import costs

import thesisrecon

UNIT, CASES = "per cent wrong by more than 1 px", 3
RETURNS = [("the result", ("H", "W"))]
COUNT, PENALTY, SIGMA = 16, 8.0, 2.0


def data(rng):
    """A wall before another one, with the texture of an image of the courtyard."""
    grey = Image.open(thesisrecon.sample("courtyard") / "images" / "0005.jpg").convert("L")
    x, y = rng.integers(200, 600), rng.integers(300, 500)
    texture = np.asarray(grey, float)[y : y + 60, x : x + 140]
    d = np.full((60, 140), 4)
    d[15:45, 50:100] = 10
    left = texture[:, :140]
    right = left.copy()
    # Far pixels first: near ones hide them.
    right[:, : 140 - 4] = left[:, 4:]
    right[15:45, 40:90] = left[15:45, 50:100]
    noisy = [one + rng.normal(0, SIGMA, one.shape) for one in (left, right)]
    seen = np.ones(d.shape, bool)
    seen[:, :COUNT] = False
    # Left of the near wall, the far one is hidden in the right image.
    seen[15:45, 44:50] = False
    return SimpleNamespace(inputs=(*noisy, COUNT, PENALTY), d=d, seen=seen)


def error(d, case):
    return 100 * np.mean(np.abs(d - case.d)[case.seen] > 1)


def ours(case):
    left, right, count, _ = case.inputs
    found = thesisrecon.match_rectified(left, right, max_disparity_px=count)
    return np.nan_to_num(np.asarray(found.disparity, float), nan=-9)


def _cost(d, left, right, count, penalty):
    along = np.take_along_axis(costs(left, right, count), d[..., None].astype(int), axis=2)
    return along.sum() + penalty * np.abs(np.diff(d, axis=1)).sum()


def faults(d, case):
    if d.min() < 0 or d.max() >= case.inputs[2]:
        return ["disparities are not from 0 to count - 1"]
    least = _cost(solve(*case.inputs), *case.inputs)  # noqa: F821 - the grader sets it
    above = _cost(d, *case.inputs) > (1 + 1e-9) * least
    if not above:
        return []
    same = (s for s, of in MISTAKES.items() if np.array_equal(of(solve, *case.inputs), d))  # noqa: F821
    return [next(same, "the rows do not have the least sum of costs and penalties")]


def vector(d, case):
    return np.where(case.seen, d, 0).astype(float).ravel()


def _forward_only(_, left, right, count, penalty):
    S = costs(left, right, count)
    jump = penalty * np.abs(np.arange(count)[:, None] - np.arange(count))
    for x in range(1, left.shape[1]):
        S[:, x] += (S[:, x - 1, None, :] + jump).min(axis=2)
    return S.argmin(axis=2)


def _flip(solve, left, right, count, penalty):
    return solve(right[:, ::-1], left[:, ::-1], count, penalty)[:, ::-1]


def _path(S, jump):
    """Disparities of least cost along the second axis."""
    S, came, d = S.copy(), np.zeros(S.shape, int), np.zeros(S.shape[:2], int)
    for x in range(1, S.shape[1]):
        total = S[:, x - 1, None, :] + jump
        came[:, x] = total.argmin(axis=2)
        S[:, x] += total.min(axis=2)
    d[:, -1] = S[:, -1].argmin(axis=1)
    for x in range(S.shape[1] - 1, 0, -1):
        d[:, x - 1] = came[np.arange(len(d)), x, d[:, x]]
    return d


def _columns(_, left, right, count, penalty):
    jump = penalty * np.abs(np.arange(count)[:, None] - np.arange(count))
    return _path(costs(left, right, count).transpose(1, 0, 2), jump).T


def _jumps(of):
    """Another penalty for a difference of two disparities."""
    return lambda solve, left, right, count, penalty: _path(
        costs(left, right, count), penalty * of(np.arange(count)[:, None] - np.arange(count))
    )


def _mirrored(solve, left, right, count, penalty):
    return solve(left[:, ::-1], right[:, ::-1], count, penalty)[:, ::-1]


MISTAKES = {
    "there is no penalty: each pixel takes its least cost": lambda solve, l, r, count, _: costs(
        l, r, count
    ).argmin(axis=2),
    "the backward pass is missing: the forward costs alone do not give the path": _forward_only,
    "left and right are swapped: the left pixel x is at x - d, not x + d": lambda solve, l, r, *rest: solve(
        r, l, *rest
    ),
    "the disparities are those of the right image": _flip,
    "the disparities are larger by 1": lambda solve, *inputs: solve(*inputs) + 1,
    "the disparities are smaller by 1": lambda solve, *inputs: solve(*inputs) - 1,
    "the sign of the disparities is wrong": lambda solve, *inputs: -solve(*inputs),
    "the paths run along columns, not rows": _columns,
    "the cost is that of right(x + d); it is right(x - d)": _mirrored,
    "the penalty is the same for each jump; it is penalty |d - k|": _jumps(lambda d: (d != 0).astype(float)),
    "the penalty grows with the square of d - k; it is penalty |d - k|": _jumps(np.square),
}

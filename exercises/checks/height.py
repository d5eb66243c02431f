"""Checks of single-view heights."""

from types import SimpleNamespace

import numpy as np
from solutions.height import ratio

import thesisrecon
from checks.scene import homogeneous, project

UNIT, RETURNS = "m", [("the result", ("N",))]
N, SIGMA = 30, 0.3


def data(rng):
    """A camera 1.7 m above the ground that looks down by 15 degrees."""
    K = np.array([[900.0, 0, 512], [0, 900, 384], [0, 0, 1]])
    s, c = np.sin(np.radians(15)), np.cos(np.radians(15))
    R = np.array([[1, 0, 0], [0, -s, -c], [0, c, -s]])
    P = K @ np.column_stack([R, R @ [0, 0, -1.7]])
    ground = np.column_stack([rng.uniform(-2, 2, N + 1), rng.uniform(4, 10, N + 1), np.zeros(N + 1)])
    heights = rng.uniform(0.5, 2.5, N + 1)
    ends = project(P, np.stack([ground, ground + heights[:, None] * [0, 0, 1]]))
    # The known segment is exact.
    ends[:, 1:] += rng.normal(0, SIGMA, (2, N, 2))
    (kb, *b), (kt, *t) = ends
    v, l = P[:, 2] * rng.uniform(0.5, 2), np.cross(P[:, 0], P[:, 1]) * 1e-4
    return SimpleNamespace(inputs=(v, l, np.array(b), np.array(t), kb, kt, heights[0]), heights=heights[1:])


def error(z, case):
    return np.sqrt(np.mean((z - case.heights) ** 2))


def ours(case):
    v, l, base, top, kb, kt, known = case.inputs
    found = thesisrecon.single_view_heights(v, l, base, top, reference=np.stack([kb, kt]), height=known)
    return found.height


def vector(z, _):
    return z / max(1, np.abs(z).max() / 100)


def _formula(part):
    """The known height times the ratio of another formula."""

    def wrong(_, v, l, base, top, kb, kt, known):
        return known * part(v, l, base, top) / part(v, l, kb[None], kt[None])

    return wrong


def _norm(x):
    return np.linalg.norm(x, axis=1)


MISTAKES = {
    "the ratio is inverted: alpha is in the denominator": (
        lambda solve, v, l, b, t, kb, kt, known: known**2 / solve(v, l, b, t, kb, kt, known)
    ),
    "alpha is inverted: z is the ratio over alpha": lambda solve, v, l, b, t, kb, kt, known: (
        ratio(v, l, b, t) * ratio(v, l, kb[None], kt[None]) / known
    ),
    "base and top are swapped": _formula(lambda v, l, b, t: ratio(v, l, t, b)),
    "heights are ratios of lengths in pixels: the perspective is missing": _formula(
        lambda v, l, b, t: _norm(b - t)
    ),
    "l' b is missing": _formula(lambda v, l, b, t: ratio(v, l, b, t) * np.abs(homogeneous(b) @ l)),
    "|v x t| is missing": _formula(lambda v, l, b, t: ratio(v, l, b, t) * _norm(np.cross(v, homogeneous(t)))),
    "v is crossed with b, not with t": _formula(
        lambda v, l, b, t: (
            ratio(v, l, b, t) * _norm(np.cross(v, homogeneous(t))) / _norm(np.cross(v, homogeneous(b)))
        )
    ),
    "l is multiplied with t, not with b": _formula(
        lambda v, l, b, t: ratio(v, l, b, t) * np.abs(homogeneous(b) @ l) / np.abs(homogeneous(t) @ l)
    ),
    "the known height is not used": lambda solve, v, l, b, t, kb, kt, known: solve(v, l, b, t, kb, kt, 1.0),
    "the sign is wrong": lambda solve, *inputs: -solve(*inputs),
    "alpha is not used": lambda solve, v, l, b, t, *_: ratio(v, l, b, t),
}

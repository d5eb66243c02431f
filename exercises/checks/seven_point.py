"""Checks of the seven-point algorithm."""

from types import SimpleNamespace

import numpy as np
from grader import up_to_scale
from solutions.homography import normalise

import thesisrecon
from checks.scene import courtyard, epipolar_rms

UNIT, RETURNS, FLOOR, CASES = "px", [("F", ("S", 3, 3))], 1e-3, 8
SCALE = np.diag([500.0, 500.0, 1.0])


def data(rng):
    scene = courtyard(rng, (4, 8), 40)
    return SimpleNamespace(inputs=tuple(scene.xy[:, :7]), exact=scene.xy)


def error(F, case):
    """The best of the solutions: the matches are exact, one of them is right."""
    return min((epipolar_rms(one, *case.exact) for one in F), default=1e3)


def ours(case):
    return thesisrecon.seven_point(*case.inputs)


def vector(F, _):
    return np.array([up_to_scale(SCALE @ one @ SCALE) for one in F]).reshape(-1, 9)


def faults(F, case):
    s = np.linalg.svd(SCALE @ F @ SCALE)[1]
    off = s[:, 2] > 1e-6 * s[:, 0]
    if off.all():
        return ["det F is not 0: the roots are not those of the sum of F1 and F2 that is returned"]
    if off.any():
        return ["the rank of an F is not 2: are complex roots left out?"]
    n = len(ours(case))
    return [] if len(F) == n else [f"{len(F)} solutions are returned; there are {n}"]


def _with(change):
    """The two matrices of the pencil, changed to solutions."""

    def wrong(_, xy1, xy2):
        (x1, T1), (x2, T2) = normalise(xy1), normalise(xy2)
        A = np.einsum("ni,nj->nij", x2, x1).reshape(-1, 9)
        return np.array([T2.T @ F @ T1 for F in change(*np.linalg.svd(A)[2][-2:].reshape(2, 3, 3))])

    return wrong


def _roots(F1, F2):
    a = np.arange(4)
    return np.roots(np.polyfit(a, np.linalg.det(a[:, None, None] * F1 + (1 - a)[:, None, None] * F2), 3))


def _reversed(F1, F2):
    roots = _roots(F1, F2)
    return [F1 / k + (1 - 1 / k) * F2 for k in roots.real[np.abs(roots.imag) < 1e-6]]


def _pencil(first, second, keep=lambda roots: np.abs(roots.imag) < 1e-6):
    def change(F1, F2):
        roots = _roots(F1, F2)
        return [first(k) * F1 + second(k) * F2 for k in roots.real[keep(roots)]]

    return _with(change)


MISTAKES = {
    "F is transposed: in x2' F x1 = 0, image 2 is on the left": lambda solve, a, b: np.swapaxes(
        solve(a, b), 1, 2
    ),
    "det F is not zero: one singular vector is returned, without the cubic": _with(lambda F1, F2: [F2]),
    "the two singular vectors are returned, without the cubic": _with(lambda F1, F2: [F1, F2]),
    "the coefficients of the cubic are in reverse order": _with(_reversed),
    "F1 and F2 are swapped": _pencil(lambda k: 1 - k, lambda k: k),
    "F is a F1 + F2, but the roots are of a F1 + (1 - a) F2": _pencil(lambda k: k, lambda k: 1),
    "complex roots are no solutions": _pencil(
        lambda k: k, lambda k: 1 - k, lambda roots: roots.real < np.inf
    ),
    "only one of the solutions is returned": lambda solve, a, b: solve(a, b)[:1],
    "x and y are swapped": lambda solve, a, b: solve(a[:, ::-1], b[:, ::-1]),
}

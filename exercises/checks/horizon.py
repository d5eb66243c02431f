"""Checks of the vanishing line."""

from types import SimpleNamespace

import numpy as np
from grader import up_to_scale
from solutions.horizon import vanishing_point

import thesisrecon
from checks.scene import divided, homogeneous

UNIT, RETURNS, LIMIT = "mm in the plane", [("H", (3, 3))], 1.5
N, SIGMA = 12, 0.3


def data(rng):
    """Segments of a plane, parallel to its axes."""
    G = np.array([[0.8, -0.3, 150.0], [0.2, 0.7, 60.0], [4e-4, 7e-4, 1.0]])
    G[2, :2] *= rng.uniform(0.7, 1.3, 2)
    start = rng.uniform(100, 900, (2, N, 2))
    ends = np.stack([start, start + rng.uniform(150, 400, (2, N, 1)) * np.eye(2)[:, None]], axis=2)
    exact = divided(homogeneous(ends) @ G.T)
    noise = rng.normal(0, SIGMA, exact.shape)
    return SimpleNamespace(inputs=tuple(exact + noise), exact=exact, plane=ends.reshape(-1, 2))


def error(H, case):
    """RMS distance of the rectified points from those of the plane, up to an affine transformation."""
    found = homogeneous(divided(homogeneous(case.exact.reshape(-1, 2)) @ H.T))
    return np.sqrt(np.mean((found @ np.linalg.lstsq(found, case.plane)[0] - case.plane) ** 2))


def ours(case):
    l = thesisrecon.rectify_plane(case.inputs).vanishing_line
    return np.array([[1, 0, 0], [0, 1, 0], l / l[2]])


def vector(H, _):
    T = np.diag([1e-3, 1e-3, 1])
    return up_to_scale(T @ H @ np.linalg.inv(T))


def faults(H, _):
    return (
        [] if np.allclose(H[:2], np.eye(3)[:2]) else ["the first two rows of H are not [1 0 0] and [0 1 0]"]
    )


def _with(l):
    def wrong(_, a, b):
        v = [vanishing_point(one / 1000) * (1000, 1000, 1) for one in (a, b)]
        line = l(*v)
        return np.array([[1, 0, 0], [0, 1, 0], line / line[2]])

    return wrong


MISTAKES = {
    "H is inverted: it maps the rectified plane to the image": lambda solve, a, b: np.linalg.inv(solve(a, b)),
    "H is transposed: the vanishing line is its last row": lambda solve, a, b: solve(a, b).T,
    "the last row is a vanishing point, not the line": _with(lambda v1, v2: v1),
    "the last row is the second vanishing point, not the line": _with(lambda v1, v2: v2),
    "the vanishing points are added, not crossed": _with(lambda v1, v2: v1 / v1[2] + v2 / v2[2]),
    "only the first two segments of each group are used": lambda solve, a, b: solve(a[:2], b[:2]),
    "x and y are swapped": lambda solve, a, b: solve(a[..., ::-1], b[..., ::-1]),
    "the division by 1000 is not undone in l": lambda solve, a, b: solve(a / 1000, b / 1000),
    "the line is moved back to pixels like a point: divide its x and y by 1000": lambda solve, a, b: (
        np.diag([1, 1, 1]) + (solve(a, b) - np.eye(3)) * 1e6
    ),
}

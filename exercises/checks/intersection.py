"""Checks of points and lines."""

from types import SimpleNamespace

import numpy as np

from checks.scene import divided, homogeneous

UNIT, RETURNS = "px", [("the result", ("N", 2))]


def data(rng):
    """Lines through known points in different directions."""
    x = rng.uniform((0, 0), (1024, 768), (20, 2))
    angle = rng.uniform(0, np.pi, 20)
    angles = np.stack([angle, angle, angle + 1, angle + 1])[..., None]
    away = rng.uniform(50, 300, (4, 20, 1)) * np.concatenate([np.cos(angles), np.sin(angles)], axis=2)
    return SimpleNamespace(inputs=tuple(x + away * np.array([1, -1, 1, -1])[:, None, None]), exact=x)


def error(x, case):
    return np.sqrt(np.mean(np.sum((x - case.exact) ** 2, axis=1)))


def vector(x, _):
    # Far away all intersections are alike.
    return np.ravel(x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e3))


def _cross(a, b, c, d):
    a, b, c, d = (homogeneous(p) for p in (a, b, c, d))
    return np.cross(np.cross(a, b), np.cross(c, d))


MISTAKES = {
    "the point is not divided by its third coordinate": lambda solve, *p: _cross(*p)[:, :2],
    "the point has unit length; divide by its third coordinate": (
        lambda solve, *p: (lambda x: x / np.linalg.norm(x, axis=1, keepdims=True))(_cross(*p))[:, :2]
    ),
    "the lines are ac and bd": lambda solve, a, b, c, d: solve(a, c, b, d),
    "the lines are ad and bc": lambda solve, a, b, c, d: solve(a, d, b, c),
    "x and y are swapped": lambda solve, *p: solve(*p)[:, ::-1],
    "the sign is wrong: divide by the third coordinate itself": lambda solve, *p: -divided(_cross(*p)),
    "the lines are added, not crossed": lambda solve, a, b, c, d: divided(
        np.cross(homogeneous(a), homogeneous(b)) + np.cross(homogeneous(c), homogeneous(d))
    ),
}

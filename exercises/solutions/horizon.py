"""Affine rectification by the vanishing line."""

import numpy as np


def vanishing_point(segments):
    """The point (3,) where segments (N, 2, 2) meet."""
    ends = np.concatenate([segments, np.ones((len(segments), 2, 1))], axis=2)
    lines = np.cross(ends[:, 0], ends[:, 1])
    lines = lines / np.linalg.norm(lines, axis=1, keepdims=True)
    return np.linalg.svd(lines)[2][-1]


def horizon(segments1, segments2):
    """Return H (3, 3) from two groups of parallel segments (N, 2, 2)."""
    v1, v2 = vanishing_point(segments1 / 1000), vanishing_point(segments2 / 1000)
    l = np.cross(v1, v2) / [1000, 1000, 1]
    return np.array([[1, 0, 0], [0, 1, 0], l / l[2]])

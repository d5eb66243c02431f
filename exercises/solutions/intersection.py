"""Lines through points, and points on lines."""

import numpy as np


def intersection(a, b, c, d):
    """Return the pixels (N, 2) where line ab meets line cd."""
    a, b, c, d = (np.column_stack([p, np.ones(len(p))]) for p in (a, b, c, d))
    x = np.cross(np.cross(a, b), np.cross(c, d))
    return x[:, :2] / x[:, 2:]

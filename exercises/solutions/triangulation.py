"""Linear triangulation."""

import numpy as np


def triangulation(P1, P2, xy1, xy2):
    """Return points (N, 3) from two cameras and pixels (N, 2)."""
    points = []
    for (x1, y1), (x2, y2) in zip(xy1, xy2, strict=True):
        rows = [x1 * P1[2] - P1[0], y1 * P1[2] - P1[1], x2 * P2[2] - P2[0], y2 * P2[2] - P2[1]]
        X = np.linalg.svd(np.array(rows))[2][-1]
        points.append(X[:3] / X[3])
    return np.array(points)

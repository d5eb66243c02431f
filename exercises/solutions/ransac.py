"""RANSAC for F."""

import numpy as np


def sampson(F, xy1, xy2):
    """Sampson distances (N,) of matches, px."""
    x1, x2 = (np.column_stack([xy, np.ones(len(xy))]) for xy in (xy1, xy2))
    l2, l1 = x1 @ F.T, x2 @ F
    return np.abs(np.sum(x2 * l2, axis=1)) / np.sqrt(np.sum(l2[:, :2] ** 2 + l1[:, :2] ** 2, axis=1))


def ransac(xy1, xy2, threshold, eight_point, rng):
    """Return which matches are inliers."""
    best = np.zeros(len(xy1), bool)
    for _ in range(500):
        some = rng.choice(len(xy1), 8, replace=False)
        inliers = sampson(eight_point(xy1[some], xy2[some]), xy1, xy2) < threshold
        if inliers.sum() > best.sum():
            best = inliers
    return best

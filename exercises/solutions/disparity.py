"""Scanline dynamic programming, all rows at once."""

import numpy as np


def costs(left, right, count):
    """C (H, W, count)."""
    C = np.full((*left.shape, count), 100.0)
    for d in range(count):
        C[:, d:, d] = np.abs(left[:, d:] - right[:, : left.shape[1] - d])
    return C


def disparity(left, right, count, penalty):
    """Return disparities (H, W)."""
    S, width = costs(left, right, count), left.shape[1]
    jump = penalty * np.abs(np.arange(count)[:, None] - np.arange(count))
    came = np.zeros(S.shape, int)
    for x in range(1, width):
        total = S[:, x - 1, None, :] + jump
        came[:, x] = total.argmin(axis=2)
        S[:, x] += total.min(axis=2)
    d = np.zeros(left.shape, int)
    d[:, -1] = S[:, -1].argmin(axis=1)
    for x in range(width - 1, 0, -1):
        d[:, x - 1] = came[np.arange(len(d)), x, d[:, x]]
    return d

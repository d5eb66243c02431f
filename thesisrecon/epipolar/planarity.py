"""How much of a pair one homography explains: a plane, or a camera that only turned."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.epipolar.certainty.kernels import count_transferred
from thesisrecon.geometry.homogeneous import cross_matrix, homogenize
from thesisrecon.geometry.multiview import epipoles, estimate_homography, homography_residuals, unit_norm

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

SAMPLES, SUBSET = 200, 200
"""Homographies tried, and matches they are judged on: a plane of a quarter of them is found with 96 %."""


def plane_homographies(F: F64, xy1: F64, xy2: F64, triples: I64) -> F64:
    """Homographies of the planes through three matches each, given F; triples (S, 3) -> (S', 3, 3).

    H = A - e2 (M^-1 b)', A = [e2]x F (HZ, result 13.6). Triples on a line are left out.
    """
    _, e2 = epipoles(F)
    A = cross_matrix(e2) @ unit_norm(F)
    x1, x2 = homogenize(xy1), homogenize(xy2)
    away = np.cross(x2, e2)
    b = np.sum(np.cross(x2, x1 @ A.T) * away, axis=1) / np.maximum(np.sum(away**2, axis=1), 1e-300)
    M = x1[triples]
    area, size = np.abs(np.linalg.det(M)), np.ptp(xy1, axis=0).max()
    usable = area > 1e-4 * size**2
    v = np.linalg.solve(M[usable], b[triples[usable]][..., None])[..., 0]
    return A - e2[:, None] * v[:, None, :]


def homography_share(F: F64, xy1: F64, xy2: F64, *, tolerance_px: float, rng: Generator) -> float:
    """Share of matches (N, 2) px that one homography takes to within ``tolerance_px`` in image 2.

    The matches agree with F, so three of them give a homography; the best of the sampled ones is fitted again
    to all its matches until they stay the same. 1 for fewer than 5 matches, which always have one.
    """
    n = len(xy1)
    if n < 5:
        return 1.0
    chosen = rng.permutation(n)[:SUBSET]
    triples = np.argsort(rng.random((SAMPLES, min(len(chosen), 50))), axis=1)[:, :3]
    offsets = rng.integers(0, len(chosen), (SAMPLES, 1))
    triples = chosen[(triples + offsets) % len(chosen)]
    planes = plane_homographies(F, xy1, xy2, triples)
    if not len(planes):
        return _refit_share(np.eye(3), xy1, xy2, tolerance_px)
    counts = count_transferred(planes, xy1[chosen], xy2[chosen], tolerance_px)
    best = planes[int(np.argmax(counts))]
    return _refit_share(best, xy1, xy2, tolerance_px)


def _refit_share(H: F64, xy1: F64, xy2: F64, tolerance_px: float) -> float:
    inside = homography_residuals(H, xy1, xy2) < tolerance_px
    for _ in range(5):
        points1, points2 = xy1[inside], xy2[inside]
        if len(points1) < 5 or not (np.ptp(points1, axis=0).any() and np.ptp(points2, axis=0).any()):
            break
        again = homography_residuals(estimate_homography(points1, points2), xy1, xy2) < tolerance_px
        if again.sum() <= inside.sum():
            break
        inside = again
    return float(inside.mean())

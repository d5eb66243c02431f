"""Whether a homography is that of a camera that turned: K R K^-1 with square pixels (HZ 13.2, 19.6)."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.geometry.multiview import homography_distances
from thesisrecon.optimize.levenberg_marquardt import minimize_residuals

F64 = NDArray[np.float64]

FOCALS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Tried focal lengths, in spreads of the points: fields of view of 150 to 10 degrees."""
REFINED = 3
CONSTRAINTS = 2
"""A homography has 8 degrees of freedom; a rotation, a focal length and a principal point 6."""
ITERATIONS = 50


def turned_camera(parameters: F64) -> F64:
    """K R K^-1 (3, 3) of log f, principal point and rotation vector (6,)."""
    f, (x, y) = float(np.exp(np.clip(parameters[0], -20.0, 20.0))), parameters[1:3]
    K = np.array([[f, 0.0, x], [0.0, f, y], [0.0, 0.0, 1.0]])
    back = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, f]]) / f
    H: F64 = K @ scipy.spatial.transform.Rotation.from_rotvec(parameters[3:]).as_matrix() @ back
    return H


def turning_ratio(H: F64, xy1: F64, xy2: F64, *, risk: float) -> float:
    """Increase of the squared residuals from H to the best K R K^-1, over the limit that noise keeps to.

    ``H`` (3, 3) is the least-squares homography of matches (N > 4, 2) in coordinates about one centre for
    both images and of unit spread. An F-test with 2 and 2 N - 8 degrees of freedom: at most 1 for a camera of
    square pixels that only turned, except with the probability ``risk``.
    """

    def residuals(parameters: F64) -> F64:
        return homography_distances(turned_camera(parameters), xy1, xy2).ravel()

    starts = [_start(H, f) for f in FOCALS]
    costs = [float(np.sum(residuals(start) ** 2)) for start in starts]
    rss = float(np.sum(homography_distances(H, xy1, xy2) ** 2))
    degrees = 2 * len(xy1) - 8
    limit = (
        CONSTRAINTS * float(scipy.special.fdtri(CONSTRAINTS, degrees, 1.0 - risk)) * max(rss, 1e-24) / degrees
    )
    ratio = np.inf
    for k in np.argsort(costs, kind="stable")[:REFINED]:
        if np.isfinite(costs[k]):
            found = minimize_residuals(residuals, starts[k], max_iterations=ITERATIONS, tolerance=1e-8)
            ratio = min(ratio, (2.0 * found.cost - rss) / limit)
        if ratio <= 1.0:
            break
    return ratio


def _start(H: F64, f: float) -> F64:
    """The rotation nearest to K^-1 H K for a focal length and the principal point at the centre."""
    A = H * np.array([[1.0, 1.0, 1.0 / f], [1.0, 1.0, 1.0 / f], [f, f, 1.0]])
    A = A * np.sign(np.linalg.det(A))
    U, _, Vt = np.linalg.svd(A)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.array([np.log(f), 0.0, 0.0, *scipy.spatial.transform.Rotation.from_matrix(R).as_rotvec()])

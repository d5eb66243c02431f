"""The covariance gate: is a resected camera determined, or does it only fit?

A camera that sees a single plane fits its points at sub-pixel residual with an arbitrary P. What tells is the
covariance of P: where it would put points of the *whole* scene, not only those it sees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def predicted_spread_px(P: F64, covariance: F64, X: F64) -> F64:
    """Standard deviation (px) of the projection of each point under the camera's covariance.

    P (3, 4), covariance (12, 12) of its row-major entries, X (N, 4) -> (N,): root of half the trace of J C
    J'. Points near the camera's principal plane come out infinite.
    """
    xh = X @ P.T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = xh[:, :2] / xh[:, 2:]
        A = X / xh[:, 2:]
    blocks = covariance.reshape(3, 4, 3, 4)
    quadratic = np.einsum("na,rasb,nb->nrs", A, blocks, A)
    var_u = quadratic[:, 0, 0] - 2 * uv[:, 0] * quadratic[:, 0, 2] + uv[:, 0] ** 2 * quadratic[:, 2, 2]
    var_v = quadratic[:, 1, 1] - 2 * uv[:, 1] * quadratic[:, 1, 2] + uv[:, 1] ** 2 * quadratic[:, 2, 2]
    spread = np.sqrt(np.maximum((var_u + var_v) / 2.0, 0.0))
    return np.where(np.isfinite(spread), spread, np.inf)

"""Robust losses rho(s) of a squared residual s, and their weights rho'(s).

The cost of residuals r is 1/2 sum rho(|r|^2); solvers multiply residuals and Jacobians by sqrt(rho').
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64


def huber(s: F64, delta: float) -> tuple[F64, F64]:
    """Compute rho = s below delta^2, 2 delta sqrt(s) - delta^2 above (Huber 1964); convex.

    Parameters
    ----------
    s, delta : ndarray, float
        Squared residuals, and turning point.

    Returns
    -------
    rho, weight : ndarray
        Loss and its derivative.
    """
    root = np.sqrt(np.maximum(s, delta**2))
    inside = s <= delta**2
    return np.where(inside, s, 2.0 * delta * root - delta**2), np.where(inside, 1.0, delta / root)


def soft_l1(s: F64, delta: float) -> tuple[F64, F64]:
    """Compute rho = 2 delta^2 (sqrt(1 + s / delta^2) - 1), the smooth relative of Huber's loss; convex.

    Parameters
    ----------
    s, delta : ndarray, float
        As in :func:`huber`.

    Returns
    -------
    rho, weight : ndarray
        Loss and its derivative.
    """
    root = np.sqrt(1.0 + s / delta**2)
    return 2.0 * delta**2 * (root - 1.0), 1.0 / root

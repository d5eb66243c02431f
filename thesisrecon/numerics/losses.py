"""Robust losses rho(s) of a squared residual s, and their weights rho'(s).

The cost of residuals r is 1/2 sum rho(|r|^2); solvers multiply residuals and Jacobians by sqrt(rho'). Each
loss is s near 0 and turns at sqrt(s) = delta.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from thesisrecon.arrays import F64

LossName = Literal["squared", "huber", "soft_l1", "cauchy"]


def _squared(s: F64, delta: float) -> tuple[F64, F64]:  # noqa: ARG001 - one signature for all losses
    """Return rho = s, least squares; ``delta`` has no effect."""
    return s, np.ones_like(s)


def _huber(s: F64, delta: float) -> tuple[F64, F64]:
    """Return rho = s below delta^2, 2 delta sqrt(s) - delta^2 above (Huber 1964); convex."""
    root = np.sqrt(np.maximum(s, delta**2))
    inside = s <= delta**2
    return np.where(inside, s, 2.0 * delta * root - delta**2), np.where(inside, 1.0, delta / root)


def soft_l1(s: F64, delta: float) -> tuple[F64, F64]:
    """Compute rho = 2 delta^2 (sqrt(1 + s / delta^2) - 1), the smooth relative of Huber's loss; convex.

    Parameters
    ----------
    s : ndarray
        Squared residuals.
    delta : float
        Turning point.

    Returns
    -------
    rho, weight : ndarray
        Loss and its derivative.
    """
    root = np.sqrt(1.0 + s / delta**2)
    return 2.0 * delta**2 * (root - 1.0), 1.0 / root


def _cauchy(s: F64, delta: float) -> tuple[F64, F64]:
    """Return rho = delta^2 log(1 + s / delta^2); not convex, needs a good start."""
    ratio = s / delta**2
    return delta**2 * np.log1p(ratio), 1.0 / (1.0 + ratio)


LOSSES: dict[str, Callable[[F64, float], tuple[F64, F64]]] = {
    "squared": _squared, "huber": _huber, "soft_l1": soft_l1, "cauchy": _cauchy,
}  # fmt: skip
LOSS_CODES = {name: code for code, name in enumerate(LOSSES)}


def loss_code(loss: str, delta: float) -> int:
    """Return the number of a loss in the compiled kernels.

    Parameters
    ----------
    loss : str
        Name in :data:`LOSSES`.
    delta : float
        Turning point.

    Returns
    -------
    int
        Number of the loss.

    Raises
    ------
    ValueError
        If the name is unknown or the turning point is not positive.
    """
    if loss not in LOSS_CODES:
        raise ValueError(f"loss must be one of {', '.join(LOSS_CODES)}; got {loss!r}")
    if not delta > 0:
        raise ValueError(f"the scale of a robust loss must be positive; got {delta}")
    return LOSS_CODES[loss]

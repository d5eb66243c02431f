"""Robust losses rho(s) of a squared residual s, and their weights rho'(s).

The cost of residuals r is 1/2 sum rho(|r|^2). Its gradient is that of a least-squares problem whose residuals
and Jacobians are multiplied by sqrt(rho'); all solvers here use this reweighting, which leaves out rho'' and
keeps the system positive. Each loss is s near 0 and turns at sqrt(s) = delta. The compiled functions take a
number of :data:`LOSS_CODES`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from numba import njit

from thesisrecon.arrays import F64

LossName = Literal["squared", "huber", "soft_l1", "cauchy", "truncated"]
LossFunction = Callable[[F64, float], tuple[F64, F64]]


def _squared(s: F64, delta: float) -> tuple[F64, F64]:  # noqa: ARG001 - one signature for all losses
    """Return rho = s, least squares; ``delta`` has no effect."""
    return s, np.ones_like(s)


def _huber(s: F64, delta: float) -> tuple[F64, F64]:
    """Return rho = s below delta^2, 2 delta sqrt(s) - delta^2 above (Huber 1964); convex."""
    root = np.sqrt(np.maximum(s, delta**2))
    inside = s <= delta**2
    return np.where(inside, s, 2.0 * delta * root - delta**2), np.where(inside, 1.0, delta / root)


def soft_l1(s: F64, delta: float) -> tuple[F64, F64]:
    """Return rho = 2 delta^2 (sqrt(1 + s / delta^2) - 1), the smooth relative of Huber's loss; convex.

    Parameters
    ----------
    s : ndarray, squared residuals
    delta : float, turning point

    Returns
    -------
    rho, weight : ndarray, loss and its derivative
    """
    root = np.sqrt(1.0 + s / delta**2)
    return 2.0 * delta**2 * (root - 1.0), 1.0 / root


def _cauchy(s: F64, delta: float) -> tuple[F64, F64]:
    """Return rho = delta^2 log(1 + s / delta^2); not convex, needs a good start."""
    ratio = s / delta**2
    return delta**2 * np.log1p(ratio), 1.0 / (1.0 + ratio)


def _truncated(s: F64, delta: float) -> tuple[F64, F64]:
    """Return rho = min(s, delta^2), the score of MSAC (Torr and Zisserman 2000)."""
    return np.minimum(s, delta**2), np.where(s <= delta**2, 1.0, 0.0)


LOSSES: dict[str, LossFunction] = {
    "squared": _squared,
    "huber": _huber,
    "soft_l1": soft_l1,
    "cauchy": _cauchy,
    "truncated": _truncated,
}
LOSS_CODES = {name: code for code, name in enumerate(LOSSES)}


def loss_code(loss: str, delta: float) -> int:
    """Return the number of a loss in the compiled kernels.

    Parameters
    ----------
    loss : str, name in :data:`LOSSES`
    delta : float, turning point

    Returns
    -------
    int, number

    Raises
    ------
    ValueError
        The name is unknown or the turning point is not positive.
    """
    if loss not in LOSS_CODES:
        raise ValueError(f"loss must be one of {', '.join(LOSS_CODES)}; got {loss!r}")
    if not delta > 0:
        raise ValueError(f"the scale of a robust loss must be positive; got {delta}")
    return LOSS_CODES[loss]


@njit(cache=True, nogil=True, inline="always")
def loss_value(code: int, s: float, delta: float) -> float:
    """Evaluate rho(s).

    Parameters
    ----------
    code : int, number of the loss
    s : float, squared residual
    delta : float, turning point

    Returns
    -------
    float, loss
    """
    d2 = delta * delta
    if code == 1:
        return s if s <= d2 else 2.0 * delta * math.sqrt(s) - d2
    if code == 2:
        return 2.0 * d2 * (math.sqrt(1.0 + s / d2) - 1.0)
    if code == 3:
        return d2 * math.log1p(s / d2)
    if code == 4:
        return min(s, d2)
    return s


@njit(cache=True, nogil=True, inline="always")
def loss_weight(code: int, s: float, delta: float) -> float:
    """Evaluate rho'(s).

    Parameters
    ----------
    code : int, number of the loss
    s : float, squared residual
    delta : float, turning point

    Returns
    -------
    float, weight
    """
    d2 = delta * delta
    if code == 1:
        return 1.0 if s <= d2 else delta / math.sqrt(s)
    if code == 2:
        return 1.0 / math.sqrt(1.0 + s / d2)
    if code == 3:
        return 1.0 / (1.0 + s / d2)
    if code == 4:
        return 1.0 if s <= d2 else 0.0
    return 1.0


@njit(cache=True, nogil=True, inline="always")
def loss_curvature(code: int, s: float, delta: float) -> float:
    """Evaluate 1 + 2 s rho'' / rho', the fraction of the curvature along a residual that its loss leaves.

    Parameters
    ----------
    code : int, number of the loss
    s : float, squared residual
    delta : float, turning point

    Returns
    -------
    float, fraction <= 1
    """
    u = s / (delta * delta)
    if code == 1:
        return 1.0 if u <= 1.0 else 0.0
    if code == 2:
        return 1.0 / (1.0 + u)
    if code == 3:
        return (1.0 - u) / (1.0 + u)
    return 1.0

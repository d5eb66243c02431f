"""Robust losses rho(s) of a squared residual s and their weights rho'(s).

The cost of a set of residuals r is 1/2 sum rho(|r|^2). Its gradient is that of a least-squares problem whose
residuals and Jacobians are multiplied by sqrt(rho'), which is how every solver here uses them (reweighting;
the second derivative of rho is left out, so the system stays positive). Each loss behaves as s near 0 and
turns where sqrt(s) = delta.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
LossName = Literal["squared", "huber", "soft_l1", "cauchy", "truncated"]
LossFunction = Callable[[F64, float], tuple[F64, F64]]


def squared(s: F64, delta: float) -> tuple[F64, F64]:  # noqa: ARG001 - one signature for all losses
    """rho = s: least squares; ``delta`` has no effect."""
    return s, np.ones_like(s)


def huber(s: F64, delta: float) -> tuple[F64, F64]:
    """rho = s below delta^2, 2 delta sqrt(s) - delta^2 above (Huber 1964); convex."""
    root = np.sqrt(np.maximum(s, delta**2))
    inside = s <= delta**2
    return np.where(inside, s, 2.0 * delta * root - delta**2), np.where(inside, 1.0, delta / root)


def soft_l1(s: F64, delta: float) -> tuple[F64, F64]:
    """rho = 2 delta^2 (sqrt(1 + s / delta^2) - 1): the smooth relative of Huber's loss; convex."""
    root = np.sqrt(1.0 + s / delta**2)
    return 2.0 * delta**2 * (root - 1.0), 1.0 / root


def cauchy(s: F64, delta: float) -> tuple[F64, F64]:
    """rho = delta^2 log(1 + s / delta^2): outliers lose their pull; not convex, needs a good start."""
    ratio = s / delta**2
    return delta**2 * np.log1p(ratio), 1.0 / (1.0 + ratio)


def truncated(s: F64, delta: float) -> tuple[F64, F64]:
    """rho = min(s, delta^2): outliers have no pull at all (the score of MSAC, Torr and Zisserman 2000)."""
    return np.minimum(s, delta**2), np.where(s <= delta**2, 1.0, 0.0)


LOSSES: dict[str, LossFunction] = {
    "squared": squared,
    "huber": huber,
    "soft_l1": soft_l1,
    "cauchy": cauchy,
    "truncated": truncated,
}
LOSS_CODES = {name: code for code, name in enumerate(LOSSES)}


def loss_code(loss: str, delta: float) -> int:
    """The number by which the compiled kernels know a loss.

    Raises ``ValueError`` for an unknown name or a scale that is not positive.
    """
    if loss not in LOSS_CODES:
        raise ValueError(f"loss must be one of {', '.join(LOSS_CODES)}; got {loss!r}")
    if not delta > 0:
        raise ValueError(f"the scale of a robust loss must be positive; got {delta}")
    return LOSS_CODES[loss]

"""Robust losses."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from numba import njit

from thesisrecon.arrays import F64

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


@njit(cache=True, nogil=True, inline="always")
def loss_value(code: int, s: float, delta: float) -> float:
    """rho(s) of the losses of losses.py, numbered in its order."""
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
    """rho'(s)."""
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
    """1 + 2 s rho'' / rho': how much of the curvature along a residual its loss leaves."""
    u = s / (delta * delta)
    if code == 1:
        return 1.0 if u <= 1.0 else 0.0
    if code == 2:
        return 1.0 / (1.0 + u)
    if code == 3:
        return (1.0 - u) / (1.0 + u)
    return 1.0

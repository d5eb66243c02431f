"""Section 5.4: the standard deviation of the noise from residuals that hold wrong matches too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

MAD_FACTOR = 1.4826022185056018
"""1 / Phi^-1(0.75): the thesis' text divides by Phi(0.75), which is not consistent."""


def noise_scale(residuals: F64, *, parameters: int = 7) -> float:
    """Robust standard deviation 1.4826 (1 + 5 / (n - p)) median |r| of residuals with mean 0.

    ``residuals`` (N,), of any sign, ``parameters`` the p degrees of freedom that were fitted to them
    (Rousseeuw and Leroy 1987; Torr and Murray, IJCV 1997). Breaks down where half of the residuals are wrong.
    Raises ``ValueError`` where N <= p, since nothing is left to estimate from, and for residuals that are not
    finite.
    """
    n = len(residuals)
    if n <= parameters:
        raise ValueError(f"noise_scale needs more than {parameters} residuals; got {n}")
    if not np.isfinite(residuals).all():
        raise ValueError("noise_scale needs finite residuals")
    return float(MAD_FACTOR * (1.0 + 5.0 / (n - parameters)) * np.median(np.abs(residuals)))

"""The weights of an interpolation, for the loops that read images between their pixels."""

from __future__ import annotations

from typing import Any

from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def cubic_weights(share: float, weights: NDArray[Any]) -> None:
    """Weights of four pixels at ``share`` in [0, 1] between the second and third: Keys 1981, a = -1/2.

    Keys, "Cubic convolution interpolation for digital image processing", IEEE Transactions on Acoustics,
    Speech, and Signal Processing 29, 1981. ``weights`` is overwritten; it may have more places.
    """
    weights[0] = ((-0.5 * share + 1.0) * share - 0.5) * share
    weights[1] = (1.5 * share - 2.5) * share * share + 1.0
    weights[2] = ((-1.5 * share + 2.0) * share + 0.5) * share
    weights[3] = (0.5 * share - 0.5) * share * share

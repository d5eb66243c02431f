"""The front door of dense matching."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.dense.matching.semi_global import CohesiveScanlines
from thesisrecon.types import DisparityMap


class PairMatcher(Protocol):
    """A variant of dense matching: :class:`CohesiveScanlines`, :class:`SemiGlobal`,
    :class:`MaximumLikelihoodScanline`."""

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Disparities of the left image in the range, both ends included."""
        ...


def match_rectified(
    left: ArrayLike, right: ArrayLike, *, max_disparity_px: float, config: PairMatcher | None = None
) -> DisparityMap:
    """Disparities of a rectified pair of parallel cameras.

    Parameters
    ----------
    left, right
        (H, W) or (H, W, 3) grey levels 0 .. 255, integer or floating, NaN = no pixel; rows correspond.
    max_disparity_px
        Of the nearest thing. The search is over 0 .. ceil(max_disparity_px).
    config
        The variant, :class:`CohesiveScanlines` where None.

    Returns
    -------
    DisparityMap
        x_right = x_left - d, NaN = unknown or hidden.

    Raises
    ------
    ValueError
        Images of different or impossible shape; a disparity that is negative or no number.
    """
    if not 0.0 <= max_disparity_px < np.inf:
        raise ValueError(f"max_disparity_px must be a number from 0 on; got {max_disparity_px}")
    matcher = CohesiveScanlines() if config is None else config
    return matcher.match(left, right, disparity_range=(0, int(np.ceil(max_disparity_px))))

"""Chapter 5: the fundamental matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.types import FundamentalFit

__all__ = ["LocallyOptimisedRansac", "estimate_fundamental"]


def estimate_fundamental(
    xy1: NDArray[np.float64], xy2: NDArray[np.float64], *, threshold_px: float = 1.0, seed: int = 0
) -> FundamentalFit:
    """Robust F of matches xy1, xy2 (N >= 8, 2) px with x2' F x1 = 0: :class:`LocallyOptimisedRansac` as it comes.

    The same seed gives the same answer. Raises ``ValueError`` for a wrong call and
    :class:`~thesisrecon.errors.StageFailure` for matches that determine no F.
    """
    return LocallyOptimisedRansac(threshold_px=threshold_px).estimate(xy1, xy2, np.random.default_rng(seed))

"""Chapter 5: the fundamental matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.least_median import LeastMedianOfSquares
from thesisrecon.epipolar.linear import estimate_eight_point, estimate_seven_point
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.refinement import (
    refine_epipolar_distance,
    refine_gradient,
    refine_reprojection,
)
from thesisrecon.epipolar.thesis_ransac import ThesisRansac
from thesisrecon.epipolar.trifocal_estimation import TrifocalFit, estimate_trifocal, refine_trifocal
from thesisrecon.epipolar.trifocal_ransac import RobustTrifocal, TrifocalRansac
from thesisrecon.epipolar.verification import PairVerification
from thesisrecon.types import FundamentalFit

__all__ = [
    "LeastMedianOfSquares",
    "LocallyOptimisedRansac",
    "PairVerification",
    "RobustTrifocal",
    "ThesisRansac",
    "TrifocalFit",
    "TrifocalRansac",
    "estimate_eight_point",
    "estimate_fundamental",
    "estimate_seven_point",
    "estimate_trifocal",
    "refine_epipolar_distance",
    "refine_gradient",
    "refine_reprojection",
    "refine_trifocal",
]


def estimate_fundamental(
    xy1: NDArray[np.float64], xy2: NDArray[np.float64], *, threshold_px: float = 1.0, seed: int = 0
) -> FundamentalFit:
    """Robust F of matches xy1, xy2 (N >= 8, 2) px, x2' F x1 = 0, by :class:`LocallyOptimisedRansac`.

    The same seed gives the same answer. Raises ``ValueError`` for a wrong call and
    :class:`~thesisrecon.errors.StageFailure` for matches that determine no F.
    """
    return LocallyOptimisedRansac(threshold_px=threshold_px).estimate(xy1, xy2, np.random.default_rng(seed))

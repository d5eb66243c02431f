"""Chapter 5: the fundamental matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.certainty import judge_certainty
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
    "judge_certainty",
    "refine_epipolar_distance",
    "refine_gradient",
    "refine_reprojection",
    "refine_trifocal",
]


def estimate_fundamental(
    xy1: NDArray[np.float64],
    xy2: NDArray[np.float64],
    *,
    threshold_px: float = 1.0,
    seed: int = 0,
    judge: bool = False,
) -> FundamentalFit:
    """Robust F of matches xy1, xy2 (N >= 8, 2) px, x2' F x1 = 0, by :class:`LocallyOptimisedRansac`.

    With ``judge`` the fit says whether the matches determine it, by
    :func:`~thesisrecon.epipolar.certainty.judge_certainty`: many inliers alone do not.
    The same seed gives the same answer. Raises ``ValueError`` for a wrong call and
    :class:`~thesisrecon.errors.StageFailure` for matches that determine no F.
    """
    rng = np.random.default_rng(seed)
    fit = LocallyOptimisedRansac(threshold_px=threshold_px).estimate(xy1, xy2, rng)
    return replace(fit, certainty=judge_certainty(fit, xy1, xy2, rng=rng)) if judge else fit

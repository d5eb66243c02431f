"""Chapter 5: the fundamental matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.records import FundamentalFit


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
    :func:`~thesisrecon.epipolar.degeneracy.assess_degeneracy`: many inliers alone do not.
    The same seed gives the same answer. Raises ``ValueError`` for a wrong call and
    :class:`~thesisrecon.errors.StageFailure` for matches that determine no F.
    """
    rng = np.random.default_rng(seed)
    fit = LocallyOptimisedRansac(threshold_px=threshold_px).estimate(xy1, xy2, rng)
    return replace(fit, degeneracy=assess_degeneracy(fit, xy1, xy2, rng=rng)) if judge else fit

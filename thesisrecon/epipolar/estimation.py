"""The fundamental matrix by any method of chapter 5, with its noise, covariance and degeneracy test."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar._degeneracy import assess_degeneracy
from thesisrecon.epipolar._frame import PairFrame, check_matches
from thesisrecon.epipolar.criteria import fundamental_covariance
from thesisrecon.errors import StageFailure
from thesisrecon.records import DegeneracyReport, FundamentalFit

Method = Literal[
    "locally-optimised", "ransac", "least-median", "gold-standard", "eight-point", "seven-point"
]  # fmt: skip
# The solutions of the seven-point algorithm fit their matches exactly.
MIN_TESTED = 8


@dataclass(frozen=True)
class FundamentalEstimate(FundamentalFit):
    """An estimate of F with its matches, and whether they determine it, tested when it is first read.

    Parameters
    ----------
    xy1, xy2 : ndarray (M, 2)
        The matches, px.
    """

    xy1: NDArray[np.float64] = field(kw_only=True, repr=False)
    xy2: NDArray[np.float64] = field(kw_only=True, repr=False)

    @cached_property
    def degeneracy(self) -> DegeneracyReport:
        """The test of section 5.5 with its evidence; the same for the same matches and F."""
        if len(self.xy1) < MIN_TESTED:
            return DegeneracyReport(False, (f"{len(self.xy1)} matches are too few to test F",))
        return assess_degeneracy(self, self.xy1, self.xy2, rng=np.random.default_rng(0))

    @property
    def determined(self) -> bool:
        """Whether the matches determine F; many inliers alone do not show it."""
        return self.degeneracy.determined

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the matches do not determine F, in sentences; empty if they do."""
        return self.degeneracy.reasons


def fit_all(xy1: NDArray[np.float64], xy2: NDArray[np.float64], *, refined: bool) -> FundamentalFit:
    """Estimate F from all matches; arguments as for :func:`thesisrecon.estimate_fundamental`."""
    from thesisrecon.epipolar.linear import estimate_eight_point
    from thesisrecon.epipolar.ransac import discard_outliers
    from thesisrecon.epipolar.refinement import refine_fundamental

    xy1, xy2 = check_matches(xy1, xy2, needed=8)
    F = estimate_eight_point(xy1, xy2)
    F = refine_fundamental(F, xy1, xy2, "reprojection") if refined else F
    sigma, inliers = discard_outliers(F, xy1, xy2)
    frame = PairFrame.of(xy1, xy2)
    points = frame.points(xy1[inliers], xy2[inliers])
    covariance = fundamental_covariance(frame, frame.matrix_in_frame(F), points, sigma * frame.scale)
    return FundamentalFit(F, inliers, sigma, covariance)


def fit_seven(xy1: NDArray[np.float64], xy2: NDArray[np.float64]) -> FundamentalFit:
    """Estimate F of seven matches; see :func:`thesisrecon.estimate_fundamental`."""
    from thesisrecon.epipolar.linear import estimate_seven_point

    solutions = estimate_seven_point(xy1, xy2)
    if not len(solutions):
        raise StageFailure(
            "the seven matches do not determine the fundamental matrix",
            "their equations are dependent",
            "choose seven matches in general position, no four of them in one plane of the scene",
        )
    nan = float("nan")
    every = np.ones(len(xy1), dtype=bool)
    return FundamentalFit(solutions[0], every, nan, np.full((9, 9), nan), 0, solutions[1:])

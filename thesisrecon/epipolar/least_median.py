"""Section 5.4: least median of squares, which needs no threshold but fewer than half of wrong matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.epipolar.covariance import fundamental_covariance
from thesisrecon.epipolar.frame import PairFrame, check_matches
from thesisrecon.epipolar.outliers import MINIMUM, discard_outliers
from thesisrecon.epipolar.refinement import refine_gradient
from thesisrecon.epipolar.thesis_ransac import SevenPointProblem
from thesisrecon.errors import StageFailure
from thesisrecon.robust.kernels import draw_sample
from thesisrecon.types import FundamentalFit

F64 = NDArray[np.float64]

NEAR_SIGMAS = 2.5
"""The median of the last rounds is over matches this near, since that over all grows with the wrong ones."""


@dataclass(frozen=True)
class LeastMedianOfSquares:
    """The F of ``samples`` samples of seven whose median squared Sampson distance is the least.

    Then sigma = 1.4826 (1 + 5 / (n - 7)) sqrt(median) and ``rounds`` times: discard what lies beyond the 95 %
    limit, minimise the gradient criterion (5.4) over the rest, estimate sigma of those near (Rousseeuw 1984;
    Zhang, IJCV 1998). 900 samples hold one free of outliers with 99.9 % where half of the matches are wrong;
    with more than half wrong the median is of wrong matches and the answer means nothing.
    """

    samples: int = 900
    rounds: int = 2

    def __post_init__(self) -> None:
        if min(self.samples, self.rounds) < 1:
            raise ValueError(f"a search needs samples and rounds of 1; got {self.samples}, {self.rounds}")

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """F of matches (N >= 8, 2) px; raises as
        :meth:`~thesisrecon.epipolar.locally_optimised.LocallyOptimisedRansac.estimate`."""
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        found = self._search(points, rng)
        if found is None:
            raise StageFailure(
                "no epipolar geometry explains the matches",
                f"none of {self.samples} samples of seven of {len(xy1)} matches determines one",
                "the matches may be repeated or lie on few points",
            )
        F = frame.matrix_in_pixels(found)
        sigma, inliers = discard_outliers(F, xy1, xy2)
        for _ in range(self.rounds):
            F = refine_gradient(F, xy1[inliers], xy2[inliers])
            sigma, inliers = discard_outliers(F, xy1, xy2, limit_px=NEAR_SIGMAS * sigma)
        covariance = fundamental_covariance(
            frame, frame.matrix_in_frame(F), points[inliers], sigma * frame.scale
        )
        return FundamentalFit(F, inliers, sigma, covariance, self.samples)

    def _search(self, points: F64, rng: Generator) -> F64 | None:
        problem, sample = SevenPointProblem(points), np.empty(7, dtype=np.int64)
        best, best_median, middle = None, np.inf, len(points) // 2
        for _ in range(self.samples):
            draw_sample(rng.random(7), len(points), sample)
            for f in problem.solve(sample):
                median = np.partition(problem.residuals(f), middle)[middle]
                if median < best_median:
                    best, best_median = f.copy(), median
        return best

"""Algorithm 2 of the thesis: seven-point samples, the most inliers, then the gradient criterion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.epipolar.covariance import fundamental_covariance
from thesisrecon.epipolar.frame import PairFrame, check_matches
from thesisrecon.epipolar.kernels import sampson_distances, seven_point
from thesisrecon.epipolar.outliers import (
    MINIMUM,
    BothLinesTest,
    InlierTest,
    SampsonTest,
    SumOfLinesTest,
    discard_outliers,
)
from thesisrecon.epipolar.refinement import refine_epipolar_distance, refine_gradient
from thesisrecon.errors import StageFailure
from thesisrecon.robust.ransac import SampleConsensus
from thesisrecon.types import FundamentalFit

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]
SAMPSON = SampsonTest()


@dataclass(frozen=True)
class SevenPointProblem:
    """Minimal samples of matches: rows (x1, y1, x2, y2) of ``points`` (N, 4), in one frame."""

    points: F64
    sample_size: int = 7
    test: InlierTest = SAMPSON

    def solve(self, sample: I64) -> list[F64]:
        """The one to three matrices through seven matches, as vectors (9,)."""
        solutions = np.empty((3, 9))
        return list(solutions[: seven_point(self.points, sample, solutions)])

    def residuals(self, model: F64) -> F64:
        """Distances (N,) of the test in the units of the points, Sampson's where it has no other."""
        if isinstance(self.test, SampsonTest):
            return np.asarray(sampson_distances(model, self.points))
        return self.test.distances(model.reshape(3, 3), self.points[:, :2], self.points[:, 2:])


@dataclass(frozen=True)
class ThesisRansac:
    """Section 5.4 as it stands, its slips corrected.

    Draw ``samples`` samples of seven, or stop once a share ``enough_share`` of the matches are inliers; keep
    the F with the most; estimate sigma by the median (1.4826 (1 + 5 / (n - 7)) median |d|; the text divides
    by Phi(0.75) where Phi^-1(0.75) is meant) and discard the outliers; then ``rounds`` times minimise the
    gradient criterion (5.4), or the distances to the epipolar lines (5.6) with ``epipolar_distance``, and
    discard again.

    Departures: a match is tested by its Sampson distance against the chi-square of one degree of freedom (the
    two epipolar distances are multiples of one residual, so their sum is not a chi-square of two), unless
    ``both_lines`` or ``sum_of_lines`` asks for the first or second test of the text; the search
    counts inliers within a fixed ``threshold_px``, since the share within a multiple of the median is the
    same for every F; the refinement runs over the orthonormal representation, which has no epipole it cannot
    reach.
    """

    threshold_px: float = 1.0
    samples: int = 1000
    enough_share: float = 0.95
    epipolar_distance: bool = False
    rounds: int = 2
    both_lines: bool = False
    sum_of_lines: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.threshold_px) and self.threshold_px > 0.0):
            raise ValueError(f"threshold_px must be positive; got {self.threshold_px}")
        if min(self.samples, self.rounds) < 1 or not 0.0 < self.enough_share <= 1.0:
            raise ValueError("a search needs samples >= 1, rounds >= 1 and 0 < enough_share <= 1")
        if self.both_lines and self.sum_of_lines:
            raise ValueError("a match is tested by both_lines or by sum_of_lines, not by both")

    @property
    def test(self) -> InlierTest:
        """The test of a match."""
        if self.both_lines:
            return BothLinesTest()
        return SumOfLinesTest() if self.sum_of_lines else SampsonTest()

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """F of matches (N >= 8, 2) px; raises as
        :meth:`~thesisrecon.epipolar.locally_optimised.LocallyOptimisedRansac.estimate`."""
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        test = self.test
        gate = test.ratio * self.threshold_px * frame.scale
        loop = SampleConsensus(gate, max_samples=self.samples, enough_share=self.enough_share)
        found = loop.search(SevenPointProblem(points, test=test), len(points), rng)
        if found is None or found.inliers.sum() < MINIMUM:
            raise StageFailure(
                "no epipolar geometry explains the matches",
                f"{self.samples} samples, none with {MINIMUM} of {len(xy1)} matches close enough",
                "the photographs may not overlap, or the matches are wrong",
            )
        F, sigma = frame.matrix_in_pixels(found.model), 0.0
        _, inliers = discard_outliers(F, xy1, xy2, limit_px=self.threshold_px, test=test)
        refine = refine_epipolar_distance if self.epipolar_distance else refine_gradient
        for _ in range(self.rounds):
            F = refine(F, xy1[inliers], xy2[inliers])
            sigma, inliers = discard_outliers(F, xy1, xy2, limit_px=self.threshold_px, test=test)
        f = frame.matrix_in_frame(F)
        covariance = fundamental_covariance(frame, f, points[inliers], sigma * frame.scale)
        return FundamentalFit(F, inliers, sigma, covariance, found.samples)

"""The default estimator of F: sampling that is refined where it succeeds, from several starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.epipolar.covariance import fundamental_covariance
from thesisrecon.epipolar.frame import PairFrame, check_matches
from thesisrecon.epipolar.kernels import sampson_distances, search, truncated_score
from thesisrecon.epipolar.rank2.kernels import GRADIENT, refine
from thesisrecon.errors import StageFailure
from thesisrecon.robust.noise import noise_scale, noise_width, trimmed_noise_scale
from thesisrecon.types import FundamentalFit

F64 = NDArray[np.float64]

BATCH = 512
MINIMUM = 8
START_STEPS, START_POINTS = 5, 500
"""Solves of each refinement of a start, and the points that all but its last refinement are on."""
REFINEMENT_STEPS = 15
SHARPENINGS, MORE_SHARPENINGS = 2, 5
KNEE = 0.25
"""Where Huber's loss turns linear, in widths of the gate: wrong matches within the gate are not rare."""
PRIOR = (100.0, 5.0)
"""What is thought of wrong matrices before the first was seen: of 100 points 5 lie within the gate."""
EXACT = 1e-9
"""Smallest width of the loss (in units of the spread of the points), for matches without noise."""


@dataclass(frozen=True)
class LocallyOptimisedRansac:
    """Seven-point sampling with a truncated quadratic score, refined over rank-2 matrices.

    Each of ``starts`` searches draws until a sample free of outliers was seen with the probability that makes
    ``confidence`` over all starts; its best matrix is refined by Levenberg-Marquardt on the gradient
    criterion (5.4) under Huber's loss at the ``gates`` (times the threshold), and the best of the starts once
    more with the loss as wide as the noise, beyond the threshold too where the noise goes on. Torr and
    Zisserman, MLESAC, CVIU 2000 (score); Chum, Matas and Kittler, DAGM 2003 (local optimisation). Fitting the
    points of a shrinking gate alone gets stuck where the scene is nearly a plane; the several starts and the
    soft loss do not.

    Parameters
    ----------
    threshold_px : Sampson distance beyond which a match counts as wrong during the search.
    confidence : probability that at least one start saw a sample free of outliers.
    starts : independent searches.
    min_samples : samples of all starts together, however many inliers were found: where most of the scene is
        one plane, a wrong F has many too.
    max_samples : samples of all starts together, whatever the confidence.
    gates : widths of the loss in thresholds, one refinement each, in this order.
    inlier_sigmas, inlier_floor_px : a match is an inlier within max(inlier_sigmas sigma, inlier_floor_px).
    """

    threshold_px: float = 1.0
    confidence: float = 0.9999
    starts: int = 4
    min_samples: int = 4000
    max_samples: int = 50000
    gates: tuple[float, ...] = (2.0, 1.5, 1.0)
    inlier_sigmas: float = 2.5
    inlier_floor_px: float = 0.3

    def __post_init__(self) -> None:
        if not (np.isfinite(self.threshold_px) and self.threshold_px > 0.0):
            raise ValueError(f"threshold_px must be positive; got {self.threshold_px}")
        if not 0.0 < self.confidence < 1.0:
            raise ValueError(f"confidence must lie between 0 and 1; got {self.confidence}")
        if self.starts < 1 or self.max_samples < self.starts or min(self.gates, default=0.0) <= 0.0:
            raise ValueError("a search needs at least one start, one sample per start and gates above 0")

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """F of matches (N >= 8, 2) px with its inliers, noise and covariance.

        Raises ``ValueError`` for wrong shapes or coordinates that are not finite, ``StageFailure`` for fewer
        than 8 matches, points on one line, or where no F has 8 matches within the threshold. Always finite.
        """
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        gate = self.threshold_px * frame.scale
        f, samples = self._best_of_starts(points, gate, rng)
        if f.any():
            self._sharpen(f, points, gate)
        return self._finish(frame, f, points, samples)

    def _best_of_starts(self, points: F64, gate: float, rng: Generator) -> tuple[F64, int]:
        best, best_score, samples = np.zeros(9), np.inf, 0
        for _ in range(self.starts):
            shuffled = points[rng.permutation(len(points))]
            f, drawn = self._search(shuffled, gate, rng)
            samples += drawn
            if not f.any():
                continue
            for k, width in enumerate(self.gates, start=1):
                some = shuffled if k == len(self.gates) else shuffled[:START_POINTS]
                refine(f, some, GRADIENT, width * gate, KNEE * width * gate, START_STEPS)
            score, _, _ = truncated_score(f, np.ascontiguousarray(shuffled.T), gate, 1.0, (0.0, 0.0))
            if score < best_score:
                best, best_score = f, score
        return best, samples

    def _search(self, points: F64, gate: float, rng: Generator) -> tuple[F64, int]:
        f, state = np.zeros(9), np.array([1.0, 0.0, *PRIOR])
        least, most = self.min_samples // self.starts, self.max_samples // self.starts
        confidence = 1.0 - (1.0 - self.confidence) ** (1.0 / self.starts)
        drawn = 0
        while drawn < most:
            uniforms = rng.random((min(BATCH, most - drawn), 7))
            before, drawn = drawn, search(points, uniforms, gate, (drawn, least, confidence), state, f)
            if drawn < before + len(uniforms):
                break
        return f, drawn

    def _sharpen(self, f: F64, points: F64, gate: float) -> None:
        """Refine once more with the width of the loss at the noise that the inliers show (in place)."""
        before = gate
        for k in range(MORE_SHARPENINGS):
            r = np.asarray(sampson_distances(f, points))
            width = noise_width(r, gate)
            if k >= SHARPENINGS and width == before:
                return
            before = width
            near = r[r < width]
            if len(near) < MINIMUM:
                return
            knee = min(max(noise_scale(near), EXACT), width)
            refine(f, points, GRADIENT, width, knee, REFINEMENT_STEPS)

    def _finish(self, frame: PairFrame, f: F64, points: F64, samples: int) -> FundamentalFit:
        residuals = np.asarray(sampson_distances(f, points)) / frame.scale
        near = residuals < noise_width(residuals, self.threshold_px)
        if not f.any() or near.sum() < MINIMUM:
            raise StageFailure(
                "no epipolar geometry explains the matches",
                f"the best of {samples} samples has {near.sum() * f.any()} of {len(points)} matches within "
                f"{self.threshold_px:g} px, needed at least {MINIMUM}",
                "The photographs may not overlap, or the matches are wrong",
            )
        sigma = trimmed_noise_scale(residuals, noise_scale(residuals[near]))
        inliers = residuals < max(self.inlier_sigmas * sigma, self.inlier_floor_px)
        covariance = fundamental_covariance(frame, f, points[inliers], sigma * frame.scale)
        return FundamentalFit(frame.matrix_in_pixels(f), inliers, sigma, covariance, samples)

"""The default estimator of F: sampling that is refined where it succeeds, until several searches agree."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.frame import PairFrame, check_matches
from thesisrecon.epipolar.precision import fundamental_covariance
from thesisrecon.epipolar.refinement import SAMPSON, refine
from thesisrecon.epipolar.sampling import sampson_distances, search, truncated_score
from thesisrecon.errors import StageFailure
from thesisrecon.numerics.noise import (
    NoiseMixture,
    best_huber_width,
    effective_noise,
    noise_scale,
    noise_width,
)
from thesisrecon.records import FundamentalFit

BATCH = 512
MINIMUM = 8
PARAMETERS = 7
START_STEPS, LAST_STEPS, START_POINTS = 5, 20, 500
"""Solves of each refinement of a start and of its last, and the points that all but the last are on."""
REFINEMENT_STEPS, SHARPENINGS = 15, 2
KNEE = 0.25
"""Where Huber's loss turns linear, in widths of the gate: wrong matches within the gate are not rare."""
PRIOR = (100.0, 5.0)
"""What is thought of wrong matrices before the first was seen: of 100 points 5 lie within the gate."""
EXACT = 1e-9
"""Smallest width of the loss (in units of the spread of the points), for matches without noise."""
SHARES = 6
"""Starts that the least samples are shared by, and of which one sees a sample free of outliers."""
SAME_SCORE = 0.03
"""Sums of truncated squares of N matches that differ by less than this times sqrt(N) are of one minimum."""
SPREAD = 1.0
"""Of wrong matches before any was seen, in units of the spread of the points."""
FEW_MATCHES = 28.0
"""How much wider the last loss is for few matches: by 1 + 28 / (n - 7), as a fit bends to what it keeps."""
COVERED = 3.0
"""Standard deviations within which nearly all noise lies."""
RIVALS = 3
WIDER, RING = 4.0, 15.0
"""Gate of the second search, and how far beyond the noise is looked whether it goes on, in gates."""
EXCESS = 0.25
"""Share of the inliers that more matches than expected in the ring give reason to search again."""
FEW_WRONG = 0.2


@dataclass(frozen=True)
class LocallyOptimisedRansac:
    """Seven-point sampling with a truncated quadratic score, refined over rank-2 matrices.

    A start draws samples until one free of outliers was seen; its best matrix is refined by
    Levenberg-Marquardt on the gradient criterion (5.4) under Huber's loss at the ``gates`` (times the
    threshold). Starts go on until ``starts`` of them ended at the best score: where one plane or a repeated
    pattern has many inliers they disagree, and more are made (Torr and Zisserman, MLESAC, CVIU 2000; Chum,
    Matas and Kittler, DAGM 2003).

    The best matrix is refined once more with the loss that suits the noise its residuals show: a mixture of
    noise, its heavier tail and wrong matches says where the noise ends, and Huber's loss is as wide as the
    residuals say is best. Where more matches than wrong ones explain lie just beyond, the noise may be
    larger than the threshold: the search is repeated with a wider gate, and the likelier of the two answers
    taken, if it leaves few matches unexplained.

    Parameters
    ----------
    threshold_px : Sampson distance beyond which a match counts as wrong during the search.
    confidence : probability that one of six starts sees a sample free of outliers; those that agree are sure.
    starts : searches that must end at the same score.
    max_starts : searches after which the best is taken though they disagree.
    min_samples : samples of six starts, however many inliers were found: where most of the scene is one
        plane, a wrong F has many too.
    max_samples : samples of all starts together, whatever the confidence.
    gates : widths of the loss in thresholds, one refinement each, in this order.
    inlier_sigmas : a match is an inlier where noise is likelier than a wrong match, and within so many sigma
        (infinite: the tail of the noise too); less where only precise matches are wanted.
    inlier_floor_px : a match within this is always an inlier.
    """

    threshold_px: float = 1.0
    confidence: float = 0.9999
    starts: int = 3
    max_starts: int = 16
    min_samples: int = 4000
    max_samples: int = 100000
    gates: tuple[float, ...] = (2.0, 1.5, 1.0)
    inlier_sigmas: float = np.inf
    inlier_floor_px: float = 0.3

    def __post_init__(self) -> None:
        if not (np.isfinite(self.threshold_px) and self.threshold_px > 0.0):
            raise ValueError(f"threshold_px must be positive; got {self.threshold_px}")
        if not 0.0 < self.confidence < 1.0:
            raise ValueError(f"confidence must lie between 0 and 1; got {self.confidence}")
        if not 1 <= self.starts <= self.max_starts:
            raise ValueError(f"starts must lie in [1, max_starts]; got {self.starts} and {self.max_starts}")
        if self.max_samples < SHARES or min(self.gates, default=0.0) <= 0.0:
            raise ValueError("a search needs at least six samples and gates above 0")
        if not self.inlier_sigmas > 0.0:
            raise ValueError(f"inlier_sigmas must be positive; got {self.inlier_sigmas}")

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """F of matches (N >= 8, 2) px with its inliers, noise and covariance.

        Raises ``ValueError`` for wrong shapes or coordinates that are not finite, ``StageFailure`` for fewer
        than 8 matches, points on one line, or where no F has 8 matches within the threshold. Always finite.
        """
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        gate = self.threshold_px * frame.scale
        found = self._candidate(points, gate, rng)
        if found.noise is None or _goes_on(found.residuals, found.noise, gate):
            wide = self._candidate(points, WIDER * gate, rng)
            samples = found.samples + wide.samples
            found = replace(wide if wide.explains_more_than(found) else found, samples=samples)
        return self._finish(frame, found, points)

    def _candidate(self, points: F64, gate: float, rng: Generator) -> _Candidate:
        ends, samples = self._starts(points, gate, rng)
        f, competing_models = _best_and_rivals(ends, _chance_of_scores(points))
        noise, loss = _sharpen(f, points, gate) if f.any() else (None, (0.0, 0.0))
        return _Candidate(f, samples, np.asarray(sampson_distances(f, points)), noise, loss, competing_models)

    def _starts(self, points: F64, gate: float, rng: Generator) -> tuple[list[tuple[float, F64]], int]:
        """Score and matrix (9,) where each search ended, until enough agree; and the samples drawn."""
        found: list[tuple[float, F64]] = []
        samples = 0
        for _ in range(self.max_starts):
            shuffled = points[rng.permutation(len(points))]
            f, drawn = self._search(shuffled, gate, rng)
            samples += drawn
            if f.any():
                self._refine_start(f, shuffled, gate)
                score, _, _ = truncated_score(f, np.ascontiguousarray(shuffled.T), gate, 1.0, (0.0, 0.0))
                found.append((score * len(points), f))
            best = min((score for score, _ in found), default=np.inf)
            agreeing = sum(score - best < _chance_of_scores(points) for score, _ in found)
            if agreeing >= self.starts + (len(found) - agreeing) // 2 or samples >= self.max_samples:
                break
        return found, samples

    def _refine_start(self, f: F64, points: F64, gate: float) -> None:
        for width in self.gates[:-1]:
            refine(f, points[:START_POINTS], SAMPSON, width * gate, KNEE * width * gate, START_STEPS)
        width = self.gates[-1]
        refine(f, points, SAMPSON, width * gate, KNEE * width * gate, LAST_STEPS)

    def _search(self, points: F64, gate: float, rng: Generator) -> tuple[F64, int]:
        f, state = np.zeros(9), np.array([1.0, 0.0, *PRIOR])
        least, most = self.min_samples // SHARES, self.max_samples // self.max_starts
        confidence = 1.0 - (1.0 - self.confidence) ** (1.0 / SHARES)
        drawn = 0
        while drawn < most:
            uniforms = rng.random((min(BATCH, most - drawn), 7))
            before, drawn = drawn, search(points, uniforms, gate, (drawn, least, confidence), state, f)
            if drawn < before + len(uniforms):
                break
        return f, drawn

    def _finish(self, frame: PairFrame, found: _Candidate, points: F64) -> FundamentalFit:
        r, noise = found.residuals, found.noise
        if noise is None:
            near = np.count_nonzero(r < self.threshold_px * frame.scale) * found.f.any()
            raise StageFailure(
                "no epipolar geometry explains the matches",
                f"the best of {found.samples} samples has {near} of {len(points)} matches within "
                f"{self.threshold_px:g} px, needed at least {MINIMUM}",
                "the photographs may not overlap, or the matches are wrong",
            )
        limit = min(noise.limit, self.inlier_sigmas * noise.sigma)
        inliers = r < max(limit, self.inlier_floor_px * frame.scale)
        fitted = r < found.loss[0]
        effective = effective_noise(r[fitted], found.loss[1], parameters=PARAMETERS)
        covariance = fundamental_covariance(frame, found.f, points[fitted], effective)
        F = frame.matrix_in_pixels(found.f)
        competing_models = np.array([frame.matrix_in_pixels(f) for f in found.competing_models]).reshape(
            -1, 3, 3
        )
        return FundamentalFit(
            F, inliers, noise.sigma / frame.scale, covariance, found.samples, competing_models
        )


@dataclass(frozen=True)
class _Candidate:
    """A matrix ``f`` (9,), the samples it took, its residuals (N,) and their noise, None for no F.

    ``loss`` is what it was fitted with: where matches stop to count and where Huber's loss turns linear.
    ``rivals`` are where other searches ended.
    """

    f: F64
    samples: int
    residuals: F64
    noise: NoiseMixture | None
    loss: tuple[float, float]
    competing_models: list[F64]

    def explains_more_than(self, competing_model: _Candidate) -> bool:
        """Whether this, found with a wider gate, is likelier and leaves few matches unexplained.

        A wide gate finds wrong matrices that many wrong matches are near to; noise beyond the threshold is
        believed only if it explains most of what the ``rival`` calls wrong, or nearly everything.
        """
        if self.noise is None or competing_model.noise is None:
            return competing_model.noise is None
        explained = int(np.count_nonzero(self.residuals < self.noise.limit))
        more = explained - int(np.count_nonzero(competing_model.residuals < competing_model.noise.limit))
        left = len(self.residuals) - explained
        few = left <= max(more, FEW_WRONG * len(self.residuals))
        return few and self.noise.log_likelihood > competing_model.noise.log_likelihood


def _chance_of_scores(points: F64) -> float:
    """By how much sums of truncated squares of the same minimum may differ."""
    return float(SAME_SCORE * len(points) ** 0.5)


def _best_and_rivals(ends: list[tuple[float, F64]], same: float) -> tuple[F64, list[F64]]:
    """The matrix with the lowest score, 0 where there is none, and the next, each ``same`` or more above."""
    best, last = np.zeros(9), -np.inf
    competing_models: list[F64] = []
    for score, f in sorted(ends, key=lambda end: end[0]):
        if last == -np.inf:
            best = f
        elif score - last >= same and len(competing_models) < RIVALS:
            competing_models.append(f)
        last = score
    return best, competing_models


def _noise(r: F64, gate: float) -> NoiseMixture | None:
    """The noise of residuals (N,) in ascending order; None where too few are of it."""
    near = r[: np.searchsorted(r, noise_width(r, gate))]
    if len(near) < MINIMUM:
        return None
    return NoiseMixture.fit(r, max(noise_scale(near), EXACT), spread=SPREAD)


def _sharpen(f: F64, points: F64, gate: float) -> tuple[NoiseMixture | None, tuple[float, float]]:
    """Refine with the loss that suits the noise that the residuals show (in place); both are returned."""
    loss = (0.0, 0.0)
    for k in range(SHARPENINGS + 1):
        r = np.sort(sampson_distances(f, points))
        noise = _noise(r, gate)
        if noise is None or k == SHARPENINGS:
            break
        limit = noise.limit
        if k > 0:
            free = max(noise.core * len(r) - PARAMETERS, 1.0)
            few = 1.0 + FEW_MATCHES / free
            limit = min(limit, few * noise.core_limit)
        limit = max(limit, EXACT, 1.001 * float(r[MINIMUM - 1]))
        near = r[: np.searchsorted(r, limit)]
        # The start bends to few of the matches: whether the noise is heavy-tailed cannot be seen before the
        # first refinement.
        width = best_huber_width(near, noise.sigma, parameters=PARAMETERS) if k > 0 else np.inf
        width = min(max(width, EXACT), limit)
        refine(f, points, SAMPSON, limit, width, REFINEMENT_STEPS)
        loss = (limit, width)
    return noise, loss


def _goes_on(r: F64, noise: NoiseMixture, gate: float) -> bool:
    """Whether just beyond the noise that was found lie more residuals (N,) than wrong ones explain."""
    end = COVERED * noise.sigma
    inside = int(np.count_nonzero(r < end))
    beyond = len(r) - inside
    ring = int(np.count_nonzero(r < end + RING * gate)) - inside
    # Of a half-normal distribution of unit spread, which wrong matches roughly have.
    expected = float(np.sqrt(2.0 / np.pi)) * beyond * RING * gate / SPREAD
    needed = inside * max(0.05, EXCESS * (1.0 - 3.0 * PARAMETERS / max(inside, 1)))
    return ring - expected > max(2.0 * float(np.sqrt(expected)), needed)


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

"""The default robust estimator of F: locally optimised RANSAC with repeated searches."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import F64
from thesisrecon.epipolar._matches import NoiseMixture, PairFrame, check_matches, noise_scale, noise_width
from thesisrecon.epipolar._sampling import sampson_distances, search_fundamental, truncated_score
from thesisrecon.epipolar.refinement import SAMPSON, fundamental_covariance, refine
from thesisrecon.errors import StageFailure, require_range
from thesisrecon.optimize.least_squares import best_huber_width, effective_noise
from thesisrecon.optimize.ransac import watched
from thesisrecon.records import FundamentalFit

MINIMUM = 8
PARAMETERS = 7
PRIOR = (100.0, 5.0)  # prior of wrong matrices: of 100 points 5 lie within the gate
SPREAD = 1.0  # prior spread of wrong matches in units of the frame


@dataclass(frozen=True)
class LocallyOptimisedRansac:
    """Seven-point RANSAC with a truncated quadratic score and refinement over rank-2 matrices [1]_ [2]_.

    A search draws samples until one without outliers is likely; its best F is refined by Levenberg-Marquardt
    on the Sampson distances (5.4) with Huber's loss. Searches are repeated until ``starts`` of them end at
    the best score. They disagree if a plane or a repeated pattern has many inliers, or if few matches are
    correct; each search then continues with samples of the matches near its F, an inner RANSAC [2]_.

    The best F is refined once more with a loss fitted to its residuals: a mixture of noise, its heavier tail
    and wrong matches gives the inlier limit and the best width of Huber's loss. If more matches than expected
    lie just beyond that limit, the noise may exceed the threshold: the search is repeated with a wider gate,
    and its result is used if it is more likely and leaves few matches unexplained.

    References
    ----------
    .. [1] P. Torr and A. Zisserman, "MLESAC", CVIU 78, 2000.
    .. [2] O. Chum, J. Matas and J. Kittler, "Locally optimized RANSAC", DAGM 2003.
    """

    threshold_px: float = 1.0  #: largest Sampson distance of an inlier during the search
    confidence: float = 0.9999  #: probability that one of six searches draws a sample without outliers
    max_samples: int = 60000  #: largest number of samples of all searches together
    starts: int = 3  #: number of searches that must end at the same score
    inlier_sigmas: float = np.inf
    """Maximum residual of an inlier in standard deviations; infinite includes the tail of the noise."""

    max_starts = 10  # maximum number of searches
    # Minimum number of samples of six searches together, for any inlier ratio, because a wrong F of a
    # dominant plane also has many inliers.
    min_samples = 4000
    gates = (2.0, 1.5, 1.0)  # residual limits of the successive refinements, in units of ``threshold_px``
    inlier_floor = 0.3  # residual up to which a match is always an inlier, in units of ``threshold_px``

    def __post_init__(self) -> None:
        require_range(self, threshold_px="(0, inf)", confidence="(0, 1)", inlier_sigmas="(0, inf]")
        require_range(self, starts=f"[1, {self.max_starts}]", max_samples=f"[{self.max_starts}, inf)")

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """See `thesisrecon.config.FundamentalEstimator.estimate`."""
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame = PairFrame.of(xy1, xy2)
        points = frame.points(xy1, xy2)
        gate = self.threshold_px * frame.scale
        found = self._best_of_searches(points, gate, rng)
        if found.noise is None or _noise_exceeds_gate(found.residuals, found.noise, gate):
            wide = self._best_of_searches(points, 4.0 * gate, rng)
            samples = found.samples + wide.samples
            found = replace(wide if wide.explains_more_than(found) else found, samples=samples)
        return self._finish(frame, found, points)

    def _best_of_searches(self, points: F64, gate: float, rng: Generator) -> _Candidate:
        ends, samples = self._repeat_search(points, gate, rng)
        # The F with the lowest score, and the next ones that coincide with none before.
        chosen: list[F64] = []
        for _, one in sorted(ends, key=lambda end: end[0]):
            if len(chosen) <= 3 and not any(_coincide(other, one, points, gate) for other in chosen):
                chosen.append(one)
        f, *others = chosen or [np.zeros(9)]
        noise, loss = _refine_to_noise(f, points, gate) if f.any() else (None, (0.0, 0.0))
        return _Candidate(f, samples, np.asarray(sampson_distances(f, points)), noise, loss, others)

    def _repeat_search(self, points: F64, gate: float, rng: Generator) -> tuple[list[tuple[float, F64]], int]:
        """Score and F (9,) of the searches, among near matches once they differ; number of samples."""
        found, samples = list[tuple[float, F64]](), 0
        # Six searches share the minimum; one of them draws a sample without outliers.
        confidence = 1.0 - (1.0 - self.confidence) ** (1.0 / 6.0)
        limits = self.min_samples // 6, self.max_samples // self.max_starts, confidence
        for k in range(self.max_starts):
            shuffled = points[rng.permutation(len(points))]
            columns = np.ascontiguousarray(shuffled.T)
            f, state = np.zeros(9), np.array([1.0, 0.0, *PRIOR])
            samples += _score_samples(shuffled, shuffled, columns, gate, limits, state, f, rng)
            if f.any():
                if k >= self.starts:
                    _search_among_inliers(f, shuffled, columns, gate, rng)
                found.append(self._refine_start(f, shuffled, columns, gate))
            agreed = self._agree(found, points, gate)
            if k + 1 == self.starts and not agreed:
                for _, f in found:
                    _search_among_inliers(f, shuffled, columns, gate, rng)
                found = [self._refine_start(f, shuffled, columns, gate) for _, f in found]
                agreed = self._agree(found, points, gate)
            if agreed or samples >= self.max_samples:
                break
        return found, samples

    def _agree(self, found: list[tuple[float, F64]], points: F64, gate: float) -> bool:
        """Whether enough searches end at the best score, to the root of the matches near the gate."""
        if len(found) < self.starts:
            return False
        best, f = min(found, key=lambda end: end[0])
        ratio = np.asarray(sampson_distances(f, points)) / gate
        near = np.count_nonzero((ratio > 0.7) & (ratio < 1.3))
        same = max(0.03 * len(points) ** 0.5, near**0.5)
        agreeing = sum(score - best < same and _coincide(f, other, points, gate) for score, other in found)
        return bool(agreeing >= self.starts + (len(found) - agreeing) // 2)

    def _refine_start(self, f: F64, points: F64, columns: F64, gate: float) -> tuple[float, F64]:
        """Refine ``f`` in place; return its sum of truncated squares and itself."""
        # Huber's loss is narrow: wrong matches within the gate are not rare.
        for width in self.gates[:-1]:
            refine(f, points[:500], SAMPSON, width * gate, 0.25 * width * gate, 5, None)
        width = self.gates[-1]
        refine(f, points, SAMPSON, width * gate, 0.25 * width * gate, 20, None)
        score, inliers, _ = truncated_score(f, columns, gate, 1.0, (0.0, 0.0))
        watched(0, score, inliers / len(points), f)
        return score * len(points), f

    def _finish(self, frame: PairFrame, found: _Candidate, points: F64) -> FundamentalFit:
        r, noise = found.residuals, found.noise
        if noise is None:
            raise StageFailure.of(
                "no-epipolar-geometry",
                f"no F of {found.samples} samples has {MINIMUM} or more of the {len(points)} matches within "
                f"{self.threshold_px:g} px",
            )
        # The tail of the noise ends at twice the threshold.
        widest = max(noise.core_limit, 2.0 * self.threshold_px * frame.scale)
        limit = min(noise.limit, self.inlier_sigmas * noise.sigma, widest)
        inliers = r < max(limit, self.inlier_floor * self.threshold_px * frame.scale)
        fitted = r < found.loss[0]
        effective = effective_noise(r[fitted], found.loss[1], parameters=PARAMETERS)
        covariance = fundamental_covariance(frame, found.f, points[fitted], effective)
        F = frame.matrix_in_pixels(found.f)
        others = np.array([frame.matrix_in_pixels(f) for f in found.competing_models]).reshape(-1, 3, 3)
        return FundamentalFit(F, inliers, noise.sigma / frame.scale, covariance, found.samples, others)


@dataclass(frozen=True)
class _Candidate:
    """Result of the searches with a gate: ``loss`` are limit and width, ``noise`` is None without an F."""

    f: F64
    samples: int
    residuals: F64
    noise: NoiseMixture | None
    loss: tuple[float, float]
    competing_models: list[F64]

    def explains_more_than(self, other: _Candidate) -> bool:
        """Whether this result of a wider gate is more likely and leaves few matches unexplained."""
        if self.noise is None or other.noise is None:
            return other.noise is None
        explained = int(np.count_nonzero(self.residuals < self.noise.limit))
        more = explained - int(np.count_nonzero(other.residuals < other.noise.limit))
        left = len(self.residuals) - explained
        few = left <= max(more, 0.2 * len(self.residuals))
        return few and self.noise.log_likelihood > other.noise.log_likelihood


def _score_samples(
    sampled: F64, points: F64, columns: F64, gate: float, limits: tuple[int, int, float],
    state: F64, f: F64, rng: Generator,
) -> int:  # fmt: skip
    """Improve ``f`` in place by samples, each better one refined; ``limits``: least, most, confidence."""
    (least, most, confidence), drawn, uniforms = limits, 0, np.empty((0, 7))
    while drawn < most:
        if not len(uniforms):
            uniforms = rng.random((min(512, most - drawn), 7))
        score, before = state[0], drawn
        stop = (drawn, least, confidence)
        drawn = search_fundamental(sampled, columns, uniforms, gate, stop, state, f)
        uniforms = uniforms[drawn - before :]
        if state[0] < score:
            # Refined on few points with twice the gate; the better of the two is kept.
            trial = f.copy()
            refine(trial, points[:300], SAMPSON, 2.0 * gate, gate, 4, None)
            better, inliers, _ = truncated_score(trial, columns, gate, state[0], (0.0, 0.0))
            if better < state[0]:
                state[:2], f[:] = (better, inliers / len(points)), trial
            watched(drawn, state[0], state[1], f)
        elif len(uniforms):
            break
    watched(drawn, state[0], state[1], f, ends=True)
    return drawn


def _search_among_inliers(f: F64, points: F64, columns: F64, gate: float, rng: Generator) -> None:
    """Improve ``f`` in place by samples of the matches near it until a round finds no better one."""
    score, inliers, _ = truncated_score(f, columns, gate, 1.0, (0.0, 0.0))
    state = np.array([score, inliers / len(points), *PRIOR])
    for _ in range(10):
        near, before = points[np.asarray(sampson_distances(f, points)) < 3.0 * gate], state[0]
        if len(near) >= MINIMUM:
            _score_samples(near, points, columns, gate, (256, 256, 1.0), state, f, rng)
        if not state[0] < before:
            return


def _coincide(f: F64, other: F64, points: F64, gate: float) -> bool:
    """Whether the inliers of either F are near the other: their RMS distance is below the gate."""
    distances = np.asarray(sampson_distances(f, points)), np.asarray(sampson_distances(other, points))
    for mine, theirs in (distances, distances[::-1]):
        # Truncated, so that a single wrong match cannot decide.
        far = np.minimum(theirs[mine < gate], 20.0 * gate)
        if far @ far > gate**2 * len(far):
            return False
    return True


def _refine_to_noise(f: F64, points: F64, gate: float) -> tuple[NoiseMixture | None, tuple[float, float]]:
    """Refine ``f`` in place with the loss fitted to its residuals; noise (None: too few) and loss."""
    loss, rounds = (0.0, 0.0), 2
    exact = 1e-9  # smallest width of the loss in units of the frame, for matches without noise
    for k in range(rounds + 1):
        r = np.sort(sampson_distances(f, points))
        near = r[: np.searchsorted(r, noise_width(r, gate))]
        if len(near) < MINIMUM:
            return None, loss
        noise = NoiseMixture.fit(r, max(noise_scale(near), exact), spread=SPREAD)
        if k == rounds:
            break
        limit = noise.limit
        if k > 0:
            # Few matches pull the fit towards them: the last loss is wider.
            few = 1.0 + 28.0 / max(noise.core * len(r) - PARAMETERS, 1.0)
            limit = min(limit, few * noise.core_limit)
        limit = max(limit, exact, 1.001 * float(r[MINIMUM - 1]))
        near = r[: np.searchsorted(r, limit)]
        # The start fits few matches: heavy tails cannot be detected before the first refinement.
        width = best_huber_width(near, noise.sigma, parameters=PARAMETERS) if k > 0 else np.inf
        width = min(max(width, exact), limit)
        refine(f, points, SAMPSON, limit, width, 15, None)
        loss = (limit, width)
    return noise, loss


def _noise_exceeds_gate(r: F64, noise: NoiseMixture, gate: float) -> bool:
    """Whether more residuals lie in a ring of 15 gates beyond 3 sigma than are expected of wrong matches."""
    end, width = 3.0 * noise.sigma, 15.0 * gate
    inside = int(np.count_nonzero(r < end))
    beyond = len(r) - inside
    ring = int(np.count_nonzero(r < end + width)) - inside
    # Wrong matches are roughly half-normal with unit spread.
    expected = float(np.sqrt(2.0 / np.pi)) * beyond * width / SPREAD
    needed = inside * max(0.05, 0.25 * (1.0 - 3.0 * PARAMETERS / max(inside, 1)))
    return ring - expected > max(2.0 * float(np.sqrt(expected)), needed)

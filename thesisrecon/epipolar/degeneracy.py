"""Degenerate planes (DEGENSAC, CVPR 2005): do the matches determine F, or does another F explain them too?

If most matches lie on one plane with homography H, every [e]x H explains them: the epipole depends on the few
matches off the plane, and a wrong F has as many inliers as the right one.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy
from numpy.random import Generator

from thesisrecon.arrays import B8, F64
from thesisrecon.epipolar import _matches
from thesisrecon.epipolar._matches import PairFrame
from thesisrecon.epipolar._sampling import sampson_distances
from thesisrecon.epipolar.homography import OFF_PLANE, find_dominant_plane, fundamentals_of_plane
from thesisrecon.epipolar.refinement import SAMPSON, refine
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import epipolar_distance_std
from thesisrecon.optimize.least_squares import student_factor
from thesisrecon.optimize.ransac import log10_false_alarms
from thesisrecon.records import DegeneracyReport, FundamentalFit

Method = Literal["locally-optimised", "ransac", "gold-standard", "eight-point", "seven-point"]

MINIMUM = 8
# Standard errors by which a competing model must be worse: right models of facades reach 7, wrong ones 2.
# Not a probability, since matches of repeated structure are dependent.
MIN_MARGIN = 3.0
SAMPLED = 60  # inliers of which the covariance and the contradictions are tested


@dataclass(frozen=True)
class _CompetingModel:
    """Another F ``f`` (9,), and the weights of matches that only the estimate or only this F explains."""

    f: F64
    lost: float
    gained: float
    error: float  #: RMS distance of its inliers to the estimate in frame units
    apart: float  #: the smaller of that and the reverse

    @property
    def margin(self) -> float:
        """Standard errors by which the estimate explains more (McNemar's test)."""
        return (self.lost - self.gained) / float(np.sqrt(max(self.lost + self.gained, 1.0)))

    def differs(self, relevant: float) -> bool:
        """Whether the estimate is wrong if this model is right; wrong matches that it gains count little."""
        return self.apart > relevant or (self.error > relevant and self.margin < -MIN_MARGIN)


def _competing_starts(
    f: F64, points: F64, weights: F64, H: F64, off_plane: B8, *, band: float, rng: Generator
) -> tuple[F64, float]:
    """Other F (S, 9) of the plane, and the fraction of matches off it that an F explains by chance."""
    # [e]x H of the plane and two matches off it (Chum, Werner and Matas, CVPR 2005) is scored on all matches
    # off the plane. In half of the pairs only one match agrees with `f`: a wrong F often shares most inliers.
    off = np.flatnonzero(off_plane)
    if len(off) < 3:
        return np.empty((0, 9)), 0.0
    # An F of two noisy matches and a local plane is inaccurate: it is scored with a band twice as wide.
    tried, distinct, wide = 300, 3, 2.0
    off = off[rng.permutation(len(off))[:400]]
    w, own = weights[off], (np.asarray(sampson_distances(f, points)) < band)[off]
    pairs = rng.integers(0, len(off), (tried, 2))
    agreeing, others = np.flatnonzero(own), np.flatnonzero(~own)
    if len(agreeing) and len(others):
        half = tried // 2
        pairs[:half, 0] = agreeing[rng.integers(0, len(agreeing), half)]
        pairs[:half, 1] = others[rng.integers(0, len(others), half)]
    F, agree, sums = fundamentals_of_plane(H, points[off], np.stack([w, w * ~own]), pairs, wide * band)
    # The two matches that define a model always agree with it.
    beyond = np.maximum(sums[:, 0] - 2.0, 0.0) / max(float(w.sum()) - 2.0, 1.0)
    chosen: list[int] = []
    for k, value in enumerate((sums[:, 0], sums[:, 0] + sums[:, 1])):
        # Models that share at most 80 % with any chosen before.
        for s in np.argsort(-value, kind="stable")[:100].tolist():
            own_weight = w * agree[s]
            if all(own_weight @ agree[c] <= 0.8 * own_weight.sum() for c in chosen):
                chosen.append(s)
            if len(chosen) >= (k + 1) * distinct:
                break
    # Most epipoles are wrong.
    return F[chosen], float(np.quantile(beyond, 0.3)) / wide


def _competing_model(start: F64, f: F64, points: F64, weights: F64, band: float) -> _CompetingModel:
    """A start (9,) refined on all points and compared with ``f``."""
    other = start.copy()
    for gate in (2.4, 1.8, 1.2):
        refine(other, points, SAMPSON, gate * band, 0.4 * gate * band, 5, None)
    distances, own = np.asarray(sampson_distances(f, points)), np.asarray(sampson_distances(other, points))
    inside, agreeing = distances < band, own < band
    lost, gained = float(weights[inside & ~agreeing].sum()), float(weights[agreeing & ~inside].sum())
    if not agreeing.any() or not inside.any():
        return _CompetingModel(other, lost, gained, np.inf, np.inf)
    # Truncated, so that a single wrong match cannot dominate.
    error, back = (
        float(np.sqrt(np.mean(np.minimum(d, 20.0 * band) ** 2))) for d in (distances[agreeing], own[inside])
    )
    return _CompetingModel(other, lost, gained, error, min(error, back))


def assess_degeneracy(
    fit: FundamentalFit, xy1: F64, xy2: F64, *, rng: Generator, unit_px: float = 1.0
) -> DegeneracyReport:
    """Test whether the matches determine the fundamental matrix of a fit.

    F is undetermined if the inliers off the dominant plane are no more than expected by chance, if another F
    explains about as many matches (McNemar's test) at a relevant distance, if more than a fifth of the
    inliers off the plane are contradicted by neighbours on it (repeated windows), or if the covariance allows
    errors of the epipolar lines above ``unit_px``. Wrong matches as coherent as a surface cannot be detected.
    """
    xy1, xy2 = _matches.check_matches(xy1, xy2, needed=MINIMUM)
    if fit.inliers.shape != (len(xy1),):
        raise ValueError(f"the fit has {fit.inliers.shape} inlier flags for {len(xy1)} matches")
    frame = PairFrame.of(xy1, xy2)
    points, f = frame.points(xy1, xy2), frame.matrix_in_frame(fit.F)
    sigma_px = max(fit.sigma_px, 0.1 * unit_px)
    band_px = max(2.5 * fit.sigma_px, 0.3 * unit_px)
    plane = find_dominant_plane(f, points, fit.inliers, sigma=sigma_px * frame.scale, rng=rng)
    # RMS distance of exact matches to their lines, from the covariance of F.
    some = np.flatnonzero(fit.inliers)
    some = some[:: max(1, len(some) // SAMPLED)]
    std = epipolar_distance_std(fit.F, fit.covariance, xy1[some], xy2[some])
    error_px = float(np.sqrt(np.mean(std**2))) if len(std) else float("inf")
    if plane is None:
        return DegeneracyReport(False, ("F has too few inliers",), expected_error_px=error_px)
    H, off_plane = plane[0], plane[1] > OFF_PLANE
    weights, band = _matches.multiplicity_weights(xy1 / unit_px, xy2 / unit_px), band_px * frame.scale
    of_plane, chance_of_model = _competing_starts(f, points, weights, H, off_plane, band=band, rng=rng)
    starts = [*of_plane, *(frame.matrix_in_frame(F) for F in fit.competing_models)]
    models = [_competing_model(start, f, points, weights, band) for start in starts]
    mine, near = fit.inliers, 2.0 * sigma_px * frame.scale
    agreeing, tried = float(weights[mine & off_plane].sum()), float(weights[off_plane].sum())
    part = _contradicted_fraction(points[mine], weights[mine], H, off_plane[mine], near)
    contradicted = agreeing * part
    chance_of_match = _matches.chance_of_agreement(xy1, xy2, band_px)
    chance = max(chance_of_model, chance_of_match)
    false_alarms = log10_false_alarms(agreeing - contradicted, tried, chance=chance, free=2)
    relevant_px = max(unit_px, 2.0 * fit.sigma_px)
    # A competing model must gain more than wrong matches agree by chance, and 5 % of the inliers off it.
    expected = 2.0 * chance_of_match * (tried - agreeing)
    least = max(0.05 * agreeing, expected + 2.0 * np.sqrt(expected) + 1.0)
    different = [m for m in models if m.gained >= least and m.differs(relevant_px * frame.scale)]
    other = min(different, key=lambda m: m.margin, default=None)
    off = f"{agreeing:.0f} of {tried:.0f} matches off the dominant plane agree with F"
    reasons = list[str]()
    if false_alarms > -2.0:
        reasons.append(f"{off}, no more than expected by chance")
    if contradicted > 0.2 * agreeing:
        among = f"{contradicted:.0f} of them lie among matches of the plane"
        reasons.append(f"{off}, but {among}, as matches between repeated structures do")
    if other is not None and other.margin < MIN_MARGIN:
        more = f"another F explains {other.gained:.0f} matches that this F does not explain"
        reasons.append(f"{more}, and misses {other.lost:.0f} of its inliers")
    # Few matches estimate their own noise: Student's quantile instead of the normal one.
    allowed_px = error_px * student_factor(max(int(fit.inliers.sum()) - 7, 1))
    if not allowed_px <= relevant_px:
        reasons.append(f"the covariance of F allows epipolar line errors of {allowed_px:.2g} px")
    return DegeneracyReport(
        determined=not reasons, reasons=tuple(reasons), off_plane=agreeing, contradicted=contradicted,
        log10_false_alarms=false_alarms, expected_error_px=error_px,
        competing_margin=other.margin if other is not None else float("inf"),
        competing_model=frame.matrix_in_pixels(other.f) if other is not None else None,
    )  # fmt: skip


def _contradicted_fraction(points: F64, weights: F64, H: F64, off: B8, near: float) -> float:
    """Fraction of the inliers ``off`` the plane that 30 % of their neighbours on it contradict."""
    # A larger difference of parallax than of position would change the order of two points of a surface.
    chosen = np.flatnonzero(off)
    chosen = chosen[:: max(1, len(chosen) // SAMPLED)]
    parallax = points[:, 2:] - dehomogenize(homogenize(points[:, :2]) @ H.T)
    apart = scipy.spatial.distance.cdist(points[chosen, :2], points[:, :2])
    apart[apart < near] = np.inf
    count = min(5, len(points))
    nearest = np.argpartition(apart, count - 1, axis=1)[:, :count]
    distance = np.take_along_axis(apart, nearest, axis=1)
    differ = np.linalg.norm(parallax[nearest] - parallax[chosen, None], axis=2) > distance
    neighbours = np.maximum(np.isfinite(distance).sum(axis=1), 1)
    contradicted, some = (~off[nearest] & differ).sum(axis=1) / neighbours > 0.3, weights[chosen]
    return float(some[contradicted].sum() / max(some.sum(), 1e-300))


@dataclass(frozen=True, eq=False)
class FundamentalEstimate(FundamentalFit):
    """An estimate of F with its matches, and whether they determine it, tested when it is first read."""

    xy1: F64 = field(kw_only=True, repr=False)  #: (M, 2) px, as ``xy2``: the matches
    xy2: F64 = field(kw_only=True, repr=False)
    unit_px: float = field(default=1.0, kw_only=True, repr=False)
    """Error of epipolar lines that matters: the threshold of the search."""
    noise_covariance: F64 | None = field(default=None, kw_only=True, repr=False)
    """(9, 9) covariance without accepted wrong matches, of which the test takes its own account."""

    @cached_property
    def degeneracy(self) -> DegeneracyReport:
        """The test for degenerate configurations with its evidence; the same for the same matches and F."""
        if len(self.xy1) < MINIMUM:
            return DegeneracyReport(False, (f"{len(self.xy1)} matches are too few to test F",))
        noise = self.covariance if self.noise_covariance is None else self.noise_covariance
        fit, rng = replace(self, covariance=noise), np.random.default_rng(0)
        return assess_degeneracy(fit, self.xy1, self.xy2, rng=rng, unit_px=self.unit_px)

    @property
    def determined(self) -> bool:
        """Whether the matches determine F; many inliers alone do not show it."""
        return self.degeneracy.determined

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the matches do not determine F, in sentences; empty if they do."""
        return self.degeneracy.reasons

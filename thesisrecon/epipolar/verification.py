"""Verification of a pair: inliers of F, share explained by one homography, whether to accept the pair."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.configuration import MINIMUM, Configuration, classify_configuration
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.homography import SUBSET, induced_homographies
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.geometry.conditioning import unit_norm
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import epipoles, homography_linear, homography_residuals
from thesisrecon.records import DegeneracyReport, FundamentalFit, Matches, TwoView

# 99 % of a plane's matches: sqrt(chi-square(2)) = 3.03, times sqrt(2) for noise in both images.
HOMOGRAPHY_SIGMAS = 4.3
# Planes tried for the inlier ratio: a plane with a quarter of the matches is found with 96 %.
TRIPLES = 200


@dataclass(frozen=True)
class PairVerification:
    """Keep the matches that agree with F; accept the pair if their number and their ratio are large enough.

    A wrong F on a repetitive facade has about 30 inliers and a small inlier ratio; a right one has more. A
    plane or a pure rotation gives good tracks and an undetermined F: the pair is accepted, and its
    ``configuration``, ``degeneracy`` and ``homography_inlier_ratio`` report it.

    Parameters
    ----------
    min_inliers : int
        Minimum number of verified matches, at least 8.
    min_inlier_ratio : float
        Minimum fraction of the matches that are verified, in [0, 1].
    """

    min_inliers: int = 60
    min_inlier_ratio: float = 0.25

    # Distance within which a homography explains a match, or 4.3 sigma if that is more.
    homography_px = 2.0

    def __post_init__(self) -> None:
        if self.min_inliers < 8:
            raise ValueError(f"min_inliers must be at least 8; got {self.min_inliers}")
        if not 0.0 <= self.min_inlier_ratio <= 1.0:
            raise ValueError(f"min_inlier_ratio must lie in [0, 1]; got {self.min_inlier_ratio}")

    def verify(self, matches: Matches, fit: FundamentalFit, rng: np.random.Generator) -> TwoView:
        """See `thesisrecon.config.Verifier.verify`."""
        inliers = fit.inliers
        if inliers.shape != (len(matches.xy1),):
            raise ValueError(f"the fit has {inliers.shape} inlier flags for {len(matches.xy1)} matches")
        xy1, xy2 = matches.xy1[inliers], matches.xy2[inliers]
        tolerance = max(self.homography_px, HOMOGRAPHY_SIGMAS * fit.sigma_px)
        ratio = homography_inlier_ratio(fit.F, xy1, xy2, tolerance_px=tolerance, rng=rng)
        reason = self._objection(len(xy1), len(inliers))
        configuration, degeneracy = _assess_pair(matches, fit, rng)
        return TwoView(
            i=matches.i,
            j=matches.j,
            F=fit.F,
            sigma_px=fit.sigma_px,
            index1=matches.index1[inliers],
            index2=matches.index2[inliers],
            xy1=xy1,
            xy2=xy2,
            affine=matches.affine[inliers],
            candidates=len(inliers),
            homography_inlier_ratio=ratio,
            accepted=not reason,
            reason=reason,
            configuration=configuration,
            degeneracy=degeneracy,
        )

    def _objection(self, verified: int, candidates: int) -> str:
        """Reason to reject the pair, empty if there is none."""
        if verified < self.min_inliers:
            return Notice("few-inliers", verified, counted(candidates, "match"), self.min_inliers)
        if verified < self.min_inlier_ratio * candidates:
            return Notice(
                "low-inlier-ratio",
                100.0 * verified / candidates,
                counted(candidates, "match"),
                100.0 * self.min_inlier_ratio,
            )
        return ""


def _assess_pair(
    matches: Matches, fit: FundamentalFit, rng: np.random.Generator
) -> tuple[str, DegeneracyReport | None]:
    """Configuration and degeneracy report of a pair; ("", None) below 12 inliers."""
    if fit.inliers.sum() < MINIMUM:
        return "", None
    try:
        kind = classify_configuration(fit.F, matches.xy1, matches.xy2, inliers=fit.inliers)
        degeneracy = assess_degeneracy(fit, matches.xy1, matches.xy2, rng=rng)
    except StageFailure:
        return "", None
    if kind in (Configuration.PLANE, Configuration.ROTATION):
        reason = Notice("one-homography", kind.value)
        degeneracy = replace(degeneracy, determined=False, reasons=(reason, *degeneracy.reasons))
    return kind.value, degeneracy


def homography_inlier_ratio(
    F: F64, xy1: F64, xy2: F64, *, tolerance_px: float, rng: np.random.Generator
) -> float:
    """The largest fraction of the matches (N, 2) of F that one homography maps to within ``tolerance_px``.

    The best of 200 planes through three matches is fitted again to its inliers until they stay the same. A
    ratio near 1 indicates a planar scene or a pure rotation; fewer than 5 matches always have a homography.
    """
    n = len(xy1)
    if n < 5:
        return 1.0
    chosen = rng.permutation(n)[:SUBSET]
    triples = np.argsort(rng.random((TRIPLES, min(len(chosen), 50))), axis=1)[:, :3]
    offsets = rng.integers(0, len(chosen), (TRIPLES, 1))
    triples = chosen[(triples + offsets) % len(chosen)]
    smallest_area = 1e-4 * float(np.ptp(xy1, axis=0).max()) ** 2
    planes = induced_homographies(unit_norm(F), epipoles(F)[1], np.hstack([xy1, xy2]), triples, smallest_area)
    moved = dehomogenize(homogenize(xy1[chosen]) @ planes.swapaxes(1, 2))
    counts = (np.sum((moved - xy2[chosen]) ** 2, axis=2) < tolerance_px**2).sum(axis=1)
    H = planes[counts.argmax()] if len(planes) else np.eye(3)
    inside = homography_residuals(H, xy1, xy2) < tolerance_px
    for _ in range(5):
        points1, points2 = xy1[inside], xy2[inside]
        if len(points1) < 5 or not (np.ptp(points1, axis=0).any() and np.ptp(points2, axis=0).any()):
            break
        again = homography_residuals(homography_linear(points1, points2), xy1, xy2) < tolerance_px
        if again.sum() <= inside.sum():
            break
        inside = again
    return float(inside.mean())

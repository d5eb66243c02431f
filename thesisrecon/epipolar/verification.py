"""How much of a pair one homography explains: a plane, or a camera that only turned.

Which matches of a pair to believe after F is known, and whether to believe the pair at all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.epipolar.configuration import MINIMUM, Configuration, classify_configuration
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.planes import homography_inlier_ratio
from thesisrecon.errors import StageFailure, counted
from thesisrecon.records import DegeneracyReport, FundamentalFit, Matches, TwoView

HOMOGRAPHY_SIGMAS = 4.3
"""99 % of a plane's matches: the root of chi-square(2) is 3.03, times sqrt(2) for noise in both images."""


@dataclass(frozen=True)
class PairVerification:
    """Keep the matches that agree with F; accept the pair where they are many and most of what was matched.

    A false F on a repetitive facade gathers about 30 inliers, and few of the matches; a right one gathers
    more. A plane or a camera that only turned gives good tracks and an undetermined F: the pair is accepted
    and its ``configuration``, ``certainty`` and ``homography_inlier_ratio`` say so.

    Parameters
    ----------
    min_inliers : verified matches a pair needs.
    min_inlier_ratio : share of the matches that must be verified.
    homography_px : distance within which a homography explains a match, or 4.3 sigma where that is more.
    """

    min_inliers: int = 60
    min_inlier_ratio: float = 0.25
    homography_px: float = 2.0

    def __post_init__(self) -> None:
        if self.min_inliers < 8:
            raise ValueError(f"min_inliers must be at least 8; got {self.min_inliers}")
        if not 0.0 <= self.min_inlier_ratio <= 1.0 or not self.homography_px > 0.0:
            raise ValueError("min_inlier_ratio must lie in [0, 1] and homography_px be positive")

    def verify(self, matches: Matches, fit: FundamentalFit, rng: np.random.Generator) -> TwoView:
        """The pair with its verified matches and the decision.

        Raises ``ValueError`` where ``matches`` and ``fit`` do not have the same number of matches.
        """
        kept = fit.inliers
        if kept.shape != (len(matches.xy1),):
            raise ValueError(f"the fit has {kept.shape} inlier flags for {len(matches.xy1)} matches")
        xy1, xy2 = matches.xy1[kept], matches.xy2[kept]
        tolerance = max(self.homography_px, HOMOGRAPHY_SIGMAS * fit.sigma_px)
        share = homography_inlier_ratio(fit.F, xy1, xy2, tolerance_px=tolerance, rng=rng)
        reason = self._objection(len(xy1), len(kept))
        configuration, degeneracy = _assess_pair(matches, fit, rng)
        return TwoView(
            i=matches.i,
            j=matches.j,
            F=fit.F,
            sigma_px=fit.sigma_px,
            index1=matches.index1[kept],
            index2=matches.index2[kept],
            xy1=xy1,
            xy2=xy2,
            affine=matches.affine[kept],
            candidates=len(kept),
            homography_inlier_ratio=share,
            accepted=not reason,
            reason=reason,
            configuration=configuration,
            degeneracy=degeneracy,
        )

    def _objection(self, verified: int, candidates: int) -> str:
        if verified < self.min_inliers:
            return (
                f"only {verified} of {counted(candidates, 'match')} agree with one epipolar geometry; "
                f"{self.min_inliers} are needed to tell it from chance and repeated patterns"
            )
        if verified < self.min_inlier_ratio * candidates:
            return (
                f"only {100.0 * verified / candidates:.0f} % of {counted(candidates, 'match')} agree with "
                f"one epipolar geometry; {100.0 * self.min_inlier_ratio:.0f} % are needed"
            )
        return ""


def _assess_pair(
    matches: Matches, fit: FundamentalFit, rng: np.random.Generator
) -> tuple[str, DegeneracyReport | None]:
    """The name of what the matches show and whether they determine F; ("", None) below 12 inliers."""
    if fit.inliers.sum() < MINIMUM:
        return "", None
    try:
        found = classify_configuration(fit.F, matches.xy1, matches.xy2, inliers=fit.inliers)
        degeneracy = assess_degeneracy(fit, matches.xy1, matches.xy2, rng=rng)
    except StageFailure:
        return "", None
    if found.kind in (Configuration.PLANE, Configuration.ROTATION):
        reason = f"one homography explains the matches ({found.kind.value})"
        degeneracy = replace(degeneracy, determined=False, reasons=(reason, *degeneracy.reasons))
    return found.kind.value, degeneracy

"""Verification of a pair: which matches to keep once F is known, and whether to accept the pair."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.epipolar.configuration import MINIMUM, Configuration, classify_configuration
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.planes import homography_inlier_ratio
from thesisrecon.errors import StageFailure, counted
from thesisrecon.records import DegeneracyReport, FundamentalFit, Matches, TwoView

# 99 % of a plane's matches: sqrt(chi-square(2)) = 3.03, times sqrt(2) for noise in both images.
HOMOGRAPHY_SIGMAS = 4.3


@dataclass(frozen=True)
class PairVerification:
    """Keep the matches that agree with F; accept the pair if they are numerous and most of all matches.

    A wrong F on a repetitive facade has about 30 inliers and a small inlier ratio; a right one has more. A
    plane or a pure rotation gives good tracks and an undetermined F: the pair is accepted, and its
    ``configuration``, ``degeneracy`` and ``homography_inlier_ratio`` report it.

    Parameters
    ----------
    min_inliers : int
        Minimum number of verified matches, at least 8.
    min_inlier_ratio : float
        Minimum fraction of the matches that are verified, in [0, 1].
    homography_px : float
        Distance within which a homography explains a match, or 4.3 sigma if that is more.
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
        """Verify the matches of a pair.

        Parameters
        ----------
        matches : Matches
            All matches of the pair.
        fit : FundamentalFit
            Robust estimate of F from these matches.
        rng : numpy.random.Generator
            Source of the samples.

        Returns
        -------
        TwoView
            The pair with its verified matches, its configuration and the decision.

        Raises
        ------
        ValueError
            If ``matches`` and ``fit`` do not have the same number of matches.

        Examples
        --------
        >>> import numpy as np
        >>> from thesisrecon import estimate_fundamental
        >>> from thesisrecon.records import Matches
        >>> rng, index = np.random.default_rng(0), np.arange(60)
        >>> xy1 = rng.uniform(0, 500, (60, 2))
        >>> xy2 = xy1 + np.array([[40.0, 10.0]]) / rng.uniform(1, 4, (60, 1)) + rng.normal(0, 0.3, (60, 2))
        >>> affine = np.tile(np.eye(2), (60, 1, 1))
        >>> matches = Matches(0, 1, index, index, xy1, xy2, np.ones(60, np.float32), affine)
        >>> pair = PairVerification(min_inliers=40).verify(matches, estimate_fundamental(xy1, xy2), rng)
        >>> pair.accepted, pair.configuration
        (True, 'pure translation')
        """
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
            return (
                f"only {verified} of {counted(candidates, 'match')} agree with one epipolar geometry "
                f"(at least {self.min_inliers} are needed to exclude chance and repeated patterns)"
            )
        if verified < self.min_inlier_ratio * candidates:
            return (
                f"only {100.0 * verified / candidates:.0f} % of {counted(candidates, 'match')} agree with "
                f"one epipolar geometry (at least {100.0 * self.min_inlier_ratio:.0f} % are needed)"
            )
        return ""


def _assess_pair(
    matches: Matches, fit: FundamentalFit, rng: np.random.Generator
) -> tuple[str, DegeneracyReport | None]:
    """Return the configuration and the degeneracy report of a pair; ("", None) below 12 inliers."""
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

"""Whether the matches of a pair determine its F, beyond agreeing with it: evidence, verdict, reasons.

Where most matches lie on one plane, every [e]x H of its homography H explains them, and the epipole rests on
the rest. A wrong F then has as many inliers as the right one, or more. It betrays itself in four ways: hardly
more matches off the plane agree with it than chance would have; another epipole explains about as many; its
covariance is large; or its matches off the plane lie amid those of the plane, where no surface could be, as
matches from one window of a facade to the next do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.epipolar.certainty.kernels import contradicted_shares
from thesisrecon.epipolar.certainty.plane import (
    DominantPlane,
    chance_of_agreement,
    find_dominant_plane,
    log10_false_alarms,
    once_each,
)
from thesisrecon.epipolar.certainty.rivals import Rival, compare_rivals, find_rivals
from thesisrecon.epipolar.frame import PairFrame, check_matches
from thesisrecon.epipolar.precision import epipolar_distance_std
from thesisrecon.types import Certainty, FundamentalFit

F64 = NDArray[np.float64]
B8 = NDArray[np.bool_]

MINIMUM = 8
BAND_SIGMAS, BAND_FLOOR_PX, SIGMA_FLOOR_PX = 2.5, 0.3, 0.1
LARGEST_CHANCE = -2.0
"""log10 of the false alarms that matches off the plane may be."""
LEAST_MARGIN = 3.0
"""Standard errors by which a rival must be worse. Right ones of real facades have 7 and more, wrong ones less
than 2; it is no bound of a probability, since matches of repeated parts are not independent."""
LEAST_GAIN = 0.05
"""A rival that changes less than this share of the matches off the plane is F with other wrong matches."""
LARGEST_ERROR_PX = 1.0
"""Distance from epipolar lines that matters, in pixels, or 2 sigma where that is more."""
CONTRADICTED, MOST_CONTRADICTED, JUDGED = 0.3, 0.2, 60
"""A match is contradicted where more than this share of its neighbours does so; so many matches may be."""


@dataclass(frozen=True)
class _Support:
    """Weights of matches off the plane: ``agreeing`` with F, all ``tried``, and what is ``contradicted``."""

    agreeing: float
    tried: float
    contradicted: float


def judge_certainty(fit: FundamentalFit, xy1: F64, xy2: F64, *, rng: Generator) -> Certainty:
    """Whether the matches (N, 2) px, wrong ones too, leave only ``fit`` as their epipolar geometry.

    Undetermined where fewer matches off the dominant plane agree with F than would be a surprise by chance,
    where another F, of that plane or from another search, explains about as many (McNemar's test, distances
    that matter), where more than a fifth of those off the plane are contradicted by neighbours on it, or
    where the covariance lets the inliers be more than a pixel off their lines. A pure translation is
    determined. Wrong matches that are as coherent as a surface (a whole facade shifted by a window) cannot be
    told from one.

    Raises ``ValueError`` where ``fit`` and the matches do not belong together, and as
    :func:`~thesisrecon.epipolar.frame.check_matches`.
    """
    xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
    if fit.inliers.shape != (len(xy1),):
        raise ValueError(f"the fit has {fit.inliers.shape} inlier flags for {len(xy1)} matches")
    frame = PairFrame.of(xy1, xy2)
    points, f = frame.points(xy1, xy2), frame.matrix_in_frame(fit.F)
    sigma_px = max(fit.sigma_px, SIGMA_FLOOR_PX)
    band_px = max(BAND_SIGMAS * fit.sigma_px, BAND_FLOOR_PX)
    plane = find_dominant_plane(f, points, fit.inliers, sigma=sigma_px * frame.scale, rng=rng)
    error_px = _expected_error(fit, xy1, xy2)
    if plane is None:
        return Certainty(False, ("too few matches agree with the geometry",), expected_error_px=error_px)
    weights = once_each(xy1, xy2)
    rivals, share = find_rivals(f, points, weights, plane, band=band_px * frame.scale, rng=rng)
    ends = [frame.matrix_in_frame(F) for F in fit.rivals]
    rivals += compare_rivals(ends, f, points, weights, band=band_px * frame.scale)
    support = _support(points, fit.inliers, weights, plane, 2.0 * sigma_px * frame.scale)
    by_chance = chance_of_agreement(xy1, xy2, band_px)
    chance = log10_false_alarms(
        support.agreeing - support.contradicted,
        support.tried,
        chance=max(share, by_chance),
        free=2,
    )
    matters_px = max(LARGEST_ERROR_PX, 2.0 * fit.sigma_px)
    least = _least_gain(support, by_chance)
    different = [r for r in rivals if r.gained >= least and _differs(r, matters_px * frame.scale)]
    other = min(different, key=lambda r: r.margin, default=None)
    return Certainty(
        determined=not (reasons := tuple(_reasons(support, chance, other, error_px, matters_px))),
        reasons=reasons,
        off_plane=support.agreeing,
        contradicted=support.contradicted,
        log10_false_alarms=chance,
        rival_margin=other.margin if other is not None else float("inf"),
        rival=frame.matrix_in_pixels(other.f) if other is not None else None,
        expected_error_px=error_px,
    )


def _least_gain(support: _Support, chance: float) -> float:
    """Weight of matches that a rival must gain to be one: more than of the wrong ones agree by chance."""
    expected = 2.0 * chance * (support.tried - support.agreeing)
    return float(max(LEAST_GAIN * support.agreeing, expected + 2.0 * np.sqrt(expected) + 1.0))


def _differs(rival: Rival, matters: float) -> bool:
    """Whether F is wrong if the rival is right; one that explains all that F does must explain much more, as
    a wrong match or two that it gains are far from F too."""
    return rival.apart > matters or (rival.error > matters and rival.margin < -LEAST_MARGIN)


def _support(points: F64, inliers: B8, weights: F64, plane: DominantPlane, near: float) -> _Support:
    mine = inliers & plane.off
    chosen = np.flatnonzero(mine[inliers])
    # Every k-th: enough to know a share.
    chosen = chosen[:: max(1, len(chosen) // JUDGED)]
    shares = contradicted_shares(plane.h, points[inliers], ~plane.off[inliers], chosen, near)
    some = weights[inliers][chosen]
    agreeing = float(weights[mine].sum())
    part = float(some[shares > CONTRADICTED].sum() / max(some.sum(), 1e-300))
    return _Support(agreeing, float(weights[plane.off].sum()), part * agreeing)


def _expected_error(fit: FundamentalFit, xy1: F64, xy2: F64) -> float:
    """RMS over the inliers of the distance of exact matches to their lines, px, from the covariance of F."""
    some = np.flatnonzero(fit.inliers)
    some = some[:: max(1, len(some) // JUDGED)]
    std = epipolar_distance_std(fit.F, fit.covariance, xy1[some], xy2[some])
    return float(np.sqrt(np.mean(std**2))) if len(std) else float("inf")


def _reasons(
    support: _Support, chance: float, rival: Rival | None, error_px: float, matters_px: float
) -> list[str]:
    off = f"{support.agreeing:.0f} of {support.tried:.0f} matches off the dominant plane agree with it"
    reasons = []
    if chance > LARGEST_CHANCE:
        reasons.append(f"{off}, no more than chance gives")
    if support.contradicted > MOST_CONTRADICTED * support.agreeing:
        reasons.append(
            f"{off}, but {support.contradicted:.0f} of them lie amid matches of the plane, as those between "
            f"repeated parts do"
        )
    if rival is not None and rival.margin < LEAST_MARGIN:
        reasons.append(
            f"another geometry explains {rival.gained:.0f} matches that it does not, and "
            f"leaves {rival.lost:.0f} of its own"
        )
    if error_px > matters_px:
        reasons.append(f"its covariance allows epipolar lines to be {error_px:.2g} px off")
    return reasons

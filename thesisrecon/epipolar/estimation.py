"""The fundamental matrix by any method of chapter 5, with its noise, covariance and degeneracy test."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.epipolar._degeneracy import assess_degeneracy
from thesisrecon.epipolar._frame import PairFrame, check_matches
from thesisrecon.epipolar._refinement import fundamental_covariance
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.errors import StageFailure, unknown_word
from thesisrecon.records import DegeneracyReport, FundamentalFit

Method = Literal[
    "locally-optimised", "ransac", "least-median", "gold-standard", "eight-point", "seven-point"
]  # fmt: skip
# The solutions of the seven-point algorithm fit their matches exactly.
MIN_TESTED = 8


@dataclass(frozen=True)
class FundamentalEstimate(FundamentalFit):
    """An estimate of F with its matches, and whether they determine it, tested when it is first read.

    Parameters
    ----------
    xy1, xy2 : ndarray (M, 2)
        The matches, px.
    """

    xy1: NDArray[np.float64] = field(kw_only=True, repr=False)
    xy2: NDArray[np.float64] = field(kw_only=True, repr=False)

    @cached_property
    def degeneracy(self) -> DegeneracyReport:
        """The test of section 5.5 with its evidence; the same for the same matches and F."""
        if len(self.xy1) < MIN_TESTED:
            return DegeneracyReport(False, (f"{len(self.xy1)} matches are too few to test F",))
        return assess_degeneracy(self, self.xy1, self.xy2, rng=np.random.default_rng(0))

    @property
    def determined(self) -> bool:
        """Whether the matches determine F; many inliers alone do not show it."""
        return self.degeneracy.determined

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the matches do not determine F, in sentences; empty if they do."""
        return self.degeneracy.reasons


def estimate_fundamental(
    xy1: NDArray[np.float64],
    xy2: NDArray[np.float64],
    *,
    method: Method = "locally-optimised",
    threshold_px: float | None = 1.0,
    seed: int | Generator = 0,
) -> FundamentalEstimate:
    """Estimate the fundamental matrix of matches by one of the methods of chapter 5.

    Parameters
    ----------
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 8 (N = 7 for "seven-point"), px.
    method : str
        For matches with outliers: "locally-optimised"
        (:class:`~thesisrecon.epipolar.locally_optimised.LocallyOptimisedRansac`), "ransac" (Algorithm 2 of
        the thesis) or "least-median". For matches without outliers: "gold-standard" (least reprojection
        error, HZ 11.4.1), "eight-point" (normalised) or "seven-point" (up to three solutions).
    threshold_px : float or None
        Largest Sampson distance of an inlier during the search of the first two methods. None: no outliers;
        "gold-standard" is used instead of these two.
    seed : int or numpy.random.Generator
        Random seed, or the generator to draw from; the same seed gives the same result.

    Returns
    -------
    FundamentalEstimate
        F with x2' F x1 = 0, inliers, noise and covariance. ``determined``: no other F explains the matches as
        well; otherwise ``reasons`` says why. The covariance is that of the minimum of the Sampson distances,
        a lower bound for the linear methods. For "seven-point" noise and covariance are NaN (there are no
        residuals), and ``competing_models`` are the other solutions.

    Raises
    ------
    ValueError
        If the method is unknown, the shapes differ or coordinates are not finite.
    StageFailure
        If there are too few or collinear matches, or no F has 8 matches within the threshold.

    Examples
    --------
    >>> import numpy as np
    >>> import thesisrecon
    >>> rng = np.random.default_rng(0)
    >>> xy1 = rng.uniform(0, 500, (60, 2))
    >>> xy2 = xy1 + np.array([[40.0, 10.0]]) / rng.uniform(1, 4, (60, 1))
    >>> xy2[:20] = rng.uniform(0, 500, (20, 2))
    >>> fit = thesisrecon.estimate_fundamental(xy1, xy2)
    >>> bool(fit.inliers[20:].all()), fit.determined
    (True, True)
    >>> plane = xy1 + rng.normal([40.0, 10.0], 0.3, (60, 2))
    >>> thesisrecon.estimate_fundamental(xy1, plane).determined
    False
    >>> linear = thesisrecon.estimate_fundamental(xy1[20:], xy2[20:], method="eight-point")
    >>> linear.covariance.shape
    (9, 9)
    """
    rng = np.random.default_rng(seed)
    if threshold_px is None:
        threshold_px, method = 1.0, "gold-standard" if method in ("locally-optimised", "ransac") else method
    if method == "locally-optimised":
        fit = LocallyOptimisedRansac(threshold_px=threshold_px).estimate(xy1, xy2, rng)
    elif method == "seven-point":
        fit = _fit_seven(xy1, xy2)
    elif method not in get_args(Method):
        raise ValueError(unknown_word("method", method, get_args(Method)))
    else:
        # Imported on use: the default method does not need it.
        from thesisrecon.epipolar.ransac import LeastMedianOfSquares, ThesisRansac

        if method == "ransac":
            fit = ThesisRansac(threshold_px=threshold_px).estimate(xy1, xy2, rng)
        elif method == "least-median":
            fit = LeastMedianOfSquares().estimate(xy1, xy2, rng)
        else:
            fit = _fit_all(xy1, xy2, refined=method == "gold-standard")
    # Copies: the test is made later.
    xy1, xy2 = np.array(xy1, dtype=np.float64), np.array(xy2, dtype=np.float64)
    return FundamentalEstimate(**vars(fit), xy1=xy1, xy2=xy2)


def _fit_all(xy1: NDArray[np.float64], xy2: NDArray[np.float64], *, refined: bool) -> FundamentalFit:
    """Estimate F from all matches; the noise by the median residual, as for the robust methods."""
    from thesisrecon.epipolar.linear import estimate_eight_point
    from thesisrecon.epipolar.ransac import discard_outliers
    from thesisrecon.epipolar.refinement import refine_fundamental

    xy1, xy2 = check_matches(xy1, xy2, needed=8)
    F = estimate_eight_point(xy1, xy2)
    F = refine_fundamental(F, xy1, xy2, "reprojection") if refined else F
    sigma, inliers = discard_outliers(F, xy1, xy2)
    frame = PairFrame.of(xy1, xy2)
    points = frame.points(xy1[inliers], xy2[inliers])
    covariance = fundamental_covariance(frame, frame.matrix_in_frame(F), points, sigma * frame.scale)
    return FundamentalFit(F, inliers, sigma, covariance)


def _fit_seven(xy1: NDArray[np.float64], xy2: NDArray[np.float64]) -> FundamentalFit:
    from thesisrecon.epipolar.linear import estimate_seven_point

    solutions = estimate_seven_point(xy1, xy2)
    if not len(solutions):
        raise StageFailure(
            "the seven matches do not determine the fundamental matrix",
            "their equations are dependent",
            "choose seven matches in general position, no four of them in one plane of the scene",
        )
    nan = float("nan")
    every = np.ones(len(xy1), dtype=bool)
    return FundamentalFit(solutions[0], every, nan, np.full((9, 9), nan), 0, solutions[1:])

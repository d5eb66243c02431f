"""Every method of chapter 5 that gives an F of two lists of matches, and the libraries beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.frame import PairFrame
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.ransac import LeastMedianOfSquares, SevenPointProblem, ThesisRansac
from thesisrecon.epipolar.refinement import refine_epipolar_distance, refine_reprojection, refine_sampson
from thesisrecon.epipolar.row_parameterization import (
    refine_epipolar_distance_by_rows,
    refine_reprojection_by_rows,
    refine_sampson_by_rows,
)
from thesisrecon.errors import StageFailure
from thesisrecon.numerics.ransac import SampleConsensus
from validation.references.fundamental import SOLVERS, opencv_eight_point

Estimate = Callable[[F64, F64, float, int], F64 | None]
"""F (3, 3) of matches (N, 2), (N, 2) px, with a threshold (px) and a seed; None where there is none."""

GOLD, DEFAULT = "gold standard, orthonormal", "default"
GOLD_FROM_DEFAULT = "gold standard, orthonormal, started from the default"
RAW, NORMALISED = "eight-point, raw pixels", "eight-point, normalised"
THRESHOLD_PX, TOLD_SIGMAS = 1.0, 3.0


@dataclass(frozen=True)
class Method:
    """A method by name: whether wrong matches may be among its matches, and whether a threshold rules it."""

    name: str
    estimate: Estimate
    robust: bool = False
    thresholded: bool = False

    def fundamental(self, xy1: F64, xy2: F64, *, threshold_px: float, seed: int) -> F64 | None:
        """F (3, 3), or None where the method gave none or nothing finite."""
        try:
            F = self.estimate(xy1, xy2, threshold_px, seed)
        except StageFailure:
            return None
        return F if F is not None and F.shape == (3, 3) and np.isfinite(F).all() and F.any() else None


def _refined(refine: Callable[[F64, F64, F64], F64]) -> Estimate:
    """The minimum of a criterion that the normalised eight-point estimate leads to."""
    return lambda xy1, xy2, _, __: refine(estimate_eight_point(xy1, xy2), xy1, xy2)


def _linear(*, normalized: bool, rank_two: bool = True) -> Estimate:
    return lambda xy1, xy2, _, __: estimate_eight_point(xy1, xy2, normalized=normalized, rank_two=rank_two)


def _thesis(**variant: bool) -> Estimate:
    def estimate(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> F64:
        method = ThesisRansac(threshold_px=threshold_px, **variant)
        return method.estimate(xy1, xy2, np.random.default_rng(seed)).F

    return estimate


def _search_alone(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> F64 | None:
    frame = PairFrame.of(xy1, xy2)
    loop = SampleConsensus(threshold_px * frame.scale, enough_share=ThesisRansac().enough_share)
    problem = SevenPointProblem(frame.points(xy1, xy2))
    found = loop.search(problem, len(xy1), np.random.default_rng(seed))
    return None if found is None else frame.matrix_in_pixels(found.model)


def _least_median(xy1: F64, xy2: F64, _: float, seed: int) -> F64:
    return LeastMedianOfSquares().estimate(xy1, xy2, np.random.default_rng(seed)).F


def _default(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> F64:
    method = LocallyOptimisedRansac(threshold_px=threshold_px)
    return method.estimate(xy1, xy2, np.random.default_rng(seed)).F


def _gold_from_default(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> F64:
    return refine_reprojection(_default(xy1, xy2, threshold_px, seed), xy1, xy2)


def _opencv_eight_point(xy1: F64, xy2: F64, _: float, __: int) -> F64 | None:
    return opencv_eight_point(xy1, xy2)


def _library(name: str) -> Estimate:
    def estimate(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> F64 | None:
        F = SOLVERS[name](xy1, xy2, threshold_px, seed)[0]
        return None if F is None else np.asarray(F, dtype=np.float64)

    return estimate


OURS = (
    Method("eight-point, raw pixels, rank 3", _linear(normalized=False, rank_two=False)),
    Method(RAW, _linear(normalized=False)),
    Method(NORMALISED, _linear(normalized=True)),
    Method("gradient (5.4), thesis' rows", _refined(refine_sampson_by_rows)),
    Method("gradient (5.4), orthonormal", _refined(refine_sampson)),
    Method("epipolar distance (5.6), thesis' rows", _refined(refine_epipolar_distance_by_rows)),
    Method("epipolar distance (5.6), orthonormal", _refined(refine_epipolar_distance)),
    Method("gold standard, thesis' rows", _refined(refine_reprojection_by_rows)),
    Method(GOLD, _refined(refine_reprojection)),
    Method(GOLD_FROM_DEFAULT, _gold_from_default),
    Method("Algorithm 2, seven-point search alone", _search_alone, robust=True, thresholded=True),
    *(
        Method(f"Algorithm 2, {label}", _thesis(**variant), robust=True, thresholded=True)
        for label, variant in (
            ("gradient", {}),
            ("epipolar distance", {"epipolar_distance": True}),
            ("gradient, test of both lines", {"both_lines": True}),
            ("gradient, test of the sum", {"sum_of_lines": True}),
        )
    ),
    Method("least median of squares", _least_median, robust=True),
    Method(DEFAULT, _default, robust=True, thresholded=True),
)
LIBRARIES = (
    Method("OpenCV FM_8POINT", _opencv_eight_point),
    Method("OpenCV FM_LMEDS", _library("FM_LMEDS"), robust=True),
    *(
        Method(label, _library(name), robust=True, thresholded=True)
        for label, name in (
            ("OpenCV FM_RANSAC", "FM_RANSAC"),
            ("OpenCV USAC_ACCURATE", "USAC_ACCURATE"),
            ("OpenCV USAC_MAGSAC", "USAC_MAGSAC"),
            ("PoseLib", "PoseLib"),
        )
    ),
)
METHODS = OURS + LIBRARIES

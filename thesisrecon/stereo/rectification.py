"""What a rectification does to the photographs, in numbers: the better one distorts less.

The front doors of rectification, and the choice among its methods by what they do to the photographs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.stereo.epipolar_pair import EpipolarPair, Size, pair_of_cameras, pair_of_fundamental
from thesisrecon.stereo.planar import (
    CommonOrientationRectifier,
    FrameLimits,
    HartleyRectifier,
    LoopZhangRectifier,
    MinimumDistortionRectifier,
    PlanarRectification,
    disparity_bounds,
    disparity_gradients,
    singular_values,
)
from thesisrecon.stereo.polar import PolarRectification, PolarRectifier

STEP_PX = 0.01
"""Half the distance over which derivatives of a map are taken."""


class Rectification(Protocol):
    """A pair of maps from photographs to a common frame."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frame."""

    def original_from_rectified(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Pixels (N, 2) of the photograph."""

    def rectified_from_original(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Places (N, 2) in the frame."""


@dataclass(frozen=True)
class RectificationQuality:
    """Distortion of a rectified pair; pairs of numbers are those of side 0 and 1.

    ``rms_dy_px`` of the matches in pixels of the frame, NaN without any. ``orthogonality_deg``: the angle of
    the photograph's midlines in the frame, ``aspect`` their ratio over what it was, NaN where they are not
    finite. ``kept`` share of each photograph inside the frame, ``growth`` pixels of the frame over those of
    the larger photograph. ``least_scale, greatest_scale`` pixels of the frame per pixel along any direction.
    ``stretch`` is the typical factor by which lengths change, exp of the RMS log singular value about their
    mean, 1 for similarities. ``slant`` (RMS gradient of the quadratic polynomial fitted to the
    disparities of the matches) says how unlike both sides are, and ``disparities`` their least and greatest.
    """

    rms_dy_px: float
    orthogonality_deg: tuple[float, float]
    aspect: tuple[float, float]
    coverage: tuple[float, float]
    size_ratio: float
    least_scale: float
    greatest_scale: float
    stretch: float
    disparity_slope: float
    disparities: tuple[float, float]

    @property
    def distortion(self) -> float:
        """The number that the choice is made by: what is done to either photograph and between both.

        ``log stretch`` and half the ``slant``, as the root of the sum of squares: a slant s stretches windows
        of one side against the other by s, to first order half of it for either.
        """
        disparity_slope = self.disparity_slope if np.isfinite(self.disparity_slope) else 0.0
        return float(np.hypot(np.log(self.stretch), 0.5 * disparity_slope))


def measure_quality(rectification: Rectification, pair: EpipolarPair) -> RectificationQuality:
    """Measure what a rectification does to ``pair``, at the samples of what both photographs see.

    It need not have been made from this pair: the epipolar geometry of ``pair`` says only what both see.
    """
    values, coverage, midlines = [], [], []
    for side in (0, 1):
        samples = pair.regions[side]
        inside = np.isfinite(rectification.rectified_from_original(side, samples)).all(axis=1)
        J = jacobians(rectification, side, samples[inside])
        values.append(singular_values(J[np.isfinite(J).all(axis=(1, 2))]))
        coverage.append(_share_inside(rectification, side, pair.sizes[side]))
        midlines.append(_midlines(rectification, side, pair.sizes[side]))
    found = np.concatenate(values)
    found = found if len(found) else np.full((1, 2), np.nan)
    logs = np.log(np.maximum(found, 1e-12))
    dy, disparity_slope, disparities = _matches(rectification, pair)
    width, height = rectification.size
    return RectificationQuality(
        rms_dy_px=dy,
        orthogonality_deg=(midlines[0][0], midlines[1][0]),
        aspect=(midlines[0][1], midlines[1][1]),
        coverage=(coverage[0], coverage[1]),
        size_ratio=width * height / max(w * h for w, h in pair.sizes),
        least_scale=float(found[:, 1].min()),
        greatest_scale=float(found[:, 0].max()),
        stretch=float(np.exp(np.std(logs))),
        disparity_slope=disparity_slope,
        disparities=disparities,
    )


def jacobians(rectification: Rectification, side: int, xy: F64) -> F64:
    """Derivatives (N, 2, 2) of the frame's coordinates by those of the photograph at pixels (N, 2), NaN
    where a polar frame begins and ends."""
    columns = []
    for axis in np.eye(2):
        ahead = rectification.rectified_from_original(side, xy + STEP_PX * axis, within=False)
        behind = rectification.rectified_from_original(side, xy - STEP_PX * axis, within=False)
        step = ahead - behind
        # A full circle of half-lines is cut somewhere, and neighbours across the cut are far apart.
        step[np.abs(step[:, 1]) > 0.5 * rectification.size[1]] = np.nan
        columns.append(step / (2.0 * STEP_PX))
    return np.stack(columns, axis=-1)


def _share_inside(rectification: Rectification, side: int, size: tuple[int, int]) -> float:
    x, y = ((np.arange(48) + 0.5) / 48 * length - 0.5 for length in size)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return float(np.isfinite(rectification.rectified_from_original(side, grid)).all(axis=1).mean())


def _midlines(rectification: Rectification, side: int, size: tuple[int, int]) -> tuple[float, float]:
    """Angle in degrees of the mapped midlines, and their ratio over that of the photograph."""
    w, h = size[0] - 1.0, size[1] - 1.0
    ends = np.array([[0.0, h / 2.0], [w, h / 2.0], [w / 2.0, 0.0], [w / 2.0, h]])
    a, b, c, d = rectification.rectified_from_original(side, ends, within=False)
    across, down = b - a, d - c
    lengths = float(np.hypot(*across)), float(np.hypot(*down))
    with np.errstate(invalid="ignore"):
        angle = float(np.degrees(np.arccos(np.clip(across @ down / (lengths[0] * lengths[1]), -1.0, 1.0))))
    return angle, lengths[0] / lengths[1] * h / w


def _matches(rectification: Rectification, pair: EpipolarPair) -> tuple[float, float, tuple[float, float]]:
    """RMS of y1 - y2, slant, and the range of disparities of the matches inside the frame."""
    left, right = (rectification.rectified_from_original(s, xy) for s, xy in enumerate(pair.matches))
    seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    if int(seen.sum()) < 3:
        return float("nan"), float("nan"), (float("nan"), float("nan"))
    left, right = left[seen], right[seen]
    dy = float(np.sqrt(np.mean((left[:, 1] - right[:, 1]) ** 2)))
    disparity_slope = float(np.sqrt(np.mean(np.sum(disparity_gradients(left, right) ** 2, axis=1))))
    return dy, disparity_slope, disparity_bounds(left[:, 0] - right[:, 0], margin=0.0)


AnyRectification = PlanarRectification | PolarRectification
Method = Literal["best", "hartley", "loop-zhang", "least-distortion", "polar", "metric"]


class Rectifier(Protocol):
    """A way of rectifying a pair."""

    def rectify(self, pair: EpipolarPair) -> AnyRectification:
        """Both maps; ``StageFailure`` where the pair cannot be rectified so."""


@dataclass(frozen=True)
class BestRectifier:
    """The one of several methods that distorts a pair least, measured by ``RectificationQuality.distortion``.

    Methods that keep the angle of a photograph's midlines within ``angle_deg`` of a right one and their ratio
    within ``aspect`` of its own come before the others, and methods that fail for a pair are passed over.
    Added are ``bending`` for polar frames, which bend straight lines, and ``size`` times the log of the
    frame's pixels over the photograph's, which cost time and tell nothing new.
    """

    methods: tuple[Rectifier, ...]
    angle_deg: float = 5.0
    aspect: float = 0.1
    bending: float = 0.03
    size: float = 0.05

    def rectify(self, pair: EpipolarPair) -> AnyRectification:
        """The best of those that succeed; the last one's ``StageFailure`` where none does."""
        best: AnyRectification | None = None
        least, failure = (True, np.inf), None
        for method in self.methods:
            try:
                found = method.rectify(pair)
            except StageFailure as reason:
                failure = reason
                continue
            cost = self._cost(found, measure_quality(found, pair))
            if best is None or cost < least:
                best, least = found, cost
        if best is None:
            raise failure if failure is not None else ValueError("a choice needs methods to choose from")
        return best

    def _cost(self, found: AnyRectification, quality: RectificationQuality) -> tuple[bool, float]:
        # A midline through the epipole of a polar frame has no angle.
        turned = max((abs(a - 90.0) for a in quality.orthogonality_deg if np.isfinite(a)), default=0.0)
        aspect = max((abs(a - 1.0) for a in quality.aspect if np.isfinite(a)), default=0.0)
        bent = self.bending if isinstance(found, PolarRectification) else 0.0
        cost = quality.distortion + bent + self.size * np.log(quality.size_ratio)
        return turned > self.angle_deg or aspect > self.aspect, float(cost)


def _methods(limits: FrameLimits) -> Mapping[Method, Rectifier]:
    return {
        "hartley": HartleyRectifier(limits),
        "loop-zhang": LoopZhangRectifier(limits),
        "least-distortion": MinimumDistortionRectifier(limits),
        "polar": PolarRectifier(limits),
        "metric": CommonOrientationRectifier(limits),
    }


def rectify(
    pair: EpipolarPair, *, method: Method = "best", limits: FrameLimits | None = None
) -> AnyRectification:
    """Rectify a pair by one method, or by whichever of those it has the data for distorts least.

    Raises ``ValueError`` for an unknown method, ``StageFailure`` for a pair that it cannot rectify.
    """
    limits = FrameLimits() if limits is None else limits
    methods = _methods(limits)
    if method == "best":
        bare = PolarRectifier(limits, max_scale=0.0, max_shear=0.0)
        return BestRectifier((*methods.values(), bare)).rectify(pair)
    if method not in methods:
        raise ValueError(f"a method of rectification is one of {['best', *methods]}; got {method!r}")
    return methods[method].rectify(pair)


def rectify_pair(
    F: F64, xy1: F64, xy2: F64, size1: Size, size2: Size, *, method: Method = "best"
) -> AnyRectification:
    """Rectify two photographs of which only F and its inliers are known (thesis, section 2.5).

    Parameters
    ----------
    F : (3, 3) with x2' F x1 = 0. xy1, xy2 : (N >= 8, 2) px matches that obey it.
    size1, size2 : (width, height) px.
    method : "hartley", "loop-zhang", "least-distortion" (planar), "polar", or the "best" of them.

    Returns
    -------
    Maps between either photograph and a frame common to both in which epipolar lines are rows, side 0 the
    first photograph and side 1 the second: x_right = x_left - d, d larger for nearer points. With the
    focal lengths unknown, "nearer" is judged with usual ones.

    Raises ``ValueError`` for wrong shapes and sizes, ``StageFailure`` for pairs without parallax, too few or
    contradictory matches, and for planar methods where the epipole is in a photograph.
    """
    return rectify(pair_of_fundamental(F, xy1, xy2, size1, size2), method=method)


def rectify_cameras(
    P1: F64,
    P2: F64,
    size1: Size,
    size2: Size,
    *,
    xy1: F64 | None = None,
    xy2: F64 | None = None,
    method: Method = "best",
) -> AnyRectification:
    """Rectify two photographs without lens distortion taken by metric cameras P = K [R t] (3, 4).

    As :func:`rectify_pair`, with "metric" (a common orientation) as one more method. Matches (N, 2) px that
    obey the cameras crop the frame to what both see, and "hartley" needs them.
    """
    return rectify(pair_of_cameras(P1, P2, size1, size2, xy1=xy1, xy2=xy2), method=method)


def disparity_range(
    rectification: AnyRectification, xy1: F64, xy2: F64, *, margin: float = 0.15
) -> tuple[int, int]:
    """Whole disparities (least, greatest) to search in, from matches (N, 2), (N, 2) px of the photographs.

    The 1 and 99 % quantiles of those inside the frame, widened at either end by ``margin`` times their
    difference and 2 px. Raises ``StageFailure`` where no match is inside.
    """
    left = rectification.rectified_from_original(0, xy1)
    right = rectification.rectified_from_original(1, xy2)
    d = left[:, 0] - right[:, 0]
    d = d[np.isfinite(d)]
    if len(d) == 0:
        raise StageFailure(
            "the range of disparities is not known", "no match is inside the rectified frame", "give one"
        )
    low, high = disparity_bounds(d, margin=margin)
    return int(np.floor(low)) - 2, int(np.ceil(high)) + 2

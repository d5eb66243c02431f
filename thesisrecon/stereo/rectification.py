"""Rectification of image pairs (thesis, section 2.5): methods, distortion measures, selection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.stereo.epipolar_pair import EpipolarPair, Size, pair_of_cameras, pair_of_fundamental
from thesisrecon.stereo.planar import (
    FrameLimits,
    PlanarRectification,
    disparity_bounds,
    disparity_gradients,
    singular_values,
)
from thesisrecon.stereo.planar_rectifiers import (
    CommonOrientationRectifier,
    HartleyRectifier,
    LoopZhangRectifier,
    MinimumDistortionRectifier,
)
from thesisrecon.stereo.polar import PolarRectification, PolarRectifier

STEP_PX = 0.01
"""Half step of numerical derivatives."""


class Rectification(Protocol):
    """Maps between two images and a common frame."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frame."""

    def original_from_rectified(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Map positions (N, 2) of the frame to pixels of an image."""

    def rectified_from_original(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Map pixels (N, 2) of an image to the frame."""


@dataclass(frozen=True)
class RectificationQuality:
    """Distortion measures of a rectified pair; pairs of numbers refer to both images.

    Attributes
    ----------
    rms_dy_px : float
        RMS vertical disparity of the matches, NaN without matches.
    orthogonality_deg : tuple of float
        Angle of the mapped image midlines.
    aspect : tuple of float
        Ratio of their lengths relative to the original, NaN if not finite.
    coverage : tuple of float
        Share of each image inside the frame.
    size_ratio : float
        Pixels of the frame relative to the larger image.
    min_scale, max_scale : float
        Extreme local scales along any direction.
    stretch : float
        Typical local scale change: exp of the standard deviation of the log singular values; 1 for
        similarities.
    disparity_slope : float
        RMS gradient of a quadratic polynomial fitted to the disparities: the difference between both images.
    disparities : tuple of float
        Disparity range of the matches.
    """

    rms_dy_px: float
    orthogonality_deg: tuple[float, float]
    aspect: tuple[float, float]
    coverage: tuple[float, float]
    size_ratio: float
    min_scale: float
    max_scale: float
    stretch: float
    disparity_slope: float
    disparities: tuple[float, float]

    @property
    def distortion(self) -> float:
        """Root of the sum of squares of ``log stretch`` and half the ``disparity_slope``.

        A slope s stretches windows of one image against the other by s, to first order s / 2 in each.
        """
        disparity_slope = self.disparity_slope if np.isfinite(self.disparity_slope) else 0.0
        return float(np.hypot(np.log(self.stretch), 0.5 * disparity_slope))


def measure_quality(rectification: Rectification, pair: EpipolarPair) -> RectificationQuality:
    """Measure the distortion of a rectification over the common field of view of a pair.

    Parameters
    ----------
    rectification : Rectification
        The rectification; it may come from another estimate of the epipolar geometry.
    pair : EpipolarPair
        The pair, which determines the common field of view.

    Returns
    -------
    RectificationQuality
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
        min_scale=float(found[:, 1].min()),
        max_scale=float(found[:, 0].max()),
        stretch=float(np.exp(np.std(logs))),
        disparity_slope=disparity_slope,
        disparities=disparities,
    )


def jacobians(rectification: Rectification, side: int, xy: F64) -> F64:
    """Compute numerical derivatives of the map from an image to the frame.

    Parameters
    ----------
    rectification : Rectification
    side : {0, 1}
    xy : ndarray (N, 2)

    Returns
    -------
    ndarray (N, 2, 2)
        Jacobians, NaN at the first and last row of a polar frame.
    """
    columns = []
    for axis in np.eye(2):
        ahead = rectification.rectified_from_original(side, xy + STEP_PX * axis, within=False)
        behind = rectification.rectified_from_original(side, xy - STEP_PX * axis, within=False)
        step = ahead - behind
        # A full circle of half-lines has a cut, across which neighbours are far apart.
        step[np.abs(step[:, 1]) > 0.5 * rectification.size[1]] = np.nan
        columns.append(step / (2.0 * STEP_PX))
    return np.stack(columns, axis=-1)


def _share_inside(rectification: Rectification, side: int, size: tuple[int, int]) -> float:
    x, y = ((np.arange(48) + 0.5) / 48 * length - 0.5 for length in size)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return float(np.isfinite(rectification.rectified_from_original(side, grid)).all(axis=1).mean())


def _midlines(rectification: Rectification, side: int, size: tuple[int, int]) -> tuple[float, float]:
    """Angle in degrees of the mapped midlines, and the ratio of their lengths relative to the original."""
    w, h = size[0] - 1.0, size[1] - 1.0
    ends = np.array([[0.0, h / 2.0], [w, h / 2.0], [w / 2.0, 0.0], [w / 2.0, h]])
    a, b, c, d = rectification.rectified_from_original(side, ends, within=False)
    across, down = b - a, d - c
    lengths = float(np.hypot(*across)), float(np.hypot(*down))
    with np.errstate(invalid="ignore"):
        angle = float(np.degrees(np.arccos(np.clip(across @ down / (lengths[0] * lengths[1]), -1.0, 1.0))))
    return angle, lengths[0] / lengths[1] * h / w


def _matches(rectification: Rectification, pair: EpipolarPair) -> tuple[float, float, tuple[float, float]]:
    """RMS of y1 - y2, disparity slope, and disparity range of the matches inside the frame."""
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
    """A rectification method."""

    def rectify(self, pair: EpipolarPair) -> AnyRectification:
        """Compute both maps; raise ``StageFailure`` if the pair cannot be rectified by this method."""


@dataclass(frozen=True)
class BestRectifier:
    """Selection of the rectification of least ``RectificationQuality.distortion`` among several methods.

    Methods within the angle and aspect limits take precedence; methods that fail are skipped.

    Parameters
    ----------
    methods : tuple of Rectifier
        Methods to choose from.
    angle_deg : float
        Limit of the midline angle's deviation from 90 degrees.
    aspect : float
        Limit of the relative change of the aspect ratio.
    bending : float
        Penalty of polar frames, which bend straight lines.
    size : float
        Weight of the log of the relative frame size, which costs time.
    """

    methods: tuple[Rectifier, ...]
    angle_deg: float = 5.0
    aspect: float = 0.1
    bending: float = 0.03
    size: float = 0.05

    def rectify(self, pair: EpipolarPair) -> AnyRectification:
        """Apply all methods and return the best result.

        Parameters
        ----------
        pair : EpipolarPair

        Returns
        -------
        PlanarRectification or PolarRectification
            The rectification of least distortion.

        Raises
        ------
        StageFailure
            If all methods fail (the failure of the last).
        """
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
            raise failure if failure is not None else ValueError("BestRectifier needs at least one method")
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
    """Rectify a prepared pair.

    Parameters
    ----------
    pair : EpipolarPair
    method : {"best", "hartley", "loop-zhang", "least-distortion", "polar", "metric"}
        Method, or the best of all for which the data suffice.
    limits : FrameLimits, optional

    Returns
    -------
    PlanarRectification or PolarRectification

    Raises
    ------
    ValueError
        If the method is unknown.
    StageFailure
        If the pair cannot be rectified.
    """
    limits = FrameLimits() if limits is None else limits
    methods = _methods(limits)
    if method == "best":
        bare = PolarRectifier(limits, max_scale=0.0, max_shear=0.0)
        return BestRectifier((*methods.values(), bare)).rectify(pair)
    if method not in methods:
        raise ValueError(f"method must be one of {['best', *methods]}; got {method!r}")
    return methods[method].rectify(pair)


def rectify_pair(
    F: F64, xy1: F64, xy2: F64, size1: Size, size2: Size, *, method: Method = "best"
) -> AnyRectification:
    """Rectify two images with known fundamental matrix (thesis, section 2.5).

    Parameters
    ----------
    F : ndarray (3, 3)
        Fundamental matrix, x2' F x1 = 0.
    xy1, xy2 : ndarray (N >= 8, 2)
        Inlier matches in pixels.
    size1, size2 : tuple of int
        (width, height) in pixels.
    method : {"best", "hartley", "loop-zhang", "least-distortion", "polar"}
        Method, or the best of them.

    Returns
    -------
    PlanarRectification or PolarRectification
        Maps to a frame whose rows are epipolar lines; x_right = x_left - d, larger d for nearer points. With
        unknown focal lengths, "nearer" is judged with usual ones.

    Raises
    ------
    ValueError
        If an array has the wrong shape or an image is too small.
    StageFailure
        If the pair has no parallax, too few or contradictory matches, or, for planar methods, an epipole
        inside an image.
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
    """Rectify two undistorted images with known metric cameras.

    Parameters
    ----------
    P1, P2 : ndarray (3, 4)
        Cameras P = K [R t].
    size1, size2 : tuple of int
        (width, height) in pixels.
    xy1, xy2 : ndarray (N, 2), optional
        Matches in pixels; they crop the frame to the common field of view, and "hartley" needs them.
    method : {"best", "hartley", "loop-zhang", "least-distortion", "polar", "metric"}
        Method, or the best of them; "metric" is the common orientation.

    Returns
    -------
    PlanarRectification or PolarRectification
        See :func:`rectify_pair`.

    Raises
    ------
    ValueError
        If an array has the wrong shape or a camera is not finite.
    StageFailure
        If the pair cannot be rectified.
    """
    return rectify(pair_of_cameras(P1, P2, size1, size2, xy1=xy1, xy2=xy2), method=method)


def disparity_range(
    rectification: AnyRectification, xy1: F64, xy2: F64, *, margin: float = 0.15
) -> tuple[int, int]:
    """Return the disparity range to search from matches.

    Parameters
    ----------
    rectification : PlanarRectification or PolarRectification
    xy1, xy2 : ndarray (N, 2)
        Matches in pixels of the images.
    margin : float
        Widening at both ends as a share of the range, in addition to 2 px.

    Returns
    -------
    tuple of int
        First and last disparity.

    Raises
    ------
    StageFailure
        If no match lies inside the frame.
    """
    left = rectification.rectified_from_original(0, xy1)
    right = rectification.rectified_from_original(1, xy2)
    d = left[:, 0] - right[:, 0]
    d = d[np.isfinite(d)]
    if len(d) == 0:
        raise StageFailure(
            "the disparity range is unknown", "no match is inside the rectified frame", "specify a range"
        )
    low, high = disparity_bounds(d, margin=margin)
    return int(np.floor(low)) - 2, int(np.ceil(high)) + 2

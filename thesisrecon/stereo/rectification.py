"""Rectification of image pairs (thesis, section 2.5): methods, distortion measures, selection."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.stereo._epipolar_pair import (
    EpipolarPair,
    Size,
    disparity_bounds,
    disparity_gradients,
    pair_of_cameras,
    pair_of_fundamental,
    singular_values,
)
from thesisrecon.stereo._planar import common_orientation, hartley, loop_zhang, minimum_distortion
from thesisrecon.stereo._polar import PolarRectification, polar
from thesisrecon.stereo._resampling import Rectification

STEP_PX = 0.01
"""Half step of numerical derivatives."""
MAX_TURN_DEG, MAX_ASPECT = 5.0, 0.1
"""Limits of the midline angle's deviation from 90 degrees, and of the change of the aspect ratio."""
BENDING = 0.03
"""Penalty of polar frames, which bend straight lines."""
SIZE_WEIGHT = 0.05
"""Weight of the log of the relative frame size, which costs time."""

Method = Callable[[EpipolarPair], Rectification]
PLANAR: tuple[Method, ...] = (hartley, loop_zhang, minimum_distortion)
"""Methods from F with homographies."""
METHODS: tuple[Method, ...] = (*PLANAR, polar, common_orientation, partial(polar, aligned=False))
"""All methods; the common orientation needs cameras."""


@dataclass(frozen=True)
class RectificationQuality:
    """Distortion measures of a rectified pair; pairs of numbers refer to both images.

    Parameters
    ----------
    orthogonality_deg : tuple of float
        Angle of the mapped image midlines.
    aspect : tuple of float
        Ratio of their lengths relative to the original, NaN if not finite.
    size_ratio : float
        Pixels of the frame relative to the larger image.
    min_scale, max_scale : float
        Extreme local scales along any direction.
    stretch : float
        Typical local scale change: exp of the standard deviation of the log singular values; 1 for
        similarities.
    disparity_slope : float
        RMS gradient of a quadratic polynomial fitted to the disparities: the difference between both images.
    """

    orthogonality_deg: tuple[float, float]
    aspect: tuple[float, float]
    size_ratio: float
    min_scale: float
    max_scale: float
    stretch: float
    disparity_slope: float

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
    values, midlines = [], []
    for side in (0, 1):
        samples = pair.regions[side]
        inside = np.isfinite(rectification.rectified_from_original(side, samples)).all(axis=1)
        J = jacobians(rectification, side, samples[inside])
        values.append(singular_values(J[np.isfinite(J).all(axis=(1, 2))]))
        midlines.append(_midlines(rectification, side, pair.sizes[side]))
    found = np.concatenate(values)
    found = found if len(found) else np.full((1, 2), np.nan)
    width, height = rectification.size
    return RectificationQuality(
        orthogonality_deg=(midlines[0][0], midlines[1][0]),
        aspect=(midlines[0][1], midlines[1][1]),
        size_ratio=width * height / max(w * h for w, h in pair.sizes),
        min_scale=float(found[:, 1].min()),
        max_scale=float(found[:, 0].max()),
        stretch=float(np.exp(np.std(np.log(np.maximum(found, 1e-12))))),
        disparity_slope=_disparity_slope(rectification, pair),
    )


def jacobians(rectification: Rectification, side: int, xy: F64) -> F64:
    """Compute numerical derivatives of the map from an image to the frame.

    Parameters
    ----------
    rectification : Rectification
        The maps.
    side : {0, 1}
        The image.
    xy : ndarray (N, 2)
        Pixels of the image.

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


def _midlines(rectification: Rectification, side: int, size: Size) -> tuple[float, float]:
    """Angle in degrees of the mapped midlines, and the ratio of their lengths relative to the original."""
    w, h = size[0] - 1.0, size[1] - 1.0
    ends = np.array([[0.0, h / 2.0], [w, h / 2.0], [w / 2.0, 0.0], [w / 2.0, h]])
    a, b, c, d = rectification.rectified_from_original(side, ends, within=False)
    across, down = b - a, d - c
    lengths = float(np.hypot(*across)), float(np.hypot(*down))
    with np.errstate(invalid="ignore"):
        angle = float(np.degrees(np.arccos(np.clip(across @ down / (lengths[0] * lengths[1]), -1.0, 1.0))))
    return angle, lengths[0] / lengths[1] * h / w


def _disparity_slope(rectification: Rectification, pair: EpipolarPair) -> float:
    """RMS disparity gradient of the matches inside the frame, NaN with fewer than 3."""
    left, right = (rectification.rectified_from_original(s, xy) for s, xy in enumerate(pair.matches))
    seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    if int(seen.sum()) < 3:
        return float("nan")
    return float(np.sqrt(np.mean(np.sum(disparity_gradients(left[seen], right[seen]) ** 2, axis=1))))


def rectify(pair: EpipolarPair, methods: Sequence[Method] = METHODS) -> Rectification:
    """Return the rectification of least distortion among several methods.

    Those within the angle and aspect limits take precedence; methods that fail are skipped.

    Parameters
    ----------
    pair : EpipolarPair
        The prepared pair.
    methods : sequence of callable
        Methods to choose from.

    Returns
    -------
    Rectification
        The rectification of least distortion.

    Raises
    ------
    StageFailure
        If all methods fail (the failure of the last).
    """
    best: Rectification | None = None
    least, failure = (True, np.inf), None
    for method in methods:
        try:
            found = method(pair)
        except StageFailure as reason:
            failure = reason
            continue
        cost = _cost(found, measure_quality(found, pair))
        if best is None or cost < least:
            best, least = found, cost
    if best is None:
        assert failure is not None
        raise failure
    return best


def _cost(found: Rectification, quality: RectificationQuality) -> tuple[bool, float]:
    # A midline through the epipole of a polar frame has no angle.
    turned = max((abs(a - 90.0) for a in quality.orthogonality_deg if np.isfinite(a)), default=0.0)
    aspect = max((abs(a - 1.0) for a in quality.aspect if np.isfinite(a)), default=0.0)
    bent = BENDING if isinstance(found, PolarRectification) else 0.0
    cost = quality.distortion + bent + SIZE_WEIGHT * np.log(quality.size_ratio)
    return turned > MAX_TURN_DEG or aspect > MAX_ASPECT, float(cost)


def rectify_pair(
    F: F64, xy1: F64, xy2: F64, size1: Size, size2: Size, *, methods: Sequence[Method] = METHODS
) -> Rectification:
    """Rectify two images with known fundamental matrix (thesis, section 2.5).

    Parameters
    ----------
    F : ndarray (3, 3)
        Fundamental matrix, x2' F x1 = 0.
    xy1, xy2 : ndarray (N >= 8, 2)
        Inlier matches in pixels.
    size1, size2 : tuple of int
        (width, height) in pixels.
    methods : sequence of callable
        Methods to choose from.

    Returns
    -------
    Rectification
        With unknown focal lengths, "nearer" is judged with usual ones.

    Raises
    ------
    ValueError
        If an array has the wrong shape or an image is too small.
    StageFailure
        If the pair has no parallax, too few or contradictory matches, or, for planar methods, an epipole
        inside an image.
    """
    return rectify(pair_of_fundamental(F, xy1, xy2, size1, size2), methods)


def rectify_cameras(
    P1: F64, P2: F64, size1: Size, size2: Size, *, xy1: F64 | None = None, xy2: F64 | None = None
) -> Rectification:
    """Rectify two undistorted images with known metric cameras.

    Parameters
    ----------
    P1, P2 : ndarray (3, 4)
        Cameras P = K [R t] with P[2] X > 0 for points in front.
    size1, size2 : tuple of int
        (width, height) in pixels.
    xy1, xy2 : ndarray (N, 2), optional
        Matches in pixels; they crop the frame to the common field of view, and :func:`hartley` needs them.

    Returns
    -------
    Rectification

    Raises
    ------
    ValueError
        If an array has the wrong shape or an image is too small.
    StageFailure
        If the pair cannot be rectified.
    """
    return rectify(pair_of_cameras(P1, P2, size1, size2, xy1=xy1, xy2=xy2))


def disparity_range(
    rectification: Rectification, xy1: F64, xy2: F64, *, margin: float = 0.15
) -> tuple[int, int]:
    """Return the disparity range to search from matches.

    Parameters
    ----------
    rectification : Rectification
        The maps.
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

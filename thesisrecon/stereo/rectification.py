"""Rectification of image pairs by the method of least distortion (thesis, section 2.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from thesisrecon.arrays import F32, F64, U8
from thesisrecon.errors import Notice, StageFailure
from thesisrecon.imaging.resampling import Rectification
from thesisrecon.stereo._epipolar_pair import EpipolarPair, Size, disparity_bounds
from thesisrecon.stereo._frames import (
    PolarRectification,
    common_orientation,
    disparity_gradients,
    hartley,
    loop_zhang,
    matches_in_frame,
    minimum_distortion,
    polar,
    singular_values,
)

BENDING = 0.03  #: penalty of polar frames, which bend straight lines

Method = Callable[[EpipolarPair], Rectification]
PLANAR: tuple[Method, ...] = (hartley, loop_zhang, minimum_distortion)  #: methods from F with homographies
METHODS: tuple[Method, ...] = (*PLANAR, polar, common_orientation, partial(polar, aligned=False))
"""All methods; the common orientation needs cameras."""


@dataclass(frozen=True)
class RectifiedImages:
    """Two images whose rows correspond: x_right = x_left - d with disparities d >= 0."""

    left: F32  #: (H, W, 3) NaN outside the originals, as is ``right``
    right: F32
    max_disparity_px: float  #: largest disparity of the matches, with a margin
    frame: Rectification  #: maps between the images and the rectified frame
    shift: int  #: columns by which the right image was moved to the right or, if negative, the left one

    @classmethod
    def of(
        cls, frame: Rectification, images: tuple[U8 | F32, U8 | F32], disparities: tuple[int, int]
    ) -> RectifiedImages:
        """Resample two images; one moves to the right by whole columns so that disparities begin at 0."""
        shift, (width, height) = disparities[0], frame.size
        moved = np.full((2, height, width + max(-shift, 0), 3), np.nan, dtype=np.float32)
        for side, image in enumerate(images):
            # Columns of the right image that are cut off correspond to none of the left one.
            place = moved[side, :, _moved_by(side, shift) :]
            # Cubic convolution exceeds the range of the levels.
            levels = np.clip(frame.warp(image.astype(np.float32), side), 0.0, 255.0)
            place[:, :width] = levels[:, : place.shape[1]]
        return cls(moved[0], moved[1], float(disparities[1] - shift), frame, shift)

    def rectified_from_original(self, side: int, xy: F64) -> F64:
        """Map pixels of an image (side 0 or 1) to the rectified one."""
        moved = self.frame.rectified_from_original(side, xy, within=False)
        return np.asarray(moved + np.array([_moved_by(side, self.shift), 0]))

    def original_from_rectified(self, side: int, xy: F64) -> F64:
        """Map pixels of a rectified image (side 0 or 1) to the original one."""
        places = np.asarray(xy - np.array([_moved_by(side, self.shift), 0]))
        return self.frame.original_from_rectified(side, places, within=False)


def _moved_by(side: int, shift: int) -> int:
    """Columns by which an image is moved: the right one by ``shift``, or the left one if it is negative."""
    return max(shift if side else -shift, 0)


@dataclass(frozen=True)
class RectificationQuality:
    """Distortion measures of a rectified pair; pairs of numbers refer to both images."""

    orthogonality_deg: tuple[float, float]  #: angle of the mapped image midlines
    aspect: tuple[float, float]  #: ratio of their lengths relative to the original
    size_ratio: float  #: pixels of the frame relative to the larger image
    min_scale: float  #: least local scale along any direction
    stretch: float  #: exp of the standard deviation of the log singular values, 1 for similarities
    disparity_slope: float  #: RMS gradient of the fitted disparities, NaN with fewer than 3 matches

    @property
    def distortion(self) -> float:
        """Root of the sum of squares of ``log stretch`` and half the ``disparity_slope``."""
        slope = self.disparity_slope if np.isfinite(self.disparity_slope) else 0.0
        return float(np.hypot(np.log(self.stretch), 0.5 * slope))


def measure_quality(rectification: Rectification, pair: EpipolarPair) -> RectificationQuality:
    """Measure the distortion of a rectification over the common field of view of a pair."""
    values, midlines = [], []
    for side, samples in enumerate(pair.regions):
        inside = np.isfinite(rectification.rectified_from_original(side, samples)).all(axis=1)
        J = jacobians(rectification, side, samples[inside])
        values.append(singular_values(J[np.isfinite(J).all(axis=(1, 2))]))
        midlines.append(_midlines(rectification, side, pair.pencil.sizes[side]))
    found = np.concatenate(values)
    found = found if len(found) else np.full((1, 2), np.nan)
    angles, aspects = zip(*midlines, strict=True)
    width, height = rectification.size
    left, right = matches_in_frame(rectification, pair.matches)
    slopes = disparity_gradients(left, right) if len(left) >= 3 else np.full((1, 2), np.nan)
    return RectificationQuality(
        orthogonality_deg=angles,
        aspect=aspects,
        size_ratio=width * height / max(w * h for w, h in pair.pencil.sizes),
        min_scale=float(found[:, 1].min()),
        stretch=float(np.exp(np.std(np.log(np.maximum(found, 1e-12))))),
        disparity_slope=float(np.sqrt(np.mean(np.sum(slopes**2, axis=1)))),
    )


def jacobians(rectification: Rectification, side: int, xy: F64) -> F64:
    """Numerical derivatives (N, 2, 2) of the map from pixels (N, 2) of an image to the frame."""
    step_px = 0.01  # Half step of numerical derivatives
    columns = []
    for axis in np.eye(2):
        ahead = rectification.rectified_from_original(side, xy + step_px * axis, within=False)
        step = ahead - rectification.rectified_from_original(side, xy - step_px * axis, within=False)
        # A full circle of half-lines has a cut, across which neighbours are far apart.
        step[np.abs(step[:, 1]) > 0.5 * rectification.size[1]] = np.nan
        columns.append(step / (2.0 * step_px))
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


def rectify(pair: EpipolarPair, methods: Sequence[Method] = METHODS) -> Rectification:
    """Return the rectification of least distortion among several methods.

    Those within the angle and aspect limits take precedence; methods that fail are skipped. If all fail, the
    ``StageFailure`` of the last is raised.
    """
    found: list[Rectification] = []
    failure = StageFailure(Notice("no-rectification-method"))
    for method in methods:
        try:
            found.append(method(pair))
        except StageFailure as reason:
            failure = reason
    if not found:
        raise failure
    return min(found, key=lambda frame: _cost(frame, measure_quality(frame, pair)))


def _cost(found: Rectification, quality: RectificationQuality) -> tuple[bool, float]:
    # Limits of the midline angle's deviation from 90 degrees, and of the change of the aspect ratio.
    max_turn_deg, max_aspect = 5.0, 0.1
    size_weight = 0.05  # Weight of the log of the relative frame size, which costs time
    # A midline through the epipole of a polar frame has no angle.
    turned = max((abs(a - 90.0) for a in quality.orthogonality_deg if np.isfinite(a)), default=0.0)
    aspect = max((abs(a - 1.0) for a in quality.aspect if np.isfinite(a)), default=0.0)
    bent = BENDING if isinstance(found, PolarRectification) else 0.0
    cost = quality.distortion + bent + size_weight * np.log(quality.size_ratio)
    return turned > max_turn_deg or aspect > max_aspect, float(cost)


def disparity_range(
    rectification: Rectification, xy1: F64, xy2: F64, *, margin: float = 0.15
) -> tuple[int, int]:
    """First and last disparity to search, from matches; ``StageFailure`` if none is in the frame."""
    left, right = matches_in_frame(rectification, (xy1, xy2))
    if len(left) == 0:
        raise StageFailure(
            "the disparity range is unknown", "no match is inside the rectified frame", "specify a range"
        )
    low, high = disparity_bounds(left[:, 0] - right[:, 0], margin=margin)
    return int(np.floor(low)) - 2, int(np.ceil(high)) + 2

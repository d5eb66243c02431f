"""Rectification of image pairs by the method of least distortion (thesis, section 2.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from thesisrecon.arrays import F32, F64, U8
from thesisrecon.errors import Notice, StageFailure
from thesisrecon.imaging.resampling import Rectification
from thesisrecon.stereo._epipolar_pair import (
    EpipolarPair,
    Size,
    disparity_bounds,
    pair_of_cameras,
    pair_of_fundamental,
)
from thesisrecon.stereo._planar import common_orientation, hartley, loop_zhang, minimum_distortion
from thesisrecon.stereo._polar import PolarRectification, polar
from thesisrecon.stereo._rectification_quality import RectificationQuality, matches_in_frame, measure_quality

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
class RectifiedImages:
    """Two images whose rows correspond: x_right = x_left - d with disparities d >= 0.

    Parameters
    ----------
    left, right : ndarray (H, W, 3) float32
        Rectified images, NaN outside the originals.
    max_disparity_px : float
        Largest disparity of the matches, with a margin.
    frame, shift : Rectification, int
        Maps between the images and the rectified frame, and the columns by which the right image was moved
        to the right or, if negative, the left one.
    """

    left: F32
    right: F32
    max_disparity_px: float
    frame: Rectification
    shift: int

    @classmethod
    def of(
        cls, frame: Rectification, images: tuple[U8 | F32, U8 | F32], disparities: tuple[int, int]
    ) -> RectifiedImages:
        """Resample two images; one moves to the right by whole columns so that disparities begin at 0.

        Parameters
        ----------
        frame, images, disparities : Rectification, tuple of ndarray (H, W, 3), tuple of int
            The maps, the images, and the first and last disparity.

        Returns
        -------
        RectifiedImages
        """
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
        """Map pixels of an image (side 0 or 1) to the rectified one.

        Parameters
        ----------
        side, xy : int, ndarray (N, 2)
            Image and pixels.

        Returns
        -------
        ndarray (N, 2)
            NaN beyond the line that is sent to infinity.
        """
        moved = self.frame.rectified_from_original(side, xy, within=False)
        return np.asarray(moved + np.array([_moved_by(side, self.shift), 0]))

    def original_from_rectified(self, side: int, xy: F64) -> F64:
        """Map pixels of a rectified image (side 0 or 1) to the original one.

        Parameters
        ----------
        side, xy : int, ndarray (N, 2)
            Image and pixels.

        Returns
        -------
        ndarray (N, 2)
            NaN beyond the epipole.
        """
        places = np.asarray(xy - np.array([_moved_by(side, self.shift), 0]))
        return self.frame.original_from_rectified(side, places, within=False)


def _moved_by(side: int, shift: int) -> int:
    """Columns by which an image is moved: the right one by ``shift``, or the left one if it is negative."""
    return max(shift if side else -shift, 0)


def rectify(pair: EpipolarPair, methods: Sequence[Method] = METHODS) -> Rectification:
    """Return the rectification of least distortion among several methods.

    Those within the angle and aspect limits take precedence; methods that fail are skipped. If all fail, the
    ``StageFailure`` of the last is raised.

    Parameters
    ----------
    pair : EpipolarPair
        The prepared pair.
    methods : sequence of callable
        Methods to choose from.

    Returns
    -------
    Rectification
    """
    best: Rectification | None = None
    least, failure = (True, np.inf), StageFailure(Notice("no-rectification-method"))
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
    """Rectify two images with known fundamental matrix.

    The direction of larger disparities for nearer points is determined with typical focal lengths.

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
        Matches in pixels, by which the frame is cropped to the common field of view.

    Returns
    -------
    Rectification
    """
    return rectify(pair_of_cameras(P1, P2, size1, size2, xy1=xy1, xy2=xy2))


def disparity_range(
    rectification: Rectification, xy1: F64, xy2: F64, *, margin: float = 0.15
) -> tuple[int, int]:
    """Return the first and last disparity to search from matches; ``StageFailure`` if none is in the frame.

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
    """
    left, right = matches_in_frame(rectification, (xy1, xy2))
    if len(left) == 0:
        raise StageFailure(
            "the disparity range is unknown", "no match is inside the rectified frame", "specify a range"
        )
    low, high = disparity_bounds(left[:, 0] - right[:, 0], margin=margin)
    return int(np.floor(low)) - 2, int(np.ceil(high)) + 2

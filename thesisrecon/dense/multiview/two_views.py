"""Section 2.5 for two photographs alone: rectified from F, matched from either side, and taken back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.dense.multiview.correspondence import (
    PairMatching,
    brightness_gain,
    sample_disparity,
    searched,
)
from thesisrecon.dense.rectification import (
    AnyRectification,
    Hartley,
    LeastDistorted,
    LeastDistortion,
    LoopZhang,
    disparity_range,
    pair_of_fundamental,
    rectify,
)
from thesisrecon.dense.rectification.sampling import require_side
from thesisrecon.geometry.multiview import canonical_cameras
from thesisrecon.types import B8, F32, F64, DisparityMap, PinholeView

U8 = NDArray[np.uint8]

STRIP_ROWS = 128
"""Rows whose places are held in float64 at a time."""


PLANAR = LeastDistorted((Hartley(), LoopZhang(), LeastDistortion()))


@dataclass(frozen=True)
class RectifiedPair:
    """Two photographs in the frame whose rows are their epipolar lines, and what matches there.

    ``frame`` maps either photograph to it and back; ``images`` (H, W, 3) float32 in it, NaN outside; ``gain``
    (3,) what makes the second photograph as bright as the first, in ``images`` applied. ``left``, ``right``:
    disparities of either side, x_right = x_left - d, larger ones nearer.
    """

    frame: AnyRectification
    images: tuple[F32, F32]
    gain: F32
    left: DisparityMap
    right: DisparityMap

    def places(self, side: int, size: tuple[int, int]) -> F32:
        """Where the pixels of the photograph of ``side``, of ``size`` (width, height), are in the other one.

        (H, W, 2) px. What the other one does not see is taken for background
        (:meth:`DisparityMap.filled`); NaN outside the frame.
        """
        found = self.right if require_side(side) else self.left
        complete = replace(found, disparity=found.filled())
        places = np.full((size[1], size[0], 2), np.nan, dtype=np.float32)
        for first in range(0, size[1], STRIP_ROWS):
            rows = places[first : first + STRIP_ROWS]
            y, x = np.indices(rows.shape[:2], dtype=np.float64)
            here = self.frame.rectified_from_original(side, np.stack([x, y + first], axis=-1).reshape(-1, 2))
            d = sample_disparity(complete, here)[0]
            inside: B8 = np.isfinite(d)
            here = here[inside]
            here[:, 0] += d[inside] if side else -d[inside]
            there = self.frame.original_from_rectified(1 - side, here, within=False)
            rows.reshape(-1, 2)[inside] = there
        return places


def match_two_views(
    rgb1: U8, rgb2: U8, F: F64, xy1: F64, xy2: F64, *, pairs: PairMatching, planar: bool = False
) -> RectifiedPair:
    """Dense correspondence of two photographs of which F and its inliers are known.

    Parameters
    ----------
    rgb1, rgb2 : (H, W, 3) uint8.
    F, xy1, xy2 : (3, 3), x2' F x1 = 0, and (N >= 8, 2) px matches that obey it.
    pairs : whose matcher and range of disparities are taken.
    planar : rectify by homographies alone, which need the epipoles outside of the photographs.

    Raises
    ------
    ValueError, StageFailure : as :func:`thesisrecon.dense.rectification.rectify_pair`; ``StageFailure`` also
        where the range of disparities is too long to be searched.
    """
    cameras = canonical_cameras(F)
    views = [
        PinholeView(k, P, rgb, np.ones(rgb.shape[:2], dtype=bool))
        for k, (P, rgb) in enumerate(zip(cameras, (rgb1, rgb2), strict=True))
    ]
    sizes = [(rgb.shape[1], rgb.shape[0]) for rgb in (rgb1, rgb2)]
    pair = pair_of_fundamental(F, xy1, xy2, sizes[0], sizes[1])
    frame = PLANAR.rectify(pair) if planar else rectify(pair)
    wanted = searched(frame, disparity_range(frame, xy1, xy2, margin=pairs.range_margin))
    gain = brightness_gain(views[0], views[1], xy1, xy2)
    left = frame.warp(rgb1.astype(np.float32), 0)
    right = frame.warp(rgb2.astype(np.float32) * gain, 1)
    found = pairs.matcher.match(left, right, disparity_range=wanted)
    # Seen in a mirror, the right image is the left one.
    mirrored = pairs.matcher.match(right[:, ::-1], left[:, ::-1], disparity_range=wanted)
    back = replace(mirrored, disparity=mirrored.disparity[:, ::-1], confidence=mirrored.confidence[:, ::-1])
    return RectifiedPair(frame, (left, right), gain, found, back)

"""Where the pixels of one view are in another: rectified, matched, and taken back exactly.

Section 2.5 for two photographs alone: rectified from F, matched from either side, and taken back.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.two_view import canonical_cameras
from thesisrecon.records import DisparityMap, PinholeView
from thesisrecon.stereo.cost import MAX_DISPARITIES
from thesisrecon.stereo.epipolar_pair import pair_of_fundamental
from thesisrecon.stereo.planar import HartleyRectifier, LoopZhangRectifier, MinimumDistortionRectifier
from thesisrecon.stereo.rectification import (
    AnyRectification,
    BestRectifier,
    disparity_range,
    rectify,
    rectify_cameras,
)
from thesisrecon.stereo.resampling import require_side
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.stereo.semi_global import SemiGlobalMatching, match_both_sides

Size = tuple[int, int]
"""Width and height, px."""
STRIP_ROWS = 128
"""Rows of the reference whose places are held in float64 at a time."""
ONE_SURFACE_PX = 1.0
"""Neighbouring disparities that differ by more are not interpolated between."""
GAIN_PATCH = 2
"""Half the side of the patches whose brightness is compared."""


@dataclass(frozen=True)
class Correspondence:
    """Where the pixels of a reference view are in another one.

    ``xy`` (H, W, 2) px of the other view, NaN where unknown; ``sigma`` (H, W) px, the deviation of that place
    along its epipolar line; ``confidence`` (H, W) in [0, 1].
    """

    xy: F32
    sigma: F32
    confidence: F32

    @property
    def known(self) -> B8:
        """(H, W) whether the pixel has a place."""
        return np.isfinite(self.sigma)


@dataclass(frozen=True)
class PairMatching:
    """Correspondence of two undistorted views by way of a rectified pair.

    ``matcher`` finds the disparities, in the range of the sparse points widened by ``range_margin`` of itself
    at either end. Their deviation is what the matcher tells but at least ``least_sigma_px``, in pixels of the
    rectified frame, and larger where its confidence is low; below ``min_confidence`` there are none.
    """

    matcher: SemiGlobalMatching | MaximumLikelihoodScanline = field(default_factory=SemiGlobalMatching)
    range_margin: float = 0.25
    min_sigma_px: float = 0.2
    min_confidence: float = 0.0

    def correspond(
        self,
        reference: PinholeView,
        other: PinholeView,
        xy1: F64,
        xy2: F64,
        *,
        sizes: tuple[Size, Size] | None = None,
    ) -> Correspondence:
        """Where the pixels of ``reference`` are in ``other``.

        ``xy1, xy2`` (N, 2) px are the projections of points of the scene into both: they give the range of
        disparities and how much brighter one photograph is. ``sizes`` (width, height) of both: pixels of
        these sizes are asked for and told of, though the views are matched at their own. ``StageFailure``
        where the pair cannot be rectified or no point is inside.
        """
        own = (size_of(reference), size_of(other))
        frame = rectify_cameras(reference.P, other.P, *own, xy1=xy1, xy2=xy2)
        wanted = searched(frame, disparity_range(frame, xy1, xy2, margin=self.range_margin))
        left = frame.warp(_levels(reference), 0)
        right = frame.warp(_levels(other) * brightness_gain(reference, other, xy1, xy2), 1)
        found = self.matcher.match(left, right, disparity_range=wanted)
        return self._back(frame, found, own, sizes or own)

    def _back(
        self, frame: AnyRectification, found: DisparityMap, own: tuple[Size, Size], told: tuple[Size, Size]
    ) -> Correspondence:
        shape = told[0][::-1]
        enlarged = max(told[1]) / max(own[1])
        xy = np.full((*shape, 2), np.nan, dtype=np.float32)
        sigma = np.full(shape, np.nan, dtype=np.float32)
        confidence = np.zeros(shape, dtype=np.float32)
        sigma_px = found.sigma_px if np.isfinite(found.sigma_px) else 0.0
        deviation = max(sigma_px, self.min_sigma_px)
        for first in range(0, shape[0], STRIP_ROWS):
            rows = slice(first, min(first + STRIP_ROWS, shape[0]))
            pixels = resized(_pixels(shape[1], rows), told[0], own[0])
            places = frame.rectified_from_original(0, pixels)
            d, sure = sample_disparity(found, places)
            inside: B8 = np.asarray(np.isfinite(d) & (sure >= self.min_confidence))
            where = places[inside]
            right, a, b = (
                frame.original_from_rectified(1, where - np.outer(d[inside] + step, (1.0, 0.0)), within=False)
                for step in (0.0, -0.5, 0.5)
            )
            scale = np.linalg.norm(b - a, axis=1)
            at = (np.flatnonzero(inside) // shape[1] + first, np.flatnonzero(inside) % shape[1])
            xy[at] = resized(right, own[1], told[1])
            confidence[at] = sure[inside]
            # Half the confidence is what a pixel has whose rival costs a step on every path more.
            sigma[at] = enlarged * deviation * scale * np.sqrt(0.5 / np.clip(sure[inside], 0.05, 0.5))
        return Correspondence(xy, sigma, confidence)


def size_of(view: PinholeView) -> Size:
    """(width, height)."""
    return view.seen.shape[1], view.seen.shape[0]


def resized(xy: F64, size: Size, wanted: Size) -> F64:
    """Pixels (N, 2) of a photograph of ``size`` where they are at the size that is wanted."""
    return np.asarray((xy + 0.5) * (np.array(wanted) / np.array(size)) - 0.5)


def searched(frame: AnyRectification, wanted: tuple[int, int]) -> tuple[int, int]:
    """What of a range can be inside the frame; ``StageFailure`` where that is nothing or too much."""
    reach = frame.size[0] - 1
    first, last = max(wanted[0], -reach), min(wanted[1], reach)
    if not 0 <= last - first < MAX_DISPARITIES:
        raise StageFailure(
            "the disparities of the pair cannot be searched",
            f"they run from {first} to {last} px",
            "choose neighbours nearer to each other, or a smaller size",
        )
    return first, last


def sample_disparity(found: DisparityMap, places: F64) -> tuple[F64, F64]:
    """Disparity and confidence (N,) at places (N, 2) of the rectified frame, NaN where unknown.

    Bilinear where all four pixels around lie on one surface, else that of the nearest pixel.
    """
    height, width = found.disparity.shape
    inside: B8 = np.asarray(np.isfinite(places).all(axis=1))
    x, y = np.where(inside[:, None], places, 0.0).T
    x, y = np.clip(x, 0.0, width - 1.0), np.clip(y, 0.0, height - 1.0)
    x0 = np.minimum(x.astype(np.int64), max(width - 2, 0))
    y0 = np.minimum(y.astype(np.int64), max(height - 2, 0))
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = x - x0, y - y0
    corners = [found.disparity[a, b] for a, b in ((y0, x0), (y0, x1), (y1, x0), (y1, x1))]
    top = corners[0] + fx * (corners[1] - corners[0])
    bottom = corners[2] + fx * (corners[3] - corners[2])
    spread = np.maximum.reduce(corners) - np.minimum.reduce(corners)
    nearest = np.rint(y).astype(np.int64), np.rint(x).astype(np.int64)
    # A comparison with NaN is false: a hole among the four leaves the nearest.
    d = np.where(spread <= ONE_SURFACE_PX, top + fy * (bottom - top), found.disparity[nearest])
    d = np.where(inside, d, np.nan)
    return d, np.where(np.isfinite(d), found.confidence[nearest], 0.0)


def brightness_gain(reference: PinholeView, other: PinholeView, xy1: F64, xy2: F64) -> F32:
    """(3,) factors that make ``other`` as bright as ``reference``, the median over the points; 1 without any.

    Exposure and white balance change between photographs, and colours are compared as they are.
    """
    levels = [_patch_means(view, xy) for view, xy in ((reference, xy1), (other, xy2))]
    good = np.isfinite(levels[0]).all(axis=1) & np.isfinite(levels[1]).all(axis=1)
    good &= np.minimum(levels[0], levels[1]).min(axis=1) > 8.0
    good &= np.maximum(levels[0], levels[1]).max(axis=1) < 247.0
    if int(good.sum()) < 8:
        return np.ones(3, dtype=np.float32)
    ratio = np.median(np.log(levels[0][good] / levels[1][good]), axis=0)
    return np.asarray(np.exp(np.clip(ratio, -1.0, 1.0)), dtype=np.float32)


def _patch_means(view: PinholeView, xy: F64) -> F64:
    """Mean colours (N, 3) about pixels (N, 2), NaN where the patch leaves the image."""
    height, width = view.seen.shape
    at = np.rint(xy).astype(np.int64)
    reach = GAIN_PATCH
    inside = np.all((at >= reach) & (at < np.array([width, height]) - reach), axis=1)
    at = np.where(inside[:, None], at, reach)
    total = np.zeros((len(xy), 3))
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            total += view.rgb[at[:, 1] + dy, at[:, 0] + dx]
    return np.where(inside[:, None], total / (2 * reach + 1) ** 2, np.nan)


def _levels(view: PinholeView) -> F32:
    levels: F32 = view.rgb.astype(np.float32)
    levels[~view.seen] = np.nan
    return levels


def _pixels(width: int, rows: slice) -> F64:
    x, y = np.meshgrid(np.arange(float(width)), np.arange(float(rows.start), float(rows.stop)))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


PLANAR = BestRectifier((HartleyRectifier(), LoopZhangRectifier(), MinimumDistortionRectifier()))


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

    def correspondences(self, side: int, size: tuple[int, int]) -> F32:
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
    ValueError, StageFailure : as :func:`thesisrecon.stereo.rectification.rectify_pair`; ``StageFailure`` also
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
    match = partial(pairs.matcher.match, disparity_range=wanted)
    return RectifiedPair(frame, (left, right), gain, *match_both_sides(match, left, right))

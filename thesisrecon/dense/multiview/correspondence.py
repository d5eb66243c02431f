"""Where the pixels of one view are in another: rectified, matched, and taken back exactly."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.dense.matching import CohesiveScanlines, MaximumLikelihoodScanline, SemiGlobal
from thesisrecon.dense.matching.ranges import LARGEST
from thesisrecon.dense.rectification import AnyRectification, disparity_range, rectify_cameras
from thesisrecon.errors import StageFailure
from thesisrecon.types import B8, F32, F64, DisparityMap, PinholeView

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
    rectified frame, and larger where its confidence is low; below ``least_confidence`` there are none.
    """

    matcher: CohesiveScanlines | SemiGlobal | MaximumLikelihoodScanline = field(
        default_factory=CohesiveScanlines
    )
    range_margin: float = 0.25
    least_sigma_px: float = 0.2
    least_confidence: float = 0.0

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
        deviation = max(sigma_px, self.least_sigma_px)
        for first in range(0, shape[0], STRIP_ROWS):
            rows = slice(first, min(first + STRIP_ROWS, shape[0]))
            pixels = resized(_pixels(shape[1], rows), told[0], own[0])
            places = frame.rectified_from_original(0, pixels)
            d, sure = sample_disparity(found, places)
            inside: B8 = np.asarray(np.isfinite(d) & (sure >= self.least_confidence))
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
    if not 0 <= last - first < LARGEST:
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

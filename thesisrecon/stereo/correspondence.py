"""Dense correspondence of two views: rectify, match, and map the disparities back to the original pixels."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8
from thesisrecon.errors import StageFailure
from thesisrecon.records import DisparityMap, Image, PinholeView
from thesisrecon.stereo._cost import MAX_DISPARITIES
from thesisrecon.stereo._resampling import Rectification
from thesisrecon.stereo.rectification import METHODS, PLANAR, disparity_range, rectify_cameras, rectify_pair
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.stereo.semi_global import SemiGlobalMatching, match_both_sides

Shape = tuple[int, ...]
"""Height and width in pixels."""
STRIP_ROWS = 128
"""Rows of the reference view that are mapped at a time."""
ONE_SURFACE_PX = 1.0
"""Disparity range of four neighbours up to which they are interpolated."""
GAIN_PATCH = 2
"""Radius of the patches whose brightness is compared."""


@dataclass(frozen=True)
class Correspondence:
    """Positions of the pixels of a reference view in another view.

    Parameters
    ----------
    xy : ndarray (H, W, 2) float32
        Pixels of the other view, NaN = unknown.
    sigma : ndarray (H, W) float32
        Standard deviation along the epipolar line in pixels.
    confidence : ndarray (H, W) float32
        Confidence in [0, 1].
    """

    xy: F32
    sigma: F32
    confidence: F32


@dataclass(frozen=True)
class PairMatching:
    """Dense correspondence of two undistorted views by stereo matching of the rectified pair.

    Parameters
    ----------
    matcher : SemiGlobalMatching or MaximumLikelihoodScanline
        Matcher of rectified images.
    range_margin : float
        Widening of the disparity range of the sparse points at both ends, as a share of the range.
    min_sigma_px : float
        Lower limit of the standard deviation of disparities, which grows with decreasing confidence.
    min_confidence : float
        Disparities of less confidence are ignored.
    """

    matcher: SemiGlobalMatching | MaximumLikelihoodScanline = field(default_factory=SemiGlobalMatching)
    range_margin: float = 0.25
    min_sigma_px: float = 0.2
    min_confidence: float = 0.0

    def correspond(
        self, reference: PinholeView, other: PinholeView, xy1: F64, xy2: F64, *, shapes: tuple[Shape, Shape]
    ) -> Correspondence:
        """Compute the positions of the pixels of ``reference`` in ``other``.

        Parameters
        ----------
        reference, other : PinholeView
            Undistorted views with their cameras.
        xy1, xy2 : ndarray (N, 2)
            Projections of sparse points into both views in pixels. They determine the disparity range and the
            brightness gain.
        shapes : tuple of (height, width)
            Image shapes in which the correspondence is returned.

        Returns
        -------
        Correspondence
            Positions in ``other``.

        Raises
        ------
        StageFailure
            If the pair cannot be rectified or no point lies in the rectified frame.
        """
        own = reference.seen.shape, other.seen.shape
        frame = rectify_cameras(reference.P, other.P, own[0][::-1], own[1][::-1], xy1=xy1, xy2=xy2)
        wanted = _searched_range(frame, disparity_range(frame, xy1, xy2, margin=self.range_margin))
        left = frame.warp(_levels(reference), 0)
        right = frame.warp(_levels(other) * _brightness_gain(reference.rgb, other.rgb, xy1, xy2), 1)
        found = self.matcher.match(left, right, disparity_range=wanted)
        return self._back(frame, found, own, shapes)

    def match_two_views(
        self, image1: Image, image2: Image, F: F64, xy1: F64, xy2: F64, *, planar: bool = False
    ) -> RectifiedPair:
        """See `thesisrecon.config.DepthEstimator.match_two_views`."""
        methods = PLANAR if planar else METHODS
        frame = rectify_pair(F, xy1, xy2, image1.rgb.shape[1::-1], image2.rgb.shape[1::-1], methods=methods)
        wanted = _searched_range(frame, disparity_range(frame, xy1, xy2, margin=self.range_margin))
        gain = _brightness_gain(image1.rgb, image2.rgb, xy1, xy2)
        left = frame.warp(image1.rgb.astype(np.float32), 0)
        right = frame.warp(image2.rgb.astype(np.float32) * gain, 1)
        match = partial(self.matcher.match, disparity_range=wanted)
        return RectifiedPair(frame, (left, right), gain, *match_both_sides(match, left, right))

    def _back(
        self, frame: Rectification, found: DisparityMap, own: tuple[Shape, Shape], wanted: tuple[Shape, Shape]
    ) -> Correspondence:
        shape = wanted[0]
        enlarged = max(wanted[1]) / max(own[1])
        xy = np.full((*shape, 2), np.nan, dtype=np.float32)
        sigma = np.full(shape, np.nan, dtype=np.float32)
        confidence = np.zeros(shape, dtype=np.float32)
        sigma_px = found.sigma_px if np.isfinite(found.sigma_px) else 0.0
        deviation = max(sigma_px, self.min_sigma_px)
        for first in range(0, shape[0], STRIP_ROWS):
            rows = range(first, min(first + STRIP_ROWS, shape[0]))
            pixels = _resized(_pixels(shape[1], rows), wanted[0], own[0])
            places = frame.rectified_from_original(0, pixels)
            d, sure = _sample_disparity(found, places)
            inside: B8 = np.asarray(np.isfinite(d) & (sure >= self.min_confidence))
            where = places[inside]
            right, a, b = (
                frame.original_from_rectified(1, where - np.outer(d[inside] + step, (1.0, 0.0)), within=False)
                for step in (0.0, -0.5, 0.5)
            )
            scale = np.linalg.norm(b - a, axis=1)
            at = (np.flatnonzero(inside) // shape[1] + first, np.flatnonzero(inside) % shape[1])
            xy[at] = _resized(right, own[1], wanted[1])
            confidence[at] = sure[inside]
            # Confidence 1/2: the second best disparity costs P1 more on every path.
            sigma[at] = enlarged * deviation * scale * np.sqrt(0.5 / np.clip(sure[inside], 0.05, 0.5))
        return Correspondence(xy, sigma, confidence)


def _resized(xy: F64, shape: Shape, wanted: Shape) -> F64:
    """Pixels (N, 2) of an image of ``shape`` in the image of ``wanted`` shape, (x + 0.5) s - 0.5."""
    return np.asarray((xy + 0.5) * (np.array(wanted[::-1]) / np.array(shape[::-1])) - 0.5)


def _searched_range(frame: Rectification, wanted: tuple[int, int]) -> tuple[int, int]:
    """Disparity range within the frame width; ``StageFailure`` if it is empty or too large."""
    reach = frame.size[0] - 1
    first, last = max(wanted[0], -reach), min(wanted[1], reach)
    if not 0 <= last - first < MAX_DISPARITIES:
        raise StageFailure(
            "the disparity range of the pair cannot be searched",
            f"it is {first} to {last} px",
            "choose neighbours with a shorter baseline, or a smaller image size",
        )
    return first, last


def _sample_disparity(found: DisparityMap, places: F64) -> tuple[F64, F64]:
    """Disparity and confidence (N,) at positions (N, 2) of the rectified frame, NaN where unknown.

    Bilinear if the four pixels around lie on one surface, else the nearest pixel.
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
    # A comparison with NaN is false: with an unknown pixel among the four the nearest is used.
    d = np.where(spread <= ONE_SURFACE_PX, top + fy * (bottom - top), found.disparity[nearest])
    d = np.where(inside, d, np.nan)
    return d, np.where(np.isfinite(d), found.confidence[nearest], 0.0)


def _brightness_gain(reference: U8, other: U8, xy1: F64, xy2: F64) -> F32:
    """Gain (3,) that makes ``other`` as bright as ``reference``: median ratio of patch means at matches.

    It compensates exposure and white balance; 1 with fewer than 8 usable points.
    """
    levels = [_patch_means(rgb, xy) for rgb, xy in ((reference, xy1), (other, xy2))]
    good = np.isfinite(levels[0]).all(axis=1) & np.isfinite(levels[1]).all(axis=1)
    good &= np.minimum(levels[0], levels[1]).min(axis=1) > 8.0
    good &= np.maximum(levels[0], levels[1]).max(axis=1) < 247.0
    if int(good.sum()) < 8:
        return np.ones(3, dtype=np.float32)
    ratio = np.median(np.log(levels[0][good] / levels[1][good]), axis=0)
    return np.asarray(np.exp(np.clip(ratio, -1.0, 1.0)), dtype=np.float32)


def _patch_means(rgb: U8, xy: F64) -> F64:
    """Mean colours (N, 3) around pixels (N, 2), NaN where the patch leaves the image."""
    height, width = rgb.shape[:2]
    at = np.rint(xy).astype(np.int64)
    reach = GAIN_PATCH
    inside = np.all((at >= reach) & (at < np.array([width, height]) - reach), axis=1)
    at = np.where(inside[:, None], at, reach)
    total = np.zeros((len(xy), 3))
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            total += rgb[at[:, 1] + dy, at[:, 0] + dx]
    return np.where(inside[:, None], total / (2 * reach + 1) ** 2, np.nan)


def _levels(view: PinholeView) -> F32:
    levels: F32 = view.rgb.astype(np.float32)
    levels[~view.seen] = np.nan
    return levels


def _pixels(width: int, rows: range) -> F64:
    y, x = np.meshgrid(np.array(rows, dtype=np.float64), np.arange(float(width)), indexing="ij")
    return np.stack([x, y], axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class RectifiedPair:
    """Two rectified images and their dense disparities.

    Parameters
    ----------
    frame : Rectification
        Maps between the images and the rectified frame.
    images : tuple of ndarray (H, W, 3) float32
        Rectified images, NaN outside; the gain is applied to the second.
    gain : ndarray (3,) float32
        Gain that makes the second image as bright as the first.
    left, right : DisparityMap
        Disparities of both images, x_right = x_left - d, larger for nearer points.
    """

    frame: Rectification
    images: tuple[F32, F32]
    gain: F32
    left: DisparityMap
    right: DisparityMap

    def correspondences(self, side: int, size: tuple[int, int]) -> F32:
        """Compute the positions of the pixels of one image in the other.

        Parameters
        ----------
        side : {0, 1}
            The image.
        size : tuple of int
            (width, height) of that image.

        Returns
        -------
        ndarray (H, W, 2) float32
            Pixels of the other image, NaN outside the frame; occluded pixels get the background disparity
            (:meth:`DisparityMap.filled`).
        """
        found = self.right if side else self.left
        complete = replace(found, disparity=found.filled())
        places = np.full((size[1], size[0], 2), np.nan, dtype=np.float32)
        for first in range(0, size[1], STRIP_ROWS):
            rows = range(first, min(first + STRIP_ROWS, size[1]))
            here = self.frame.rectified_from_original(side, _pixels(size[0], rows))
            d = _sample_disparity(complete, here)[0]
            inside: B8 = np.isfinite(d)
            here = here[inside]
            here[:, 0] += d[inside] if side else -d[inside]
            there = self.frame.original_from_rectified(1 - side, here, within=False)
            places[first : rows.stop].reshape(-1, 2)[inside] = there
        return places

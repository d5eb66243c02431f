"""Dense correspondence of two views: rectify, match, and map the disparities back to the original pixels."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8, Record
from thesisrecon.errors import StageFailure
from thesisrecon.imaging.resampling import Rectification, bilinear_samples
from thesisrecon.records import DisparityMap, Image, PinholeView
from thesisrecon.stereo._cost import MAX_DISPARITIES
from thesisrecon.stereo._epipolar_pair import pair_of_cameras, pair_of_fundamental
from thesisrecon.stereo._postprocessing import match_both_sides
from thesisrecon.stereo.rectification import METHODS, PLANAR, disparity_range, rectify
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.stereo.semi_global import SemiGlobalMatching

Shape = tuple[int, ...]  #: height and width in pixels
MAX_COSTS = 400.0
"""Matching costs per pixel of the reference view; the frames of wide baselines are reduced to that."""


@dataclass(frozen=True, eq=False)
class Correspondence(Record):
    """Positions of the pixels of a reference view in another view."""

    xy: F32  #: (H, W, 2) pixels of the other view, NaN = unknown
    sigma: F32  #: (H, W) standard deviation along the epipolar line in pixels


@dataclass(frozen=True)
class PairMatching:
    """Dense correspondence of two undistorted views by stereo matching of the rectified pair."""

    matcher: SemiGlobalMatching | MaximumLikelihoodScanline = field(default_factory=SemiGlobalMatching)
    min_confidence: float = 0.0  #: disparities of less confidence are ignored

    def correspond(
        self, reference: PinholeView, other: PinholeView, xy1: F64, xy2: F64, *, shapes: tuple[Shape, Shape]
    ) -> Correspondence:
        """Compute the positions of the pixels of ``reference`` in ``other``."""
        own = reference.seen.shape, other.seen.shape
        sizes = own[0][::-1], own[1][::-1]
        frame = rectify(pair_of_cameras(reference.P, other.P, *sizes, xy1=xy1, xy2=xy2))
        wanted = _searched_range(frame, xy1, xy2)
        costs = frame.size[0] * frame.size[1] * (wanted[1] - wanted[0] + 1) / reference.seen.size
        if costs > MAX_COSTS:
            frame = frame.reduced((MAX_COSTS / costs) ** (1.0 / 3.0))
            wanted = _searched_range(frame, xy1, xy2)
        left = frame.warp(_levels(reference), 0)
        right = frame.warp(_levels(other) * brightness_gain(reference.rgb, other.rgb, xy1, xy2), 1)
        found = self.matcher.match(left, right, disparity_range=wanted)
        return self._map_back(frame, found, own, shapes)

    def match_two_views(
        self, image1: Image, image2: Image, F: F64, xy1: F64, xy2: F64, *, planar: bool = False
    ) -> "RectifiedPair":
        """See `thesisrecon.config.DepthEstimator.match_two_views`."""
        pair = pair_of_fundamental(F, xy1, xy2, image1.rgb.shape[1::-1], image2.rgb.shape[1::-1])
        frame = rectify(pair, PLANAR if planar else METHODS)
        wanted = _searched_range(frame, xy1, xy2)
        gain = brightness_gain(image1.rgb, image2.rgb, xy1, xy2)
        left = frame.warp(image1.levels, 0)
        right = frame.warp(image2.levels * gain, 1)
        match = partial(self.matcher.match, disparity_range=wanted)
        return RectifiedPair(frame, (left, right), gain, *match_both_sides(match, left, right))

    def _map_back(
        self, frame: Rectification, found: DisparityMap, own: tuple[Shape, Shape], wanted: tuple[Shape, Shape]
    ) -> Correspondence:
        """Correspondence at ``wanted`` shapes from disparities of the frame of images of ``own`` shapes."""
        # Lower limit of the standard deviation of disparities, which grows with decreasing confidence.
        min_sigma_px = 0.2
        xy = np.full((*wanted[0], 2), np.nan, dtype=np.float32)
        sigma = np.full(wanted[0], np.nan, dtype=np.float32)
        std = max(wanted[1]) / max(own[1]) * float(np.fmax(found.sigma_px, min_sigma_px))
        for rows, pixels in _strips(wanted[0]):
            places = frame.rectified_from_original(0, _resized(pixels, wanted[0], own[0]))
            d, sure = _sample_disparity(found, places)
            inside: B8 = np.asarray(np.isfinite(d) & (sure >= self.min_confidence))
            d, sure, places = d[inside], sure[inside], places[inside]
            right, beside = (
                frame.original_from_rectified(1, places - np.outer(d + step, (1.0, 0.0)), within=False)
                for step in (0.0, 1.0)
            )
            scale = np.linalg.norm(beside - right, axis=1)
            xy[rows].reshape(-1, 2)[inside] = _resized(right, own[1], wanted[1])
            # Confidence 1/2: the second best disparity costs P1 more on every path.
            sigma[rows].reshape(-1)[inside] = std * scale * np.sqrt(0.5 / np.clip(sure, 0.05, 0.5))
        return Correspondence(xy, sigma)


def _strips(shape: Shape) -> Iterator[tuple[slice, F64]]:
    """Rows of an image a few at a time, and the positions (N, 2) of their pixels."""
    strip_rows = 128  # Rows of the reference view that are mapped at a time
    for first in range(0, shape[0], strip_rows):
        rows = slice(first, min(first + strip_rows, shape[0]))
        y, x = np.mgrid[rows, : shape[1]]
        yield rows, np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64)


def _resized(xy: F64, shape: Shape, wanted: Shape) -> F64:
    """Pixels (N, 2) of an image of ``shape`` in the image of ``wanted`` shape, (x + 0.5) s - 0.5."""
    return np.asarray((xy + 0.5) * (np.array(wanted[::-1]) / np.array(shape[::-1])) - 0.5)


def _searched_range(frame: Rectification, xy1: F64, xy2: F64) -> tuple[int, int]:
    """Disparity range of matches within the frame width; ``StageFailure`` if it is empty or too large."""
    # Widening of the disparity range of the sparse points at both ends, as a share of the range.
    range_margin = 0.25
    first, last = disparity_range(frame, xy1, xy2, margin=range_margin)
    first, last = max(first, 1 - frame.size[0]), min(last, frame.size[0] - 1)
    if not 0 <= last - first < MAX_DISPARITIES:
        raise StageFailure.of("large-disparity-range", first, last)
    return first, last


def _sample_disparity(found: DisparityMap, places: F64) -> tuple[F64, F64]:
    """Disparity and confidence (N,) at positions (N, 2) of the rectified frame, NaN where unknown."""
    one_surface_px = 1.0  # Disparity range of four neighbours up to which they are interpolated
    height, width = found.disparity.shape
    inside: B8 = np.asarray(np.isfinite(places).all(axis=1))
    x, y = np.clip(np.where(inside[:, None], places, 0.0), 0.0, (width - 1.0, height - 1.0)).T
    between, spread = (values[:, 0] for values in bilinear_samples(found.disparity[..., None], x, y))
    nearest = np.rint(y).astype(np.int64), np.rint(x).astype(np.int64)
    # A comparison with NaN is false: with an unknown pixel among the four the nearest is used.
    d = np.where(spread <= one_surface_px, between, found.disparity[nearest])
    d = np.where(inside, d, np.nan)
    return d, np.where(np.isfinite(d), found.confidence[nearest], 0.0)


def brightness_gain(reference: U8, other: U8, xy1: F64, xy2: F64) -> F32:
    """Gain (3,) that makes ``other`` as bright as ``reference``: median ratio of patch means at matches."""
    reach = 2  # Radius of the patches whose brightness is compared
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    levels = list[F64]()
    for rgb, xy in ((reference, xy1), (other, xy2)):
        at = np.rint(xy).astype(np.int64)
        inside = np.all((at >= reach) & (at < np.array(rgb.shape[1::-1]) - reach), axis=1)
        at = np.where(inside[:, None], at, reach)
        patches = rgb[at[:, 1, None, None] + dy, at[:, 0, None, None] + dx]
        levels.append(np.where(inside[:, None], patches.mean(axis=(1, 2)), np.nan))
    good = np.isfinite(levels[0]).all(axis=1) & np.isfinite(levels[1]).all(axis=1)
    good &= np.minimum(levels[0], levels[1]).min(axis=1) > 8.0
    good &= np.maximum(levels[0], levels[1]).max(axis=1) < 247.0
    if int(good.sum()) < 8:
        return np.ones(3, dtype=np.float32)
    ratio = np.median(np.log(levels[0][good] / levels[1][good]), axis=0)
    return np.asarray(np.exp(np.clip(ratio, -1.0, 1.0)), dtype=np.float32)


def _levels(view: PinholeView) -> F32:
    levels: F32 = view.rgb.astype(np.float32)
    levels[~view.seen] = np.nan
    return levels


@dataclass(frozen=True, eq=False)
class RectifiedPair(Record):
    """Two rectified images and their dense disparities."""

    frame: Rectification  #: maps between the images and the rectified frame
    images: tuple[F32, F32]  #: (H, W, 3) rectified, NaN outside; the gain is applied to the second
    gain: F32  #: (3,) makes the second image as bright as the first
    left: DisparityMap  #: of the first image, x_right = x_left - d, larger for nearer points
    right: DisparityMap  #: of the second image, of the same sign

    def correspondences(self, side: int, size: tuple[int, int]) -> F32:
        """Compute the positions of the pixels of one image in the other."""
        found = self.right if side else self.left
        complete = replace(found, disparity=found.filled())
        places = np.full((size[1], size[0], 2), np.nan, dtype=np.float32)
        for rows, pixels in _strips(size[::-1]):
            here = self.frame.rectified_from_original(side, pixels)
            d = _sample_disparity(complete, here)[0]
            inside: B8 = np.isfinite(d)
            here = here[inside]
            here[:, 0] += d[inside] if side else -d[inside]
            there = self.frame.original_from_rectified(1 - side, here, within=False)
            places[rows].reshape(-1, 2)[inside] = there
        return places

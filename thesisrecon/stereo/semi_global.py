"""Semi-global matching of rectified pairs (thesis, section 2.5; Hirschmüller, PAMI 30(2), 2008).

The dynamic programming of reference [26] solves every row alone, which causes streaks. Semi-global
matching sums the minimal costs of the paths that reach a pixel along its row and column (4 paths), or along
the diagonals as well (8 paths). Occlusions are found afterwards by the left-right check.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thesisrecon.arrays import F32, I16, U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo._cost import (
    ARM,
    CENSUS_BITS,
    LEVELS,
    WEIGHT_SHIFT,
    CostFeatures,
    StereoImage,
    Strip,
    census,
    checked_range,
    cost_volume,
    estimate_noise,
    prepare_stereo_images,
    row_strips,
    run_strips,
    support_masks,
)
from thesisrecon.stereo._path_kernels import TOP, adaptive_P2, scratch_size, sum_paths
from thesisrecon.stereo._postprocessing import (
    MIN_NEIGHBOURS,
    STEP_PX,
    TEXTURED,
    best_disparities,
    check_left_right,
    disparity_noise,
    edge_preserving_mean,
    fill_pinholes,
    final_confidence,
    remove_speckles,
    texture_of,
)

MIN_NOISE = 1.0
"""Standard deviation in grey levels of quantisation and viewpoint change, added to the image noise."""
MAX_P2 = 15.0
"""Upper limit of P2 in maximal matching costs: both share one byte, and costs need a few levels."""


@dataclass(frozen=True)
class CensusAndColour:
    """Hamming distance of census transforms plus truncated absolute colour difference.

    The 5 x 5 census transform (Zabih and Woodfill 1994) is invariant to exposure; the colours distinguish
    regions of equal pattern. Truncation limits the influence of occlusions and outliers.

    Parameters
    ----------
    census_share : float
        Share of the census in the maximal cost; the colours have the rest.
    truncation : float
        Truncation of the colour difference, in standard deviations of the noise.
    support : bool
        Average the costs over cross-shaped support regions (Zhang, Lu and Lafruit 2009) with arms of 2
        pixels.
    tolerance : float
        Colour difference at which an arm ends, in standard deviations of the noise.
    outside : float
        Cost of a partner outside the image, as a share of the maximal cost.
    """

    census_share: float = 0.56
    truncation: float = 10.0
    support: bool = True
    tolerance: float = 5.0
    outside: float = 0.4

    def __post_init__(self) -> None:
        for name in ("census_share", "outside"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be between 0 and 1; got {getattr(self, name)}")
        for name in ("truncation", "tolerance"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be above 0; got {getattr(self, name)}")

    def _arms(self, image: StereoImage, noise: float) -> U8:
        """Support arms (4, ARM, H, W) of the pixels; the second axis is empty without ``support``."""
        masks = np.empty((4, ARM if self.support else 0, *image.valid.shape), np.uint8)
        if self.support:
            tolerance = np.int16(min(round(self.tolerance * noise * LEVELS), 255 * LEVELS))
            support_masks(image.channels, image.valid, tolerance, masks)
        return masks

    def _weights(self, channels: int, noise: float, max_cost: int) -> I16:
        """Weights of a census bit and of a quarter level, and truncation, for noise in grey levels."""
        one = max_cost << WEIGHT_SHIFT
        cap = min(max(round(self.truncation * noise * LEVELS * channels), channels), 255 * LEVELS * channels)
        of_bit = round(self.census_share * one / CENSUS_BITS)
        of_level = max(round((1.0 - self.census_share) * one / cap), int(self.census_share < 1.0))
        return np.array([of_bit, of_level, cap], np.int16)


@dataclass(frozen=True)
class PathPenalties:
    """Smoothness penalties of semi-global matching, in units of the maximal matching cost.

    The penalty of a disparity change above 1 is P2 / (1 + g / ``edge``), at least ``min_P2``, with the
    intensity step g between the pixels (Hirschmüller 2008, section 2.2).

    Parameters
    ----------
    P1 : float
        Penalty of a disparity change of 1.
    P2 : float
        Penalty of larger changes between pixels of equal intensity.
    min_P2 : float
        Lower limit of the adapted P2.
    edge : float
        Intensity step that halves P2, in standard deviations of the noise.
    """

    P1: float = 0.43
    P2: float = 1.6
    min_P2: float = 0.65
    edge: float = 14.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.P1 <= self.min_P2 <= self.P2 <= MAX_P2:
            raise ValueError(
                f"penalties must obey 0 <= P1 <= min_P2 <= P2 <= {MAX_P2:g}; "
                f"got {self.P1}, {self.min_P2}, {self.P2}"
            )
        if not self.edge > 0.0:
            raise ValueError(f"edge must be above 0; got {self.edge}")

    @property
    def _max_cost(self) -> int:
        """The maximal matching cost as an integer: the largest for which cost and penalty fit one byte."""
        return int(TOP / (1.0 + self.P2))

    def _adapted_P2(self, image: StereoImage, noise: float) -> U8:
        """P2 (4, H, W) between neighbouring pixels, see :func:`adaptive_P2`."""
        out = np.empty((4, *image.valid.shape), np.uint8)
        scale = np.float32(self.edge * noise * LEVELS * len(image.channels))
        largest, least = np.float32(self.P2 * self._max_cost), np.float32(self.min_P2 * self._max_cost)
        adaptive_P2(image.grey, largest, least, scale, out)
        return out


@dataclass(frozen=True)
class DisparityPostprocessing:
    """Left-right check, speckle filter and smoothing of disparities.

    Parameters
    ----------
    left_right_px : float
        Largest difference in the left-right check.
    min_region_px : int
        Connected regions of fewer pixels are removed, as are larger ones without texture.
    min_confidence : float
        Disparities of less confidence are unknown.
    radius : int
        Radius of the edge-preserving mean over disparities within 1 px of the centre; 0 = none.
    """

    left_right_px: float = 1.0
    min_region_px: int = 60
    min_confidence: float = 0.02
    radius: int = 2

    def __post_init__(self) -> None:
        if not (self.left_right_px >= 0.0 and self.min_region_px >= 0 and self.radius >= 0):
            raise ValueError("left_right_px, min_region_px and radius must not be negative")
        if not 0.0 <= self.min_confidence < 1.0:
            raise ValueError(f"min_confidence must be in [0, 1); got {self.min_confidence}")

    def _apply(self, left: F32, right: F32, confidence: F32, texture: F32) -> DisparityMap:
        """Check, filter and smooth the disparities (H, W) of the left image; ``left`` is overwritten.

        Values propagated into regions without ``texture`` get low ``confidence``, which is overwritten.
        """
        limits = np.array([self.left_right_px, self.min_confidence], np.float32)
        check_left_right(left, right, confidence, limits)
        remove_speckles(left, texture > TEXTURED, STEP_PX, self.min_region_px)
        closed = np.empty_like(left)
        fill_pinholes(left, MIN_NEIGHBOURS, closed)
        closed[np.isnan(texture)] = np.nan
        smooth = np.empty_like(left)
        edge_preserving_mean(closed, STEP_PX, self.radius, smooth)
        final_confidence(confidence, left, smooth, texture)
        return DisparityMap(smooth, confidence, disparity_noise(closed, smooth))


@dataclass(frozen=True)
class SemiGlobalMatching:
    """Semi-global matching with census and colour costs.

    The default has four paths: costs that are averaged over an adaptive support gain little from the
    diagonals, which extend foreground disparities past the corners of objects.

    Parameters
    ----------
    paths : int
        4 (rows and columns) or 8 (with diagonals).
    costs : CensusAndColour
    penalties : PathPenalties
        P1 and P2.
    postprocessing : DisparityPostprocessing
        Left-right check, speckle filter and smoothing.
    memory_mb : float
        Memory limit for costs and path sums of one strip of rows; each thread has its own strip.
    threads : int
    """

    paths: int = 4
    costs: CensusAndColour = field(default_factory=CensusAndColour)
    penalties: PathPenalties = field(default_factory=PathPenalties)
    postprocessing: DisparityPostprocessing = field(default_factory=DisparityPostprocessing)
    memory_mb: float = 256.0
    threads: int = 1

    def __post_init__(self) -> None:
        if self.paths not in (4, 8):
            raise ValueError(f"paths must be 4 or 8; got {self.paths}")

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Compute the disparities of the left image.

        Parameters
        ----------
        left, right : array_like (H, W) or (H, W, K <= 4)
            Grey levels 0 .. 255 of a rectified pair, NaN = no pixel.
        disparity_range : tuple of int
            First and last disparity in pixels, both included; x_right = x_left - d. Disparities are positive
            for parallel cameras and have either sign for converging ones.

        Returns
        -------
        DisparityMap
            NaN where the pixel is occluded, fails the left-right check or is ambiguous. The result does not
            depend on the number of threads.
        """
        first, last = checked_range(disparity_range)
        images = prepare_stereo_images(left, right)
        measured = float(np.mean([estimate_noise(image) for image in images]))
        noise = float(np.hypot(MIN_NOISE, measured))
        (height, width), n = images[0].valid.shape, last - first + 1
        bits = np.empty((2, height, width), np.int32)
        for image, out in zip(images, bits, strict=True):
            census(image.grey, out)
        max_cost, pairs = self.penalties._max_cost, self.paths // 2
        arms = self.costs._arms(images[0], noise)
        weights = self.costs._weights(len(images[0].channels), noise, max_cost)
        outside = np.uint8(round(self.costs.outside * max_cost))
        P1, P2 = self.penalties.P1, self.penalties._adapted_P2(images[0], noise)
        found = np.empty((3, height, width), np.float32)

        def rows_of(side: int, rows: slice) -> CostFeatures:
            image = images[side]
            return bits[side, rows], np.ascontiguousarray(image.channels[:, rows]), image.valid[rows]

        def work(strip: Strip) -> None:
            start, stop, top, bottom = strip
            rows = slice(top, bottom)
            # One allocation gets large memory pages.
            cells, transposed = (bottom - top) * n * width, scratch_size(bottom - top, n, width)
            whole = np.empty((1 + pairs) * cells + 2 * transposed, np.uint8)
            volume, sums, scratch = np.split(whole, [cells, (1 + pairs) * cells])
            volume, sums = volume.reshape(-1, n, width), sums.reshape(pairs, -1, n, width)
            support = np.ascontiguousarray(arms[:, :, rows])
            cost_volume(rows_of(0, rows), rows_of(1, rows), support, first, weights, outside, volume)
            penalties = np.ascontiguousarray(P2[:, rows])
            sum_paths(volume, penalties, np.uint8(round(P1 * max_cost)), sums, scratch.reshape(2, transposed))
            own = found[:, start:stop]
            # Confidence 1/2 if the second best disparity costs P1 more on every path.
            best_disparities(
                sums, start - top, first, (own[0], own[1], own[2]), float(2 * pairs * P1 * max_cost)
            )

        # One byte per pixel and disparity for the cost, and one for each pair of opposite paths.
        memory = 1e6 * self.memory_mb
        room = max(memory - 2 * scratch_size(height, n, width), 0.5 * memory)
        run_strips(work, row_strips(height, (1 + pairs) * width * n, room), self.threads)
        left_px, right_px, confidence = found
        left_px[images[0].valid == 0] = np.nan
        return self.postprocessing._apply(left_px, right_px, confidence, texture_of(images[0], measured))


PUBLISHED = SemiGlobalMatching(
    paths=8,
    costs=CensusAndColour(census_share=1.0, support=False),
    postprocessing=DisparityPostprocessing(radius=0),
)
"""Semi-global matching as published: eight paths over census costs of single pixels."""


def match_both_sides(
    match: Callable[[Any, Any], DisparityMap], left: NDArray[Any], right: NDArray[Any]
) -> tuple[DisparityMap, DisparityMap]:
    """Compute the disparities of both images with a matcher of the left image.

    The second match exchanges the images and mirrors them: the mirrored right image is a left image.

    Parameters
    ----------
    match : callable
        ``match(left, right)`` returns the disparities of the left image.
    left, right : ndarray (H, W) or (H, W, K)
        Rectified images.

    Returns
    -------
    tuple of DisparityMap
        Disparities of the left and of the right image, x_right = x_left - d in both.
    """

    def mirrored(image: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(image[:, ::-1])

    found, back = match(left, right), match(mirrored(right), mirrored(left))
    return found, DisparityMap(mirrored(back.disparity), mirrored(back.confidence), back.sigma_px)

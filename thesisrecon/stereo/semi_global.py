"""Semi-global matching of rectified pairs (thesis, section 2.5; Hirschmüller, PAMI 30(2), 2008).

It sums the minimal costs of the paths that reach a pixel along its row and column (4 paths), or along the
diagonals as well (8 paths). Occlusions are found afterwards by the left-right check.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.arrays import F32, I16, U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo._cost import (
    ARM,
    CENSUS_BITS,
    LEVELS,
    WEIGHT_SHIFT,
    StereoImage,
    census,
    checked_range,
    cost_volume,
    estimate_noise,
    prepare_stereo_images,
    row_strips,
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
TOLERANCE = 5.0
"""Colour difference at which an arm of the support ends, in standard deviations of the noise."""
OUTSIDE = 0.4
"""Cost of a partner outside the image, as a share of the maximal cost."""
P1, P2, MIN_P2 = 0.43, 1.6, 0.65
"""Penalties of a disparity change of 1, of larger ones, and limit of the adapted P2, in maximal costs."""
EDGE = 14.0
"""Intensity step that halves P2, in standard deviations of the noise."""
MAX_COST = int(TOP / (1.0 + P2))
"""Maximal matching cost: the largest for which cost and penalty fit one byte."""
LEFT_RIGHT_PX, MIN_CONFIDENCE = 1.0, 0.02
"""Largest difference in the left-right check; disparities of less confidence are unknown."""
MIN_REGION_PX = 60
"""Connected regions of fewer pixels are removed, as are larger ones without texture."""


@dataclass(frozen=True)
class SemiGlobalMatching:
    """Semi-global matching with census and colour costs.

    The cost is the Hamming distance of 5 x 5 census transforms (Zabih and Woodfill 1994), which are invariant
    to exposure, plus the truncated colour difference, which distinguishes regions of equal pattern. Costs
    averaged over an adaptive support improve little with diagonal paths, which extend foreground disparities
    beyond the corners of objects.
    """

    paths: int = 4  #: 4 (rows and columns) or 8 (with diagonals)
    census_share: float = 0.56  #: share of the census in the maximal cost; the colours have the rest
    truncation: float = 10.0  #: largest colour difference in the cost, in standard deviations of the noise
    support: bool = True
    """Average the costs over cross-shaped regions (Zhang, Lu and Lafruit 2009) with arms of 2 pixels."""
    smoothing_radius: int = 2  #: radius of the edge-preserving mean over similar disparities; 0 = none

    # Limit for costs and path sums of one strip of rows.
    memory_mb = 256.0

    def __post_init__(self) -> None:
        if self.paths not in (4, 8):
            raise ValueError(f"paths must be 4 or 8; got {self.paths}")
        if not (0.0 <= self.census_share <= 1.0 and self.truncation > 0.0 and self.smoothing_radius >= 0):
            raise ValueError("census_share must be in [0, 1], truncation positive, smoothing_radius >= 0")

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Compute the disparities of the left image.

        Parameters
        ----------
        left, right : array_like (H, W) or (H, W, K <= 4)
            Grey levels 0 .. 255 of a rectified pair, NaN = no pixel.
        disparity_range : tuple of int
            First and last disparity in pixels, both included; x_right = x_left - d, of either sign.

        Returns
        -------
        DisparityMap
            NaN where the pixel is occluded, fails the left-right check or is ambiguous.
        """
        first, last = checked_range(disparity_range)
        images = prepare_stereo_images(left, right)
        measured = float(np.mean([estimate_noise(image) for image in images]))
        noise = float(np.hypot(MIN_NOISE, measured))
        (height, width), n, pairs = images[0].valid.shape, last - first + 1, self.paths // 2
        bits = np.empty((2, height, width), np.int32)
        for image, out in zip(images, bits, strict=True):
            census(image.grey, out)
        arms = np.empty((4, ARM if self.support else 0, height, width), np.uint8)
        if self.support:
            tolerance = np.int16(min(round(TOLERANCE * noise * LEVELS), 255 * LEVELS))
            support_masks(images[0].channels, images[0].valid, tolerance, arms)
        weights, outside = self._weights(len(images[0].channels), noise), np.uint8(round(OUTSIDE * MAX_COST))
        penalties, P1_cost = _adapted_P2(images[0], noise), np.uint8(round(P1 * MAX_COST))
        # Confidence 1/2 if the second best disparity costs P1 more on every path.
        half = float(2 * pairs * P1 * MAX_COST)
        found = np.empty((3, height, width), np.float32)
        # One byte per pixel and disparity for the cost, and one for each pair of opposite paths.
        memory = 1e6 * self.memory_mb
        room = max(memory - 2 * scratch_size(height, n, width), 0.5 * memory)
        for start, stop, top, bottom in row_strips(height, (1 + pairs) * width * n, room):
            rows = slice(top, bottom)
            features = [
                (bits[side, rows], np.ascontiguousarray(image.channels[:, rows]), image.valid[rows])
                for side, image in enumerate(images)
            ]
            # One allocation gets large memory pages.
            cells, transposed = (bottom - top) * n * width, scratch_size(bottom - top, n, width)
            whole = np.empty((1 + pairs) * cells + 2 * transposed, np.uint8)
            volume, sums, scratch = np.split(whole, [cells, (1 + pairs) * cells])
            volume, sums = volume.reshape(-1, n, width), sums.reshape(pairs, -1, n, width)
            support = np.ascontiguousarray(arms[:, :, rows])
            cost_volume(features[0], features[1], support, first, weights, outside, volume)
            steps = np.ascontiguousarray(penalties[:, rows])
            sum_paths(volume, steps, P1_cost, sums, scratch.reshape(2, transposed))
            own = found[:, start:stop]
            best_disparities(sums, start - top, first, (own[0], own[1], own[2]), half)
        found[0][images[0].valid == 0] = np.nan
        return self._postprocess(found[0], found[1], found[2], texture_of(images[0], measured))

    def _weights(self, channels: int, noise: float) -> I16:
        """Weights of a census bit and of a quarter level, and truncation, for noise in grey levels."""
        one = MAX_COST << WEIGHT_SHIFT
        cap = min(max(round(self.truncation * noise * LEVELS * channels), channels), 255 * LEVELS * channels)
        of_bit = round(self.census_share * one / CENSUS_BITS)
        of_level = max(round((1.0 - self.census_share) * one / cap), int(self.census_share < 1.0))
        return np.array([of_bit, of_level, cap], np.int16)

    def _postprocess(self, left: F32, right: F32, confidence: F32, texture: F32) -> DisparityMap:
        """Check, filter and smooth the disparities (H, W) of the left image; inputs are overwritten."""
        limits = np.array([LEFT_RIGHT_PX, MIN_CONFIDENCE], np.float32)
        check_left_right(left, right, confidence, limits)
        remove_speckles(left, texture > TEXTURED, STEP_PX, MIN_REGION_PX)
        closed, smooth = np.empty_like(left), np.empty_like(left)
        fill_pinholes(left, MIN_NEIGHBOURS, closed)
        closed[np.isnan(texture)] = np.nan
        edge_preserving_mean(closed, STEP_PX, self.smoothing_radius, smooth)
        final_confidence(confidence, left, smooth, texture)
        return DisparityMap(smooth, confidence, disparity_noise(closed, smooth))


def _adapted_P2(image: StereoImage, noise: float) -> U8:
    """P2 / (1 + g / ``EDGE``) with the intensity step g, at least ``MIN_P2``; see :func:`adaptive_P2`."""
    out = np.empty((4, *image.valid.shape), np.uint8)
    scale = np.float32(EDGE * noise * LEVELS * len(image.channels))
    adaptive_P2(image.grey, np.float32(P2 * MAX_COST), np.float32(MIN_P2 * MAX_COST), scale, out)
    return out


PUBLISHED = SemiGlobalMatching(paths=8, census_share=1.0, support=False, smoothing_radius=0)
"""Semi-global matching as published: eight paths over census costs of single pixels."""

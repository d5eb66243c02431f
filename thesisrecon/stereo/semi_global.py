"""Semi-global matching of rectified pairs (thesis, section 2.5; Hirschmüller, PAMI 30(2), 2008).

The dynamic programming of reference [26] solves every row alone, which causes streaks. Semi-global
matching sums the minimal costs of the paths that reach a pixel along its row and column (4 paths), or along
the diagonals as well (8 paths). Occlusions are found afterwards by the left-right check.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thesisrecon.arrays import U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo.cost import (
    CensusAndColour,
    StereoImage,
    Strip,
    checked_range,
    estimate_noise,
    prepare_stereo_images,
    row_strips,
    run_strips,
)
from thesisrecon.stereo.cost_kernels import LEVELS
from thesisrecon.stereo.path_kernels import TOP, adaptive_P2, scratch_size, sum_paths
from thesisrecon.stereo.postprocessing import DisparityPostprocessing, best_disparities, texture_of

MIN_NOISE = 1.0
"""Standard deviation in grey levels of quantisation and viewpoint change, added to the image noise."""
MAX_P2 = 15.0
"""Upper limit of P2 in maximal matching costs: both share one byte, and costs need a few levels."""


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
    def max_cost(self) -> int:
        """The maximal matching cost as an integer: the largest for which cost and penalty fit one byte."""
        return int(TOP / (1.0 + self.P2))

    def adapted_P2(self, image: StereoImage, noise: float) -> U8:
        """Compute the intensity-adapted P2 between neighbouring pixels.

        Parameters
        ----------
        image : StereoImage
            The left image.
        noise : float
            Standard deviation of its noise in grey levels.

        Returns
        -------
        ndarray (4, H, W) uint8
            Penalties from the left, upper, upper left and upper right neighbour.
        """
        out = np.empty((4, *image.valid.shape), np.uint8)
        scale = np.float32(self.edge * noise * LEVELS * len(image.channels))
        largest, least = np.float32(self.P2 * self.max_cost), np.float32(self.min_P2 * self.max_cost)
        adaptive_P2(image.grey, largest, least, scale, out)
        return out


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

        Raises
        ------
        ValueError
            If the image shapes are invalid or differ, or the range is empty.
        """
        first, last = checked_range(disparity_range)
        images = prepare_stereo_images(left, right)
        measured = float(np.mean([estimate_noise(image) for image in images]))
        noise = float(np.hypot(MIN_NOISE, measured))
        height, width = images[0].valid.shape
        features = [self.costs.features(image) for image in images]
        support = self.costs.support_arms(images[0], noise)
        P2 = self.penalties.adapted_P2(images[0], noise)
        P1 = np.uint8(round(self.penalties.P1 * self.penalties.max_cost))
        found = np.empty((3, height, width), np.float32)
        # Confidence 1/2 if the second best disparity costs P1 more on every path.
        half = float(2 * self._pairs * self.penalties.P1 * self.penalties.max_cost)

        def work(strip: Strip) -> None:
            start, stop, top, bottom = strip
            volume, sums, scratch = self._workspace(bottom - top, last - first + 1, width)
            self.costs.fill_volume(
                volume,
                features[0],
                features[1],
                support,
                rows=(top, bottom),
                first=first,
                noise=noise,
                max_cost=self.penalties.max_cost,
            )
            sum_paths(volume, np.ascontiguousarray(P2[:, top:bottom]), P1, sums, scratch)
            own = found[:, start:stop]
            best_disparities(sums, start - top, first, (own[0], own[1], own[2]), half)

        # One byte per pixel and disparity for the cost, and one for each pair of opposite paths.
        per_row = (1 + self._pairs) * width * (last - first + 1)
        memory = 1e6 * self.memory_mb
        room = max(memory - 2 * scratch_size(height, last - first + 1, width), 0.5 * memory)
        run_strips(work, row_strips(height, per_row, room), self.threads)
        left_px, right_px, confidence = found
        left_px[images[0].valid == 0] = np.nan
        return self.postprocessing.apply(left_px, right_px, confidence, texture_of(images[0], measured))

    @property
    def _pairs(self) -> int:
        return self.paths // 2

    def _workspace(self, height: int, disparities: int, width: int) -> tuple[U8, U8, U8]:
        """Costs, path sums and scratch of a strip in one allocation, which gets large memory pages."""
        cells, transposed = height * disparities * width, scratch_size(height, disparities, width)
        whole = np.empty((1 + self._pairs) * cells + 2 * transposed, np.uint8)
        costs, sums, scratch = np.split(whole, [cells, (1 + self._pairs) * cells])
        shape = (height, disparities, width)
        return costs.reshape(shape), sums.reshape(self._pairs, *shape), scratch.reshape(2, transposed)


PUBLISHED = SemiGlobalMatching(
    paths=8,
    costs=CensusAndColour(census_share=1.0, support=False),
    postprocessing=DisparityPostprocessing(radius=0),
)
"""Semi-global matching as published: eight paths over census costs of single pixels."""


class PairMatcher(Protocol):
    """A dense matcher: :class:`SemiGlobalMatching` or that of :mod:`thesisrecon.stereo.scanline`."""

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Compute the disparities of the left image within the range, both ends included."""
        ...


def match_rectified_arrays(
    left: ArrayLike, right: ArrayLike, *, max_disparity_px: float, matcher: PairMatcher | None = None
) -> DisparityMap:
    """Compute the disparities of a rectified pair of parallel cameras.

    Parameters
    ----------
    left, right : array_like (H, W) or (H, W, 3)
        Grey levels 0 .. 255, integer or floating point, NaN = no pixel; rows correspond.
    max_disparity_px : float
        Disparity of the nearest point; 0 .. ceil(max_disparity_px) are searched.
    matcher : PairMatcher, optional
        Default: :class:`SemiGlobalMatching` with 4 paths.

    Returns
    -------
    DisparityMap
        x_right = x_left - d, NaN = unknown or occluded.

    Raises
    ------
    ValueError
        If the image shapes are invalid or differ, or max_disparity_px is negative or not finite.

    Examples
    --------
    >>> blocks = np.random.default_rng(0).uniform(0.0, 255.0, (10, 20))
    >>> right = np.kron(blocks, np.ones((4, 4)))
    >>> found = match_rectified_arrays(np.roll(right, 5, axis=1), right, max_disparity_px=8)
    >>> round(float(np.nanmedian(found.disparity)), 1)
    5.0
    """
    if not 0.0 <= max_disparity_px < np.inf:
        raise ValueError(f"max_disparity_px must be finite and not negative; got {max_disparity_px}")
    matcher = SemiGlobalMatching() if matcher is None else matcher
    return matcher.match(left, right, disparity_range=(0, int(np.ceil(max_disparity_px))))


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

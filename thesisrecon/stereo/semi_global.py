"""Matching by path sums: the scanlines tied together by the columns (the default), and semi-global matching.

The dynamic programming of the thesis' reference decides every row by itself and shows it: rows of different
opinion make streaks. Here a pixel adds up the least costs of the scanline that reaches it from the left and
from the right, and of the column that reaches it from above and from below; where the diagonals join in it is
semi-global matching (Hirschmüller, PAMI 2008). Occlusion is no state of the program but what the check of
both sides against each other finds.

The front door of dense matching.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.arrays import U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo.cost import (
    CensusAndColour,
    Strip,
    checked_range,
    estimate_noise,
    prepare_pair,
    row_strips,
    run_strips,
)
from thesisrecon.stereo.paths import PathPenalties, scratch_size
from thesisrecon.stereo.postprocessing import Finish, best_disparities, texture_of

LEAST_NOISE = 1.0
"""Grey levels that corresponding pixels differ by besides the noise: digitisation, another point of view."""


@dataclass(frozen=True)
class PathSum:
    """What the variants share: costs, penalties, checks, memory and threads.

    ``diagonals`` adds the four diagonal paths to the rows and columns. ``memory_mb`` bounds what the costs
    and sums of one strip take; every thread has a strip of its own.
    """

    costs: CensusAndColour
    penalties: PathPenalties
    finish: Finish
    diagonals: bool
    memory_mb: float
    threads: int

    def match(self, left: ArrayLike, right: ArrayLike, disparity_range: tuple[int, int]) -> DisparityMap:
        """See :meth:`CohesiveScanlines.match`."""
        first, last = checked_range(disparity_range)
        sides = prepare_pair(left, right)
        measured = float(np.mean([estimate_noise(side) for side in sides]))
        noise = float(np.hypot(LEAST_NOISE, measured))
        height, width = sides[0].valid.shape
        costed = [self.costs.side(side) for side in sides]
        support = self.costs.support_of(sides[0], noise)
        jumps = self.penalties.jumps(sides[0], noise)
        found = np.empty((3, height, width), np.float32)
        # Half confidence where the rival costs as much more as a step on every path.
        half = float(2 * self._pairs * self.penalties.step * self.penalties.dearest)

        def work(strip: Strip) -> None:
            start, stop, top, bottom = strip
            volume, sums, scratch = self._workspace(bottom - top, last - first + 1, width)
            self.costs.fill(
                volume,
                costed[0],
                costed[1],
                support,
                rows=(top, bottom),
                first=first,
                noise=noise,
                dearest=self.penalties.dearest,
            )
            self.penalties.sum_into(sums, volume, jumps[:, top:bottom], scratch)
            own = found[:, start:stop]
            best_disparities(sums, start - top, first, (own[0], own[1], own[2]), half)

        # A byte for the cost of a disparity of a pixel, and one for each pair of opposite paths.
        per_row = (1 + self._pairs) * width * (last - first + 1)
        memory = 1e6 * self.memory_mb
        room = max(memory - 2 * scratch_size(height, last - first + 1, width), 0.5 * memory)
        run_strips(work, row_strips(height, per_row, room), self.threads)
        left_px, right_px, confidence = found
        left_px[sides[0].valid == 0] = np.nan
        return self.finish.apply(left_px, right_px, confidence, texture_of(sides[0], measured))

    @property
    def _pairs(self) -> int:
        return 4 if self.diagonals else 2

    def _workspace(self, height: int, disparities: int, width: int) -> tuple[U8, U8, U8]:
        """Costs, path sums and scratch of a strip in one piece: large pieces come in large pages."""
        cells, turned = height * disparities * width, scratch_size(height, disparities, width)
        whole = np.empty((1 + self._pairs) * cells + 2 * turned, np.uint8)
        costs, sums, scratch = np.split(whole, [cells, (1 + self._pairs) * cells])
        shape = (height, disparities, width)
        return costs.reshape(shape), sums.reshape(self._pairs, *shape), scratch.reshape(2, turned)


@dataclass(frozen=True)
class CohesiveScanlines:
    """The default: path sums along rows and columns over census and colour costs with adaptive support.

    Four paths do better than eight here: over costs averaged over a support the diagonals add little
    evidence, and they carry the disparity of a foreground past its corners.
    """

    costs: CensusAndColour = field(default_factory=CensusAndColour)
    penalties: PathPenalties = field(default_factory=PathPenalties)
    finish: Finish = field(default_factory=Finish)
    diagonals: bool = False
    memory_mb: float = 256.0
    threads: int = 1

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Disparities of the left image.

        Parameters
        ----------
        left, right
            (H, W) or (H, W, K <= 4) grey levels 0 .. 255 of a rectified pair, NaN = no pixel.
        disparity_range
            First and last disparity in pixels, both included; x_right = x_left - d, so they are positive for
            parallel cameras and of either sign where these converge.

        Returns
        -------
        DisparityMap
            NaN where the pixel is hidden in the right image, where the two sides contradict each other, and
            where nothing tells one disparity from another. The same bytes whatever the number of threads.

        Raises
        ------
        ValueError
            Images of different or impossible shape, an empty range.
        """
        return _path_sum(self).match(left, right, disparity_range)


@dataclass(frozen=True)
class SemiGlobal:
    """Semi-global matching as published, on census costs: eight paths, no support, the same checks."""

    costs: CensusAndColour = field(default_factory=lambda: CensusAndColour(census_share=1.0, support=False))
    penalties: PathPenalties = field(default_factory=PathPenalties)
    finish: Finish = field(default_factory=lambda: Finish(radius=0))
    diagonals: bool = True
    memory_mb: float = 256.0
    threads: int = 1

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """See :meth:`CohesiveScanlines.match`."""
        return _path_sum(self).match(left, right, disparity_range)


def _path_sum(variant: CohesiveScanlines | SemiGlobal) -> PathSum:
    return PathSum(
        variant.costs,
        variant.penalties,
        variant.finish,
        variant.diagonals,
        variant.memory_mb,
        variant.threads,
    )


class PairMatcher(Protocol):
    """A variant of dense matching: :class:`CohesiveScanlines`, :class:`SemiGlobal`,
    :class:`MaximumLikelihoodScanline`."""

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Disparities of the left image in the range, both ends included."""
        ...


def match_rectified(
    left: ArrayLike, right: ArrayLike, *, max_disparity_px: float, config: PairMatcher | None = None
) -> DisparityMap:
    """Disparities of a rectified pair of parallel cameras.

    Parameters
    ----------
    left, right
        (H, W) or (H, W, 3) grey levels 0 .. 255, integer or floating, NaN = no pixel; rows correspond.
    max_disparity_px
        Of the nearest thing. The search is over 0 .. ceil(max_disparity_px).
    config
        The variant, :class:`CohesiveScanlines` where None.

    Returns
    -------
    DisparityMap
        x_right = x_left - d, NaN = unknown or hidden.

    Raises
    ------
    ValueError
        Images of different or impossible shape; a disparity that is negative or no number.
    """
    if not 0.0 <= max_disparity_px < np.inf:
        raise ValueError(f"max_disparity_px must be a number from 0 on; got {max_disparity_px}")
    matcher = CohesiveScanlines() if config is None else config
    return matcher.match(left, right, disparity_range=(0, int(np.ceil(max_disparity_px))))

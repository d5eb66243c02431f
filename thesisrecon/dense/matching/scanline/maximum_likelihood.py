"""Maximum likelihood stereo, [26] of the thesis (Cox, Hingorani, Rao and Maggs, CVIU 63, 1996)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thesisrecon.dense.matching.costs.kernels import LEVELS
from thesisrecon.dense.matching.finish.checks import texture_of
from thesisrecon.dense.matching.finish.kernels import rate
from thesisrecon.dense.matching.pair import estimate_noise, prepare_pair
from thesisrecon.dense.matching.ranges import checked_range
from thesisrecon.dense.matching.scanline.kernels import NOTHING, solve_rows
from thesisrecon.dense.matching.strips import Strip, run_strips
from thesisrecon.types import DisparityMap

F32 = NDArray[np.float32]
Cohesion = Literal["none", "along", "along and across"]

GREY_RANGE = 256.0
"""Values that a hidden pixel may have: its density is uniform over them."""
ROUNDING_PX = float(1.0 / np.sqrt(12.0))
"""Deviation of a disparity that is the nearest whole number."""
ROWS, WARM_UP = 96, 8
"""Rows of a strip, and the rows above that are solved before so that its first row coheres with something."""
MATCH_NATS = 0.5
"""Expected cost of a match, per component: (z - z')^2 / (2 s^2) is the square of a standard normal."""
SIGNIFICANT = 30.0
"""Nats: what is less probable by more counts as impossible."""


@dataclass(frozen=True)
class MaximumLikelihoodScanline:
    """The correspondences of every scanline with the greatest likelihood, by dynamic programming.

    Two measurements of one thing are normal about its true value with variance s^2 in each of their m
    components, so with the mean for the unknown true value a match costs |z - z'|^2 / (4 s^2). A pixel
    without partner costs ln(P_D phi^m / ((1 - P_D) (2 pi s^2)^(m / 2))): it is seen by the other camera with
    probability P_D (``detection``), and a value of its own is uniform over phi = 256 grey levels. Ordering
    and uniqueness hold by construction; hidden pixels are found, not guessed.

    ``cohesion`` decides among solutions of equal likelihood: "along" the row as few discontinuities as
    possible (MLMH), "along and across" as few as possible along the row and against the row before (MLMH+V).
    As in the paper equality is that of whole numbers, ``steps_per_nat`` steps a nat; the paper's grey levels
    and s^2 = 4 make 16.

    A measurement is the colours of the pixel and of those within ``radius``; the paper's is the pixel alone
    (``radius`` 0), and says that any vector will do. s^2 is ``least_variance`` (the paper's 4) and what the
    images' own noise adds to it.

    The paper charges a pixel at the border, beyond the other camera's view, as a hidden one. That draws the
    disparities at both ends of a row to zero, and P_D says nothing of pixels that no camera is pointed at:
    with ``out_of_view`` they cost what a match is expected to, which draws nowhere.
    """

    detection: float = 0.99
    least_variance: float = 4.0
    radius: int = 1
    cohesion: Cohesion = "along and across"
    steps_per_nat: float = 16.0
    out_of_view: bool = True
    threads: int = 1

    def __post_init__(self) -> None:
        if not 0.5 <= self.detection < 1.0:
            raise ValueError(f"detection must be in [0.5, 1); got {self.detection}")
        if not (self.least_variance > 0.0 and self.steps_per_nat > 0.0 and 0 <= self.radius <= 4):
            raise ValueError("least_variance and steps_per_nat must be above 0, radius in 0 .. 4")
        if self.cohesion not in ("none", "along", "along and across"):
            raise ValueError(f"cohesion must be none, along, or along and across; got {self.cohesion}")

    def match(self, left: ArrayLike, right: ArrayLike, *, disparity_range: tuple[int, int]) -> DisparityMap:
        """Whole disparities of the left image; the arguments and the result are those of the default variant.

        ``confidence`` is the probability of the disparity (or one beside it) against all others of the range,
        given the two measurements alone: 3 / D where nothing tells them apart; and less where there is no
        texture, for the errors of neighbouring pixels are not as independent as that takes them to be.
        Ordered rows are all the memory it takes: a few rows of D costs.
        """
        first, last = checked_range(disparity_range)
        sides = prepare_pair(left, right)
        noise = float(np.mean([estimate_noise(side) for side in sides]))
        variance = self.least_variance + noise**2
        components = len(sides[0].channels) * (2 * self.radius + 1) ** 2
        hidden = self.hidden_cost(components, variance)
        model = (
            self.radius,
            self.steps_per_nat / (4.0 * variance * LEVELS**2),
            round(self.steps_per_nat * hidden),
            round(self.steps_per_nat * (MATCH_NATS * components if self.out_of_view else hidden)),
            int(self.cohesion != "none"),
            int(self.cohesion == "along and across"),
        )
        likelihood = np.exp(-np.arange(int(SIGNIFICANT * self.steps_per_nat) + 2) / self.steps_per_nat)
        likelihood[-1] = 0.0
        height, width = sides[0].valid.shape
        disparity, confidence = np.empty((height, width), np.float32), np.empty((height, width), np.float32)

        def work(strip: Strip) -> None:
            start, stop, top, bottom = strip
            rows = [(np.ascontiguousarray(s.channels[:, top:bottom]), s.valid[top:bottom]) for s in sides]
            found = np.empty((bottom - top, width), np.int32)
            probable = np.empty((bottom - top, width), np.float32)
            solve_rows(rows[0], rows[1], (first, last), model, likelihood, (found, probable))
            own = slice(start - top, stop - top)
            disparity[start:stop] = np.where(found[own] == NOTHING, np.float32(np.nan), found[own])
            confidence[start:stop] = probable[own]

        run_strips(work, self._strips(height), self.threads)
        rate(confidence, disparity, disparity, texture_of(sides[0], noise))
        return DisparityMap(disparity, confidence, ROUNDING_PX)

    def hidden_cost(self, components: int, variance: float) -> float:
        """Cost in nats of a pixel of so many components that the other camera does not see."""
        odds = np.log(self.detection / (1.0 - self.detection))
        return float(odds + components * np.log(GREY_RANGE / np.sqrt(2.0 * np.pi * variance)))

    def _strips(self, height: int) -> list[Strip]:
        below = self.radius
        return [
            (start, min(start + ROWS, height), max(start - WARM_UP, 0), min(start + ROWS + below, height))
            for start in range(0, height, ROWS)
        ]

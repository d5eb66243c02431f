"""What a change of disparity costs, and the sums of the least path costs under it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.dense.matching.costs.kernels import LEVELS
from thesisrecon.dense.matching.pair import Side
from thesisrecon.dense.matching.paths.kernels import TOP, jump_penalties, sum_paths

U8 = NDArray[np.uint8]

LARGEST = 15.0
"""Of a penalty, in dearest costs: they share a byte, and a cost needs a few steps of its own."""


@dataclass(frozen=True)
class PathPenalties:
    """Penalties of a change of disparity from one pixel of a path to the next, in dearest costs of a match.

    ``step`` for a change by one. For more ``jump`` / (1 + g / ``edge``), g the step of grey between the
    pixels in units of the noise, but no less than ``least_jump``: surfaces end where the colour changes
    (Hirschmüller 2008, P1 and P2).
    """

    step: float = 0.43
    jump: float = 1.6
    least_jump: float = 0.65
    edge: float = 14.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.step <= self.least_jump <= self.jump <= LARGEST:
            raise ValueError(
                f"penalties must obey 0 <= step <= least_jump <= jump <= {LARGEST:g}; "
                f"got {self.step}, {self.least_jump}, {self.jump}"
            )
        if not self.edge > 0.0:
            raise ValueError(f"edge must be above 0; got {self.edge}")

    @property
    def dearest(self) -> int:
        """The dearest cost of a match as a whole number: as large as the penalties leave room for."""
        return int(TOP / (1.0 + self.jump))

    def jumps(self, side: Side, noise: float) -> U8:
        """(4, H, W) penalties of a jump from the pixel at the left, above, above left and above right."""
        out = np.empty((4, *side.valid.shape), np.uint8)
        scale = np.float32(self.edge * noise * LEVELS * len(side.channels))
        largest, least = np.float32(self.jump * self.dearest), np.float32(self.least_jump * self.dearest)
        jump_penalties(side.grey, largest, least, scale, out)
        return out

    def sum_into(self, out: U8, costs: U8, jumps: U8, scratch: U8) -> None:
        """Sums of the least costs of the paths that end in a pixel, two by two, ``out`` (P, H, D, W).

        P = 2 along its row and column, P = 4 also along the diagonals; from ``costs`` (H, D, W) and
        ``jumps`` (4, H, W) of the same rows; ``scratch`` (2, ``scratch_size(H, D, W)``).
        """
        step = np.uint8(round(self.step * self.dearest))
        sum_paths(costs, np.ascontiguousarray(jumps), step, out, scratch)

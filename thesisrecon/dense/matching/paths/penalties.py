"""What a change of disparity costs, and the sums of the least path costs under it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.dense.matching.costs.kernels import LEVELS
from thesisrecon.dense.matching.costs.volume import DEAREST
from thesisrecon.dense.matching.pair import Side
from thesisrecon.dense.matching.paths.kernels import jump_penalties, sum_paths

I16 = NDArray[np.int16]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

LARGEST = 30.0
"""Of a penalty, in dearest costs: path costs have 16 bits, and so has the sum of eight."""


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

    def jumps(self, side: Side, noise: float) -> I16:
        """(4, H, W) penalties of a jump from the pixel at the left, above, above left and above right."""
        out = np.empty((4, *side.valid.shape), np.int16)
        scale = self.edge * noise * LEVELS * len(side.channels)
        largest, least = np.float32(self.jump * DEAREST), np.float32(self.least_jump * DEAREST)
        jump_penalties(side.grey, largest, least, np.float32(scale), out)
        return out

    def totals(self, costs: U8, jumps: I16, *, diagonals: bool) -> U16:
        """(H, D, W) sums of the least costs of the paths that end in a pixel, four or, with ``diagonals``,
        eight, from ``costs`` (H, D, W) and ``jumps`` (4, H, W) of the same rows."""
        out = np.empty(costs.shape, np.uint16)
        step = np.int16(round(self.step * DEAREST))
        sum_paths(costs, np.ascontiguousarray(jumps), step, diagonals, out)
        return out

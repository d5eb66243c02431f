"""The monotonicity constraint (figure 1.1): pixels of a row keep their order in the other photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.types import B8, F32
from thesisrecon.views.interpolation.kernels import mark_crossings

SLACK_PX = 0.5
"""Partners may cross by so much: less is the noise of disparities, not the scene."""


@dataclass(frozen=True)
class Monotonicity:
    """How far a pair obeys the constraint: ``violated`` (H, W) pixels that change their order with another
    one of their row, ``share`` of the ``known`` ones (a share of all pixels, too)."""

    violated: B8
    share: float
    known: float

    @property
    def holds(self) -> bool:
        """Whether no pixel violates it: every view between shows the same points."""
        return self.share == 0.0


def check_monotonicity(disparity: F32, *, slack_px: float = SLACK_PX) -> Monotonicity:
    """Which pixels of a rectified photograph violate the constraint, from their disparities (H, W), NaN =
    unknown.

    For pixels u1 left of v1 their partners must be u2 left of v2; then u lies left of v in every view
    between. A thin thing in front of a far background violates it, with all of the background that it passes.
    Raises ``ValueError`` for another shape.
    """
    disparity = np.ascontiguousarray(disparity, dtype=np.float32)
    if disparity.ndim != 2:
        raise ValueError(f"disparities must be (H, W); got {disparity.shape}")
    violated = np.zeros(disparity.shape, dtype=np.bool_)
    mark_crossings(disparity, slack_px, violated)
    known = np.isfinite(disparity)
    count = max(int(known.sum()), 1)
    return Monotonicity(violated, float(violated.sum() / count), float(known.mean()) if known.size else 0.0)

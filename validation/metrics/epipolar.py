"""Error of F against the truth; precision and recall of its inliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.geometry.two_view import symmetric_residuals

BoolArray = NDArray[np.bool_]

NONE_PX = 99.0
"""Error of a missing F, and the maximum reported error."""


def rms_epipolar_distance(F: F64 | None, truth: F64) -> float:
    """RMS distance, px, of right correspondences (M, 4) to their epipolar lines over both images (5.6).

    At most ``NONE_PX``, which stands for no F too.
    """
    if F is None:
        return NONE_PX
    d = symmetric_residuals(F, truth[:, :2], truth[:, 2:])
    return float(min(np.sqrt(np.mean(d**2) / 2.0), NONE_PX))


def precision_recall(inliers: BoolArray, right: BoolArray) -> tuple[float, float]:
    """Share of the inliers (N,) that are right, and of the right matches (N,) that are inliers.

    Without inliers both are 0.
    """
    both = float(np.sum(inliers & right))
    return both / max(float(inliers.sum()), 1.0), both / max(float(right.sum()), 1.0)

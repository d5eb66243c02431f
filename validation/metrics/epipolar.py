"""Error of F against the truth."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.two_view import symmetric_residuals

NONE_PX = 99.0
"""Error of a missing F, and the maximum reported error."""
RIGHT_PX = 1.0
"""An F with a smaller error is right."""


def rms_epipolar_distance(F: F64 | None, truth: F64) -> float:
    """RMS distance, px, of right correspondences (M, 4) to their epipolar lines over both images (5.6).

    At most ``NONE_PX``, which stands for no F too: None, zeros or numbers that are not finite.
    """
    if F is None or not (np.isfinite(F).all() and F.any()):
        return NONE_PX
    d = symmetric_residuals(F, truth[:, :2], truth[:, 2:])
    return float(min(np.sqrt(np.mean(d**2) / 2.0), NONE_PX))

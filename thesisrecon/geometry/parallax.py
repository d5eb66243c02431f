"""Whether two photographs show any depth (section 5.5: what a turning camera or a plane leaves of F)."""

from __future__ import annotations

import numpy as np

from thesisrecon.errors import StageFailure
from thesisrecon.geometry.multiview import estimate_homography, homography_residuals, sampson_residuals
from thesisrecon.types import F64

PARALLAX_PER_NOISE, LEAST_PARALLAX_PX = 3.0, 0.05
"""Displacements that no homography explains, 90 % quantile, over the distances from the epipolar lines."""


def require_parallax(F: F64, xy1: F64, xy2: F64, *, at_infinity: F64 | None = None, advice: str = "") -> None:
    """Refuse matches that one homography takes to each other: F is then any, and no depth is to be had.

    ``F`` (3, 3) and N >= 4 of its inliers (N, 2), (N, 2) px; ``at_infinity`` (3, 3) the homography of the
    plane at infinity, where the cameras are known: then a plane of the scene has parallax. ``advice`` goes on
    after that of taking photographs from places farther apart. Raises ``StageFailure``.
    """
    noise = float(np.quantile(np.abs(sampson_residuals(F, xy1, xy2)), 0.9))
    if at_infinity is None:
        residuals = _homography_residuals(xy1, xy2)
    else:
        residuals = homography_residuals(at_infinity, xy1, xy2)
    parallax = float(np.quantile(residuals, 0.9))
    if parallax > PARALLAX_PER_NOISE * noise + LEAST_PARALLAX_PX:
        return
    what = "one homography" if at_infinity is None else "a scene at infinity"
    raise StageFailure(
        "the photographs show no parallax: the camera only turned, or the scene is a plane or too far away",
        f"{what} explains 90 % of {len(xy1)} matches to {parallax:.2g} px, the noise being {noise:.2g} px",
        f"take photographs from places farther apart{advice}",
    )


def _homography_residuals(xy1: F64, xy2: F64) -> F64:
    """Of the homography of most matches: least squares, twice more without the worst tenth."""
    kept, residuals = np.ones(len(xy1), dtype=bool), np.zeros(len(xy1))
    for _ in range(3):
        H = estimate_homography(xy1[kept], xy2[kept])
        residuals = homography_residuals(H, xy1, xy2)
        kept = residuals <= np.quantile(residuals, 0.9)
    return residuals

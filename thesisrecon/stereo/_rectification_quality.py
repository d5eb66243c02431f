"""Distortion of rectified frames, and matches in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.imaging.resampling import Rectification
from thesisrecon.stereo._epipolar_pair import EpipolarPair, Size

STEP_PX = 0.01
"""Half step of numerical derivatives."""
MAX_MATCHES = 300
"""Limit of the number of matches to which disparity gradients are fitted."""


@dataclass(frozen=True)
class RectificationQuality:
    """Distortion measures of a rectified pair; pairs of numbers refer to both images."""

    orthogonality_deg: tuple[float, float]  #: angle of the mapped image midlines
    aspect: tuple[float, float]  #: ratio of their lengths relative to the original
    size_ratio: float  #: pixels of the frame relative to the larger image
    min_scale: float  #: least local scale along any direction
    stretch: float  #: exp of the standard deviation of the log singular values, 1 for similarities
    disparity_slope: float  #: RMS gradient of the fitted disparities, NaN with fewer than 3 matches

    @property
    def distortion(self) -> float:
        """Root of the sum of squares of ``log stretch`` and half the ``disparity_slope``."""
        slope = self.disparity_slope if np.isfinite(self.disparity_slope) else 0.0
        return float(np.hypot(np.log(self.stretch), 0.5 * slope))


def measure_quality(rectification: Rectification, pair: EpipolarPair) -> RectificationQuality:
    """Measure the distortion of a rectification over the common field of view of a pair."""
    values, midlines = [], []
    for side, samples in enumerate(pair.regions):
        inside = np.isfinite(rectification.rectified_from_original(side, samples)).all(axis=1)
        J = jacobians(rectification, side, samples[inside])
        values.append(singular_values(J[np.isfinite(J).all(axis=(1, 2))]))
        midlines.append(_midlines(rectification, side, pair.pencil.sizes[side]))
    found = np.concatenate(values)
    found = found if len(found) else np.full((1, 2), np.nan)
    angles, aspects = zip(*midlines, strict=True)
    width, height = rectification.size
    slope = float("nan")
    left, right = matches_in_frame(rectification, pair.matches)
    if len(left) >= 3:
        slope = float(np.sqrt(np.mean(np.sum(disparity_gradients(left, right) ** 2, axis=1))))
    return RectificationQuality(
        orthogonality_deg=angles,
        aspect=aspects,
        size_ratio=width * height / max(w * h for w, h in pair.pencil.sizes),
        min_scale=float(found[:, 1].min()),
        stretch=float(np.exp(np.std(np.log(np.maximum(found, 1e-12))))),
        disparity_slope=slope,
    )


def jacobians(rectification: Rectification, side: int, xy: F64) -> F64:
    """Numerical derivatives (N, 2, 2) of the map from pixels (N, 2) of an image to the frame."""
    columns = []
    for axis in np.eye(2):
        ahead = rectification.rectified_from_original(side, xy + STEP_PX * axis, within=False)
        step = ahead - rectification.rectified_from_original(side, xy - STEP_PX * axis, within=False)
        # A full circle of half-lines has a cut, across which neighbours are far apart.
        step[np.abs(step[:, 1]) > 0.5 * rectification.size[1]] = np.nan
        columns.append(step / (2.0 * STEP_PX))
    return np.stack(columns, axis=-1)


def _midlines(rectification: Rectification, side: int, size: Size) -> tuple[float, float]:
    """Angle in degrees of the mapped midlines, and the ratio of their lengths relative to the original."""
    w, h = size[0] - 1.0, size[1] - 1.0
    ends = np.array([[0.0, h / 2.0], [w, h / 2.0], [w / 2.0, 0.0], [w / 2.0, h]])
    a, b, c, d = rectification.rectified_from_original(side, ends, within=False)
    across, down = b - a, d - c
    lengths = float(np.hypot(*across)), float(np.hypot(*down))
    with np.errstate(invalid="ignore"):
        angle = float(np.degrees(np.arccos(np.clip(across @ down / (lengths[0] * lengths[1]), -1.0, 1.0))))
    return angle, lengths[0] / lengths[1] * h / w


def matches_in_frame(
    rectification: Rectification, matches: Sequence[F64], *, within: bool = True
) -> tuple[F64, F64]:
    """Positions in the frame (M, 2) of the matches, two arrays (N, 2), that are mapped in both images."""
    mapped = rectification.rectified_from_original
    left, right = (mapped(side, xy, within=within) for side, xy in enumerate(matches))
    seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    return left[seen], right[seen]


def disparity_gradients(left: F64, right: F64) -> F64:
    """Gradients (M, 2) of a quadratic polynomial fitted to the disparities of matches (N, 2), M <= 300."""
    every = max(len(left) // MAX_MATCHES, 1)
    left, right = left[::every], right[::every]
    middle = 0.5 * (left + right)
    middle = middle - middle.mean(axis=0)
    unit = float(np.abs(middle).max(initial=1e-12))
    x, y = (middle / unit).T
    design = np.stack([x, y, x * x, x * y, y * y, np.ones_like(x)], axis=1)
    # Minimum-norm solution for few or collinear matches.
    c = np.linalg.lstsq(design, (left[:, 0] - right[:, 0]) / unit, rcond=1e-6)[0]
    return np.stack([c[0] + 2.0 * c[2] * x + c[3] * y, c[1] + c[3] * x + 2.0 * c[4] * y], axis=1)


def homography_jacobians(H: F64, xy: F64) -> F64:
    """Derivatives (N, 2, 2) of a homography at positions (N, 2)."""
    xh = homogenize(xy) @ H.T
    moved = xh[:, :2] / xh[:, 2:]
    return np.asarray((H[None, :2, :2] - moved[:, :, None] * H[2, :2]) / xh[:, 2, None, None])


def singular_values(J: F64) -> F64:
    """Singular values (N, 2) of 2 x 2 matrices, the larger first."""
    a = 0.5 * np.hypot(J[:, 0, 0] + J[:, 1, 1], J[:, 1, 0] - J[:, 0, 1])
    b = 0.5 * np.hypot(J[:, 0, 0] - J[:, 1, 1], J[:, 1, 0] + J[:, 0, 1])
    return np.stack([a + b, np.abs(a - b)], axis=1)

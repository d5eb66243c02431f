"""Extent of rectified frames, and distortion measures of the maps to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo._epipolar_pair import EpipolarPair

MAX_SHRINK = 1.4
"""Largest reduction of any pixel along any direction; the area is preserved on average."""
MAX_GROWTH = 6.0
"""Largest number of pixels of the frame relative to the larger image."""
CROP_MARGIN = 1.0
"""Margin of the disparity range that limits the crop, as a share of the range of the matches."""
MAX_MATCHES = 300
"""Limit of the number of matches to which disparity gradients are fitted."""


def frame_size(extent: F64, pair: EpipolarPair) -> tuple[int, int]:
    """(width, height) of a frame of some extent (2,), rounded up; ``StageFailure`` if too large or empty."""
    width, height = float(extent[0]), float(extent[1])
    most = MAX_GROWTH * max(w * h for w, h in pair.sizes)
    if not width * height <= most:
        raise StageFailure(
            "the rectified images are too distorted",
            f"they need {width * height / 1e6:.3g} million pixels, the limit is {most / 1e6:.3g}",
            "rectify in polar coordinates, or choose views with less forward motion",
        )
    if not min(width, height) >= 2.0:
        raise StageFailure(
            "the rectified images do not overlap",
            f"their common frame is {width:.3g} x {height:.3g} px",
            "choose views that overlap more",
        )
    return int(np.ceil(width)), int(np.ceil(height))


def common_crop(samples: Sequence[F64], matches: Sequence[F64]) -> tuple[F64, F64]:
    """Least and greatest rectified coordinates (2, 2) that both images see, one row per image.

    Along the rows each image is cut to what the other can show at the disparities of the matches, two arrays
    (N, 2) of rectified positions as the ``samples`` of the images.
    """
    low, high = (np.stack([f(xy, axis=0) for xy in samples]) for f in (np.min, np.max))
    low[:, 1], high[:, 1] = low[:, 1].max(), high[:, 1].min()
    if len(matches[0]):
        near, far = disparity_bounds(matches[0][:, 0] - matches[1][:, 0], margin=CROP_MARGIN)
        least, most = low[:, 0].copy(), high[:, 0].copy()
        low[0, 0], high[0, 0] = max(least[0], least[1] + near), min(most[0], most[1] + far)
        low[1, 0], high[1, 0] = max(least[1], least[0] - far), min(most[1], most[0] - near)
    return low, high


def disparity_bounds(disparities: F64, *, margin: float) -> tuple[float, float]:
    """1 % and 99 % quantiles of disparities (N,), widened at both ends by a share of the range.

    A few matches are wrong along their epipolar lines.
    """
    low, high = np.quantile(disparities, [0.01, 0.99])
    return float(low - margin * (high - low)), float(high + margin * (high - low))


def disparity_gradients(left: F64, right: F64) -> F64:
    """Gradients (M, 2) of a quadratic polynomial fitted to the disparities of matches (N, 2), M <= 300.

    They measure the relative stretch, shear and bending of both images without relief.
    """
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

"""Simulated oblique views of an image, whose patches match those of another camera far to the side.

J.-M. Morel and G. Yu, "ASIFT: a new framework for fully affine invariant image comparison", SIAM J. Imaging
Sciences 2, 2009.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import F32, F64
from thesisrecon.features._kernels import sample_affinely

# Angle between the directions of views of tilt 1, and smoothing for each unit of tilt, of that paper.
DIRECTION_STEP, ANTI_ALIASING = np.radians(72.0), 0.8
# Shorter side of the smallest image with views: two patches.
MIN_SIDE = 64


@dataclass(frozen=True)
class ObliqueView:
    """Pixels ``gray`` (h, w) of a simulated view; an image pixel x is at ``to_view`` x + ``offset``."""

    tilt: float
    direction: float
    gray: F32
    to_view: F64
    offset: F64


def oblique_views(gray: F32, tilts: Sequence[float], enlargement: float) -> Iterator[ObliqueView]:
    """Compress an image (H, W) by each tilt, in directions over 180 degrees; tiny images have no views."""
    for tilt in tilts if min(gray.shape) >= MIN_SIDE else ():
        count = int(np.ceil(np.pi * tilt / DIRECTION_STEP))
        for k in range(count):
            yield simulate_view(gray, tilt, np.pi * k / count, enlargement)


def simulate_view(gray: F32, tilt: float, direction: float, enlargement: float = 1.0) -> ObliqueView:
    """Compress an image by ``tilt`` along the ``direction`` (rad), which becomes the x axis of the view.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.features.oblique import simulate_view
    >>> view = simulate_view(np.ones((60, 100), np.float32), 2.0, 0.0)
    >>> view.gray.shape, view.to_view[0, 0]
    ((60, 50), 0.5)
    """
    c, s = np.cos(direction), np.sin(direction)
    turn = enlargement * np.array([[c, s], [-s, c]])
    half = 0.5 * (np.array(gray.shape[::-1]) - 1.0)
    width, height = np.ceil(2.0 * np.abs(turn) @ half).astype(np.int64) + 1
    middle = 0.5 * np.array([width - 1.0, height - 1.0])
    back = np.asarray(np.linalg.inv(turn), np.float64)
    turned = sample_affinely(gray, back, half - back @ middle, (int(height), int(width)))
    smooth = scipy.ndimage.gaussian_filter1d(turned, ANTI_ALIASING * np.sqrt(tilt**2 - 1.0), axis=1)
    x = np.arange(int(width / tilt)) * tilt
    left = np.minimum(x.astype(np.int64), width - 2)
    share = (x - left).astype(np.float32)
    narrow = (1.0 - share) * smooth[:, left] + share * smooth[:, left + 1]
    to_view = np.diag([1.0 / tilt, 1.0]) @ turn
    offset = middle / [tilt, 1.0] - to_view @ half
    return ObliqueView(tilt, direction, np.ascontiguousarray(narrow, np.float32), to_view, offset)

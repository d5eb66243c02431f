"""Section 4.2.1: the corner detector of Harris and Stephens with a surface fit and a selection that covers
the image.

C. Harris, M. Stephens, A combined corner and edge detector, Alvey Vision Conference 1988.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.features.kernels import corner_response, fit_maxima, keep_apart, squared_suppression_radii
from thesisrecon.geometry.raster import gaussian_taps, smooth
from thesisrecon.types import F32, F64, I64, Features, Image

# Below this response (grey levels squared) the corners are those of quantisation and compression noise.
NOISE_RESPONSE = 0.05
# How many times its share one part of the image may fill of the pool of strong corners.
SHARE = 1.5


@dataclass(frozen=True)
class HarrisCorners:
    """The thesis' detector: one scale, a threshold on R, the strongest corners that are not in each other's
    way.

    Parameters
    ----------
    max_corners : corners kept.
    derivative_sigma_px, integration_sigma_px : the two Gaussians of section 4.2.1.
    threshold_rel : share of the largest response that a corner must reach.
    spacing_rel : least distance of two corners, as a share of the long side: clusters are thinned so that the
        corners cover a large area.
    """

    max_corners: int = 2000
    derivative_sigma_px: float = 1.0
    integration_sigma_px: float = 1.5
    threshold_rel: float = 0.002
    spacing_rel: float = 0.004

    def detect(self, image: Image) -> Features:
        """Corners of one photograph, strongest first, at scale 1; none where the image has no structure."""
        xy, response = find_corners(image.gray, self.derivative_sigma_px, self.integration_sigma_px)
        if len(xy):
            strong = response >= self.threshold_rel * float(response[0])
            xy, response = xy[strong], response[strong]
        order = np.arange(len(xy), dtype=np.int64)
        kept = keep_apart(xy, order, self.spacing_rel * max(image.size))[: self.max_corners]
        return Features(xy=xy[kept], scale=np.ones(len(kept), np.float32), response=response[kept])


def find_corners(
    gray: F32, derivative_sigma_px: float = 1.0, integration_sigma_px: float = 1.5
) -> tuple[F64, F32]:
    """All corners of (H, W) above the noise, strongest first: ``xy`` (N, 2) px and response (N,).

    R = det M / trace M (the thesis' measure; its two lost signs restored), maxima of 3 x 3 neighbourhoods
    refined by a quadratic surface. Equal responses are ordered as they are read, so the result is
    reproducible.
    """
    taps = gaussian_taps(integration_sigma_px)
    if min(gray.shape) < 2 * len(taps):
        return np.empty((0, 2)), np.empty(0, np.float32)
    response = corner_response(smooth(gray, derivative_sigma_px), taps)
    xy, value = fit_maxima(response, NOISE_RESPONSE)
    order = np.argsort(-value, kind="stable")
    return xy[order], value[order]


def select_spread(xy: F64, response: F32, count: int, *, pool: int, robustness: float = 0.9) -> I64:
    """Indices of ``count`` corners that cover the image, strongest first (adaptive non-maximal suppression).

    Among a pool of strong ones, those farthest from any that is stronger by 1 / robustness.
    No part of the image, of a sixth of its long side, fills the pool beyond ``SHARE`` times its share: else
    a shaded half gets no corner at all.

    M. Brown, R. Szeliski, S. Winder, Multi-image matching using multi-scale oriented patches, CVPR 2005,
    section 3.
    """
    members = _shared_pool(xy, pool)
    if len(members) <= count:
        return members
    radii = squared_suppression_radii(xy[members].astype(np.float32), response[members], robustness)
    return members[np.sort(np.argsort(-radii, kind="stable")[:count])]


def _shared_pool(xy: F64, pool: int) -> I64:
    """The first ``pool`` of the corners, no part of the image giving more than its limit."""
    if len(xy) <= pool:
        return np.arange(len(xy), dtype=np.int64)
    part = np.floor(6.0 * (xy - xy.min(axis=0)) / (float(np.ptp(xy, axis=0).max()) + 1.0)).astype(np.int64)
    cell = 6 * part[:, 1] + part[:, 0]
    by_cell = np.argsort(cell, kind="stable")
    cells, start, size = np.unique(cell[by_cell], return_index=True, return_counts=True)
    rank = np.empty(len(xy), np.int64)
    rank[by_cell] = np.arange(len(xy)) - np.repeat(start, size)
    allowed = np.flatnonzero(rank < max(1, int(SHARE * pool / len(cells))))
    return allowed[:pool].astype(np.int64)

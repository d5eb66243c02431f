"""Section 4.2.1: the corner detector of Harris and Stephens with a surface fit and spatial selection.

C. Harris and M. Stephens, "A combined corner and edge detector", Alvey Vision Conference, 1988.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.features._kernels import (
    corner_response,
    enforce_spacing,
    fit_maxima,
    squared_suppression_radii,
)
from thesisrecon.imaging.filters import gaussian_taps, smooth
from thesisrecon.records import Features, Image

# det / trace (grey levels squared) below which corners are quantisation and compression noise.
NOISE_RESPONSE = 0.05
# Candidates of a selection, as a multiple of the number selected.
POOL_RATIO = 1.7
# Maximum number of candidates in a cell of the image, relative to an even distribution.
POOL_LIMIT = 1.5
# Ratio of responses that counts as clearly stronger.
ROBUSTNESS = 0.9


@dataclass(frozen=True)
class CornerMeasure:
    """The corner response R of section 4.2.1 and its parameters.

    M (2 x 2; the thesis' "4 x 4" is a slip) holds the products of the image gradient, smoothed by a Gaussian.
    The thesis' formula for R lost two signs: M and (M11 + M22) fit both det M / trace M (Noble 1988) and det
    M - k (trace M)^2 (Harris and Stephens 1988); both are available.

    Parameters
    ----------
    formula : {"noble", "harris"}
        det / trace, or det - k trace^2.
    integration_sigma_px : float
        Gaussian of M, three sigma to each side. The thesis has sigma 1.
    colour : bool
        Mean of M over red, green and blue, else M of the grey values.
    subpixel : bool
        Fit a quadratic surface to the 3 x 3 pixels of each maximum, else keep the pixel.
    """

    formula: Literal["noble", "harris"] = "noble"
    integration_sigma_px: float = 1.5
    colour: bool = False
    subpixel: bool = True

    # k of Harris and Stephens.
    harris_k = 0.04
    # Gaussian before the derivative.
    derivative_sigma_px = 1.0

    def __post_init__(self) -> None:
        if not self.integration_sigma_px > 0.0:
            raise ValueError(f"integration_sigma_px must be above 0; got {self.integration_sigma_px}")

    def _channels(self, image: Image) -> F32:
        """(C, H, W) grey values or three colours."""
        if not self.colour:
            return image.gray[None]
        return np.ascontiguousarray(np.moveaxis(image.rgb, 2, 0), dtype=np.float32)

    def _response(self, channels: F32) -> F32:
        """R (H, W), zero near the border."""
        derivative = np.array([-0.5, 0.0, 0.5], np.float32)
        channels = np.stack([smooth(channel, self.derivative_sigma_px) for channel in channels])
        # Mean over the channels, so that R of a grey image does not depend on ``colour``; the taps are used
        # twice.
        taps = self._integration() / np.float32(np.sqrt(len(channels)))
        weight = self.harris_k if self.formula == "harris" else 0.0
        return corner_response(channels, derivative, taps, weight)

    def _find(self, channels: F32) -> tuple[F64, F32]:
        """Corners (N, 2) above the noise and their responses (N,), strongest first; none in tiny images."""
        if min(channels.shape[1:]) < 2 * len(self._integration()):
            return np.empty((0, 2)), np.empty(0, np.float32)
        xy, value = fit_maxima(self._response(channels), self._noise_response(), self.subpixel)
        # Equal responses keep the reading order.
        order = np.argsort(-value, kind="stable")
        return xy[order], value[order]

    def _noise_response(self) -> float:
        """R of an isotropic corner whose det / trace is ``NOISE_RESPONSE``."""
        if self.formula == "noble":
            return NOISE_RESPONSE
        return (2.0 * NOISE_RESPONSE) ** 2 * (1.0 - 4.0 * self.harris_k)

    def _integration(self) -> F32:
        return gaussian_taps(self.integration_sigma_px)


@dataclass(frozen=True)
class HarrisCorners:
    """The thesis' detector: one scale, a threshold on R, the strongest corners with spatial selection.

    Parameters
    ----------
    max_corners : int
        Maximum number of corners.
    threshold_rel : float
        Minimum response relative to the largest one; 0 for all above the noise.
    selection : {"spacing", "spread"}
        Drop corners too near to a stronger one, or use :func:`select_spread`.
    measure : CornerMeasure
        Response and its parameters.
    """

    max_corners: int = 2000
    threshold_rel: float = 0.002
    selection: Literal["spacing", "spread"] = "spacing"
    measure: CornerMeasure = field(default_factory=CornerMeasure)

    # Minimum distance of two corners for "spacing", relative to the long side.
    spacing_rel = 0.004

    def __post_init__(self) -> None:
        if self.max_corners < 1:
            raise ValueError(f"max_corners must be at least 1; got {self.max_corners}")
        if not 0.0 <= self.threshold_rel <= 1.0:
            raise ValueError(f"threshold_rel must lie between 0 and 1; got {self.threshold_rel}")

    def detect(self, image: Image) -> Features:
        """See `thesisrecon.config.Detector.detect`."""
        xy, response = self.measure._find(self.measure._channels(image))
        if len(xy):
            strong = response >= self.threshold_rel * float(response[0])
            xy, response = xy[strong], response[strong]
        if self.selection == "spread":
            kept = select_spread(xy, response, self.max_corners)
        else:
            spacing = self.spacing_rel * max(image.size)
            kept = enforce_spacing(xy, np.arange(len(xy)), spacing)[: self.max_corners]
        return Features(xy=xy[kept], scale=np.ones(len(kept), np.float32), response=response[kept])


def select_spread(xy: F64, response: F32, count: int) -> I64:
    """Select corners that cover the image (adaptive non-maximal suppression) [1]_.

    Selects, among the 1.7 ``count`` strongest corners, those farthest from any clearly stronger one. A cell
    of a sixth of the long side contributes at most ``POOL_LIMIT`` times as many of these candidates as in an
    even distribution, so that dark parts of the image get corners as well.

    Parameters
    ----------
    xy : ndarray (N, 2)
        Corners, strongest first, px.
    response : ndarray (N,)
        Responses.
    count : int
        Number of corners to select.

    Returns
    -------
    ndarray (M,) of int
        Indices, strongest first.

    References
    ----------
    .. [1] M. Brown, R. Szeliski and S. Winder, "Multi-image matching using multi-scale oriented patches",
       CVPR 2005.
    """
    members = _shared_pool(xy, int(POOL_RATIO * count))
    if len(members) <= count:
        return members
    radii = squared_suppression_radii(xy[members].astype(np.float32), response[members], ROBUSTNESS)
    return members[np.sort(np.argsort(-radii, kind="stable")[:count])]


def _shared_pool(xy: F64, pool: int) -> I64:
    """The first ``pool`` of the corners, with a limit for each cell of the image."""
    if len(xy) <= pool:
        return np.arange(len(xy), dtype=np.int64)
    part = np.floor(6.0 * (xy - xy.min(axis=0)) / (float(np.ptp(xy, axis=0).max()) + 1.0)).astype(np.int64)
    cell = 6 * part[:, 1] + part[:, 0]
    by_cell = np.argsort(cell, kind="stable")
    cells, start, size = np.unique(cell[by_cell], return_index=True, return_counts=True)
    rank = np.empty(len(xy), np.int64)
    rank[by_cell] = np.arange(len(xy)) - np.repeat(start, size)
    allowed = np.flatnonzero(rank < max(1, int(POOL_LIMIT * pool / len(cells))))
    return allowed[:pool].astype(np.int64)

"""Section 4.2.1: the corner detector of Harris and Stephens with a surface fit and a selection that covers
the image.

C. Harris, M. Stephens, A combined corner and edge detector, Alvey Vision Conference 1988.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from thesisrecon.features.kernels import keep_apart, squared_suppression_radii
from thesisrecon.features.measure import CornerMeasure, find_corners
from thesisrecon.types import F32, F64, I64, Features, Image

# How many times its share one part of the image may fill of the pool of strong corners.
SHARE = 1.5


@dataclass(frozen=True)
class HarrisCorners:
    """The thesis' detector: one scale, a threshold on R, the strongest corners that are not in each other's
    way.

    Parameters
    ----------
    max_corners : corners kept.
    threshold_rel : share of the largest response that a corner must reach; 0 for those above the noise.
    selection : how the corners are made to cover a large area: "spacing" drops those too near to a stronger
        one, "spread" is :func:`select_spread`, "strongest" does nothing.
    spacing_rel : least distance of two corners where ``selection`` is "spacing", as a share of the long side.
    pool_ratio : corners among which "spread" chooses, as a multiple of ``max_corners``.
    measure : the R-matrix and its parameters.
    """

    max_corners: int = 2000
    threshold_rel: float = 0.002
    selection: Literal["spacing", "spread", "strongest"] = "spacing"
    spacing_rel: float = 0.004
    pool_ratio: float = 1.7
    measure: CornerMeasure = field(default_factory=CornerMeasure)

    def __post_init__(self) -> None:
        if self.max_corners < 1:
            raise ValueError(f"max_corners must be at least 1; got {self.max_corners}")
        if not 0.0 <= self.threshold_rel <= 1.0:
            raise ValueError(f"threshold_rel must lie between 0 and 1; got {self.threshold_rel}")
        if not (self.spacing_rel >= 0.0 and self.pool_ratio >= 1.0):
            raise ValueError(
                "spacing_rel must be at least 0 and pool_ratio at least 1; "
                f"got {self.spacing_rel} and {self.pool_ratio}"
            )

    def detect(self, image: Image) -> Features:
        """Corners of one photograph, strongest first, at scale 1; none where the image has no structure."""
        xy, response = find_corners(self.measure.channels(image), self.measure)
        if len(xy):
            strong = response >= self.threshold_rel * float(response[0])
            xy, response = xy[strong], response[strong]
        kept = self._select(xy, response, max(image.size))
        return Features(xy=xy[kept], scale=np.ones(len(kept), np.float32), response=response[kept])

    def _select(self, xy: F64, response: F32, long_side: int) -> I64:
        if self.selection == "spread":
            return select_spread(xy, response, self.max_corners, pool=int(self.pool_ratio * self.max_corners))
        kept = np.arange(len(xy), dtype=np.int64)
        if self.selection == "spacing":
            kept = keep_apart(xy, kept, self.spacing_rel * long_side)
        return kept[: self.max_corners]


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

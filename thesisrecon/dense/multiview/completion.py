"""Pixels without a depth take that of other views, where both photographs agree with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.dense.multiview.consistency import transfer
from thesisrecon.dense.multiview.kernels import splat_depths
from thesisrecon.dense.multiview.refinement import PlaneRefinement
from thesisrecon.types import F32, DepthMap, PinholeView


@dataclass(frozen=True)
class Completion:
    """Depths for what is hidden from all neighbours of a view but measured by others that it shares it with.

    The maps of other views are taken to a view; where it has no depth their nearest one is offered to
    the search for slanted windows, against the ``most`` photographs whose maps offer most. What the windows
    accept (the rule of :class:`PlaneRefinement`) is depth as good as any: nothing is interpolated. Gaps of
    ``gap_px`` between offered pixels are searched too, for maps differ in resolution.
    """

    most: int = 4
    gap_px: int = 1
    sweeps: int = 2

    def complete(
        self,
        own: DepthMap,
        others: Sequence[DepthMap],
        views: Mapping[int, PinholeView],
        *,
        refinement: PlaneRefinement,
    ) -> DepthMap:
        """``own`` with depths of more pixels, from the maps ``others`` and the photographs ``views``."""
        unknown = np.isnan(own.depth) & views[own.view].seen
        offers = []
        for other in others:
            offer = np.full_like(own.depth, np.nan)
            splat_depths(other.depth, transfer(other.P, own.P), offer)
            offers.append(np.where(unknown, offer, np.float32(np.nan)))
        worth = [int(np.isfinite(offer).sum()) for offer in offers]
        best = [k for k in sorted(range(len(offers)), key=lambda k: (-worth[k], k)) if worth[k]][: self.most]
        if not best:
            return own
        nearest = np.fmin.reduce([offers[k] for k in best])
        wanted = unknown & scipy.ndimage.binary_dilation(np.isfinite(nearest), np.ones((3, 3)), self.gap_px)
        rho = (np.float32(1.0) / np.where(unknown, nearest, own.depth)).astype(np.float32)
        photographs = [views[others[k].view] for k in best]
        found = refinement.search(views[own.view], photographs, rho, wanted=wanted, sweeps=self.sweeps)
        return _with(own, *found)


def _with(own: DepthMap, rho: F32, std: F32, support: np.ndarray) -> DepthMap:
    """The map with inverse depths where they are known."""
    new = np.isfinite(rho)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(1.0) / rho
        std = std * depth * depth
    return replace(
        own,
        depth=np.where(new, depth, own.depth),
        std=np.where(new, std, own.std),
        views=np.where(new, support, own.views).astype(np.uint8),
    )

"""Depth maps held against each other: what other views confirm stays.

Pixels without a depth take that of other views, where both photographs agree with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.records import DepthMap, PinholeView
from thesisrecon.stereo.depth_kernels import continue_surface, count_agreement, splat_depths
from thesisrecon.stereo.plane_refinement import ALIKE, PlaneRefinement


@dataclass(frozen=True)
class Consistency:
    """Reprojection both ways (as Merrell et al., ICCV 2007, and COLMAP's fusion have it) and speckles.

    A pixel is taken to another view by its depth, and that view's depth brings it back. It is confirmed
    where it returns within ``reprojection_px`` and both depths differ by at most ``relative`` plus
    ``deviations`` of their deviations; it is contradicted where the other view sees through it. A pixel
    stays if at least ``least_views`` confirm it and more than contradict it, or if none contradicts it and it
    continues the surface of those about it: within ``gate`` deviations of the plane through the pixels within
    ``radius``. Connected pieces of fewer than
    ``smallest_piece`` of the pixels, across which depth changes by less than ``step`` from pixel to pixel,
    go.
    """

    reprojection_px: float = 1.5
    relative: float = 0.01
    deviations: float = 2.0
    least_views: int = 1
    smallest_piece: float = 1e-4
    step: float = 0.02
    radius: int = 5
    gate: float = 2.0

    def confirm(self, depth_map: DepthMap, others: Sequence[DepthMap]) -> DepthMap:
        """``depth_map`` where ``others`` confirm it, with their number in ``views``."""
        agree = np.zeros(depth_map.depth.shape, dtype=np.uint8)
        contradict = np.zeros_like(agree)
        limits = np.array([self.reprojection_px, self.relative, self.deviations])
        for other in others:
            count_agreement(
                depth_map.depth,
                depth_map.std,
                transfer(depth_map.P, other.P),
                other.depth,
                other.std,
                transfer(other.P, depth_map.P),
                limits,
                agree,
                contradict,
            )
        keep = (agree >= self.least_views) & (agree > contradict)
        keep |= (contradict == 0) & self.continues(depth_map, keep)
        return self.clean(_kept(replace(depth_map, views=np.maximum(agree, 1)), keep))

    def continues(self, depth_map: DepthMap, sure: B8) -> B8:
        """(H, W) pixels that continue the surface of those that are ``sure``."""
        with np.errstate(divide="ignore"):
            rho = (1.0 / depth_map.depth).astype(np.float32)
        joins = np.zeros(sure.shape, dtype=np.uint8)
        std = depth_map.std * rho * rho
        continue_surface(rho, std, sure.astype(np.uint8), self.radius, ALIKE, self.gate, joins)
        return joins > 0

    def clean(self, depth_map: DepthMap) -> DepthMap:
        """Without small pieces."""
        least = self.smallest_piece * depth_map.depth.size
        return _kept(depth_map, piece_sizes(depth_map.depth, self.step) >= least)


def transfer(P: F64, P_other: F64) -> F64:
    """(3, 4) that takes (z x, z y, z, 1) of one camera to z' (x', y', 1) of the other."""
    M = np.linalg.inv(P[:, :3])
    centre = camera_centre(P)
    return np.column_stack([P_other[:, :3] @ M, P_other @ (centre / centre[3])])


def piece_sizes(depth: F32, step: float) -> F64:
    """(H, W) pixels of the connected piece that each belongs to, 0 where unknown.

    Neighbours are connected where their depths differ by at most ``step`` of either.
    """
    number = np.arange(depth.size).reshape(depth.shape)
    log = np.log(depth)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        # A comparison with NaN is false.
        joined = np.abs(log[a] - log[b]) <= step
        pairs.append(np.stack([number[a][joined], number[b][joined]]))
    row, column = np.concatenate(pairs, axis=1)
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(row), dtype=bool), (row, column)), shape=(depth.size, depth.size)
    )
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    sizes = np.bincount(label)[label].reshape(depth.shape)
    return np.where(np.isfinite(depth), sizes, 0.0)


def _kept(depth_map: DepthMap, keep: B8) -> DepthMap:
    return replace(
        depth_map,
        depth=np.where(keep, depth_map.depth, np.float32(np.nan)),
        std=np.where(keep, depth_map.std, np.float32(np.nan)),
        views=np.where(keep, depth_map.views, np.uint8(0)),
    )


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

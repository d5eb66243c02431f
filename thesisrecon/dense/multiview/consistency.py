"""Depth maps held against each other: what other views confirm stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.dense.multiview.kernels import continue_surface, count_agreement
from thesisrecon.dense.multiview.refinement.planes import ALIKE
from thesisrecon.geometry.camera import camera_centre
from thesisrecon.types import B8, F32, F64, DepthMap


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

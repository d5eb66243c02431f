"""From correspondences of a reference view to inverse depths of its pixels: two ways."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.records import PinholeView
from thesisrecon.stereo.correspondence import Correspondence
from thesisrecon.stereo.depth_kernels import fuse_inverse_depths, inverse_depths, update_kalman

Correspond = Callable[[int, int], Correspondence | None]
"""The correspondence of view i in view j, None where the pair gives none."""


@dataclass(frozen=True)
class InverseDepth:
    """Inverse depth of the pixels of a view: ``value``, ``std`` (H, W) float32, NaN where unknown; ``views``
    (H, W) how many other views it is from, ``rivals`` how many say otherwise."""

    value: F32
    std: F32
    views: U8
    conflicts: U8

    @property
    def contradictory(self) -> B8:
        """(H, W) where no two agree although two or more speak."""
        return np.asarray((self.views < 2) & (self.conflicts > 0))

    def where(self, keep: B8) -> InverseDepth:
        """What is kept, unknown elsewhere."""
        value, std = (np.where(keep, part, np.float32(np.nan)) for part in (self.value, self.std))
        views, conflicts = (np.where(keep, part, np.uint8(0)) for part in (self.views, self.conflicts))
        return InverseDepth(value, std, views, conflicts)


class Linker(Protocol):
    """A way of making one inverse depth of several correspondences."""

    def link(
        self,
        view: int,
        views: Mapping[int, PinholeView],
        neighbours: Sequence[int],
        correspond: Correspond,
    ) -> InverseDepth:
        """Inverse depths of the pixels of ``view``."""

    def views_used(self, view: int, views: Collection[int], neighbours: Sequence[int]) -> set[int]:
        """The numbers of the other views that :meth:`link` asks for."""


@dataclass(frozen=True)
class RobustFusion:
    """Every neighbour gives an inverse depth with a deviation; those that agree are averaged.

    Estimates within ``gate`` deviations of each other agree, and the largest party wins, the
    more certain one among equals. A pixel about which a single neighbour speaks is kept, for another view's
    depth map to confirm.
    """

    gate: float = 3.0

    def link(
        self,
        view: int,
        views: Mapping[int, PinholeView],
        neighbours: Sequence[int],
        correspond: Correspond,
    ) -> InverseDepth:
        """Inverse depths of the pixels of ``view`` from each of its neighbours."""
        found = []
        for other in neighbours:
            pair = correspond(view, other)
            if pair is not None:
                found.append(inverse_depth_of(views[view].P, views[other].P, pair))
        shape = views[view].seen.shape
        result = _nothing(shape)
        if found:
            rho, std = (np.stack([one[k] for one in found]) for k in (0, 1))
            fuse_inverse_depths(rho, std, self.gate, result.value, result.std, result.views, result.conflicts)
        return result

    def views_used(self, view: int, views: Collection[int], neighbours: Sequence[int]) -> set[int]:
        """The neighbours."""
        del view, views
        return set(neighbours)


@dataclass(frozen=True)
class SequenceLinking:
    """Koch, Pollefeys and Van Gool, "Multi viewpoint stereo from uncalibrated video sequences", ECCV 1998.

    From the reference view the disparities of neighbouring pairs are chained up and down the sequence: where
    a pixel is in view k + 1 follows from where it was in view k. Every view of the chain measures the depth
    anew with a longer baseline; a 1-D Kalman filter on the inverse depth takes the measurements in until the
    first beyond ``gate`` deviations of the innovation, where the pixel is taken to be hidden. The deviations
    of the links add up in squares. Chains end after ``length`` links and where a pair gives nothing; both
    directions are filtered on their own and joined where they agree.
    """

    length: int = 4
    gate: float = 3.0

    def link(
        self,
        view: int,
        views: Mapping[int, PinholeView],
        neighbours: Sequence[int],  # noqa: ARG002 - one signature for all linkers
        correspond: Correspond,
    ) -> InverseDepth:
        """Inverse depths of the pixels of ``view``; the sequence is that of the views' numbers."""
        order = sorted(views)
        place = order.index(view)
        chains = [order[place : place + self.length + 1], order[: place + 1][::-1][: self.length + 1]]
        ends = [self._chain(chain, views, correspond) for chain in chains if len(chain) > 1]
        result = _nothing(views[view].seen.shape)
        if not ends:
            return result
        rho, std = (np.stack(part) for part in ([e.value for e in ends], [e.std for e in ends]))
        fuse_inverse_depths(rho, std, self.gate, result.value, result.std, result.views, result.conflicts)
        result.views[:] = np.where(np.isfinite(result.value), np.maximum.reduce([e.views for e in ends]), 0)
        return result

    def views_used(self, view: int, views: Collection[int], neighbours: Sequence[int]) -> set[int]:
        """Those next in the sequence, on either side."""
        del neighbours
        order = sorted(views)
        place = order.index(view)
        return set(order[max(place - self.length, 0) : place + self.length + 1]) - {view}

    def _chain(
        self, chain: Sequence[int], views: Mapping[int, PinholeView], correspond: Correspond
    ) -> InverseDepth:
        reference = views[chain[0]]
        state = _nothing(reference.seen.shape)
        alive = np.ones(reference.seen.shape, dtype=np.uint8)
        linked: Correspondence | None = None
        for previous, following in pairwise(chain):
            step = correspond(previous, following)
            if step is None:
                break
            linked = step if linked is None else follow(linked, step)
            new = inverse_depth_of(reference.P, views[following].P, linked)
            update_kalman(state.value, state.std, *new, self.gate, alive, state.views)
        return state


def follow(first: Correspondence, second: Correspondence) -> Correspondence:
    """Where the pixels of a view i are in view k, from i in j and j in k.

    The place in j is between pixels: the places of the four around are interpolated where they are within two
    pixels of each other's step, else the nearest one's is moved along. Deviations add up in squares.
    """
    height, width = second.sigma.shape
    at = first.xy
    inside = np.isfinite(at).all(axis=2)
    inside &= (at[..., 0] > -0.5) & (at[..., 0] < width - 0.5)
    inside &= (at[..., 1] > -0.5) & (at[..., 1] < height - 0.5)
    place = np.where(inside[..., None], at, 0.0).astype(np.float32)
    x0 = np.clip(np.floor(place[..., 0]).astype(np.int64), 0, max(width - 2, 0))
    y0 = np.clip(np.floor(place[..., 1]).astype(np.int64), 0, max(height - 2, 0))
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (place[..., 0] - x0)[..., None], (place[..., 1] - y0)[..., None]
    corners = [second.xy[a, b] for a, b in ((y0, x0), (y0, x1), (y1, x0), (y1, x1))]
    top = corners[0] + fx * (corners[1] - corners[0])
    bottom = corners[2] + fx * (corners[3] - corners[2])
    xy = top + fy * (bottom - top)
    spread = np.max(np.maximum.reduce(corners) - np.minimum.reduce(corners), axis=2)
    near = np.clip(np.rint(place).astype(np.int64), 0, [width - 1, height - 1])
    nearest = near[..., 1], near[..., 0]
    moved = second.xy[nearest] + (place - near)
    with np.errstate(invalid="ignore"):
        xy = np.where((spread <= 3.0)[..., None], xy, moved)
    sigma = np.where(inside, np.hypot(first.sigma, second.sigma[nearest]), np.nan)
    xy = np.where(np.isfinite(sigma)[..., None], xy, np.nan)
    confidence = np.where(inside, np.minimum(first.confidence, second.confidence[nearest]), 0.0)
    return Correspondence(*(part.astype(np.float32) for part in (xy, sigma, confidence)))


def inverse_depth_of(P: F64, P_other: F64, pair: Correspondence) -> tuple[F32, F32]:
    """Inverse depth and deviation (H, W) of the pixels of a camera whose places in another one are known."""
    M = np.linalg.inv(P[:, :3])
    centre = camera_centre(P)
    rho, std = np.empty_like(pair.sigma), np.empty_like(pair.sigma)
    inverse_depths(pair.xy, pair.sigma, P_other[:, :3] @ M, P_other @ (centre / centre[3]), rho, std)
    return rho, std


def _nothing(shape: tuple[int, ...]) -> InverseDepth:
    unknown, counts = np.full((2, *shape), np.nan, dtype=np.float32), np.zeros((2, *shape), dtype=np.uint8)
    return InverseDepth(unknown[0], unknown[1], counts[0], counts[1])

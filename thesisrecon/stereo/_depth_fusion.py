"""Fusion of correspondences with several views into the inverse depth of each pixel (thesis, section 2.5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from thesisrecon.arrays import F32, F64, U8
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.records import PinholeView
from thesisrecon.stereo._depth_kernels import fuse_inverse_depths, inverse_depths, update_kalman
from thesisrecon.stereo.correspondence import Correspondence

Correspond = Callable[[int, int], Correspondence | None]
"""Returns the correspondence of view i in view j, None if the pair fails."""

GATE = 3.0
"""Standard deviations within which estimates agree; limit of the innovation of the filter."""


@dataclass(frozen=True)
class InverseDepth:
    """Inverse depth of the pixels of a view.

    Parameters
    ----------
    value, std : ndarray (H, W) float32
        Inverse depth and standard deviation, NaN = unknown.
    views, conflicts : ndarray (H, W) uint8
        Numbers of other views that agree and disagree.
    """

    value: F32
    std: F32
    views: U8
    conflicts: U8


@dataclass(frozen=True)
class RobustFusion:
    """Robust weighted mean of the inverse depths measured with all neighbours.

    The largest group of estimates that agree is averaged, the more certain one among equals. A measurement
    with a single neighbour is kept; the depth map of another view must confirm it.
    """

    def link(
        self, view: int, views: Mapping[int, PinholeView], neighbours: Sequence[int], correspond: Correspond
    ) -> InverseDepth:
        """Compute the inverse depths of the pixels of a view from its neighbours.

        Parameters
        ----------
        view : int
            Number of the view.
        views : mapping of int to PinholeView
            All views.
        neighbours : sequence of int
            Neighbours of the view.
        correspond : callable
            Returns the correspondence of view i in view j, None if the pair fails.

        Returns
        -------
        InverseDepth
            Inverse depths with their standard deviations.
        """
        found = []
        for other in neighbours:
            pair = correspond(view, other)
            if pair is not None:
                found.append(_inverse_depth_of(views[view].P, views[other].P, pair))
        shape = views[view].seen.shape
        result = _nothing(shape)
        if found:
            rho, std = (np.stack([one[k] for one in found]) for k in (0, 1))
            fuse_inverse_depths(rho, std, GATE, result.value, result.std, result.views, result.conflicts)
        return result


@dataclass(frozen=True)
class SequenceLinking:
    """Link correspondences through the image sequence with a Kalman filter per pixel.

    Koch, Pollefeys and Van Gool, "Multi viewpoint stereo from uncalibrated video sequences", ECCV 1998. The
    disparities of consecutive pairs are chained up and down the sequence from the reference view. Each view
    of the chain measures the depth with a longer baseline, and the variances of the links add up. A pixel's
    chain ends at the first measurement outside the gate, where it is taken as occluded. Both directions are
    filtered separately and fused where they agree.

    Parameters
    ----------
    length : int
        Maximal number of links in each direction.
    """

    length: int = 4

    def link(
        self,
        view: int,
        views: Mapping[int, PinholeView],
        neighbours: Sequence[int],  # noqa: ARG002 - one signature for all linkers
        correspond: Correspond,
    ) -> InverseDepth:
        """Compute the inverse depths of the pixels of a view; views are ordered by number.

        Parameters
        ----------
        view : int
            Number of the view.
        views : mapping of int to PinholeView
            All views.
        neighbours : sequence of int
            Not used.
        correspond : callable
            Returns the correspondence of view i in view j, None if the pair fails.

        Returns
        -------
        InverseDepth
            Inverse depths with their standard deviations.
        """
        order = sorted(views)
        place = order.index(view)
        chains = [order[place : place + self.length + 1], order[: place + 1][::-1][: self.length + 1]]
        ends = [self._chain(chain, views, correspond) for chain in chains if len(chain) > 1]
        result = _nothing(views[view].seen.shape)
        if not ends:
            return result
        rho, std = (np.stack(part) for part in ([e.value for e in ends], [e.std for e in ends]))
        fuse_inverse_depths(rho, std, GATE, result.value, result.std, result.views, result.conflicts)
        result.views[:] = np.where(np.isfinite(result.value), np.maximum.reduce([e.views for e in ends]), 0)
        return result

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
            linked = step if linked is None else _concatenated(linked, step)
            new = _inverse_depth_of(reference.P, views[following].P, linked)
            update_kalman(state.value, state.std, *new, GATE, alive, state.views)
        return state


def _concatenated(first: Correspondence, second: Correspondence) -> Correspondence:
    """Correspondence of view i in k from those of i in j and of j in k.

    The positions of the four pixels around in j are interpolated if they are consistent, else that of the
    nearest is shifted. Variances add up.
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


def _inverse_depth_of(P: F64, P_other: F64, pair: Correspondence) -> tuple[F32, F32]:
    """Inverse depth and standard deviation (H, W) from the correspondence with another camera."""
    rho, std = np.empty_like(pair.sigma), np.empty_like(pair.sigma)
    inverse_depths(pair.xy, pair.sigma, *pixel_transfer(P, P_other), rho, std)
    return rho, std


def pixel_transfer(P: F64, P_other: F64) -> tuple[F64, F64]:
    """Return H (3, 3) and e (3,) that transfer pixels and inverse depths to another camera.

    A pixel (x, y, 1) of inverse depth rho is at H (x, y, 1) + rho e in the other view: the homography of the
    plane at infinity and the epipole.

    Parameters
    ----------
    P, P_other : ndarray (3, 4)
        Cameras whose third coordinate is the depth.

    Returns
    -------
    tuple of ndarray
    """
    centre = camera_centre(P)
    return P_other[:, :3] @ np.linalg.inv(P[:, :3]), P_other @ (centre / centre[3])


def _nothing(shape: tuple[int, ...]) -> InverseDepth:
    unknown, counts = np.full((2, *shape), np.nan, dtype=np.float32), np.zeros((2, *shape), dtype=np.uint8)
    return InverseDepth(unknown[0], unknown[1], counts[0], counts[1])

"""Fusion of correspondences with several views into the inverse depth of each pixel (thesis, section 2.5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np

from thesisrecon.arrays import F32, F64, U8
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.imaging.resampling import bilinear_samples
from thesisrecon.records import PinholeView
from thesisrecon.stereo._depth_kernels import fuse_inverse_depths, inverse_depths, update_kalman
from thesisrecon.stereo.correspondence import Correspondence

Correspond = Callable[[int, int], Correspondence | None]
"""Returns the correspondence of view i in view j, None if the pair fails."""

A = TypeVar("A")
B = TypeVar("B")

GATE = 3.0
"""Standard deviations within which estimates agree; limit of the innovation of the filter."""
CONSISTENT_PX = 3.0
"""Range of the positions of four neighbours up to which they are interpolated."""


@dataclass(frozen=True)
class InverseDepth:
    """Inverse depth of the pixels of a view."""

    value: F32  #: (H, W), NaN = unknown
    std: F32  #: (H, W)
    views: U8  #: (H, W) number of other views that agree
    conflicts: U8  #: (H, W) number of other views that disagree


def fuse_neighbours(
    view: int,
    views: Mapping[int, PinholeView],
    neighbours: Sequence[int],
    correspond: Correspond,
    pool: Executor | None = None,
) -> InverseDepth:
    """Robust weighted mean of the inverse depths measured with all neighbours (2.5).

    The largest group of estimates that agree is averaged, the more certain one among equals. A measurement
    with a single neighbour is kept; the depth map of another view must confirm it.
    """
    pairs = zip(neighbours, _with_idle_threads(pool, partial(correspond, view), neighbours), strict=True)
    found = [_measured(views[view].P, views[other].P, pair) for other, pair in pairs if pair is not None]
    return _fused(views[view].seen.shape, found)


def _with_idle_threads(pool: Executor | None, function: Callable[[A], B], items: Sequence[A]) -> list[B]:
    """Map a function in this thread; threads of ``pool`` without other work take items that are not begun."""
    if pool is None:
        return [function(item) for item in items]
    offers = [pool.submit(function, item) for item in items]
    own = {n: function(items[n]) for n, offer in enumerate(offers) if offer.cancel()}
    return [own[n] if n in own else offer.result() for n, offer in enumerate(offers)]


def link_sequence(
    view: int, views: Mapping[int, PinholeView], links: int, correspond: Correspond
) -> InverseDepth:
    """Link correspondences through the views in order of their numbers with a Kalman filter per pixel (2.5).

    Koch, Pollefeys and Van Gool, "Multi viewpoint stereo from uncalibrated video sequences", ECCV 1998. The
    disparities of consecutive pairs are chained up and down the sequence from the reference view, at most
    ``links`` in each direction. Each view of the chain measures the depth with a longer baseline, and the
    variances of the links add up. A pixel's chain ends at the first measurement outside the gate, where it is
    taken as occluded. Both directions are filtered separately and fused where they agree.
    """
    order = sorted(views)
    place = order.index(view)
    chains = order[place : place + links + 1], order[: place + 1][::-1][: links + 1]
    ends = [_filtered(chain, views, correspond) for chain in chains if len(chain) > 1]
    result = _fused(views[view].seen.shape, [(end.value, end.std) for end in ends])
    if ends:
        longest = np.maximum.reduce([end.views for end in ends])
        result.views[:] = np.where(np.isfinite(result.value), longest, 0)
    return result


def _filtered(chain: Sequence[int], views: Mapping[int, PinholeView], correspond: Correspond) -> InverseDepth:
    """Kalman filter of the first view of a chain."""
    reference = views[chain[0]]
    state = _unknown(reference.seen.shape)
    alive = np.ones(reference.seen.shape, dtype=np.uint8)
    linked: Correspondence | None = None
    for previous, following in pairwise(chain):
        step = correspond(previous, following)
        if step is None:
            break
        linked = step if linked is None else _concatenated(linked, step)
        new = _measured(reference.P, views[following].P, linked)
        update_kalman(state.value, state.std, *new, GATE, alive, state.views)
    return state


def _concatenated(first: Correspondence, second: Correspondence) -> Correspondence:
    """Correspondence of view i in k from those of i in j and of j in k; variances add up."""
    limits = np.array(second.sigma.shape[::-1])
    inside = np.all((first.xy > -0.5) & (first.xy < limits - 0.5), axis=2)
    place = np.where(inside[..., None], first.xy, 0.0).astype(np.float32)
    xy, spread = bilinear_samples(second.xy, place[..., 0], place[..., 1])
    near = np.clip(np.rint(place).astype(np.int64), 0, limits - 1)
    nearest = near[..., 1], near[..., 0]
    consistent = np.max(spread, axis=2, keepdims=True) <= CONSISTENT_PX
    xy = np.where(consistent, xy, second.xy[nearest] + (place - near))
    sigma = np.where(inside, np.hypot(first.sigma, second.sigma[nearest]), np.nan)
    xy = np.where(np.isfinite(sigma)[..., None], xy, np.nan)
    return Correspondence(xy.astype(np.float32), sigma.astype(np.float32))


def _measured(P: F64, P_other: F64, pair: Correspondence) -> tuple[F32, F32]:
    """Inverse depth and standard deviation (H, W) from the correspondence with another camera."""
    rho, std = np.empty_like(pair.sigma), np.empty_like(pair.sigma)
    inverse_depths(pair.xy, pair.sigma, *pixel_transfer(P, P_other), rho, std)
    return rho, std


def pixel_transfer(P: F64, P_other: F64) -> tuple[F64, F64]:
    """H (3, 3) and e (3,) that take a pixel (x, y, 1) of inverse depth rho to H (x, y, 1) + rho e."""
    centre = camera_centre(P)
    return P_other[:, :3] @ np.linalg.inv(P[:, :3]), P_other @ (centre / centre[3])


def _fused(shape: tuple[int, ...], found: Sequence[tuple[F32, F32]]) -> InverseDepth:
    """Fusion of inverse depths and standard deviations (H, W)."""
    result = _unknown(shape)
    if found:
        rho, std = (np.stack(part) for part in zip(*found, strict=True))
        fuse_inverse_depths(rho, std, GATE, result.value, result.std, result.views, result.conflicts)
    return result


def _unknown(shape: tuple[int, ...]) -> InverseDepth:
    unknown, counts = np.full((2, *shape), np.nan, dtype=np.float32), np.zeros((2, *shape), dtype=np.uint8)
    return InverseDepth(unknown[0], unknown[1], counts[0], counts[1])

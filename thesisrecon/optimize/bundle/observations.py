"""Image observations of scene points, the weighting of their residuals, and an order of view pairs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon._numba import kernel
from thesisrecon.arrays import F64, I64, require_finite, require_shapes


@dataclass(frozen=True)
class SortedObservations:
    """Observations sorted by (point, view).

    ``start`` (N + 1,) is the first observation of each point, ``order`` (K,) the caller's position of each.
    """

    seen: Observations
    start: I64
    order: I64

    def unsort(self, values: F64) -> F64:
        """Bring one value (K, ...) per sorted observation to the order of the caller."""
        out = np.empty_like(values)
        out[self.order] = values
        return out


def sort_observations(observations: Observations, n_views: int, n_points: int) -> SortedObservations:
    """Sort observations by point and view, with the places at which each point begins."""
    view = np.ascontiguousarray(observations.view_index, dtype=np.int64)
    point = np.ascontiguousarray(observations.point_index, dtype=np.int64)
    xy = np.ascontiguousarray(observations.xy, dtype=np.float64)
    what = "a list of observations"
    require_shapes(what, view_index=(view, ("K",)), point_index=(point, ("K",)), xy=(xy, ("K", 2)))
    require_finite(what, xy)
    if len(view) and (view.min() < 0 or view.max() >= n_views or point.min() < 0 or point.max() >= n_points):
        raise ValueError(f"observation indices are beyond the {n_views} views or {n_points} points")
    key = point * max(n_views, 1) + view
    order = np.arange(len(key))
    if np.any(key[1:] < key[:-1]):
        order = np.argsort(key, kind="stable")
        view, point, xy = view[order], point[order], xy[order]
    start = np.zeros(n_points + 1, dtype=np.int64)
    np.cumsum(np.bincount(point, minlength=n_points), out=start[1:])
    return SortedObservations(Observations(view, point, xy), start, order)


class Jacobians(NamedTuple):
    """Weighted ``residual`` (K, 2) and Jacobians ``A`` (K, 2, C), ``E`` (K, 2, F), ``B`` (K, 2, 3)."""

    residual: F64
    A: F64
    E: F64
    B: F64

    @classmethod
    def empty(cls, n: int, own: int, common: int) -> Jacobians:
        """Allocate buffers of n observations with ``own`` columns in A and ``common`` ones in E."""
        return cls(*(np.empty((n, *shape)) for shape in [(2,), (2, own), (2, common), (2, 3)]))


class Weighting(NamedTuple):
    """Weighting of residuals: in units of ``sigma``, with Huber's loss of width ``delta``.

    ``min_curvature`` is the least fraction of the curvature along a residual that is kept where the second
    derivative of the loss reduces it (Triggs et al., Bundle Adjustment, 1999, equation 11); 1: reweighting.
    """

    sigma: float
    delta: float
    min_curvature: float = 1.0


@kernel(inline="always")
def loss_value(s: float, delta: float) -> float:
    """Evaluate Huber's rho(s); least squares if delta is infinite."""
    d2 = delta * delta
    return s if s <= d2 else 2.0 * delta * math.sqrt(s) - d2


@kernel(inline="always")
def loss_weight(s: float, delta: float) -> float:
    """Evaluate rho'(s)."""
    return 1.0 if s <= delta * delta else delta / math.sqrt(s)


@kernel(inline="always")
def loss_curvature(s: float, delta: float) -> float:
    """Evaluate 1 + 2 s rho'' / rho', the fraction of the curvature along a residual that its loss leaves."""
    return 1.0 if s / (delta * delta) <= 1.0 else 0.0


@kernel(inline="always")
def away_from_zero(w: float) -> float:
    """Move a projective depth off 0, so that a point in the focal plane gets a huge residual."""
    if w >= 0.0:
        return max(w, TINY)
    return min(w, -TINY)


_MORTON_BITS = 31
TINY = 1e-12


class Observations(NamedTuple):
    """View, point and pixels (K, 2) of observations of scene points; sorted by point is fastest."""

    view_index: I64
    point_index: I64
    xy: F64


def cached_pair_order(first: ArrayLike, second: ArrayLike) -> I64:
    """Indices of view pairs in an order in which cached data of a view are reused.

    Views of a pair get near numbers (reverse Cuthill-McKee), and ranges of Morton's curve (IBM, 1966) contain
    few different views: with all pairs, a cache of M of V views computes V^2 / M.
    """
    i, j = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    if not len(i):
        return i
    views, place = np.unique(np.concatenate([i, j]), return_inverse=True)
    near, ends = np.empty(len(views), np.int64), place.reshape(2, -1)
    graph = scipy.sparse.coo_array((np.ones(2 * len(i)), (place, ends[::-1].ravel())), shape=[len(views)] * 2)
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)
    near[order] = np.arange(len(views))
    low, high = np.sort(near[ends], axis=0)
    curve = np.zeros(len(i), dtype=np.int64)
    for bit in range(_MORTON_BITS):
        curve |= ((low >> bit) & 1) << (2 * bit + 1) | ((high >> bit) & 1) << (2 * bit)
    return np.lexsort((i, curve))

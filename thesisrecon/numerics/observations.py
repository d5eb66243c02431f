"""Image observations of scene points, checked and sorted, and the other arrays that kernels take together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.homogeneous import require_finite, require_shapes

_MORTON_BITS = 31


class Observations(NamedTuple):
    """Image observations of scene points, in any order; sorted by point is fastest.

    Attributes
    ----------
    view_index, point_index : ndarray (K,) of int, view and point of each observation
    xy : ndarray (K, 2), pixels
    """

    view_index: I64
    point_index: I64
    xy: F64

    def part(self, first: int, last: int) -> Observations:
        """Return observations ``first`` to ``last`` without a copy."""
        return Observations(self.view_index[first:last], self.point_index[first:last], self.xy[first:last])


@dataclass(frozen=True)
class SortedObservations:
    """Checked observations, sorted by (point, view).

    Attributes
    ----------
    view_index, point_index : ndarray (K,) of int, view and point of each observation
    xy : ndarray (K, 2), pixels
    start : ndarray (N + 1,) of int, first observation of each point
    order : ndarray (K,) of int, position of each observation in the caller's order
    """

    view_index: I64
    point_index: I64
    xy: F64
    start: I64
    order: I64

    def unsort(self, values: F64) -> F64:
        """Return values of observations in the caller's order.

        Parameters
        ----------
        values : ndarray (K, ...), values in sorted order

        Returns
        -------
        ndarray (K, ...), values in the caller's order
        """
        out = np.empty_like(values)
        out[self.order] = values
        return out


def sort_observations(
    view_index: I64, point_index: I64, xy: F64, n_views: int, n_points: int
) -> SortedObservations:
    """Check observations and sort them by (point, view).

    Parameters
    ----------
    view_index, point_index : ndarray (K,) of int, view and point of each observation
    xy : ndarray (K, 2), pixels
    n_views, n_points : int, numbers of views and points

    Returns
    -------
    SortedObservations, sorted observations

    Raises
    ------
    ValueError
        Wrong shapes, indices out of range, or pixels that are not finite.
    """
    view = np.ascontiguousarray(view_index, dtype=np.int64)
    point = np.ascontiguousarray(point_index, dtype=np.int64)
    xy = np.ascontiguousarray(xy, dtype=np.float64)
    require_shapes("observations", view_index=(view, ("K",)), point_index=(point, ("K",)), xy=(xy, ("K", 2)))
    require_finite("observations", xy)
    if len(view) and (view.min() < 0 or view.max() >= n_views or point.min() < 0 or point.max() >= n_points):
        raise ValueError(f"observation indices are beyond the {n_views} views or {n_points} points")
    key = point * max(n_views, 1) + view
    order = np.arange(len(key))
    if np.any(key[1:] < key[:-1]):
        order = np.argsort(key, kind="stable")
        view, point, xy = view[order], point[order], xy[order]
    start = np.zeros(n_points + 1, dtype=np.int64)
    np.cumsum(np.bincount(point, minlength=n_points), out=start[1:])
    return SortedObservations(view, point, xy, start, order)


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

    def part(self, first: int, last: int) -> Jacobians:
        """Return observations ``first`` to ``last`` without a copy."""
        return Jacobians(*(a[first:last] for a in self))


class Weighting(NamedTuple):
    """Weighting of residuals: in units of ``sigma``, under loss number ``code`` that turns at ``delta``.

    ``min_curvature`` is the least fraction of the curvature along a residual that is kept if its loss bends
    (Triggs et al., Bundle Adjustment, 1999, equation 11): 1 is plain reweighting, less is closer to Newton's
    steps.
    """

    sigma: float
    code: int
    delta: float
    min_curvature: float = 1.0


def morton_pair_order(first: ArrayLike, second: ArrayLike) -> I64:
    """Return an order of view pairs in which cached data of a view are reused.

    Along Morton's curve through the table of pairs, ranges of any size contain few different views: of V
    views with a cache of M some V^2 / M are computed, instead of one for each pair.

    Parameters
    ----------
    first, second : array_like (M,) of int, views of each pair

    Returns
    -------
    ndarray (M,) of int, indices of the pairs; a pair and its reverse are adjacent

    References
    ----------
    Morton, "A computer oriented geodetic data base", IBM, 1966.
    """
    i, j = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    low, high = np.minimum(i, j), np.maximum(i, j)
    curve = np.zeros(len(i), dtype=np.int64)
    for bit in range(_MORTON_BITS):
        curve |= ((low >> bit) & 1) << (2 * bit + 1) | ((high >> bit) & 1) << (2 * bit)
    return np.lexsort((i, curve))

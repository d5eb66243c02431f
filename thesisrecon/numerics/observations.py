"""Observations of points in views, checked and sorted for the kernels.

Arrays that travel together into the kernels.

Frames in which projective problems are well conditioned: scaled pixels and whitened space.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.arrays import F64, I64


class Observations(NamedTuple):
    """Image observations of scene points, in any order; sorted by point is fastest."""

    view_index: I64
    point_index: I64
    xy: F64

    def part(self, first: int, last: int) -> Observations:
        """Return observations ``first`` to ``last`` without a copy."""
        return Observations(self.view_index[first:last], self.point_index[first:last], self.xy[first:last])


@dataclass(frozen=True)
class SortedObservations:
    """Observations sorted by (point, view), checked; ``order`` (K,) takes the caller's order to this one.

    ``start`` (N + 1,) is where the observations of each point begin.
    """

    view_index: I64
    point_index: I64
    xy: F64
    start: I64
    order: I64

    def unsort(self, values: F64) -> F64:
        """Values per observation (K, ...) in the caller's order."""
        out = np.empty_like(values)
        out[self.order] = values
        return out


def sort_observations(
    view_index: I64, point_index: I64, xy: F64, n_views: int, n_points: int
) -> SortedObservations:
    """Check and sort observations by (point, view); raises ``ValueError`` for wrong shapes, indices or
    NaN."""
    view = np.ascontiguousarray(view_index, dtype=np.int64)
    point = np.ascontiguousarray(point_index, dtype=np.int64)
    xy = np.ascontiguousarray(xy, dtype=np.float64)
    if view.ndim != 1 or view.shape != point.shape or xy.shape != (len(view), 2):
        raise ValueError(
            f"observations need (K,), (K,) and (K, 2) arrays; got {view.shape}, {point.shape} and {xy.shape}"
        )
    if not np.isfinite(xy).all():
        raise ValueError("observations must be finite")
    if len(view) and (view.min() < 0 or view.max() >= n_views or point.min() < 0 or point.max() >= n_points):
        raise ValueError(
            f"observations name views or points beyond the {n_views} views and {n_points} points"
        )
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
        """Buffers of n observations with ``own`` columns in A and ``common`` ones in E."""
        return cls(*(np.empty((n, *shape)) for shape in [(2,), (2, own), (2, common), (2, 3)]))

    def part(self, first: int, last: int) -> Jacobians:
        """Those of observations first..last, without a copy."""
        return Jacobians(*(a[first:last] for a in self))


class Weighting(NamedTuple):
    """Residuals are counted in units of ``sigma`` under loss number ``code``, which turns at ``delta``.

    ``least`` is the share of the curvature along a residual that is kept at least where its loss bends
    (Triggs et al., Bundle Adjustment, 1999, equation 11): 1 is plain reweighting, less comes closer to
    Newton's steps.
    """

    sigma: float
    code: int
    delta: float
    min_curvature: float = 1.0


_MORTON_BITS = 31


def morton_pair_order(first: ArrayLike, second: ArrayLike) -> I64:
    """(M,) the pairs of views in an order in which what was made of a view serves again.

    Along Morton's curve (G. M. Morton, A computer oriented geodetic data base, IBM, 1966) through the table
    of pairs, a pair and its turned one together: parts of any size hold few different views, so that of V
    views with room for M of them some V^2 / M are made, and not one for each pair, whatever M is.
    """
    i, j = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    low, high = np.minimum(i, j), np.maximum(i, j)
    curve = np.zeros(len(i), dtype=np.int64)
    for bit in range(_MORTON_BITS):
        curve |= ((low >> bit) & 1) << (2 * bit + 1) | ((high >> bit) & 1) << (2 * bit)
    return np.lexsort((i, curve))

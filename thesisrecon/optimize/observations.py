"""Observations of points in views, checked and sorted for the kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Observations:
    """What the photographs show: observation k is point ``point_index[k]`` in view ``view_index[k]`` at
    ``xy[k]`` px; (K,), (K,) and (K, 2) in any order, sorted by point is fastest."""

    view_index: I64
    point_index: I64
    xy: F64


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

"""Observations of points in views, checked and sorted for the kernels.

Arrays that travel together into the kernels.

Frames in which projective problems are well conditioned: scaled pixels and whitened space.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import F64, I64


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


class Seen(NamedTuple):
    """Observations: ``view_index`` and ``point_index`` (K,), ``xy`` (K, 2) px."""

    view_index: I64
    point_index: I64
    xy: F64

    def part(self, first: int, last: int) -> Seen:
        """Observations first..last, without a copy."""
        return Seen(self.view_index[first:last], self.point_index[first:last], self.xy[first:last])


class Weighing(NamedTuple):
    """Residuals are counted in units of ``sigma`` under loss number ``code``, which turns at ``delta``.

    ``least`` is the share of the curvature along a residual that is kept at least where its loss bends
    (Triggs et al., Bundle Adjustment, 1999, equation 11): 1 is plain reweighting, less comes closer to
    Newton's steps.
    """

    sigma: float
    code: int
    delta: float
    least: float = 1.0


def pixel_conditioning(xy: F64) -> F64:
    """T (3, 3) that moves the middle of xy (K, 2) to 0 and its half-diagonal to 1; isotropic, so residuals
    scale.

    The identity's scale stands in where all pixels are equal.
    """
    if len(xy) == 0:
        return np.eye(3)
    low, high = xy.min(axis=0), xy.max(axis=0)
    half = 0.5 * float(np.hypot(*(high - low)))
    s = 1.0 / half if half > 0.0 else 1.0
    cx, cy = 0.5 * (low + high)
    return np.array([[s, 0.0, -s * cx], [0.0, s, -s * cy], [0.0, 0.0, 1.0]])


def scene_frame(X: F64) -> tuple[F64, float]:
    """Middle (3,) and inverse size of points X (N, 3) by medians, so that far points do not matter.

    (0, 1) without points; the scale is 1 where all points are equal.
    """
    if len(X) == 0:
        return np.zeros(3), 1.0
    origin = np.median(X, axis=0)
    size = float(np.median(np.linalg.norm(X - origin, axis=1)))
    return origin, 1.0 / size if size > 0.0 else 1.0


def whitening_transform(X: F64, *, rounds: int = 4) -> F64:
    """M (4, 4) for which the unit vectors x = M X / |M X| have sum x x' proportional to I; X (N, 4)
    homogeneous.

    Fixed-point iteration of Tyler (Annals of Statistics 1987): every point counts as a direction, so neither
    the homogeneous scales nor a few far points matter. Directions without extent (all points on a plane) are
    stretched by at most 1e6. det M > 0, hence orientations are kept; points of norm 0 are left out.
    """
    M = np.eye(4)
    norms = np.linalg.norm(X, axis=1)
    X = X[norms > 0.0] / norms[norms > 0.0, None]
    if len(X) < 4:
        return M
    for _ in range(rounds):
        moved = X @ M.T
        moved /= np.linalg.norm(moved, axis=1)[:, None]
        values, vectors = np.linalg.eigh(moved.T @ moved / len(moved))
        stretch = 1.0 / np.sqrt(np.maximum(4.0 * values, 1e-12))
        M = (vectors * stretch) @ vectors.T @ M
        M /= np.linalg.norm(M)
    return M

"""Section 6.3: space points from their images, by five methods behind one door.

============== ===== ================================== ==================================================
method         views what it makes least                use
============== ===== ================================== ==================================================
``linear``     any   an algebraic residual              starts; fast, good enough where noise is small
``iterated``   any   nearly the reprojection error      as linear, no longer depending on cameras' scales
``midpoint``   any   distances of rays in space         metric frames only
``polynomial`` two   the reprojection error, globally   the best for two views, in any frame
``optimal``    any   the reprojection error, locally    the best for more views, in any frame
============== ===== ================================== ==================================================

Hartley and Sturm, "Triangulation", CVIU 68(2), 1997. docs/triangulation.md compares them.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import require_finite
from thesisrecon.geometry.kernels import (
    PASSES,
    list_seen,
    reduce_reprojection,
    triangulate_linearly,
    triangulate_midpoints,
)
from thesisrecon.geometry.optimal_triangulation import triangulate_polynomial

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Method = Literal["polynomial", "linear", "midpoint", "iterated", "optimal"]
Listed = tuple[I64, I64, F64]
"""Observations sorted by point: where each point's begin (N + 1,), their views (K,) and pixels (K, 2)."""

_AT_REST = 1e-6
"""Relative change of all depths at which the iterated linear method has come to rest."""
_PARALLEL = 1e-14
"""Determinant of the mid-point system below which rays are parallel: about 2 sin^2 of the angle of two."""
_ITERATIONS = 200
"""Most steps of the n-view method; the median point takes three or four."""


def triangulate_observations(P: F64, view: I64, point: I64, xy: F64, n_points: int) -> F64:
    """Linear triangulation of all points of an observation list; -> (n_points, 4) with unit norm.

    P (V, 3, 4); view, point (K,), xy (K, 2) px, in any order, fastest where sorted by point. The criterion is
    that of :func:`triangulate_linear`. Points with fewer than two observations come out as zeros.
    """
    if not (point[1:] >= point[:-1]).all():
        order = np.argsort(point, kind="stable")
        view, point, xy = view[order], point[order], xy[order]
    start = np.searchsorted(point, np.arange(n_points + 1)).astype(np.int64)
    listed = (start, np.ascontiguousarray(view, dtype=np.int64), np.ascontiguousarray(xy, dtype=np.float64))
    return _linear(P, listed, 0)


def triangulate_linear(P: F64, xy: F64) -> F64:
    """Linear triangulation (6.3.1), P (V, 3, 4), xy (V, N, 2) px, NaN = not seen; -> X (N, 4) unit norm.

    Least sum of squares of u p3'X - p1'X and v p3'X - p2'X over unit X. Of Hartley's normalisation the shift
    changes nothing here, for these rows do not see it, and the scale is the weight of a view: each view's
    rows are divided by the norm of M's first two, the pixels' origin in the middle of its points. In a metric
    frame that is the focal length, so that rows are depths times angles. The answer changes with the
    projective frame. Points seen in fewer than two views come out as zeros. Raises ``ValueError`` as
    :func:`triangulate` does.
    """
    P, xy = _checked(P, xy)
    return _linear(P, _listed(xy), 0)


def triangulate_iterated(P: F64, xy: F64) -> F64:
    """Iterated linear triangulation (Hartley and Sturm's Iterative-LS); arguments as in
    :func:`triangulate_linear`.

    The rows are divided by the depth p3'X of the pass before, which makes them the reprojection residuals at
    rest, and solved again, ten times at most; where the depths do not come to rest, the last or the linear
    answer stands, whichever reprojects better. The limit is near the least reprojection error, not at it: the
    depths count as constants.
    """
    P, xy = _checked(P, xy)
    return _linear(P, _listed(xy), PASSES)


def triangulate_midpoint(P: F64, xy: F64) -> F64:
    """Point nearest to all rays (6.3.2); P (V, 3, 4), xy (V, N, 2) px, NaN = not seen; -> X (N, 4), X4 = 1.

    Sum of squared distances in space. Meaningful in a metric frame only: distances do not exist in a
    projective one, and the answer changes with it, for the worse. Parallel rays and points seen once come out
    as zeros. Raises ``ValueError`` for a camera whose centre is at infinity, which has no rays in this sense.
    """
    P, xy = _checked(P, xy)
    M = P[:, :, :3]
    if not (np.abs(np.linalg.det(M)) > 1e-14 * np.linalg.norm(M, axis=(1, 2)) ** 3).all():
        raise ValueError("the mid-point method needs finite cameras; the left 3x3 part of one is singular")
    inverses = np.linalg.inv(M)
    centres = np.ascontiguousarray(-np.einsum("vab,vb->va", inverses, P[:, :, 3]))
    X = np.empty((xy.shape[1], 4))
    triangulate_midpoints(np.ascontiguousarray(inverses), centres, *_listed(xy), _PARALLEL, X)
    return X


def triangulate_optimal(P: F64, xy: F64) -> F64:
    """Least reprojection error from any number of views; P (V, 3, 4), xy (V, N, 2) px, NaN = not seen; -> X
    (N, 4) unit norm.

    Levenberg-Marquardt from the linear answer until no step lowers the sum of squared distances any more, in
    a frame in which the cameras' rows are orthonormal; the same point in every projective frame. The minimum
    is a local one: with two views beside an epipole :func:`triangulate_polynomial` may know a lower. No
    robust loss: wrong observations count in full. Points seen in fewer than two views come out as zeros.
    """
    P, xy = _checked(P, xy)
    listed = start, view, seen = _listed(xy)
    X = _linear(P, listed, 0)
    if len(view) == 0:
        return X
    low, high = seen.min(axis=0), seen.max(axis=0)
    centre, scale = 0.5 * (low + high), 2.0 / max(float((high - low).max()), 1e-12)
    moved = np.concatenate([scale * (P[:, :2] - centre[:, None] * P[:, 2:]), P[:, 2:]], axis=1)
    moved /= np.linalg.norm(moved, axis=(1, 2), keepdims=True)
    Q, R = np.linalg.qr(moved.reshape(-1, 4))
    if not np.abs(np.diag(R)).min() > 1e-13 * np.abs(R).max():
        Q, R = moved.reshape(-1, 4), np.eye(4)
    Y = np.ascontiguousarray(X @ R.T)
    sizes = np.linalg.norm(Y, axis=1, keepdims=True)
    Y /= np.where(sizes > 0.0, sizes, 1.0)
    cameras = np.ascontiguousarray(Q).reshape(-1, 3, 4)
    reduce_reprojection(cameras, start, view, scale * (seen - centre), _ITERATIONS, Y)
    X = np.linalg.solve(R, Y.T).T
    sizes = np.linalg.norm(X, axis=1, keepdims=True)
    return np.asarray(X / np.where(sizes > 0.0, sizes, 1.0))


def triangulate(P: F64, xy: F64, *, method: Method = "polynomial") -> F64:
    """Space points from their images by one of the methods of section 6.3.

    Parameters
    ----------
    P : (V, 3, 4) cameras of any scale, V >= 2.
    xy : (V, N, 2) px, NaN = not seen.
    method : "polynomial" (optimal, exactly two views), "linear", "midpoint" (metric frames only), "iterated"
        (linear) or "optimal" (least reprojection error from any number of views).

    Returns
    -------
    X (N, 4) homogeneous, in the frame of the cameras; zeros where a point is seen in fewer than two views or
    its rays do not fix it.

    Raises ``ValueError`` for an unknown method, wrong shapes, infinite pixels, and cameras that are zero, not
    finite, fewer than two or not for the method.
    """
    methods = {
        "polynomial": triangulate_polynomial,
        "linear": triangulate_linear,
        "midpoint": triangulate_midpoint,
        "iterated": triangulate_iterated,
        "optimal": triangulate_optimal,
    }
    if method not in methods:
        raise ValueError(f"triangulate knows {', '.join(methods)}; got method={method!r}")
    return methods[method](*_checked(P, xy))


def triangulation_angles(centres: F64, view: I64, point: I64, X: F64, n_points: int) -> F64:
    """Largest angle (rad) between a point's rays, against the ray of its first observation; -> (n_points,).

    centres (V, 3), X (n_points, 3); a point without observations gets 0.
    """
    rays = X[point] - centres[view]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    first = np.zeros((n_points, 3))
    first[point[::-1]] = rays[::-1]
    cosine = np.clip(np.einsum("ka,ka->k", rays, first[point]), -1.0, 1.0)
    angles = np.zeros(n_points)
    np.maximum.at(angles, point, np.arccos(cosine))
    return angles


def _checked(P: F64, xy: F64) -> tuple[F64, F64]:
    """Cameras and pixels as contiguous float64 arrays, or ``ValueError``."""
    if np.iscomplexobj(P) or np.iscomplexobj(xy):
        raise ValueError("triangulate needs real numbers; got complex ones")
    P, xy = np.ascontiguousarray(P, dtype=np.float64), np.ascontiguousarray(xy, dtype=np.float64)
    if P.ndim != 3 or P.shape[1:] != (3, 4) or xy.ndim != 3 or xy.shape[0] != len(P) or xy.shape[2] != 2:
        raise ValueError(f"triangulate needs P (V, 3, 4) and xy (V, N, 2); got {P.shape} and {xy.shape}")
    if len(P) < 2:
        raise ValueError(f"triangulate needs at least two cameras; got {len(P)}")
    require_finite("triangulate, for its cameras,", P)
    if not np.abs(P).max(axis=(1, 2)).all():
        raise ValueError("triangulate needs cameras that are not all zero")
    if np.isinf(xy).any():
        raise ValueError("triangulate needs finite pixels, or NaN for not seen; some are infinite")
    return P, xy


def _listed(xy: F64) -> Listed:
    views, points = xy.shape[:2]
    start, view = np.empty(points + 1, dtype=np.int64), np.empty(views * points, dtype=np.int64)
    seen = np.empty((views * points, 2))
    count = list_seen(xy, start, view, seen)
    return start, view[:count], seen[:count]


def _linear(P: F64, listed: Listed, passes: int) -> F64:
    """The linear answer, and with ``passes`` the iterated one."""
    start, view, xy = listed
    P = np.ascontiguousarray(P, dtype=np.float64)
    counts = np.maximum(np.bincount(view, minlength=len(P)), 1)
    middle = np.stack([np.bincount(view, xy[:, i], minlength=len(P)) / counts for i in range(2)], axis=1)
    # The fourth column would bring in where the origin of space lies.
    size = np.linalg.norm(P[:, :2, :3] - middle[:, :, None] * P[:, 2:, :3], axis=(1, 2))
    X = np.empty((len(start) - 1, 4))
    triangulate_linearly(P, 1.0 / np.where(size > 0.0, size, 1.0), start, view, xy, passes, _AT_REST, X)
    return X

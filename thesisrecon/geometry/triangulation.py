"""Sections 6.3 and 6.4: points from several views, cameras from points (linear) and from three points (P3P).

Points with fewer than two observations, or with observations from one centre only, are zeros, all others have
unit norm (mid-points X4 = 1). Near an epipole "optimal" may end in a higher minimum than "polynomial".
docs/theory/projective.md compares the methods (Hartley and Sturm, "Triangulation", CVIU 68(2), 1997).
"""

import math

import numpy as np
from numpy.typing import NDArray

from thesisrecon._numba import copy_to, empty, kernel, zeros
from thesisrecon.arrays import F64, I64, require_finite
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, normalizing_transform, unit_norm
from thesisrecon.geometry.small_matrices import orthogonalize_columns

PASSES = 10
"""Passes of the iterated linear method; by then those that converge have done so (Hartley and Sturm)."""
_AT_REST = 1e-6  # relative change of all depths at which the iterated linear method has converged
_ONE_CENTRE = 1e-12
"""Distance of two centres, over 1 plus that from the origin, below which they are equal to rounding."""
_PARALLEL = 1e-14
"""Determinant of the mid-point system of two rays, about 2 sin^2 of their angle, below which they are
parallel; it grows with the third power of their number."""

SortedPixels = tuple[I64, I64, F64]
"""Observations sorted by point: first of each point (N + 1,), views (K,), pixels (K, 2)."""


@kernel
def _insert_row(R: F64, row: F64) -> None:
    """Rotate one more row (4,) into the triangle R (4, 4) (Givens); R'R grows by row row'."""
    for c in range(4):
        if row[c] == 0.0:
            continue
        length = math.sqrt(R[c, c] * R[c, c] + row[c] * row[c])
        cosine, sine = R[c, c] / length, row[c] / length
        R[c, c] = length
        for k in range(c + 1, 4):
            above = R[c, k]
            R[c, k] = cosine * above + sine * row[k]
            row[k] = cosine * row[k] - sine * above


@kernel
def _least_singular_vector(R: F64, x: F64) -> None:
    """Fill x (4,) with the unit vector of least |R x|, x[3] >= 0, by one-sided Jacobi rotations."""
    A, V, least = empty((4, 4)), empty((4, 4)), math.inf
    for i in range(4):
        copy_to(A[i], R[i])
    orthogonalize_columns(A, V)
    for p in range(4):
        length = A[0, p] ** 2 + A[1, p] ** 2 + A[2, p] ** 2 + A[3, p] ** 2
        if length < least:
            least, sign = length, math.copysign(1.0, V[3, p])
            x[0], x[1], x[2], x[3] = sign * V[0, p], sign * V[1, p], sign * V[2, p], sign * V[3, p]


@kernel
def _least_algebraic(
    P: F64, obs: tuple[I64, F64, F64], first: int, last: int, R: F64, row: F64, x: F64
) -> None:
    """Fill x (4,) with the least sum of (w (u p3'x - p1'x))^2 + (w (v p3'x - p2'x))^2; R, row are scratch."""
    view, xy, weight = obs
    R[:] = 0.0
    for k in range(first, last):
        p, w = P[view[k]], weight[k]
        for i in range(2):
            for c in range(4):
                row[c] = w * (xy[k, i] * p[2, c] - p[i, c])
            _insert_row(R, row)
    _least_singular_vector(R, x)


@kernel
def _from_one_centre(P: F64, centre: F64, first: int, last: int, view: I64) -> bool:
    """Whether all cameras that observe a point have the centre of the first; centres (V, 4) are unit."""
    c = centre[view[first]]
    for k in range(first + 1, last):
        p = P[view[k]]
        apart = size = 0.0
        for i in range(3):
            epipole = p[i, 0] * c[0] + p[i, 1] * c[1] + p[i, 2] * c[2] + p[i, 3] * c[3]
            apart += epipole * epipole
            size += p[i, 0] * p[i, 0] + p[i, 1] * p[i, 1] + p[i, 2] * p[i, 2]
        if apart > _ONE_CENTRE * _ONE_CENTRE * size:
            return False
    return True


@kernel
def _triangulate_each(P: F64, weight: F64, centre: F64, listed: SortedPixels, X: F64) -> None:
    """Fill X (N, 4) by the linear method, the rows of an observation times its weight (K,).

    Points observed from one ``centre`` (V, 4) are 0.
    """
    start, view, xy = listed
    R, row = zeros((4, 4)), empty(4)
    for j in range(len(start) - 1):
        first, last = start[j], start[j + 1]
        X[j] = 0.0
        if last - first >= 2 and not _from_one_centre(P, centre, first, last, view):
            _least_algebraic(P, (view, xy, weight), first, last, R, row, X[j])


def triangulate_observations(P: F64, view: I64, point: I64, xy: F64, n_points: int) -> F64:
    """Linear triangulation of observations in any order: unit points (n_points, 4), zeros from one centre."""
    if not (point[1:] >= point[:-1]).all():
        order = np.argsort(point, kind="stable")
        view, point, xy = view[order], point[order], xy[order]
    start = np.searchsorted(point, np.arange(n_points + 1)).astype(np.int64)
    listed = (start, np.ascontiguousarray(view, dtype=np.int64), np.ascontiguousarray(xy, dtype=np.float64))
    return triangulate_linear(P, listed, 0)


def triangulation_angles(centres: F64, view: I64, point: I64, X: F64, n_points: int) -> F64:
    """For each point the largest angle, rad, between one of its rays and the ray of its first observation."""
    rays = X[point] - centres[view]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    first = np.zeros((n_points, 3))
    first[point[::-1]] = rays[::-1]
    cosine = np.clip(np.einsum("ka,ka->k", rays, first[point]), -1.0, 1.0)
    angles = np.zeros(n_points)
    np.maximum.at(angles, point, np.arccos(cosine))
    return angles


def sort_by_point(xy: F64) -> SortedPixels:
    """List the observations of xy (V, N, 2) that are not NaN, point by point."""
    n_points = xy.shape[1]
    point, view = np.nonzero(~np.isnan(xy[:, :, 0] + xy[:, :, 1]).T)
    start = np.searchsorted(point, np.arange(n_points + 1))
    return start, np.ascontiguousarray(view), xy.reshape(-1, 2).take(view * n_points + point, axis=0)


def triangulate_linear(P: F64, listed: SortedPixels, passes: int) -> F64:
    """Linear method (6.3.1): least sum of squares of u p3'X - p1'X and v p3'X - p2'X over unit X.

    The rows of a view are divided by the norm of the first two rows of M (in a metric frame the focal
    length), with the pixel origin in the middle of the view's points. ``passes`` > 0: Iterative-LS.
    """
    start, view, xy = listed
    P = np.ascontiguousarray(P, dtype=np.float64)
    counts = np.maximum(np.bincount(view, minlength=len(P)), 1)
    middle = np.stack([np.bincount(view, xy[:, i], minlength=len(P)) / counts for i in range(2)], axis=1)
    # The fourth column would depend on the origin of space.
    size = np.linalg.norm(P[:, :2, :3] - middle[:, :, None] * P[:, 2:, :3], axis=(1, 2))
    scale = 1.0 / np.where(size > 0.0, size, 1.0)
    centre = camera_centre(P)
    centre /= np.maximum(np.linalg.norm(centre, axis=1, keepdims=True), 1e-300)
    X, weight = np.empty((len(start) - 1, 4)), scale[view]
    _triangulate_each(P, weight, centre, listed, X)
    return _iterated(P, weight, centre, listed, X, passes) if passes else X


def _iterated(P: F64, weight: F64, centre: F64, listed: SortedPixels, X: F64, passes: int) -> F64:
    """Iterative-LS: each row over the depth p3'X of the last pass, until no depth of a point changes.

    Where it does not come to rest, the answer of least reprojection error.
    """
    start, view, xy = listed
    point = np.repeat(np.arange(len(X)), np.diff(start))
    found, moving = X.copy(), np.abs(X).any(axis=1)
    for n in range(passes):
        depth = np.abs(np.einsum("ka,ka->k", P[view, 2], found[point]))
        change = np.zeros(len(X))
        with np.errstate(divide="ignore", invalid="ignore"):
            np.maximum.at(change, point, np.abs(depth * weight - 1.0))
            weight = 1.0 / depth
        moving &= (np.bincount(point, weight, len(X)) < np.inf) & ((n == 0) | (change >= _AT_REST))
        trial = np.empty_like(X)
        _triangulate_each(P, np.where(moving[point], weight, 1.0), centre, listed, trial)
        found[moving] = trial[moving]
    images = (dehomogenize(np.einsum("kab,kb->ka", P[view], Y[point])) - xy for Y in (found, X))
    cost, before = (np.bincount(point, np.sum(off**2, axis=1), len(X)) for off in images)
    return np.where(((change < _AT_REST) | (cost < before))[:, None], found, X)


def triangulate_midpoint(P: F64, listed: SortedPixels) -> F64:
    """Point nearest to all rays (6.3.2), meaningful in a metric frame only; zeros for parallel rays."""
    start, view, xy = listed
    M = P[:, :, :3]
    if not (np.abs(np.linalg.det(M)) > 1e-14 * np.linalg.norm(M, axis=(1, 2)) ** 3).all():
        raise ValueError("the mid-point method needs finite cameras; the left 3x3 part of one is singular")
    point = np.repeat(np.arange(len(start) - 1), np.diff(start))
    centres = -np.linalg.solve(M, P[:, :, 3:])[:, :, 0]
    origin = centres.mean(axis=0)
    r = (centres - origin)[view]
    apart = np.linalg.norm(r - r[start[point]], axis=1) > _ONE_CENTRE * (1.0 + np.abs(centres).max())
    d = np.einsum("kab,kb->ka", np.linalg.inv(M)[view], homogenize(xy))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    A, b = np.zeros((len(start) - 1, 3, 3)), np.zeros((len(start) - 1, 3, 1))
    np.add.at(A, point, np.eye(3) - d[:, :, None] * d[:, None])
    np.add.at(b, point, (r - np.sum(d * r, axis=1, keepdims=True) * d)[:, :, None])
    least = _PARALLEL * (np.diff(start) / 2.0) ** 3
    good = (np.bincount(point[apart], minlength=len(A)) > 0) & (np.linalg.det(A) > least)
    X = np.zeros((len(start) - 1, 4))
    X[good] = homogenize(np.linalg.solve(A[good], b[good])[:, :, 0] + origin)
    return X


def resect_linear(X: F64, xy: F64) -> F64:
    """Unit camera of least algebraic residual (DLT) of points X (M, 4) and xy (M, 2), M >= 6.

    Best with whitened unit vectors X; coplanar points do not determine the camera.
    """
    if len(X) < 6:
        raise ValueError(f"resect_linear needs at least 6 points; got {len(X)}")
    require_finite("resect_linear", X, xy)
    A, T = _camera_equations(X, xy)
    return unit_norm(np.linalg.inv(T) @ np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 4))


def resect_six(X: F64, xy: F64) -> F64:
    """Unit cameras (B, 3, 4) by 11 of the 12 equations of six points X (B, 6, 4) and xy (B, 6, 2)."""
    A, T = _camera_equations(X, xy)
    p = np.linalg.qr(A[:, :11].swapaxes(1, 2), mode="complete")[0][:, :, 11]
    return unit_norm(np.linalg.inv(T) @ p.reshape(-1, 3, 4))


def _camera_equations(X: F64, xy: F64) -> tuple[F64, F64]:
    """Rows u p3'X - p1'X, then v p3'X - p2'X, (..., 2 M, 12) in conditioned pixels T (u, v, 1)."""
    T = normalizing_transform(xy.reshape(-1, 2))
    conditioned, zero = xy * T[0, 0] + T[:2, 2], np.zeros_like(X)
    first = np.concatenate([-X, zero, conditioned[..., :1] * X], axis=-1)
    second = np.concatenate([zero, -X, conditioned[..., 1:] * X], axis=-1)
    return np.concatenate([first, second], axis=-2), T


def pose_from_three_points(X: F64, rays: F64) -> F64:
    """All poses [R t] (B', 3, 4) that see three points X (B, 3, 3) along unit rays (B, 3, 3) (P3P).

    With side lengths a = |X2 - X3|, b = |X1 - X3|, c = |X1 - X2| and the angles between the rays, the ratio v
    = s3 / s1 of the distances is a root of Grunert's quartic: up to four poses a sample (Haralick et al.,
    IJCV 13(3), 1994).
    """
    a2, b2, c2 = (np.sum((X[:, i] - X[:, j]) ** 2, axis=1) for i, j in ((1, 2), (0, 2), (0, 1)))
    ca, cb, cc = (np.sum(rays[:, i] * rays[:, j], axis=1) for i, j in ((1, 2), (0, 2), (0, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        q = (a2 - c2) / b2
        c_b, a_b = c2 / b2, a2 / b2
        # Quartic in v = s3/s1: A4 v^4 + ... + A0 (Haralick et al., eq. for Grunert's method).
        A4 = (q - 1) ** 2 - 4 * c_b * ca**2
        A3 = 4 * (q * (1 - q) * cb - (1 - (a2 + c2) / b2) * ca * cc + 2 * c_b * ca**2 * cb)
        A2 = 2 * (
            q**2 - 1 + 2 * q**2 * cb**2 + 2 * (1 - c_b) * ca**2 - 4 * (a2 + c2) / b2 * ca * cb * cc
            + 2 * (1 - a_b) * cc**2
        )  # fmt: skip
        A1 = 4 * (-q * (1 + q) * cb + 2 * a_b * cc**2 * cb - (1 - (a2 + c2) / b2) * ca * cc)
        A0 = (1 + q) ** 2 - 4 * a_b * cc**2
    x = polynomial_roots(np.stack([A4, A3, A2, A1, A0], axis=1))
    sample, which = np.nonzero(
        (np.abs(x.imag) < 1e-4 * (1.0 + np.abs(x.real))) & (x.real > 0.0) & (x.real < 1e100)
    )
    v = x.real[sample, which]
    X, rays, q, b2, ca, cb, cc = (array[sample] for array in (X, rays, q, b2, ca, cb, cc))
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((q - 1) * v**2 - 2 * q * cb * v + 1 + q) / (2 * (cc - v * ca))
        s1 = np.sqrt(b2 / (1 + v**2 - 2 * v * cb))
    Y = np.stack([s1, u * s1, v * s1], axis=1)[:, :, None] * rays
    good = np.isfinite(Y).all(axis=(1, 2)) & (u > 0)
    X, Y = X[good], Y[good]
    R = _triad(Y) @ _triad(X).swapaxes(1, 2)
    t = Y.mean(axis=1) - np.einsum("bij,bj->bi", R, X.mean(axis=1))
    # The triads of points on one line, as of equal rays, are no bases.
    return np.asarray(np.concatenate([R, t[:, :, None]], axis=2)[np.linalg.det(R) > 0.5])


def polynomial_roots(c: F64) -> NDArray[np.complex128]:
    """Complex roots (N, D) of polynomials c (N, D + 1), highest power first (companion matrices).

    NaN if both ends of c are nearly zero.
    """
    # Those of the reversed polynomial are 1 / x: the larger of both ends leads.
    small = np.abs(c[:, 0]) < np.abs(c[:, -1])
    c = np.where(small[:, None], c[:, ::-1], c)
    good = np.isfinite(c).all(axis=1) & (np.abs(c[:, 0]) > 1e-12 * np.abs(c).max(axis=1, initial=1e-300))
    companion = np.eye(c.shape[1] - 1, k=-1) * np.ones((np.count_nonzero(good), 1, 1))
    companion[:, 0] = -c[good, 1:] / c[good, :1]
    x = np.full((len(c), c.shape[1] - 1), np.nan + 0j)
    x[good] = np.linalg.eigvals(companion)
    x[small] = 1.0 / np.where(x[small] == 0.0, 1e-300, x[small])
    return x


def _triad(X: F64) -> F64:
    """Orthonormal columns (B, 3, 3) that follow a triangle."""
    first = X[:, 1] - X[:, 0]
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
    third = np.cross(first, X[:, 2] - X[:, 0])
    third /= np.maximum(np.linalg.norm(third, axis=1, keepdims=True), 1e-300)
    return np.stack([first, np.cross(third, first), third], axis=2)

"""One image: vanishing points, planes rectified by parallel and orthogonal lines, heights, and boards."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from thesisrecon.api.bundle import bundle_adjust
from thesisrecon.api.given import checked_sizes
from thesisrecon.arrays import F64, I64, Record, checked, generator, number, numbers, whole_number
from thesisrecon.camera import Camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry import homogeneous
from thesisrecon.geometry.homogeneous import homogenize, quadratic_rows, symmetric, unit_norm
from thesisrecon.geometry.strata import calibration_from_image, nearest_rotation
from thesisrecon.optimize.least_squares import central_differences, minimize_residuals

SAMPLES = 2000  # pairs of segments that a search for one vanishing point draws


@dataclass(frozen=True, eq=False)
class VanishingPoints(Record):
    """Vanishing points of line segments, that of most segments first."""

    v: F64  #: (M, 3) homogeneous, unit norm; the third entry is near 0 if the lines are parallel in the image
    covariance: F64  #: (M, 3, 3) of these unit vectors, rank 2
    group: I64  #: (N,) vanishing point of each segment, -1 for none
    sigma_px: float  #: standard deviation of an endpoint across its line


def vanishing_points(
    segments: F64, *, count: int = 3, threshold_px: float = 1.5, seed: int | Generator = 0
) -> VanishingPoints:
    """Estimate the vanishing points of line segments (HZ 8.6).

    Each is the v of most segments whose endpoints x lie within the threshold of the line m x v through their
    midpoint m; over these the sum of d(x, m x v)^2 is minimised, to first order the maximum likelihood for
    noise of the endpoints (Liebowitz, 2001). The search takes pairs of segments, and goes on without those
    that were found.

    Parameters
    ----------
    segments : array_like (N, 2, 2)
        Endpoints of segments, px.
    count : int
        Largest number of vanishing points; one needs three segments.
    threshold_px : float
        Largest distance of an endpoint.
    seed : int or numpy.random.Generator
        Random seed, or the generator to draw from.

    Returns
    -------
    VanishingPoints
        Points, their covariances, and the group of each segment.

    Raises
    ------
    ValueError
        If a shape is wrong, or a segment has no length.
    StageFailure
        If no three segments share a vanishing point.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import vanishing_points
    >>> start = np.random.default_rng(0).uniform(0, 500, (30, 2))
    >>> v = np.where(np.arange(30)[:, None] < 20, [900.0, 200], [100.0, -3000])
    >>> found = vanishing_points(np.stack([start, start + 0.1 * (v - start)], axis=1))
    >>> (found.v[:2, :2] / found.v[:2, 2:]).round(3).tolist(), np.bincount(found.group).tolist()
    ([[900.0, 200.0], [100.0, -3000.0]], [20, 10])
    """
    caller = "vanishing_points"
    (segments,) = checked(caller, segments=(segments, ("N", 2, 2)))
    rng, limit = generator(caller, seed), number(caller, "threshold_px", threshold_px)
    whole_number(caller, "count", count, 1)
    _require_lengths(caller, segments)
    T = homogeneous.normalizing_transform(segments.reshape(-1, 2))
    ends = homogenize(segments) @ T.T
    back, unit = np.linalg.inv(T), T[0, 0]

    left, found, squares, dof = np.arange(len(ends)), list[tuple[F64, F64]](), 0.0, 0
    group = np.full(len(ends), -1)
    while len(left) >= 3 and len(found) < count:
        first = rng.integers(0, len(left), SAMPLES)
        second = (first + rng.integers(1, len(left), SAMPLES)) % len(left)
        lines = np.cross(ends[left, 0], ends[left, 1])
        some = np.cross(lines[first], lines[second])
        some = some[np.linalg.norm(some, axis=1) > 1e-12]
        support = [np.count_nonzero(np.abs(_line_distances(v, ends[left])) < limit * unit) for v in some]
        v, inside = some[int(np.argmax(support))] if support else np.zeros(3), left
        for _ in range(3):
            inside = left[np.abs(_line_distances(v, ends[left])) < limit * unit]
            if len(inside) < 3 or not v.any():
                break
            v, covariance, cost = _refined(v, ends[inside])
        if len(inside) < 3 or not v.any():
            break
        # To unit vectors in pixels.
        J = central_differences(lambda x: _unit(back @ x), v)
        found.append((_unit(back @ v), J @ covariance @ J.T))
        group[inside] = len(found) - 1
        squares, dof = squares + 2.0 * cost, dof + len(inside) - 2
        left = left[group[left] < 0]
    if not found:
        raise StageFailure.of("no-vanishing-point", threshold_px)
    # An end is off the line through the middle by half the difference of the noise of both ends.
    sigma = float(np.sqrt(2.0 * squares / max(dof, 1))) / unit
    v, covariances = (np.array(each) for each in zip(*found, strict=True))
    return VanishingPoints(v, covariances, group, sigma)


def _unit(v: F64) -> F64:
    return np.asarray(v / np.linalg.norm(v))


def _refined(v: F64, ends: F64) -> tuple[F64, F64, float]:
    """The unit v (3,) of least distances from the lines of segments, its covariance and the cost."""
    across = homogeneous.directions_across(_unit(v))
    fit = minimize_residuals(lambda x: _line_distances(_unit(v) + x @ across, ends), np.zeros(2))
    return _unit(_unit(v) + fit.x @ across), across.T @ fit.covariance @ across, fit.cost


class RectifiedPlane(NamedTuple):
    """Homography H (3, 3) from pixels to the plane, and the vanishing line (3,) of the plane."""

    H: F64
    vanishing_line: F64


def rectify_plane(parallel: Sequence[F64], orthogonal: F64 | None = None) -> RectifiedPlane:
    """Rectify a plane up to an affinity by parallel lines, to a similarity by orthogonal ones too (HZ 2.7).

    The line at infinity of the plane is imaged to the vanishing line l of the groups of parallel lines, and
    H = [1 0 0; 0 1 0; l'] makes it (0, 0, 1). Then each pair of lines l, m that are orthogonal gives an
    equation (l1 m1, l1 m2 + l2 m1, l2 m2) s = 0 in S = A A', the affine part of the dual conic; A^-1 follows.

    Parameters
    ----------
    parallel : sequence of array_like (N, 2, 2)
        Groups of segments, px, at least two of two segments, parallel in the plane within a group.
    orthogonal : array_like (M, 2, 2, 2), optional
        Pairs of segments with a right angle in the plane, M >= 2 of different directions. None: the result is
        affine.

    Returns
    -------
    RectifiedPlane
        ``H`` keeps the centre of the segments in place, and its scale there.

    Raises
    ------
    ValueError
        If a shape is wrong, or there are too few groups or pairs.
    StageFailure
        If the lines do not determine the plane: their vanishing points are one, the pairs have the same
        directions, or no real plane has these right angles.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import rectify_plane
    >>> grid = np.array([[[0, 0], [0, 9]], [[9, 0], [9, 9]], [[0, 0], [9, 0]], [[0, 9], [9, 9]]], float)
    >>> G = np.array([[80.0, 10, 100], [0, 60, 90], [0.01, 0.02, 1]])  # of a tilted plane
    >>> seen = grid @ G[:, :2].T + G[:, 2]
    >>> seen = seen[..., :2] / seen[..., 2:]
    >>> found = rectify_plane([seen[:2], seen[2:]])
    >>> H = found.H @ G
    >>> bool(np.allclose(H[2] / H[2, 2], [0, 0, 1]))  # an affinity
    True
    """
    caller = "rectify_plane"
    given = parallel if np.iterable(parallel) else np.atleast_1d(*numbers(caller, parallel=parallel))
    groups = [checked(caller, parallel=(group, ("N", 2, 2)))[0] for group in given]
    if len(groups) < 2 or min(map(len, groups)) < 2:
        raise ValueError(f"{caller} needs two groups of two parallel segments or more")
    _require_lengths(caller, *groups)
    T = homogeneous.normalizing_transform(np.concatenate(groups).reshape(-1, 2))
    v = []
    for group in groups:
        lines = _lines(group, T)
        v.append(np.linalg.svd(lines)[2][2])
        if len(group) > 2:
            v[-1] = _refined(v[-1], homogenize(group) @ T.T)[0]
    _, sizes, Vt = np.linalg.svd(np.array(v))
    if not sizes[1] > 1e-9:
        raise StageFailure.of("plane-undetermined", "the groups share one vanishing point")
    H, l = np.eye(3), Vt[2] / Vt[2, 2] if abs(Vt[2, 2]) > 1e-9 else Vt[2]
    if Vt[2, 2] == l[2]:
        raise StageFailure.of("plane-undetermined", "its vanishing line passes through the segments")
    H[2] = l
    if orthogonal is not None:
        (pairs,) = checked(caller, orthogonal=(orthogonal, ("M", 2, 2, 2)))
        _require_lengths(caller, pairs)
        if len(pairs) < 2:
            raise ValueError(f"{caller} needs two pairs of orthogonal segments; got {len(pairs)}")
        a, b = (_lines(pairs[:, k], T) @ np.linalg.inv(H) for k in (0, 1))
        a, b = (x / np.linalg.norm(x[:, :2], axis=1, keepdims=True) for x in (a, b))
        rows = np.column_stack([a[:, 0] * b[:, 0], a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0], a[:, 1] * b[:, 1]])
        _, sizes, Vt = np.linalg.svd(rows)
        S = np.array([[Vt[2, 0], Vt[2, 1]], [Vt[2, 1], Vt[2, 2]]]) * np.sign(Vt[2, 0] + Vt[2, 2])
        if not (sizes[1] > 1e-9 and np.linalg.det(S) > 0.0):
            raise StageFailure.of("plane-undetermined", "the right angles give no real plane")
        A = np.linalg.cholesky(S / np.sqrt(np.linalg.det(S)))
        H[:2, :2] = np.linalg.inv(A)
        H = np.block([[H[:2, :2], np.zeros((2, 1))], [l[None]]])
    return RectifiedPlane(np.linalg.inv(T) @ H @ T, _unit(l @ T))


def _require_lengths(caller: str, *segments: F64) -> None:
    for some in segments:
        if not (np.linalg.norm(some[..., 0, :] - some[..., 1, :], axis=-1) > 0.0).all():
            raise ValueError(f"{caller} needs segments with two different ends")


def _lines(segments: F64, T: F64) -> F64:
    """Unit lines (N, 3) of segments in a frame."""
    ends = homogenize(segments) @ T.T
    lines = np.cross(ends[:, 0], ends[:, 1])
    return np.asarray(lines / np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), 1e-300))


def _line_distances(v: F64, ends: F64) -> F64:
    """Distances (N,) of the first ends (N, 2, 3) from the lines through the middles and v."""
    lines = np.cross(ends.mean(axis=1), v)
    return np.asarray(
        np.einsum("ni,ni->n", ends[:, 0], lines) / np.maximum(np.hypot(*lines[:, :2].T), 1e-300)
    )


class Heights(NamedTuple):
    """Heights (N,), and their standard deviations."""

    height: F64
    std: F64


def single_view_heights(
    vertical: F64, horizon: F64, base: F64, top: F64, *, reference: F64, height: float = 1.0,
    sigma_px: float = 1.0,
) -> Heights:  # fmt: skip
    """Measure heights above a plane in one image from one known height (HZ 8.7; Criminisi et al. 2000).

    With the base b and the top t of a vertical segment, the vertical vanishing point v and the vanishing
    line l of the plane, the height is z = -|b x t| / (alpha (l . b) |v x t|): the cross ratio of b, t, v and
    the horizon. The reference determines alpha.

    Parameters
    ----------
    vertical, horizon : array_like (3,)
        Homogeneous vanishing point of the verticals, and vanishing line of the plane.
    base, top : array_like (N, 2)
        Points of the plane and the points above them, px.
    reference : array_like (2, 2)
        Base and top of the segment whose height is known.
    height : float
        Its height.
    sigma_px : float
        Standard deviation of a coordinate of these points.

    Returns
    -------
    Heights
        Heights in units of ``height``, negative below the plane, and their standard deviations by the noise
        of the points alone.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite, or the reference determines no scale.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import single_view_heights
    >>> P = np.array([[800.0, 320, 0, 1000], [0, 240, -800, 2400], [0, 1, 0, 5]])  # z is up
    >>> X = np.array([[0.0, 0, 0, 1], [0, 0, 1.5, 1], [1, 2, 0, 1], [1, 2, 1.8, 1]]) @ P.T
    >>> xy = X[:, :2] / X[:, 2:]
    >>> horizon = np.cross(P[:, 0], P[:, 1])
    >>> found = single_view_heights(P[:, 2], horizon, xy[2:3], xy[3:], reference=xy[:2], height=1.5)
    >>> found.height.round(6).tolist()
    [1.8]
    """
    caller = "single_view_heights"
    v, l, base, top, known = checked(
        caller, vertical=(vertical, (3,)), horizon=(horizon, (3,)), base=(base, ("N", 2)),
        top=(top, ("N", 2)), reference=(reference, (2, 2)),
    )  # fmt: skip
    height, sigma = number(caller, "height", height), number(caller, "sigma_px", sigma_px)

    def ratio(xy: F64) -> F64:
        """-|b x t| / ((l . b) |v x t|) of points (..., 4), with the sign of t - b towards v."""
        b, t = homogenize(xy[..., :2]), homogenize(xy[..., 2:])
        up, cross = np.cross(v, t), np.cross(b, t)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.sum(cross * up, axis=-1) / (np.sum(up * up, axis=-1) * (b @ l)))

    unit = ratio(known.reshape(-1))
    if not 0.0 < np.abs(unit) < np.inf:
        raise ValueError(f"{caller} needs a reference with two different ends and its base off the horizon")
    z = height * ratio(np.hstack([base, top])) / unit
    J = height * central_differences(lambda x: ratio(x) / unit, np.hstack([base, top]))
    of_known = central_differences(lambda x: unit / ratio(x), known.reshape(1, 4))
    return Heights(z, sigma * np.sqrt(np.sum(J**2, axis=-1) + z**2 * np.sum(of_known**2)))


def calibrate_from_homographies(
    H: F64, size: tuple[int, int], *, board: F64 | None = None, xy: F64 | None = None
) -> tuple[Camera, ...]:
    """Calibrate a camera from images of a plane (Zhang, PAMI 22(11), 2000; HZ 8.5).

    With H = (h1 h2 h3) ~ K (r1 r2 t), each image gives h1' w h2 = 0 and h1' w h1 = h2' w h2 for
    w = K^-T K^-1. With the points of the board, the cameras, K without skew and the radial lens are adjusted.

    Parameters
    ----------
    H : array_like (V, 3, 3)
        Homographies from the plane to pixels, V >= 3 of different orientations; or V = 2, without skew.
    size : tuple of int, or image
        Image (width, height).
    board : array_like (N, 2), optional
        Points of a printed board, such as its corners, in any unit of length.
    xy : array_like (V, N, 2), optional
        Their pixels; NaN = not seen.

    Returns
    -------
    tuple of Camera
        One for each image, with one K, in the frame and unit of the plane (z = 0); adjusted ones have ``std``
        and a lens k1, k2.

    Raises
    ------
    ValueError
        If a shape is wrong, or there are fewer than two homographies.
    StageFailure
        If the planes do not determine a camera: they are parallel, for example.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon import calibrate_from_homographies
    >>> K = np.array([[800.0, 0, 320], [0, 810, 240], [0, 0, 1]])
    >>> R = Rotation.from_euler("xy", [[0.5, 0.1], [-0.3, 0.5], [0.2, -0.6]]).as_matrix()
    >>> H = K @ np.dstack([R[:, :, :2], np.tile([[[0.0], [0], [5]]], (3, 1, 1))])
    >>> (calibrate_from_homographies(H, (640, 480))[0].K.round(3) + 0.0).tolist()
    [[800.0, 0.0, 320.0], [0.0, 810.0, 240.0], [0.0, 0.0, 1.0]]
    """
    caller = "calibrate_from_homographies"
    (H,) = checked(caller, H=(H, ("V", 3, 3)))
    if len(H) < 2:
        raise ValueError(f"{caller} needs two homographies or more; got {len(H)}")
    (width, height) = checked_sizes(caller, size, 1)[0].tolist()
    # About the image centre in units of the long side, so that the columns have one scale.
    T = np.linalg.inv(homogeneous.pixel_from_unit(np.array([[width, height]]))[0])
    G = unit_norm(T @ H)
    a, b = G[:, :, 0], G[:, :, 1]
    rows = np.concatenate([quadratic_rows(a, b), quadratic_rows(a, a) - quadratic_rows(b, b)])
    if len(H) == 2:
        rows = np.vstack([rows, np.eye(6)[1]])
    _, sizes, Vt = np.linalg.svd(rows)
    w = symmetric(Vt[5])
    try:
        if not sizes[4] > 1e-7 * sizes[0]:
            raise ValueError("one orientation")
        K = np.linalg.inv(T) @ calibration_from_image(w * np.sign(w[0, 0]))
    except ValueError:
        raise StageFailure.of("planes-undetermined") from None
    cameras = []
    for M in np.linalg.inv(K) @ H:
        M = M * np.sign(M[2, 2]) * 2.0 / (np.linalg.norm(M[:, 0]) + np.linalg.norm(M[:, 1]))
        R = nearest_rotation(np.column_stack([M[:, 0], M[:, 1], np.cross(M[:, 0], M[:, 1])]))
        cameras.append(Camera(K, R, M[:, 2], (width, height)))
    if board is None or xy is None:
        return tuple(cameras)
    (points,) = checked(caller, board=(board, ("N", 2)))
    cameras = [replace(one, K=one.K * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]) for one in cameras]
    X = np.column_stack([points, np.zeros(len(points))])
    free = ("focal", "aspect", "principal_point", "k1", "k2")
    return bundle_adjust(
        cameras, X, xy, free=free, fixed_points=np.ones(len(X), bool), loss="squared"
    ).cameras

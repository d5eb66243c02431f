"""Cameras and points: resection, triangulation, cheirality and models of plain arrays."""

from collections.abc import Sequence
from typing import get_args

import numpy as np
from numpy.random import Generator

from thesisrecon import arrays
from thesisrecon.api.given import calibrated_arrays, checked_sizes
from thesisrecon.arrays import F64, I64, Stratum
from thesisrecon.camera import compose_camera, decompose_camera
from thesisrecon.errors import Notice, require_word
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.optimize.bundle.partial import TriangulationMethod, triangulate_points
from thesisrecon.optimize.ransac import Budget, Resection, resect_robust
from thesisrecon.records import Reconstruction, Tracks


def cheirality(P: F64, X: F64) -> F64:
    """Return chi = det(M)^(1/3) W / t (3.27), positive in front of the camera, 0 at infinity.

    The scales of X and P do not matter, negative ones included. The magnitude is an inverse depth (the thesis
    takes it for a depth), without a unit if P is not normalised.

    Parameters
    ----------
    P, X : array_like (3, 4) and (N, 4)
        Camera and homogeneous points.

    Returns
    -------
    ndarray (N,)

    Examples
    --------
    >>> X = np.array([[0.0, 0.0, 2.0, 1.0], [0.0, 0.0, -2.0, 1.0]])
    >>> cheirality(np.eye(3, 4), X).round(9).tolist()
    [0.5, -0.5]
    """
    P, X = arrays.checked("cheirality", missing=("P", "X"), P=(P, (3, 4)), X=(X, ("N", 4)))
    return np.asarray(np.cbrt(np.linalg.det(P[:, :3])) * X[:, 3] / (X @ P[2]))


def resect(
    X: F64, xy: F64, K: F64 | None = None, *, threshold_px: float | None = 1.0, confidence: float = 0.9999,
    max_samples: int = 100_000, seed: int | Generator = 0,
) -> Resection:  # fmt: skip
    """Estimate a camera from space points and their pixels, some of them wrong (section 6.4; HZ 7).

    RANSAC over samples of six points (DLT), or with K of three (P3P), then the least reprojection error of
    the inliers.

    Parameters
    ----------
    X, xy : array_like (N, 3) and (N, 2)
        Points, N >= 6 (N >= 4 with K), and their pixels.
    K : ndarray (3, 3), optional
        Calibration matrix; None: estimated, which needs points off one plane.
    threshold_px : float or None
        Reprojection error of an inlier during the search; None: all points are inliers.
    confidence, max_samples : float, int
        Probability of a sample without outliers at which the search ends, and the largest number of samples.
    seed : int or numpy.random.Generator
        Random seed, or the generator to draw from.

    Returns
    -------
    Resection
        Camera, inliers, noise and covariance; ``competing_poses`` if another pose fits as well.

    Raises
    ------
    StageFailure
        If there are too few points, no more inliers than chance explains, all points lie in one plane and K
        is not given, or points are behind the camera that fits them, as in left-handed coordinates.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Camera, resect
    >>> K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> camera = Camera(K, np.eye(3), np.array([0.2, -0.1, 4.0]), (640, 480))
    >>> X = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    >>> found = resect(X, camera.project(X))
    >>> float(found.K[0, 0].round(6)), found.t.round(6).tolist()
    (500.0, [0.2, -0.1, 4.0])
    """
    X, xy = arrays.checked("resect", X=(X, ("N", 3)), xy=(xy, ("N", 2)))
    if K is not None:
        (K,) = arrays.numbers("resect", K=K)
        arrays.require_calibration("resect", K)
    require_threshold(threshold_px, xy)
    budget = search_budget(confidence, max_samples)
    return resect_robust(X, xy, K, threshold_px, budget, arrays.generator("resect", seed))


def triangulate(P: F64, xy: F64, *, method: TriangulationMethod | None = None) -> F64:
    """Triangulate space points by one of the methods of section 6.3 (HZ 12).

    Parameters
    ----------
    P, xy : array_like (V, 3, 4) and (V, N, 2)
        V >= 2 cameras of any scale, and pixels; NaN or masked for not observed.
    method : {"polynomial", "linear", "midpoint", "iterated", "optimal"}, optional
        "polynomial": optimal for exactly two views (6.3.3); "linear" and "iterated": algebraic (6.3.1);
        "midpoint": metric frames only (6.3.2); "optimal": least reprojection error from any number of views.
        None: "polynomial" for two views, else "optimal".

    Returns
    -------
    ndarray (N, 4)
        Homogeneous points; zeros if a point is observed in fewer than two views or from one centre only, and
        of "midpoint" if its rays are parallel.

    Raises
    ------
    ValueError
        Unknown method, wrong shapes, infinite pixels, or unsuitable cameras.

    Examples
    --------
    >>> P = np.stack([np.eye(3, 4), np.hstack([np.eye(3), [[-1.0], [0.0], [0.0]]])])
    >>> X = triangulate(P, np.array([[[0.0, 0.0]], [[-0.5, 0.0]]]))
    >>> np.allclose(X / X[:, 3:], [[0.0, 0.0, 2.0, 1.0]])
    True
    """
    if method is not None:
        require_word("method", method, get_args(TriangulationMethod))
    P, xy = arrays.checked("triangulate", missing=("xy",), P=(P, ("V", 3, 4)), xy=(xy, ("V", "N", 2)))
    if len(P) < 2:
        raise ValueError(f"triangulate needs at least two cameras; got {len(P)}")
    if not np.abs(P).max(axis=(1, 2)).all():
        raise ValueError("triangulate needs cameras that are not all zero")
    if np.isinf(xy).any():
        raise ValueError("triangulate needs finite pixels, or NaN for not seen; some are infinite")
    return triangulate_points(P, xy, method=method)


def reconstruction_from_cameras(
    *cameras: F64, sizes: I64, X: F64 | None = None, xy: F64 | None = None,
    stratum: Stratum = "metric", sigma_px: float = 1.0,
) -> Reconstruction:  # fmt: skip
    """Return the reconstruction of plain arrays, with cameras P = K [R t] (section 3.5; HZ 6.1).

    Parameters
    ----------
    *cameras : ndarray
        P (V, 3, 4), or K (V, 3, 3) or (3, 3), R (V, 3, 3) and t (V, 3) of a metric frame.
    sizes : array_like (V, 2) or (2,), or images
        Image width and height, or the images.
    X, xy : ndarray (N, 3) or (N, 4), ndarray (V, N, 2), optional
        Points, and their pixels, NaN where not observed; X None: triangulated from xy.
    stratum, sigma_px : {"metric", "affine", "projective"}, float
        Frame of P, and the noise of one image coordinate.

    Returns
    -------
    Reconstruction
        All views registered; ``ValueError`` if the arrays do not fit together, K is no calibration matrix
        or R no rotation as in :class:`thesisrecon.Camera`, or pixels lie far outside their images.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import reconstruction_from_cameras
    >>> K, R, t = np.diag([800.0, 800, 1]), np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-1, 0, 0]])
    >>> reconstruction_from_cameras(K, R, t, sizes=(640, 480)).P[1].tolist()
    [[800.0, 0.0, 0.0, -800.0], [0.0, 800.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    """
    P, K, sizes = _checked_cameras(cameras, sizes, metric=stratum == "metric")
    Xh, view, point, pixels = _checked_points(P, sizes, X, xy, finite=stratum == "metric")
    tracks = Tracks(view, point, pixels, len(P), len(Xh))
    valid = np.any(Xh != 0.0, axis=1)
    return Reconstruction(
        stratum, P, Xh, np.ones(len(P), dtype=bool), valid, valid[point], tracks, sizes, sigma_px,
        ("",) * len(P), K, None if K is None else np.zeros((len(P), 3)),
    )  # fmt: skip


def _checked_cameras(cameras: Sequence[F64], sizes: I64, *, metric: bool) -> tuple[F64, F64 | None, I64]:
    """P (V, 3, 4), K (V, 3, 3) of a metric frame, and sizes (V, 2), of P alone or of K, R and t."""
    caller = "reconstruction_from_cameras"
    K: F64 | None = None
    if len(cameras) == 1:
        (P,) = arrays.checked(caller, P=(cameras[0], ("V", 3, 4)))
        if metric:
            K, R, t = (np.stack(part) for part in zip(*map(decompose_camera, P), strict=True))
            P = compose_camera(K, R, t)
    elif len(cameras) == 3 and metric:
        K, R, t = calibrated_arrays(caller, *cameras)
        arrays.require_finite(caller, K, R, t)
        for one in K:
            arrays.require_calibration(caller, one)
        arrays.require_rotations(caller, R)
        P = compose_camera(K, R, t)
    else:
        raise ValueError(f"{caller} needs P, or K, R and t of a metric frame; got {len(cameras)} arrays")
    return P, K, checked_sizes(caller, sizes, len(P))


def outside_by(view: I64, xy: F64, sizes: I64) -> F64:
    """How far (K,) pixels (K, 2) lie outside the images of their views, over the long side; else negative."""
    size = sizes[view]
    return np.asarray((np.maximum(-xy, xy - size) / size.max(axis=1, keepdims=True)).max(axis=1))


def require_inside(view: I64, xy: F64, sizes: I64) -> None:
    """Raise ``ValueError`` if pixels (K, 2) lie far outside the images of their views; ``sizes`` (V, 2)."""
    size, reach = sizes[view], outside_by(view, xy, sizes)
    # Pixels this far outside show that the size is wrong, for example height x width.
    if len(reach) and reach.max() > 0.1:
        k = int(reach.argmax())
        raise ValueError(Notice("pixels-outside", view[k], tuple(size[k].tolist()), reach[k]))


def _checked_points(
    P: F64, sizes: I64, X: F64 | None, xy: F64 | None, *, finite: bool
) -> tuple[F64, I64, I64, F64]:
    """Points (N, 4), zeros where unknown, and view, point and pixels (K,), (K,), (K, 2) of observations."""
    caller = "reconstruction_from_cameras"
    if xy is None:
        xy = np.full((len(P), 0 if X is None else len(X), 2), np.nan)
    (xy,) = arrays.numbers(caller, missing=("xy",), xy=xy)
    arrays.require_shapes(caller, P=(P, ("V", 3, 4)), xy=(xy, ("V", "N", 2)))
    point, views = np.nonzero(np.isfinite(xy).all(axis=2).T)
    require_inside(views, xy[views, point], sizes)
    if X is None:
        X = triangulate_points(P, xy) if xy.shape[1] else np.zeros((0, 4))
    (X,) = arrays.numbers(caller, X=X)
    X = homogenize(X) if X.ndim == 2 and X.shape[1] == 3 else X
    arrays.require_shapes(caller, X=(X, ("N", 4)), xy=(xy[0], ("N", 2)))
    arrays.require_finite(caller, X)
    if finite:
        near = np.abs(X[:, 3:]) > 1e-12 * np.linalg.norm(X, axis=1, keepdims=True)
        X = np.where(near, X / np.where(near, X[:, 3:], 1.0), 0.0)
    return X, views, point, xy[views, point]


def require_threshold(threshold_px: float | None, *points: F64) -> None:
    """Raise ``ValueError`` unless a threshold is None, or positive and smaller than the extents of points."""
    if threshold_px is None:
        return
    given = arrays.number("the search", "threshold_px", threshold_px, "a positive number or None")
    if not 0.0 < given < np.inf:
        raise ValueError(Notice("no-threshold", threshold_px))
    extents = [float(np.ptp(xy, axis=0).max()) for xy in points if len(xy)]
    if extents and 0.0 < (extent := min(extents)) <= threshold_px:
        raise ValueError(Notice("large-threshold", extent, threshold_px))


def search_budget(confidence: float, max_samples: int) -> Budget:
    """The budget of a search, checked."""
    if not 0.0 < arrays.number("the search", "confidence", confidence) < 1.0:
        raise ValueError(f"confidence must lie between 0 and 1; got {confidence}")
    return Budget(confidence, arrays.whole_number("the search", "max_samples", max_samples, 1))

"""Cameras and points: resection, triangulation, cheirality and bundle adjustment with covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import (
    B8,
    F64,
    I64,
    Stratum,
    require_calibration,
    require_finite,
    require_rotations,
    require_shapes,
)
from thesisrecon.camera import Camera, compose_camera, decompose_camera
from thesisrecon.errors import unknown_word
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.optimize.bundle.metric import MAX_SIGMAS_TO_MINIMUM, BundleOptions, refine_metric_bundle
from thesisrecon.optimize.bundle.metric_kernels import POSE_DOF, MetricCameras
from thesisrecon.optimize.bundle.observations import Observations, sort_observations
from thesisrecon.optimize.bundle.partial import TriangulationMethod, triangulate_points
from thesisrecon.optimize.ransac import Budget
from thesisrecon.optimize.robust_resection import Resection, resect_robust
from thesisrecon.records import IntrinsicsPrior, Reconstruction, Tracks

CameraInput = Sequence[Camera] | tuple[F64, F64, F64] | Mapping[str, Camera] | Reconstruction
"""Cameras, (K, R, t), cameras by image name, or a metric reconstruction."""
COLUMNS: Mapping[str, tuple[int, ...]] = {
    "focal": (0,), "aspect": (1,), "skew": (2,), "principal_point": (3, 4), "k1": (5,), "k2": (6,),
    "k3": (7,),
}  # fmt: skip
"""Rows and columns of each intrinsic in the covariance."""
STD_NAMES = ("focal_px", "aspect", "skew_px", "principal_x_px", "principal_y_px", "k1", "k2", "k3")
"""Names of the standard deviations in :attr:`thesisrecon.Camera.std`."""


@dataclass(frozen=True)
class BundleAdjustment:
    """Refined cameras and points with their uncertainty.

    All covariances are those of the inner gauge (free network adjustment): among the solutions that differ by
    a similarity, the one that moves the cameras least. They contain the uncertainty of all other unknowns.
    """

    cameras: tuple[Camera, ...]  #: with ``std`` of their intrinsics (0: not free)
    X: F64  #: (N, 3)
    residual_px: F64  #: (V, N, 2) or (K, 2) projection minus observation; NaN where there is none
    sigma_px: float  #: standard deviation of one image coordinate, estimated from the residuals
    cost: float  #: 1/2 sum rho with the priors, in units of the noise that weighted the residuals
    #: (V, 6, 6) of the motion x -> exp(w) x + d in the camera frame, (w in rad, d); infinite if unseen
    pose_covariance: F64
    #: (V, 8, 8) in the order focal, aspect, skew, principal x and y, k1, k2, k3; zero where not free
    intrinsics_covariance: F64
    point_covariance: F64  #: (N, 3, 3), infinite for points in fewer than two views
    #: distance of the cameras from the minimum in standard deviations, by the gradient: none is farther
    sigmas_to_minimum: float

    @property
    def converged(self) -> bool:
        """Whether another adjustment would move no camera parameter by a tenth of its standard deviation."""
        return self.sigmas_to_minimum <= MAX_SIGMAS_TO_MINIMUM

    @property
    def centre_covariance(self) -> F64:
        """Covariance of the camera centres (V, 3, 3)."""
        R, translation = np.array([camera.R for camera in self.cameras]), self.pose_covariance[:, 3:, 3:]
        seen = np.isfinite(translation).all(axis=(1, 2), keepdims=True)
        moved = np.swapaxes(R, 1, 2) @ np.where(seen, translation, 0.0) @ R
        return np.asarray(np.where(seen, moved, np.diag([np.inf] * 3)))


def bundle_adjust(
    cameras: CameraInput, X: F64 | None = None, xy: F64 | Tracks | Observations | None = None, *,
    sizes: I64 | None = None, shared: bool | I64 = True, free: Sequence[str] = ("focal", "k1"),
    prior: Mapping[str, float] | None = None, loss: str = "huber", loss_px: float | None = None,
    sigma_px: float | None = None, max_iterations: int = 200,
) -> BundleAdjustment:  # fmt: skip
    """Refine cameras and points together, with their covariances (6.7, HZ 18.1 and A6.3).

    Minimises sum rho(|x - project(X)|^2 / sigma^2) + sum ((q - q0) / std)^2 over poses, points and the free
    intrinsics q.

    Parameters
    ----------
    cameras : sequence of Camera, tuple (K, R, t) or Reconstruction
        Initial cameras; or K (3, 3) or (V, 3, 3), R (V, 3, 3) and t (V, 3) with ``sizes``; or a metric
        reconstruction: its registered views and, if X and xy are not given, its valid points and inliers.
    X : ndarray (N, 3)
        Initial points.
    xy : ndarray (V, N, 2), Tracks or Observations
        Pixels of the points, NaN = not seen; or a list with ``view_index``, ``point_index`` and ``xy``.
    sizes : array_like (V, 2) or (2,), optional
        Image width and height, for plain arrays.
    shared : bool or ndarray (V,) of int
        True: images of the same size share their free intrinsics, which start at their mean; False: each
        image has its own; or a camera number per image.
    free : sequence of str
        Intrinsics to refine: "focal", "aspect", "skew", "principal_point", "k1", "k2", "k3".
    prior : mapping of str to float, optional
        Standard deviations of free intrinsics about the given cameras, of shared ones about their mean:
        relative for "focal", in pixels for "principal_point" and "skew".
    loss, loss_px : {"huber", "squared"}, float
        Loss, and the residual at which Huber's loss becomes linear (None: two standard deviations of the
        noise).
    sigma_px : float, optional
        Standard deviation of one image coordinate. None: estimated from the residuals.
    max_iterations : int
        Maximum number of linear solves; if they do not suffice, ``converged`` is false.

    Returns
    -------
    BundleAdjustment
        Cameras, points, residuals and covariances; poses and points without observations are unchanged.

    Raises
    ------
    ValueError
        If the arrays do not fit together, pixels lie far outside their images, most points lie behind the
        cameras, there are fewer equations than unknowns, or an option is invalid.

    Notes
    -----
    The covariances are those of the linearised problem at the minimum, with the noise estimated from the
    residuals (``sigma_px`` only weights the data against the prior). The blocks of the points follow from the
    Schur complement, V^-1 + V^-1 W' S^-1 W V^-1, without approximation.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon import Camera, bundle_adjust
    >>> rng, K = np.random.default_rng(0), np.array([[800.0, 0, 319.5], [0, 800, 239.5], [0, 0, 1]])
    >>> R = Rotation.from_euler("yx", rng.uniform(-0.5, 0.5, (6, 2))).as_matrix()
    >>> true = [Camera(K, r, np.array([0.0, 0, 5]), (640, 480)) for r in R]
    >>> X = rng.uniform(-1, 1, (60, 3))
    >>> xy = np.stack([camera.project(X) for camera in true]) + 0.5 * rng.normal(size=(6, 60, 2))
    >>> found = bundle_adjust(true, X + 0.01 * rng.normal(size=X.shape), xy, prior={"k1": 0.05})
    >>> bool(abs(found.cameras[0].K[0, 0] - 800) < 4 * found.cameras[0].std["focal_px"])
    True
    >>> found.point_covariance.shape, round(found.sigma_px, 1)
    ((60, 3, 3), 0.5)
    """
    views, X, observed, dense = _problem(cameras, X, xy, sizes)
    free = (free,) if isinstance(free, str) else tuple(free)
    chosen = _free(free)
    if loss not in ("huber", "squared"):
        raise ValueError(unknown_word("loss", loss, ("huber", "squared")))
    start = _start(views, shared, chosen)
    knowledge = _prior(start.intrinsics, prior or {}, chosen, free)
    _check(start, X, observed, chosen, bool(prior))
    _require_inside(observed.view_index, observed.xy, np.array([view.size for view in views]))
    noise = weight = 1.0 if sigma_px is None else sigma_px
    # A first pass estimates noise that is not given: the weight of the prior and the width depend on it.
    for last in (True,) if sigma_px is not None else (False, True):
        width = 2.0 * noise if loss_px is None else loss_px
        width = np.inf if loss == "squared" else width
        options = BundleOptions(
            sigma_px=noise, loss_px=width, max_iterations=max_iterations, settled=1e-6,
            covariance=last, point_covariance=last,
        )  # fmt: skip
        fit = refine_metric_bundle(start, X, observed, free=chosen, prior=knowledge, options=options)
        start, X, weight, noise = fit.cameras, fit.X, noise, max(fit.sigma_px, 1e-6)
    assert fit.pose_covariance is not None
    assert fit.point_covariance is not None
    residual = fit.residual_px
    if dense is not None:
        residual = np.full(dense, np.nan)
        residual[observed.view_index, observed.point_index] = fit.residual_px
    K, std = fit.cameras.K, np.sqrt(np.diagonal(fit.intrinsics_covariance, axis1=1, axis2=2))
    rows, unseen = fit.cameras.intrinsics, np.isin(np.arange(len(views)), observed.view_index, invert=True)
    poses = np.where(unseen[:, None, None], np.diag([np.inf] * POSE_DOF), fit.pose_covariance)
    stds = [dict(zip(STD_NAMES, row, strict=True)) for row in std.tolist()]
    R, t = fit.cameras.R, fit.cameras.t
    refined = tuple(
        replace(view, K=K[i], R=R[i], t=t[i], distortion=rows[i, 5:], std=stds[i])
        for i, view in enumerate(views)
    )
    return BundleAdjustment(
        refined, fit.X, residual, fit.sigma_px, fit.cost, poses, fit.intrinsics_covariance,
        fit.point_covariance, fit.sigmas_to_minimum * weight / noise,
    )  # fmt: skip


def _problem(
    cameras: CameraInput, X: F64 | None, xy: F64 | Tracks | Observations | None, sizes: I64 | None,
) -> tuple[list[Camera], F64, Observations, tuple[int, ...] | None]:  # fmt: skip
    """Cameras, points and observations, and the shape of xy if it was dense."""
    views = as_cameras("bundle_adjust", cameras, sizes)
    if isinstance(cameras, Reconstruction) and X is None and xy is None:
        return views, *_of_reconstruction(cameras), None
    if X is None or xy is None:
        raise ValueError("bundle_adjust needs X (N, 3) and xy, the pixels of the points; got None")
    X, shape = np.asarray(X, dtype=np.float64), None
    if isinstance(xy, Tracks | Observations):
        observed = Observations(xy.view_index, xy.point_index, xy.xy)
    else:
        xy = np.asarray(xy, dtype=np.float64)
        shape = (len(views), len(X), 2)
        if xy.shape != shape:
            raise ValueError(
                f"bundle_adjust of {len(views)} cameras and {len(X)} points needs xy {shape}; got {xy.shape}"
            )
        point, view = np.nonzero(np.isfinite(xy).all(axis=2).T)
        observed = Observations(view, point, xy[view, point])
    require_shapes("bundle_adjust", X=(X, ("N", 3)))
    return views, X, observed, shape


def _of_reconstruction(r: Reconstruction) -> tuple[F64, Observations]:
    """Valid points, and the inlier observations in registered views."""
    tracks, used = r.tracks, r.used
    view, point = np.cumsum(r.registered) - 1, np.cumsum(r.valid) - 1
    X = r.X[r.valid]
    observed = Observations(view[tracks.view_index[used]], point[tracks.point_index[used]], tracks.xy[used])
    return np.asarray(X[:, :3] / X[:, 3:]), observed


def _free(names: Sequence[str]) -> B8:
    """Columns (8,) of the intrinsics to refine."""
    chosen = np.zeros(len(STD_NAMES), dtype=bool)
    for name in names:
        if name not in COLUMNS:
            raise ValueError(unknown_word("intrinsic in free", name, COLUMNS))
        chosen[list(COLUMNS[name])] = True
    return chosen


def _start(views: Sequence[Camera], shared: bool | I64, free: B8) -> MetricCameras:
    """The cameras as a table with a row per view; views with equal numbers share the free columns."""
    n = len(views)
    if isinstance(shared, bool | np.bool_):
        sizes = list(dict.fromkeys(view.size for view in views))
        number = np.array([sizes.index(view.size) for view in views]) if shared else np.arange(n)
    else:
        number = np.asarray(shared)
        if number.shape != (n,) or number.dtype.kind not in "iu":
            raise ValueError(f"shared must be True, False or a camera number per view ({n},); got {number}")
    table = np.zeros((n, len(STD_NAMES)))
    for row, K in zip(table, (view.K for view in views), strict=True):
        row[:5] = K[0, 0], K[1, 1] / K[0, 0], K[0, 1], K[0, 2], K[1, 2]
    table[:, 5:] = radial_coefficients("bundle_adjust", views)
    R, t = (np.array([getattr(view, name) for view in views]) for name in ("R", "t"))
    sharing = np.where(free, number[:, None], np.arange(n)[:, None])
    return MetricCameras(R, t, table, np.arange(n), sharing)


def _prior(table: F64, prior: Mapping[str, float], free: B8, names: Sequence[str]) -> IntrinsicsPrior:
    """Gaussian prior of the table of intrinsics (V, 8)."""
    std = np.full(table.shape, np.inf)
    for name, value in prior.items():
        if name not in COLUMNS or not free[list(COLUMNS[name])].all():
            raise ValueError(f"prior has {name!r}, which is not among the free intrinsics {tuple(names)}")
        if not 0.0 < value < np.inf:
            raise ValueError(f"prior[{name!r}] is a standard deviation and must be above 0; got {value}")
        std[:, list(COLUMNS[name])] = value
    return IntrinsicsPrior.unshared(table, std)


def _check(start: MetricCameras, X: F64, observed: Observations, free: B8, bound: bool) -> None:
    """Raise ``ValueError`` if most points are behind the cameras, or for fewer equations than unknowns."""
    sort_observations(observed, len(start.R), len(X))
    view, point = observed.view_index, observed.point_index
    require_finite("bundle_adjust, for points with observations,", X[point])
    depth = np.einsum("kb,kb->k", start.R[view, 2], X[point]) + start.t[view, 2]
    behind = float(np.mean(depth <= 0.0)) if len(depth) else 0.0
    # Of most points only if the poses use another convention.
    if behind > 0.5:
        rule = "R is world to camera and t = -R centre"
        raise ValueError(f"{behind:.0%} of the observed points lie behind their cameras; {rule}")
    seen = np.unique(view)
    assert start.shared is not None
    own = sum(len(np.unique(start.shared[seen, c])) for c in np.flatnonzero(free)) if not bound else 0
    unknowns = POSE_DOF * len(seen) + 3 * len(np.unique(point)) + own - 7  # those of a similarity
    if 2 * len(view) < unknowns or len(seen) < 2:
        given = f"{len(view)} observations in {len(seen)} views give {2 * len(view)} equations"
        rule = "bundle_adjust needs two views and as many equations as unknowns"
        raise ValueError(f"{rule}; {given} for {unknowns} unknowns")


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
    P, X = np.asarray(P, dtype=np.float64), np.asarray(X, dtype=np.float64)
    require_shapes("cheirality", P=(P, (3, 4)), X=(X, ("N", 4)))
    return np.asarray(np.cbrt(np.linalg.det(P[:, :3])) * X[:, 3] / (X @ P[2]))


def resect(
    X: F64,
    xy: F64,
    K: F64 | None = None,
    *,
    threshold_px: float | None = 1.0,
    confidence: float = 0.9999,
    max_samples: int = 100_000,
    seed: int | Generator = 0,
) -> Resection:
    """Estimate a camera from space points and their pixels, some of them wrong (section 6.4).

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
        Camera, inliers, noise and covariance.

    Raises
    ------
    ValueError
        If the shapes are wrong, numbers are not finite, or K is not upper triangular with positive focal
        lengths and K33 = 1.
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
    X, xy = np.asarray(X, dtype=np.float64), np.asarray(xy, dtype=np.float64)
    require_shapes("resect", X=(X, ("N", 3)), xy=(xy, ("N", 2)))
    if K is not None:
        K = np.asarray(K, dtype=np.float64)
        require_calibration("resect", K)
    require_finite("resect", X, xy)
    require_threshold(threshold_px, xy)
    budget = search_budget(confidence, max_samples)
    return resect_robust(X, xy, K, threshold_px, budget, np.random.default_rng(seed))


def triangulate(P: F64, xy: F64, *, method: TriangulationMethod | None = None) -> F64:
    """Triangulate space points by one of the methods of section 6.3 (HZ 12).

    Parameters
    ----------
    P, xy : ndarray (V, 3, 4) and (V, N, 2)
        V >= 2 cameras of any scale, and pixels; NaN for not observed.
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
    if method is not None and method not in get_args(TriangulationMethod):
        raise ValueError(f"method must be one of {', '.join(get_args(TriangulationMethod))}; got {method!r}")
    if np.iscomplexobj(P) or np.iscomplexobj(xy):
        raise ValueError("triangulate needs real numbers; got complex ones")
    P, xy = np.ascontiguousarray(P, dtype=np.float64), np.ascontiguousarray(xy, dtype=np.float64)
    require_shapes("triangulate", P=(P, ("V", 3, 4)), xy=(xy, ("V", "N", 2)))
    if len(P) < 2:
        raise ValueError(f"triangulate needs at least two cameras; got {len(P)}")
    require_finite("triangulate, for its cameras,", P)
    if not np.abs(P).max(axis=(1, 2)).all():
        raise ValueError("triangulate needs cameras that are not all zero")
    if np.isinf(xy).any():
        raise ValueError("triangulate needs finite pixels, or NaN for not seen; some are infinite")
    return triangulate_points(P, xy, method=method)


def reconstruction_from_cameras(
    *cameras: F64, sizes: I64, X: F64 | None = None, xy: F64 | None = None,
    stratum: Stratum = "metric", sigma_px: float = 1.0,
) -> Reconstruction:  # fmt: skip
    """Return the reconstruction of plain arrays.

    Parameters
    ----------
    *cameras : ndarray
        P (V, 3, 4), or K (V, 3, 3) or (3, 3), R (V, 3, 3) and t (V, 3) of a metric frame.
    sizes : array_like (V, 2) or (2,)
        Image width and height.
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


def _calibrated(caller: str, K: F64, R: F64, t: F64) -> tuple[F64, F64, F64]:
    """K (V, 3, 3), also of one camera, R (V, 3, 3) and t (V, 3)."""
    K, R, t = (np.asarray(one, dtype=np.float64) for one in (K, R, t))
    K = np.broadcast_to(K, (len(R), 3, 3)) if K.ndim == 2 else K
    require_shapes(caller, K=(K, ("V", 3, 3)), R=(R, ("V", 3, 3)), t=(t, ("V", 3)))
    return K, R, t


def _checked_sizes(caller: str, sizes: I64, n: int) -> I64:
    """Image sizes (n, 2) of (n, 2) or (2,) whole numbers above 0."""
    given = np.asarray(sizes)
    if given.shape not in ((2,), (n, 2)) or not np.isin(given.dtype.kind, ("i", "u", "f")):
        raise ValueError(f"{caller} needs sizes (V, 2) or (2,), width and height; got {given.shape}, V = {n}")
    if not (np.isfinite(given).all() and (given >= 1).all() and (given == np.round(given)).all()):
        raise ValueError(f"{caller} needs sizes of whole numbers above 0; got {given.tolist()}")
    return np.broadcast_to(given, (n, 2)).astype(np.int64)


def _checked_cameras(cameras: Sequence[F64], sizes: I64, *, metric: bool) -> tuple[F64, F64 | None, I64]:
    """P (V, 3, 4), K (V, 3, 3) of a metric frame, and sizes (V, 2), of P alone or of K, R and t."""
    caller = "reconstruction_from_cameras"
    K: F64 | None = None
    if len(cameras) == 1:
        P = np.asarray(cameras[0], dtype=np.float64)
        require_shapes(caller, P=(P, ("V", 3, 4)))
        require_finite(caller, P)
        if metric:
            K, R, t = (np.stack(part) for part in zip(*map(decompose_camera, P), strict=True))
            P = compose_camera(K, R, t)
    elif len(cameras) == 3 and metric:
        K, R, t = _calibrated(caller, *cameras)
        require_finite(caller, K, R, t)
        for one in K:
            require_calibration(caller, one)
        require_rotations(caller, R)
        P = compose_camera(K, R, t)
    else:
        raise ValueError(f"{caller} needs P, or K, R and t of a metric frame; got {len(cameras)} arrays")
    return P, K, _checked_sizes(caller, sizes, len(P))


def _require_inside(view: I64, xy: F64, sizes: I64) -> None:
    """Raise ``ValueError`` if pixels (K, 2) lie far outside the images of their views; ``sizes`` (V, 2)."""
    size = sizes[view]
    reach = (np.maximum(-xy, xy - size) / size.max(axis=1, keepdims=True)).max(axis=1)
    # Pixels this far outside show that the size is wrong, for example height x width.
    if len(reach) and reach.max() > 0.1:
        k = int(reach.argmax())
        what = f"its size {tuple(size[k].tolist())} by {reach[k]:.0%} of the long side"
        raise ValueError(f"pixels of view {view[k]} lie outside {what}; sizes are (width, height)")


def _checked_points(
    P: F64, sizes: I64, X: F64 | None, xy: F64 | None, *, finite: bool
) -> tuple[F64, I64, I64, F64]:
    """Points (N, 4), zeros where unknown, and view, point and pixels (K,), (K,), (K, 2) of observations."""
    caller = "reconstruction_from_cameras"
    if xy is None:
        xy = np.full((len(P), 0 if X is None else len(X), 2), np.nan)
    xy = np.asarray(xy, dtype=np.float64)
    require_shapes(caller, P=(P, ("V", 3, 4)), xy=(xy, ("V", "N", 2)))
    point, views = np.nonzero(np.isfinite(xy).all(axis=2).T)
    _require_inside(views, xy[views, point], sizes)
    if X is None:
        X = triangulate_points(P, xy) if xy.shape[1] else np.zeros((0, 4))
    X = np.asarray(X, dtype=np.float64)
    X = homogenize(X) if X.ndim == 2 and X.shape[1] == 3 else X
    require_shapes(caller, X=(X, ("N", 4)), xy=(xy[0], ("N", 2)))
    require_finite(caller, X)
    if finite:
        near = np.abs(X[:, 3:]) > 1e-12 * np.linalg.norm(X, axis=1, keepdims=True)
        X = np.where(near, X / np.where(near, X[:, 3:], 1.0), 0.0)
    return X, views, point, xy[views, point]


def require_threshold(threshold_px: float | None, *points: F64) -> None:
    """Raise ``ValueError`` unless a threshold is None, or positive and smaller than the extents of points."""
    if threshold_px is None:
        return
    if not 0.0 < threshold_px < np.inf:
        raise ValueError(
            f"threshold_px must be positive and finite, or None for no search; got {threshold_px}"
        )
    extents = [float(np.ptp(xy, axis=0).max()) for xy in points if len(xy)]
    if extents and 0.0 < (extent := min(extents)) <= threshold_px:
        raise ValueError(
            f"threshold_px must be smaller than the extent of the points, {extent:.3g}, which it cannot tell "
            f"from wrong ones otherwise; got {threshold_px:g}"
        )


def search_budget(confidence: float, max_samples: int) -> Budget:
    """The budget of a search, checked."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie between 0 and 1; got {confidence}")
    if isinstance(max_samples, bool) or not int(max_samples) == max_samples or max_samples < 1:
        raise ValueError(f"max_samples must be a whole number of at least 1; got {max_samples}")
    return Budget(confidence, int(max_samples))


def as_cameras(
    caller: str, cameras: CameraInput, sizes: I64 | None = None, names: Sequence[str] = ()
) -> list[Camera]:
    """The cameras in order; the registered ones of a reconstruction; of a mapping those of ``names``."""
    if isinstance(cameras, Reconstruction):
        return _registered_cameras(caller, cameras)
    if isinstance(cameras, Mapping):
        missing = [name for name in names if name not in cameras]
        if missing:
            first = next(iter(cameras), None)
            raise ValueError(f"{caller} got no camera for {missing[0]}; the first camera is that of {first}")
        return [cameras[name] for name in names or cameras]
    given: list[Any] = list(cameras) if isinstance(cameras, Sequence) else []
    if given and all(isinstance(one, Camera) for one in given):
        return given
    if len(given) != 3 or any(isinstance(one, Camera | str) for one in given):
        kinds = "cameras as thesisrecon.Camera, result.reconstruction, or a tuple (K, R, t) of arrays"
        raise ValueError(f"{caller} needs {kinds}; got a {type(cameras).__name__}")
    if sizes is None:
        raise ValueError(f"{caller} needs sizes (V, 2) or (2,), width and height, with (K, R, t)")
    K, R, t = _calibrated(caller, *given)
    return [Camera(*one) for one in zip(K, R, t, _checked_sizes(caller, sizes, len(R)), strict=True)]


def _registered_cameras(caller: str, r: Reconstruction) -> list[Camera]:
    if r.stratum != "metric" or r.K is None:
        raise ValueError(f"{caller} needs a metric reconstruction with K; got {r.stratum}")
    lenses = np.zeros((len(r.P), 3)) if r.distortion is None else r.distortion
    views = []
    for i in np.flatnonzero(r.registered):
        Rt = np.linalg.solve(r.K[i], r.P[i])
        views.append(Camera(r.K[i], Rt[:, :3], Rt[:, 3], tuple(r.sizes[i].tolist()), lenses[i]))
    return views


def radial_coefficients(caller: str, views: Sequence[Camera]) -> F64:
    """Distortion k1, k2, k3 (V, 3) of cameras; ``ValueError`` if one has further coefficients."""
    table = np.zeros((len(views), 3))
    for row, view in zip(table, views, strict=True):
        lens = np.zeros(0) if view.distortion is None else view.distortion
        if np.any(lens[3:]):
            raise ValueError(f"{caller} takes distortion by k1, k2, k3; got {len(lens)} coefficients")
        row[: len(lens[:3])] = lens[:3]
    return table

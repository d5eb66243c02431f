"""Bundle adjustment in one call: cameras and points refined together, with their covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.api.cameras import require_inside
from thesisrecon.api.given import CameraInput, as_cameras, points_of_reconstruction, radial_coefficients
from thesisrecon.arrays import B8, F64, I64, Record, numbers, require_finite, require_shapes
from thesisrecon.camera import Camera
from thesisrecon.errors import unknown_word
from thesisrecon.optimize.bundle.metric import MAX_SIGMAS_TO_MINIMUM, BundleOptions, refine_metric_bundle
from thesisrecon.optimize.bundle.projection import POSE_DOF, MetricCameras, Observations, sort_observations
from thesisrecon.records import IntrinsicsPrior, Reconstruction, Tracks
from thesisrecon.results import RunResult

COLUMNS: Mapping[str, tuple[int, ...]] = {
    "focal": (0,), "aspect": (1,), "skew": (2,), "principal_point": (3, 4), "k1": (5,), "k2": (6,),
    "k3": (7,),
}  # fmt: skip
"""Rows and columns of each intrinsic in the covariance."""
STD_NAMES = ("focal_px", "aspect", "skew_px", "principal_x_px", "principal_y_px", "k1", "k2", "k3")
"""Names of the standard deviations in :attr:`thesisrecon.Camera.std`."""


@dataclass(frozen=True, eq=False)
class BundleAdjustment(Record):
    """Refined cameras and points with their uncertainty.

    All covariances are those of the inner gauge (free network adjustment): among the solutions that differ by
    a similarity, the one that moves the cameras least (Triggs et al., "Bundle adjustment - a modern
    synthesis", 2000, section 9). They contain the uncertainty of all other unknowns.
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
    require_inside(observed.view_index, observed.xy, np.array([view.size for view in views]))
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
    cameras = cameras.reconstruction if isinstance(cameras, RunResult) else cameras
    views = as_cameras("bundle_adjust", cameras, sizes)
    if isinstance(cameras, Reconstruction) and X is None and xy is None:
        X, *observed = points_of_reconstruction(cameras)
        return views, X, Observations(*observed), None
    if X is None or xy is None:
        raise ValueError("bundle_adjust needs X (N, 3) and xy, the pixels of the points; got None")
    (X,), shape = numbers("bundle_adjust", X=X), None
    if isinstance(xy, Tracks | Observations):
        observed = Observations(xy.view_index, xy.point_index, xy.xy)
    else:
        (xy,) = numbers("bundle_adjust", missing=("xy",), xy=xy)
        shape = (len(views), len(X), 2)
        if xy.shape != shape:
            raise ValueError(
                f"bundle_adjust of {len(views)} cameras and {len(X)} points needs xy {shape}; got {xy.shape}"
            )
        point, view = np.nonzero(np.isfinite(xy).all(axis=2).T)
        observed = Observations(view, point, xy[view, point])
    require_shapes("bundle_adjust", X=(X, ("N", 3)))
    return views, X, observed, shape


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

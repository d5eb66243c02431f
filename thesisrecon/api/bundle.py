"""Bundle adjustment in one call: cameras and points refined together, with their covariances."""

import warnings
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from thesisrecon import arrays
from thesisrecon.api.cameras import outside_by, require_inside
from thesisrecon.api.given import (
    CameraInput,
    as_cameras,
    as_sparse_model,
    cameras_of_model,
    lens_table,
)
from thesisrecon.arrays import B8, F64, I64, Record
from thesisrecon.camera import Camera, camera_of_row
from thesisrecon.errors import Notice, counted, require_word
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.lens import ANGLE, BASE, DIVISION
from thesisrecon.optimize.bundle import knowledge, metric, projection
from thesisrecon.optimize.bundle.knowledge import LOSSES, BundleKnowledge, PositionPrior
from thesisrecon.optimize.bundle.projection import LENS, POSE_DOF, MetricCameras, Observations
from thesisrecon.optimize.least_squares import MAD_FACTOR
from thesisrecon.records import IntrinsicsPrior, Tracks
from thesisrecon.results import RunResult
from thesisrecon.runtime._blas import one_blas_thread

Chosen = I64 | B8 | Sequence[int]  # Numbers of cameras or points, or a mask
COLUMNS: Mapping[str, tuple[int, ...]] = {
    "focal": (0,), "aspect": (1,), "skew": (2,), "principal_point": (3, 4), "k1": (5,), "k2": (6,),
    "k3": (7,), "k4": (8,), "p1": (9,), "p2": (10,),
}  # fmt: skip
"""Rows and columns of each intrinsic in the covariance."""
STD_NAMES = (
    "focal_px", "aspect", "skew_px", "principal_x_px", "principal_y_px", "k1", "k2", "k3", "k4", "p1", "p2",
)  # fmt: skip
"""Names of the standard deviations in :attr:`thesisrecon.Camera.std`."""


@dataclass(frozen=True, eq=False)
class BundleAdjustment(Record):
    """Refined cameras and points with their uncertainty.

    All covariances are those of the inner gauge (free network adjustment): among the solutions that differ by
    a similarity, the one that moves the cameras least (Triggs et al., "Bundle adjustment - a modern
    synthesis", 2000, section 9); only the similarities that nothing fixes count. They contain the uncertainty
    of all other unknowns.
    """

    cameras: tuple[Camera, ...]  #: with ``std`` of their intrinsics (0: not free)
    X: F64  #: (N, 3)
    residual_px: F64  #: (V, N, 2) or (K, 2) projection minus observation; NaN where there is none
    sigma_px: float  #: standard deviation of one image coordinate, estimated from the residuals
    cost: float  #: 1/2 sum rho with the priors, in units of the noise that weighted the residuals
    #: (V, 6, 6) of the motion x -> exp(w) x + d in the camera frame, (w in rad, d); infinite if unseen
    pose_covariance: F64
    #: (V, 8, 8) in the order focal, aspect, skew, principal x and y, k1, k2, k3; (V, 11, 11) with k4, p1, p2
    #: if a lens has them or is not radial; zero where not free
    intrinsics_covariance: F64
    point_covariance: F64  #: (N, 3, 3), infinite for points in fewer than two views
    #: distance of the cameras from the minimum in standard deviations, by the gradient: none is farther
    sigmas_to_minimum: float
    #: with ``joint``: (6 V + C V, 6 V + C V) of all poses, then all intrinsics, each as above; zero where
    #: nothing moves; shared intrinsics are repeated
    joint_covariance: F64 | None = None

    @property
    def converged(self) -> bool:
        """Whether another adjustment would move no camera parameter by a tenth of its standard deviation."""
        return self.sigmas_to_minimum <= metric.MAX_SIGMAS_TO_MINIMUM

    @property
    def centre_covariance(self) -> F64:
        """Covariance of the camera centres (V, 3, 3)."""
        R, translation = np.array([camera.R for camera in self.cameras]), self.pose_covariance[:, 3:, 3:]
        seen = np.isfinite(translation).all(axis=(1, 2), keepdims=True)
        moved = np.swapaxes(R, 1, 2) @ np.where(seen, translation, 0.0) @ R
        return np.asarray(np.where(seen, moved, np.diag([np.inf] * 3)))


@one_blas_thread()
def bundle_adjust(
    cameras: CameraInput, X: F64 | None = None, xy: F64 | Tracks | Observations | None = None, *,
    sizes: I64 | None = None, shared: bool | I64 = True, free: Sequence[str] = ("focal", "k1"),
    prior: Mapping[str, float | F64] | None = None, loss: str = "huber", loss_px: float | None = None,
    sigma_px: float | None = None, covariances: F64 | None = None, fixed_cameras: Chosen = (),
    fixed_points: Chosen = (), gauge: Literal["inner", "two-cameras"] = "inner",
    positions: F64 | None = None, position_std: float | F64 = 1.0, control_points: F64 | None = None,
    control_std: float | F64 = 1.0, max_iterations: int = 200, joint: bool = False,
) -> BundleAdjustment:  # fmt: skip
    """Refine cameras and points together, with their covariances (6.7, HZ 18.1 and A6.3).

    Minimises sum rho(r' Q^-1 r / sigma^2) + sum ((q - q0) / std)^2 + sum |(C - C0) / std|^2 over poses,
    points and the free intrinsics q, with the residuals r = x - project(X), the covariances Q of the
    observations and known positions C0 of camera centres and points.

    Parameters
    ----------
    cameras : sequence of Camera, mapping of str to Camera, tuple (K, R, t) or model
        Initial cameras; or K (3, 3) or (V, 3, 3), R (V, 3, 3) and t (V, 3) with ``sizes``; or a model as for
        :func:`thesisrecon.compare_models` (path, RunResult, metric Reconstruction, pycolmap): its registered
        views and, if X and xy are not given, its valid points and inliers.
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
        Intrinsics to refine: "focal", "aspect", "skew", "principal_point", "k1", "k2", "k3", of lenses that
        are not "division" "p1", "p2", and of fisheye lenses "k4". A division lens has k1 alone.
    prior : mapping of str to float or (V,), optional
        Standard deviations of free intrinsics about the given cameras, of shared ones about their mean:
        relative for "focal", in pixels for "principal_point" and "skew"; in an array 0 fixes the value of an
        image, and infinity leaves it free.
    loss : {"huber", "squared", "cauchy", "geman-mcclure", "tukey"}
        Loss; the last three redescend: gross errors lose their influence (Zhang, IVC 15, 1997).
    loss_px : float, optional
        Width of the loss: Huber's becomes linear there, Tukey's constant. None: 2, 2.4 (cauchy), 4
        (geman-mcclure) or 5 (tukey) standard deviations of the noise.
    sigma_px : float, optional
        Standard deviation of one image coordinate. None: estimated from the residuals. With ``covariances``
        the factor on their square roots.
    covariances : ndarray (V, N), (V, N, 2, 2), (K,) or (K, 2, 2), optional
        Variances or covariances of the observations, of which only the ratios matter if ``sigma_px`` is None.
    fixed_cameras, fixed_points : array_like of int, or of bool (V,) and (N,)
        Cameras whose poses, and points that do not move.
    gauge : {"inner", "two-cameras"}
        "two-cameras": the first camera does not move, nor the farthest one along the line between them.
    positions, position_std : ndarray (V, 3), float, (3,) or (V, 3)
        Known camera centres, NaN where unknown, and the standard deviations of their coordinates.
    control_points, control_std : ndarray (N, 3), float, (3,) or (N, 3)
        Known positions of points, NaN where unknown, and their standard deviations. If nothing is fixed, the
        initial model is first moved to at least three known positions by a similarity.
    max_iterations : int
        Maximum number of linear solves; if they do not suffice, ``converged`` is false.
    joint : bool
        Whether to return ``joint_covariance``, that of all poses and intrinsics together.

    Returns
    -------
    BundleAdjustment
        Cameras, points, residuals and covariances; poses and points without observations are unchanged.

    Raises
    ------
    ValueError
        If the arrays do not fit together, more than 5 % of the pixels lie far outside their images, most
        points lie behind the cameras, the pixels fit poses of another convention (camera to world, for
        example), there are fewer equations than unknowns, or an option is invalid.

    Warns
    -----
    UserWarning
        If up to 5 % of the pixels lie outside their images by more than 10 % of the long side (they are named
        and left out), or focal lengths or residuals at the end are not those of a camera.

    Notes
    -----
    The covariances are those of the linearised problem at the minimum, with the noise estimated from the
    residuals (``sigma_px`` only weights the data against the prior). The blocks of the points follow from the
    Schur complement, V^-1 + V^-1 W' S^-1 W V^-1, without approximation. Points that fisheye lenses see at 90
    degrees from their axis or farther are not adjusted to.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import bundle_adjust, sample
    >>> cube, rng = np.load(sample("cube") / "cube.npz"), np.random.default_rng(0)
    >>> t = -np.einsum("vij,vj->vi", cube["R"], cube["C"])
    >>> xy = cube["xy"] + 0.5 * rng.normal(size=cube["xy"].shape)
    >>> found = bundle_adjust((cube["K"], cube["R"], t), cube["X"], xy, sizes=(823, 581), prior={"k1": 0.05})
    >>> bool(abs(found.cameras[0].K[0, 0] - 842) < 4 * found.cameras[0].std["focal_px"])
    True
    >>> found.point_covariance.shape, round(found.sigma_px, 1)
    ((360, 3, 3), 0.5)
    """
    views, X, observed, dense = _problem(cameras, X, xy, sizes)
    free = tuple(free) if isinstance(free, Sequence | Set) and not isinstance(free, str) else (free,)
    chosen = _free(free)
    require_word("loss", loss, LOSSES)
    arrays.whole_number("bundle_adjust", "max_iterations", max_iterations, 1)
    loss_px = None if loss_px is None else arrays.number("bundle_adjust", "loss_px", loss_px)
    sigma_px = None if sigma_px is None else arrays.number("bundle_adjust", "sigma_px", sigma_px)
    start = _start(views, shared, chosen)
    chosen = chosen[: start.intrinsics.shape[1]]
    prior = {} if prior is None else prior
    expected = _prior(start.intrinsics, prior, chosen, free)
    # Only for its checks of the list.
    projection.sort_observations(observed, len(views), len(X))
    root, inside = _whitening(covariances, dense, observed), _inside(views, observed)
    inside &= _in_front_of_fisheye(start, X, observed)
    observed = observed.at(inside)
    known = BundleKnowledge(
        loss if loss_px is None or loss_px < np.inf else "squared", None if root is None else root[inside],
        _mask("fixed_cameras", fixed_cameras, len(views), observed.view_index),
        _mask("fixed_points", fixed_points, len(X), observed.point_index),
        _positions("positions", positions, position_std, len(views), observed.view_index),
        _positions("control_points", control_points, control_std, len(X), observed.point_index),
    )  # fmt: skip
    _check(start, X, observed, chosen, bool(prior), known)
    start, X, known = _placed(start, X, known, gauge)
    _check_convention(start, X, observed)
    unknown = chosen, expected, known
    fit, scale = _adjusted(start, X, observed, unknown, (sigma_px, loss_px), max_iterations, joint)
    _warn_of_implausible(views, fit)
    assert fit.pose_covariance is not None
    assert fit.point_covariance is not None
    residual = np.full((len(inside), 2) if dense is None else dense, np.nan)
    place = (inside,) if dense is None else (observed.view_index, observed.point_index)
    residual[place] = fit.residual_px
    K, std = fit.cameras.K, np.sqrt(np.diagonal(fit.intrinsics_covariance, axis1=1, axis2=2))
    rows, unseen = fit.cameras.intrinsics, np.isin(np.arange(len(views)), observed.view_index, invert=True)
    poses = np.where(unseen[:, None, None], np.diag([np.inf] * POSE_DOF), fit.pose_covariance)
    stds = [dict(zip(STD_NAMES, row, strict=False)) for row in std.tolist()]
    R, t = fit.cameras.R, fit.cameras.t
    joined = fit.joint_covariance
    if joined is not None:
        kept = np.arange(rows.shape[1]) < LENS
        chosen = np.append(np.ones(POSE_DOF * len(views), dtype=bool), np.tile(kept, len(views)))
        joined = joined[np.ix_(chosen, chosen)]
    refined = tuple(
        camera_of_row((K[i], R[i], t[i]), view.size, rows[i, 5:], std=stds[i], as_stored=view.as_stored)
        for i, view in enumerate(views)
    )
    return BundleAdjustment(
        refined, fit.X, residual, fit.sigma_px, fit.cost, poses, fit.intrinsics_covariance[:, :LENS, :LENS],
        fit.point_covariance, fit.sigmas_to_minimum * scale, joined,
    )  # fmt: skip


def _adjusted(
    start: MetricCameras, X: F64, observed: Observations,
    unknown: tuple[B8, IntrinsicsPrior, BundleKnowledge], noise: tuple[float | None, float | None], most: int,
    joint: bool,
) -> tuple[metric.MetricBundleResult, float]:  # fmt: skip
    """The adjustment, and the weight of its last pass over the noise found."""
    # First passes estimate noise that is not given: the weight of the prior and the width depend on it. For a
    # loss that redescends they begin with the noise of the start, so that the width falls with the residuals.
    (free, prior, known), (sigma, width) = unknown, noise
    redescends = known.loss not in ("huber", "squared")
    plain = known.is_empty and not redescends
    passes = 1 if sigma is not None else 4 if redescends else 2
    found = 1.0 if sigma is None else sigma
    if sigma is None and redescends:
        residual = _residuals(start, X, observed)
        residual = residual if known.root is None else np.einsum("kij,kj->ki", known.root, residual)
        found = max(MAD_FACTOR * float(np.median(np.abs(residual))), 1e-6)
    for last in [False] * (passes - 1) + [True]:
        loss_px = LOSSES[known.loss][1] * found if width is None else width
        if known.loss == "squared":
            loss_px = np.inf if plain else found
        options = metric.BundleOptions(
            sigma_px=found, loss_px=loss_px, max_iterations=most, settled=1e-6, noise=True, covariance=last,
            point_covariance=last, joint_covariance=last and joint,
        )  # fmt: skip
        fit = metric.refine_metric_bundle(
            start, X, observed, free=free, prior=prior, options=options, knowledge=None if plain else known
        )
        start, X, weight, found = fit.cameras, fit.X, found, max(fit.sigma_px, 1e-6)
    return fit, weight / found


def _problem(
    cameras: CameraInput, X: F64 | None, xy: F64 | Tracks | Observations | None, sizes: I64 | None,
) -> tuple[list[Camera], F64, Observations, tuple[int, ...] | None]:  # fmt: skip
    """Cameras, points and observations, and the shape of xy if it was dense."""
    cameras = cameras.reconstruction if isinstance(cameras, RunResult) else cameras
    if X is None and xy is None and not isinstance(cameras, Mapping | list | tuple | None):
        model = as_sparse_model(cameras, "the model of bundle_adjust")
        views = as_cameras("bundle_adjust", cameras_of_model(model, "the model of bundle_adjust"))
        return views, model.X, Observations(model.view_index, model.point_index, model.xy), None
    views = as_cameras("bundle_adjust", cameras, sizes)
    if X is None or xy is None:
        raise ValueError("bundle_adjust needs X (N, 3) and xy, the pixels of the points; got None")
    (X,), shape = arrays.numbers("bundle_adjust", X=X), None
    if isinstance(xy, Tracks | Observations):
        observed = projection.read_observations("bundle_adjust", xy)
    else:
        (xy,) = arrays.numbers("bundle_adjust", missing=("xy",), xy=xy)
        shape = (len(views), len(X), 2)
        if xy.shape != shape:
            raise ValueError(Notice("shape-of-observations", len(views), len(X), shape, xy.shape))
        point, view = np.nonzero(np.isfinite(xy).all(axis=2).T)
        observed = Observations(view, point, xy[view, point])
    arrays.require_shapes("bundle_adjust", X=(X, ("N", 3)))
    return views, X, observed, shape


def _free(names: Sequence[str]) -> B8:
    """Columns (12,) of the intrinsics to refine."""
    chosen = np.zeros(LENS + 1, dtype=bool)
    for name in names:
        chosen[list(COLUMNS[require_word("intrinsic in free", name, COLUMNS)])] = True
    return chosen


def _start(views: Sequence[Camera], shared: bool | I64, free: B8) -> MetricCameras:
    """The cameras as a table with a row per view; views with equal numbers share the free columns."""
    n = len(views)
    if isinstance(shared, bool | np.bool_):
        sizes = list(dict.fromkeys(view.size for view in views))
        own = np.array([sizes.index(view.size) for view in views]) if shared else np.arange(n)
    else:
        own = arrays.whole_numbers("bundle_adjust", "shared, or True or False", shared)
        if own.shape != (n,):
            raise ValueError(f"shared must be True, False or a camera number per view ({n},); got {own}")
    lenses = lens_table("bundle_adjust", views, BASE + 1 if free[8:].any() else 3)
    table = np.column_stack([projection.pinhole_rows(np.array([view.K for view in views])), lenses])
    bases = table[:, LENS] if table.shape[1] > LENS else np.zeros(n)
    if free[6:].any() and (bases == DIVISION).any():
        raise ValueError("a division lens has k1 only: leave k2, k3, k4, p1 and p2 out of free")
    if free[8] and (bases != ANGLE).any():
        raise ValueError("k4 is a coefficient of fisheye lenses only: leave it out of free")
    R, t = (np.array([getattr(view, name) for view in views]) for name in ("R", "t"))
    sharing = np.where(free[: table.shape[1]], own[:, None], np.arange(n)[:, None])
    return MetricCameras(R, t, table, np.arange(n), sharing)


def _prior(table: F64, prior: Mapping[str, float | F64], free: B8, names: Sequence[str]) -> IntrinsicsPrior:
    """Gaussian prior of the table of intrinsics (V, 8)."""
    std = np.full(table.shape, np.inf)
    if not isinstance(prior, Mapping):
        raise ValueError(Notice("no-prior", type(prior).__name__))
    for name, value in prior.items():
        if name not in COLUMNS or not free[list(COLUMNS[name])].all():
            raise ValueError(f"prior has {name!r}, which is not among the free intrinsics {tuple(names)}")
        values = arrays.number_or_numbers("bundle_adjust", f"prior[{name!r}]", value)
        if values.shape not in ((), (len(table),)):
            raise ValueError(Notice("prior-of-cameras", name, len(table), value))
        if not ((values >= 0.0).all() if values.ndim else 0.0 < values < np.inf):
            raise ValueError(f"prior[{name!r}] is a standard deviation and must be above 0; got {value}")
        std[:, list(COLUMNS[name])] = values[..., None]
    return IntrinsicsPrior.unshared(table, std)


def _mask(name: str, chosen: Chosen, n: int, seen: I64) -> B8 | None:
    """Mask (n,) of the ``seen`` ones of numbers or of a mask; None without any."""
    index = arrays.whole_numbers("bundle_adjust", name, chosen)
    if index.shape == (n,) and np.asarray(chosen).dtype == bool:
        index = np.flatnonzero(index)
    if not index.size:
        return None
    if index.ndim != 1 or index.min() < 0 or index.max() >= n:
        raise ValueError(f"{name} must be numbers from 0 to {n - 1}, or a mask ({n},); got {chosen}")
    mask = np.isin(np.arange(n), np.intersect1d(index, seen))
    return mask if mask.any() else None


def _positions(name: str, at: F64 | None, std: float | F64, n: int, seen: I64) -> PositionPrior:
    """The known positions (n, 3) of what is ``seen``."""
    if at is None:
        return knowledge.NO_PRIOR
    (at,) = arrays.numbers("bundle_adjust", missing=(name,), **{name: at})
    widths = arrays.number_or_numbers("bundle_adjust", f"standard deviation of {name}", std)
    if at.shape != (n, 3) or widths.shape not in ((), (3,), (n, 3)):
        raise ValueError(Notice("shape-of-positions", name, n, at.shape, widths.shape))
    known = np.isfinite(at).all(axis=1) & np.isin(np.arange(n), seen)
    widths = np.broadcast_to(widths, (n, 3))[known]
    if not (widths > 0.0).all():
        raise ValueError(f"the standard deviations of {name} must be above 0; got {std}")
    return PositionPrior(np.flatnonzero(known), at[known], np.eye(3) / widths[:, None, :])


def _whitening(covariances: F64 | None, dense: tuple[int, ...] | None, observed: Observations) -> F64 | None:
    """Roots (K, 2, 2) of the information of the observations, None if they are equal."""
    if covariances is None:
        return None
    (Q,) = arrays.numbers("bundle_adjust", covariances=covariances)
    shape = (len(observed.xy),) if dense is None else dense[:2]
    if Q.shape not in (shape, (*shape, 2, 2)):
        raise ValueError(Notice("shape-of-covariances", shape, (*shape, 2, 2), Q.shape))
    Q = Q if dense is None else Q[observed.view_index, observed.point_index]
    Q = Q[:, None, None] * np.eye(2) if Q.ndim == 1 else Q
    try:
        root = np.asarray(np.linalg.inv(np.linalg.cholesky(Q)))
    except np.linalg.LinAlgError:
        root = np.full((1, 2, 2), np.nan)
    if not np.isfinite(root).all():
        raise ValueError("covariances must be positive (definite) for each observation")
    return root


def _inside(views: Sequence[Camera], o: Observations) -> B8:
    """Observations (K,) in or near their images; a few others are named in a warning, many are refused."""
    sizes = np.array([view.size for view in views])
    far = outside_by(o.view_index, o.xy, sizes) > 0.1
    turned = outside_by(o.view_index, o.xy, sizes[:, ::-1])[far] > 0.1
    # Many, or several that are all inside if width and height are exchanged: the sizes are wrong.
    if far.sum() > max(1, 0.05 * len(far)) or (far.sum() > 1 and not turned.any()):
        require_inside(o.view_index, o.xy, sizes)
    if not far.any():
        return ~far
    rows = [np.asarray(part)[far][:3].tolist() for part in (o.point_index, o.view_index, o.xy)]
    first = (f"point {j} in view {i} at ({x:.0f}, {y:.0f})" for j, i, (x, y) in zip(*rows, strict=True))
    said = f"{counted(int(far.sum()), 'observation')} far outside the image left out: {', '.join(first)}"
    warnings.warn(f"bundle_adjust: {said}{' ...' if far.sum() > 3 else ''}", UserWarning, stacklevel=3)
    return ~far


def _depths(cameras: MetricCameras, X: F64, o: Observations) -> F64:
    """Depths (K,) of the points of observations."""
    view = o.view_index
    return np.asarray(np.einsum("ka,ka->k", cameras.R[view, 2], X[o.point_index]) + cameras.t[view, 2])


def _in_front_of_fisheye(start: MetricCameras, X: F64, o: Observations) -> B8:
    """Observations (K,) but those of fisheye lenses at 90 degrees from the axis or farther."""
    if start.intrinsics.shape[1] <= LENS:
        return np.ones(len(o.xy), dtype=bool)
    return np.asarray((_depths(start, X, o) > 0.0) | (start.intrinsics[o.view_index, LENS] != ANGLE))


def _placed(
    start: MetricCameras, X: F64, known: BundleKnowledge, gauge: str
) -> tuple[MetricCameras, F64, BundleKnowledge]:
    """The start near known positions, and the knowledge that the gauge adds."""
    require_word("gauge", gauge, ("inner", "two-cameras"))
    centres = start.centres
    if knowledge.remaining_gauge(known, start.R, start.t, X).shape[1] < 7:
        if gauge == "two-cameras":
            raise ValueError('gauge="two-cameras" needs a problem without fixed or known poses and points')
        if known.fixed_poses is not None or known.fixed_points is not None:
            return start, X, known
        source = np.concatenate([centres[known.centres.index], X[known.points.index]])
        try:
            move = estimate_similarity(
                source, np.concatenate([known.centres.position, known.points.position])
            )
        except ValueError:
            return start, X, known
        R = start.R @ move.R.T
        t = -np.einsum("vij,vj->vi", R, move.apply(centres))
        return replace(start, R=R, t=t), move.apply(X), known
    if gauge == "two-cameras":
        line = centres - centres[0]
        far = int(np.linalg.norm(line, axis=1).argmax())
        # A millionth of the distance: far below any noise.
        root = np.zeros((1, 3, 3))
        root[0, 0] = 1e6 * line[far] / max(float(line[far] @ line[far]), 1e-300)
        prior = PositionPrior(np.array([far]), centres[[far]], root)
        known = replace(known, fixed_poses=np.arange(len(centres)) == 0, centres=prior)
    return start, X, known


def _residuals(start: MetricCameras, X: F64, o: Observations) -> F64:
    """Projection minus observation (K, 2) at the start."""
    model = projection.MetricModel(start.R, start.t, start.intrinsics, np.asarray(start.group), X)
    return np.asarray(projection.image_points(model, o.view_index, o.point_index)[0] - o.xy)


def _check_convention(start: MetricCameras, X: F64, o: Observations) -> None:
    """Raise ``ValueError`` if poses of another convention fit at least ten times better."""
    seen = o.at(slice(None, None, max(len(o.xy) // 20000, 1)))
    back, turned = np.swapaxes(start.R, 1, 2), np.diag([1.0, -1.0, -1.0])
    by_inverse, by_centre = (-np.einsum("vij,vj->vi", R, start.t) for R in (back, start.R))
    poses = {
        "R and t are camera to world": (back, by_inverse), "t is the camera centre": (start.R, by_centre),
        "R is camera to world": (back, start.t),
    }  # fmt: skip
    poses |= {
        f"{name} and the axes are those of OpenGL": (turned @ R, t @ turned)
        for name, (R, t) in {**poses, "R and t are right": (start.R, start.t)}.items()
    }
    given, best, said = _misfit(_residuals(start, X, seen)), np.inf, ""
    for name, (R, t) in poses.items():
        other = replace(start, R=np.ascontiguousarray(R), t=np.ascontiguousarray(t))
        in_front = (_depths(other, X, seen) > 0.0)[:, None]
        misfit = _misfit(np.where(in_front, _residuals(other, X, seen), np.inf))
        if misfit < best:
            best, said = misfit, name
    # Less is the error of a start, not of a convention.
    if best < 0.1 * given and given > 0.005 * np.ptp(seen.xy, axis=0).max():
        raise ValueError(Notice("other-convention", said, best, given))


def _misfit(residual: F64) -> float:
    return float(np.median(np.linalg.norm(residual, axis=1)))


def _warn_of_implausible(views: Sequence[Camera], fit: metric.MetricBundleResult) -> None:
    """Warn of focal lengths beyond those of cameras, if they began within, and of very large residuals."""
    longest = np.array([max(view.size) for view in views])
    before, after = np.array([view.K[0, 0] for view in views]) / longest, fit.cameras.K[:, 0, 0] / longest
    odd = np.flatnonzero(((after < 0.2) | (after > 20.0)) & (before > 0.2) & (before < 20.0))
    said = []
    if len(odd):
        i = odd[0]
        said.append(f"the focal length of camera {i} moved to {after[i] * longest[i]:.0f} px")
    size = float(np.median(np.linalg.norm(fit.residual_px, axis=1)))
    if size > 0.02 * longest.max():
        said.append(f"the median residual is {size:.0f} px")
    if said:
        advice = "check the convention of the poses (R world to camera, t = -R centre), X and xy"
        warnings.warn(f"bundle_adjust: {' and '.join(said)}; {advice}", UserWarning, stacklevel=3)


def _check(
    start: MetricCameras, X: F64, observed: Observations, free: B8, bound: bool, known: BundleKnowledge
) -> None:
    """Raise ``ValueError`` if most points are behind the cameras, or for fewer equations than unknowns."""
    view, point = observed.view_index, observed.point_index
    arrays.require_finite("bundle_adjust, for points with observations,", X[point])
    depth = _depths(start, X, observed)
    behind = float(np.mean(depth <= 0.0)) if len(depth) else 0.0
    # Of most points only if the poses use another convention.
    if behind > 0.5:
        raise ValueError(Notice("points-behind-cameras", behind))
    seen, points = np.unique(view), np.unique(point)
    own = sum(len(np.unique(start.shared[seen, c])) for c in np.flatnonzero(free)) if not bound else 0
    fixed = [
        0 if mask is None else int(mask[index].sum())
        for mask, index in ((known.fixed_poses, seen), (known.fixed_points, points))
    ]
    priors = 3 * (len(known.centres.index) + len(known.points.index))
    # Those of a similarity have no effect if nothing is known.
    unknowns = POSE_DOF * (len(seen) - fixed[0]) + 3 * (len(points) - fixed[1]) + own
    unknowns -= 0 if any(fixed) or priors else 7
    if 2 * len(view) + priors < unknowns or len(seen) < (1 if fixed[1] or priors else 2):
        raise ValueError(Notice("few-equations", len(view), len(seen), 2 * len(view), unknowns))

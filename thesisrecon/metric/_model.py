"""The metric estimate under refinement: cameras with shared intrinsics, points, inlier observations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon._numba import kernel
from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.strata import upgrade_cameras, upgrade_points
from thesisrecon.geometry.triangulation import triangulate_observations, triangulation_angles
from thesisrecon.lens import ANGLE, DIVISION, PERSPECTIVE, fit_lens, straight_places, undistort
from thesisrecon.optimize.bundle.partial import refine_points
from thesisrecon.optimize.bundle.projection import LENS, MetricCameras, MetricModel, image_points
from thesisrecon.records import IntrinsicsPrior, Reconstruction, Tracks, Upgrade

# Columns of a table of intrinsics: f, aspect, skew, cx, cy, k1, k2, k3.
FOCAL, ASPECT, SKEW, CENTRE, K1, WIDTH = 0, 1, 2, (3, 4), 5, 8
LENS_WIDTH = LENS + 1  # further k4, p1, p2 and the number of the lens model
EARLY_SIGMAS, LATE_SIGMAS = 12.0, 7.0  # residual gates of the early and the late rounds in noise sigmas
MAX_TANGENT = 4.0  # largest tangent of the angle from the axis of what triangulates: 76 degrees
RADII = 100  # radii of the image at which one lens is fitted to another
LENS_STD = {PERSPECTIVE: (0.5, 0.3, 0.1), DIVISION: (1.0,), ANGLE: (0.2, 0.1, 0.05, 0.02)}
"""Prior deviations of the coefficients about 0 of a lens that pairs of images show."""
DECENTRING, DECENTRING_STD = (K1 + 4, K1 + 5), 0.005
"""Columns of p1 and p2 of such a lens, and their prior deviations."""
BASES = {
    "auto": (ANGLE, PERSPECTIVE, DIVISION), "radial": (PERSPECTIVE,), "brown": (PERSPECTIVE,),
    "division": (DIVISION,), "fisheye": (ANGLE,),
}  # fmt: skip
"""Bases of the lens by the model that the user sets."""
MIN_ANGLE = float(np.radians(0.05))  # smallest triangulation angle of a point
MAX_OBSERVATIONS, MANY_VIEWS, CELLS = 400_000, 40, 8
"""Larger sets are adjusted on a selection of points: more than ``MAX_OBSERVATIONS`` are divided evenly among
the views; of more than ``MANY_VIEWS`` each view gets the numbers below. A view has ``CELLS`` along a side."""
LONG_PER_VIEW, PRECISE_PER_VIEW = 1000, 500


@dataclass(frozen=True)
class MetricEstimate:
    """Metric cameras, points (zeros where not ``valid``) and inliers of one adjustment round.

    ``loss_sigmas`` is the width of Huber's loss in sigmas, ``tail`` the width of the residuals' tail relative
    to normal noise, by which gates are widened, ``sigmas_to_minimum`` the distance of the cameras from the
    minimum of the last adjustment in standard deviations.
    """

    tracks: Tracks
    sizes: I64
    cameras: MetricCameras
    registered: B8
    X: F64
    valid: B8
    inlier: B8
    sigma_px: float
    loss_sigmas: float = 2.0
    tail: float = 1.0
    sigmas_to_minimum: float = np.nan

    @property
    def gate_px(self) -> float:
        """Noise times tail width: the unit of gates in sigmas."""
        return self.sigma_px * self.tail


def restrict_points(model: MetricEstimate, points: I64) -> MetricEstimate:
    """The model with only ``points``, in this order."""
    t, number = model.tracks, np.full(model.tracks.n_points, -1)
    number[points] = np.arange(len(points))
    k = np.flatnonzero(number[t.point_index] >= 0)
    tracks = Tracks(t.view_index[k], number[t.point_index[k]], t.xy[k], t.n_views, len(points))
    return replace(model, tracks=tracks, X=model.X[points], valid=model.valid[points], inlier=model.inlier[k])


def seen_views(tracks: Tracks) -> int:
    """Number of views with observations: the images of other groups have none."""
    return int(np.count_nonzero(np.bincount(tracks.view_index)))


def with_precise_points(model: MetricEstimate, tracks: Tracks) -> tuple[MetricEstimate, I64]:
    """Select among the points of all ``tracks`` those of the least residuals first; return their numbers too.

    A corner of a surface with relief moves with the viewing direction, which bends long sequences of views.
    """
    model = with_tracks(model, tracks)
    t, variance = model.tracks, model.sigma_px**2
    k = np.flatnonzero(model.registered[t.view_index] & model.valid[t.point_index])
    view, point = t.view_index[k], t.point_index[k]
    xy, _ = reproject_observations(model, view, point)
    squared = np.nan_to_num(np.sum((xy - t.xy[k]) ** 2, axis=1), nan=np.inf)
    squared = np.minimum(squared, (LATE_SIGMAS * model.gate_px) ** 2)
    total = np.bincount(point, squared, minlength=t.n_points)
    count = np.bincount(point, minlength=t.n_points)
    # Posterior mean of the variance; the inverse gamma prior is that of all points and limits short tracks.
    # It weighs as much as six residuals.
    noise = (total + 6 * variance) / np.maximum(2 * count - 3 + 6, 1)
    order = np.argsort(np.where(model.valid, noise, np.inf), kind="stable")
    points = select_spread_points(model, order, PRECISE_PER_VIEW)
    return restrict_points(model, points), points


def select_spread_points(model: MetricEstimate, order: I64, per_view: int) -> I64:
    """Select points in the ``order`` until every view (``per_view``) and cell has enough of them."""
    t = model.tracks
    cell = np.clip(t.xy / model.sizes[t.view_index] * CELLS, 0, CELLS - 1).astype(np.int64)
    cell = (t.view_index * CELLS + cell[:, 0]) * CELLS + cell[:, 1]
    occupied = np.bincount(np.unique(cell) // CELLS**2, minlength=t.n_views)
    views = seen_views(t)
    wanted = per_view if views > MANY_VIEWS else MAX_OBSERVATIONS // max(views, 1)
    needed = np.repeat(-(-wanted // np.maximum(occupied, 1)), CELLS**2)
    start = np.concatenate([[0], np.cumsum(np.bincount(t.point_index, minlength=t.n_points))])
    keep = np.zeros(t.n_points, dtype=bool)
    choose_points(order, start, cell, needed, keep)
    return np.flatnonzero(keep)


@kernel
def choose_points(order: I64, start: I64, cell: I64, needed: I64, keep: B8) -> None:
    """Mark each point that at least half of its cells need, cell[k] with start[j] <= k < start[j + 1]."""
    for j in order:
        missing = 0
        for k in range(start[j], start[j + 1]):
            missing += 1 if needed[cell[k]] > 0 else 0
        keep[j] = 2 * missing >= start[j + 1] - start[j]
        if keep[j]:
            for k in range(start[j], start[j + 1]):
                needed[cell[k]] -= 1


def reproject_observations(model: MetricEstimate, view: I64, point: I64) -> tuple[F64, F64]:
    """Pixels (K, 2), with distortion, and depths (K,) of the points of observations."""
    c = model.cameras
    R, t, intrinsics, X = (np.ascontiguousarray(a) for a in (c.R, c.t, c.intrinsics, model.X))
    pixels: tuple[F64, F64] = image_points(MetricModel(R, t, intrinsics, c.group, X), view, point)
    return pixels


def normalized_observations(cameras: MetricCameras, view: I64, xy: F64) -> F64:
    """Undistorted normalised image points (K, 2) of observations ``xy`` (K, 2) px."""
    rows = cameras.intrinsics[cameras.group[view]]
    f, aspect, skew, cx, cy = rows[:, :K1].T
    y = (xy[:, 1] - cy) / (aspect * f)
    distorted = np.column_stack([(xy[:, 0] - cx - skew * y) / f, y])
    distortion = rows[:, K1:]
    return undistort(distorted, distortion) if distortion.any() else distorted


def retriangulate_tracks(
    model: MetricEstimate, *, sigmas: float, min_angle: float = MIN_ANGLE
) -> MetricEstimate:
    """Triangulate all tracks, undistorted, from the registered views and from their inliers again."""
    t = model.tracks
    near = np.flatnonzero(model.registered[t.view_index])
    normalized = normalized_observations(model.cameras, t.view_index[near], t.xy[near])
    if model.cameras.intrinsics.shape[1] > WIDTH:
        # Towards 90 degrees off the axis noise grows without bound.
        usable = np.linalg.norm(normalized, axis=1) < MAX_TANGENT
        near, normalized = near[usable], normalized[usable]
    view, point = t.view_index[near], t.point_index[near]
    poses = np.concatenate([model.cameras.R, model.cameras.t[:, :, None]], axis=2)
    scale = np.median(model.cameras.intrinsics[model.cameras.group[model.registered], 0])
    loss = model.sigma_px / scale
    X = _triangulate(poses, normalized, view, point, t.n_points, loss)
    model = select_inliers(replace(model, X=X), sigmas=sigmas, min_angle=min_angle)
    has_outlier = np.bincount(point[~model.inlier[near]], minlength=t.n_points) > 0
    again = model.inlier[near] & has_outlier[point]
    if again.any():
        Y = _triangulate(poses, normalized[again], view[again], point[again], t.n_points, loss)
        better = np.bincount(point[again], minlength=t.n_points) >= 2
        model = replace(model, X=np.where(better[:, None], Y, X))
        model = select_inliers(model, sigmas=sigmas, min_angle=min_angle)
    return model


def _triangulate(poses: F64, xy: F64, view: I64, point: I64, n_points: int, loss: float) -> F64:
    Xh = triangulate_observations(poses, view, point, xy, n_points)
    Xh = refine_points(poses, Xh, view, point, xy, loss_px=loss, iterations=4)
    with np.errstate(divide="ignore", invalid="ignore"):
        X = Xh[:, :3] / Xh[:, 3:]
    return np.where(np.isfinite(X).all(axis=1, keepdims=True), X, 0.0)


def with_tracks(model: MetricEstimate, tracks: Tracks) -> MetricEstimate:
    """The cameras of a model with the points of all ``tracks``."""
    if model.tracks.n_points == tracks.n_points:
        return model
    X, none = np.zeros((tracks.n_points, 3)), np.zeros(tracks.n_points, dtype=bool)
    model = replace(model, tracks=tracks, X=X, valid=none, inlier=none[tracks.point_index])
    return retriangulate_tracks(model, sigmas=LATE_SIGMAS)


def inlier_mask(model: MetricEstimate, *, sigmas: float) -> B8:
    """Observations (K,) within the gate and in front of their registered camera, at any angle."""
    t = model.tracks
    k = np.flatnonzero(model.registered[t.view_index])
    view, point = t.view_index[k], t.point_index[k]
    xy, depth = reproject_observations(model, view, point)
    residual = np.nan_to_num(np.linalg.norm(xy - t.xy[k], axis=1), nan=np.inf)
    known = np.abs(model.X[point]).sum(axis=1) > 0
    inlier = np.zeros(len(t.xy), dtype=bool)
    inlier[k] = (residual < sigmas * model.gate_px) & (depth > 0) & known
    return inlier


def select_inliers(model: MetricEstimate, *, sigmas: float, min_angle: float) -> MetricEstimate:
    """Update inliers and valid points (two inliers and a triangulation angle above ``min_angle`` rad)."""
    t = model.tracks
    inlier = inlier_mask(model, sigmas=sigmas)
    centres = model.cameras.centres
    view, point = t.view_index[inlier], t.point_index[inlier]
    angle = triangulation_angles(centres, view, point, model.X, t.n_points)
    valid = (np.bincount(point, minlength=t.n_points) >= 2) & (angle > min_angle)
    return replace(model, inlier=inlier & valid[t.point_index], valid=valid)


def residual_norms(model: MetricEstimate) -> F64:
    """Lengths px of the reprojection residuals of the inliers."""
    t = model.tracks
    view, point = t.view_index[model.inlier], t.point_index[model.inlier]
    xy, _ = reproject_observations(model, view, point)
    return np.asarray(np.linalg.norm(xy - t.xy[model.inlier], axis=1))


def inlier_ratios(model: MetricEstimate) -> F64:
    """Inliers over observations of valid points in each view (V,); 1 for a view without any."""
    t = model.tracks
    seen = np.bincount(t.view_index[model.valid[t.point_index]], minlength=t.n_views)
    good = np.bincount(t.view_index[model.inlier], minlength=t.n_views)
    return np.asarray(np.where(seen > 0, good / np.maximum(seen, 1), 1.0))


def camera_rows(prior: IntrinsicsPrior) -> tuple[I64, I64]:
    """Row of intrinsics (V,) of each view, and the table (G, 8) of sharing: equal numbers share the value."""
    moves = (prior.std > 0.0).any(axis=0)
    knowledge = np.nan_to_num(np.concatenate([prior.mean, prior.std], axis=1), nan=-1.0, posinf=-1.0)
    same = np.unique(knowledge, axis=0, return_inverse=True)[1].reshape(-1, 1)
    key = np.concatenate([prior.shared[:, moves], same], axis=1)
    first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)[1:]
    shared = prior.shared[first]
    of_lens = np.repeat(shared[:, K1:], _width(prior) - K1 - 1, axis=1)
    return group.reshape(-1).astype(np.int64), np.column_stack([shared, of_lens])


def _width(prior: IntrinsicsPrior) -> int:
    """Columns of the intrinsics."""
    return WIDTH if prior.lens is None and prior.lens_model in ("auto", "radial") else LENS_WIDTH


def upgraded_model(
    reconstruction: Reconstruction, upgrade: Upgrade, prior: IntrinsicsPrior
) -> MetricEstimate | None:
    """Upgrade a projective reconstruction to a metric model; None if fewer than three cameras fit.

    Of two cameras both must fit. Cameras C = K^-1 P H further than 0.3 from a scaled rotation
    (3 C C' / tr(C C') - I) are left out.
    """
    views = np.flatnonzero(reconstruction.registered)
    H = upgrade.metric_from_projective
    rotations, translations, S = upgrade_cameras(reconstruction.P[views], upgrade.K[views], H)
    off = np.sqrt(np.sum((3.0 * S**2 / np.sum(S**2, axis=1, keepdims=True) - 1.0) ** 2, axis=1))
    good = off < 0.3
    if good.sum() < min(3, len(views)):
        return None
    n = len(reconstruction.P)
    R, t = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    R[views], t[views] = rotations, translations
    registered = np.zeros(n, dtype=bool)
    registered[views[good]] = True
    X, finite, spread = upgrade_points(reconstruction.X, reconstruction.valid, H)
    group, shared = camera_rows(prior)
    rows = _intrinsics(upgrade.K, reconstruction.registered, reconstruction.sizes, prior)
    cameras = MetricCameras(R, t / spread, rows[np.unique(group, return_index=True)[1]], group, shared)
    inlier = reconstruction.inlier & registered[reconstruction.tracks.view_index]
    tracks, sizes, sigma = reconstruction.tracks, reconstruction.sizes, reconstruction.sigma_px
    return MetricEstimate(tracks, sizes, cameras, registered, X / spread, finite, inlier, sigma)


def _intrinsics(K: F64, registered: B8, sizes: I64, prior: IntrinsicsPrior) -> F64:
    """(V, 8) start values: focals and principal points of K, else the median field of view; prior means."""
    group, longest = prior.group, sizes.max(axis=1)
    typical = float(np.median(K[registered, 0, 0] / longest[registered]))
    rows = np.zeros((len(K), _width(prior)))
    rows[:, 1 : K1 + 1] = prior.mean[:, 1:]
    for g in range(int(group.max()) + 1):
        views = np.flatnonzero(group == g)
        known = views[registered[views]]
        focal = float(np.median(K[known, 0, 0])) if len(known) else typical * longest[views[0]]
        rows[views, FOCAL] = focal
        if len(known):
            rows[views[:, None], [*CENTRE]] = np.median(K[known, :2, 2], axis=0)
    if prior.lens is not None:
        p = np.linspace(0.0, 1.0, RADII + 1)[1:]
        for view in np.flatnonzero(prior.lens[:, :2].any(axis=1)):
            half = float(np.linalg.norm(sizes[view])) / 2.0
            straight = straight_places(np.column_stack([p, 0.0 * p]), prior.lens[view])[0][:, 0]
            rows[view] = refitted_lens(rows[view], ANGLE, half * p, half * straight / rows[view, FOCAL])
    # Self-calibration allows known values a tolerance, and values that do not move keep their start.
    for column in (FOCAL, *CENTRE):
        exact = prior.std[:, column] == 0.0
        rows[exact, column] = prior.mean[exact, column]
    return rows


def refitted_lens(row: F64, kind: int, radii: F64, tangents: F64) -> F64:
    """A row of intrinsics with the lens of a base ``kind`` that images directions at ``radii`` (N,) px.

    ``tangents`` (N,) are those of their angles from the axis; large and negative ones are not fitted.
    """
    seen = (tangents > 0.0) & (tangents < MAX_TANGENT)
    count = len(LENS_STD[kind])
    if kind == DIVISION:
        # r = r_d / (1 + k r_d^2), by least squares of its coefficients in r_d / r.
        basis = np.column_stack([np.ones(seen.sum()), radii[seen] ** 2])
        f, g = np.linalg.lstsq(basis, radii[seen] / tangents[seen], rcond=None)[0]
        focal, coefficients = float(f), np.array([g * f])
    else:
        focal, coefficients = fit_lens(kind, radii[seen], tangents[seen], count)
    row = row.copy()
    row[FOCAL], row[K1:], row[LENS] = focal, 0.0, kind
    row[K1 : K1 + count] = coefficients
    return row

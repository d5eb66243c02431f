"""Tests of shared intrinsics and given focal lengths against the images.

Small zoom differences and crops deform a model without large residuals. The model is adjusted again with one
value per view: twice the decrease in cost is chi-square under the hypothesis of one camera (likelihood
ratio). If the focal lengths of single views are undetermined, the test cannot decide and the interval is
widened.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import Notice
from thesisrecon.metric._adjustment import MetricAdjustment
from thesisrecon.metric._model import (
    ASPECT,
    CENTRE,
    FOCAL,
    SKEW,
    WIDTH,
    MetricEstimate,
    reproject_observations,
)
from thesisrecon.metric._uncertainty import MIN_BLOCKS, USUAL_INFLATION
from thesisrecon.optimize.bundle.metric import MetricBundleResult, refine_metric_bundle
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations, move_poses
from thesisrecon.optimize.bundle.scatter import BlockScatter, linearise_fit
from thesisrecon.records import IntrinsicsPrior

MAX_VIEWS, RUN = 200, 20
"""Number of views tested, and length of the runs of neighbours that are chosen from more views: the
observations of :func:`subsample_inliers` are too few for all."""
OWN_STD = 0.01
"""Deviations of single images that a camera model may leave out: principal points in long sides
(stabilisation), aspect ratio, and skew over the focal length (rolling shutter)."""
READOUT_STEP, SMALL = 0.02, 1e-3  # steps of numerical derivatives, in times between consecutive images
MIN_FOCAL_DIFFERENCE, MIN_CENTRE_DIFFERENCE = 0.01, 0.015
"""Smaller differences of focals (relative) and principal points (in long sides) are harmless."""
ZOOM_STD = 0.03  # assumed relative scatter of focals that cannot be tested


def runs_of_views(model: MetricEstimate) -> MetricEstimate:
    """The model with about ``MAX_VIEWS`` views, in runs of neighbours; itself if it has no more."""
    views = np.flatnonzero(model.registered)
    if len(views) <= MAX_VIEWS:
        return model
    t, place = model.tracks, np.arange(len(views)) % (RUN * -(-len(views) // MAX_VIEWS))
    registered = np.isin(np.arange(t.n_views), views[place < RUN])
    inlier = model.inlier & registered[t.view_index]
    inlier &= (np.bincount(t.point_index[inlier], minlength=t.n_points) >= 2)[t.point_index]
    return replace(model, registered=registered, inlier=inlier)


def subsample_inliers(model: MetricEstimate) -> Observations:
    """Inliers of every n-th point, at most about 15,000."""
    t, index = model.tracks, np.flatnonzero(model.inlier)
    chosen = np.zeros(t.n_points, dtype=bool)
    chosen[np.unique(t.point_index[index])[:: int(np.ceil(len(index) / 15000))]] = True
    index = index[chosen[t.point_index[index]]]
    return Observations(t.view_index[index], t.point_index[index], t.xy[index])


_Case = tuple[MetricCameras, F64, Observations, B8, IntrinsicsPrior]
"""Cameras, points and observations of an adjustment, the intrinsics that are free, and their prior."""


def _per_view(
    model: MetricEstimate, adjustment: MetricAdjustment, columns: tuple[int, ...], *,
    focal_spread: float = np.inf, own_std: float = np.inf,
) -> _Case:  # fmt: skip
    """Give the views own values in some columns, unknown or within ``own_std`` of those of the model."""
    views, adjustment = np.flatnonzero(model.registered), replace(adjustment, hierarchical=None)
    cameras, seen = model.cameras, subsample_inliers(model)
    rows = cameras.group[views]
    shared, own = cameras.shared[rows].copy(), np.arange(len(views), dtype=np.int64)
    prior, free = adjustment.row_prior(model), adjustment.free(model)
    mean, std, longest = prior.mean[rows].copy(), prior.std[rows].copy(), model.sizes[views].max(axis=1)
    units = {**dict.fromkeys(CENTRE, longest), SKEW: cameras.intrinsics[rows, FOCAL]}
    for column in columns:
        shared[:, column], free[column] = own, True
        if np.isfinite(own_std):
            mean[:, column] = cameras.intrinsics[rows, column]
            std[:, column] = own_std * units.get(column, 1.0)
        else:
            # Images may be crops.
            std[:, column] = 0.1 * longest if column in CENTRE else np.inf
    known = IntrinsicsPrior.unshared(mean, std)
    if np.isfinite(focal_spread):
        spread = np.where(np.arange(mean.shape[1]) == FOCAL, focal_spread, np.inf)
        known = replace(known, kind=cameras.shared[rows, FOCAL], spread=spread)
    cameras = replace(cameras.of_views(views), shared=shared)
    seen = seen._replace(view_index=np.searchsorted(views, seen.view_index))
    return cameras, model.X, seen, free, known


def _adjusted(model: MetricEstimate, adjustment: MetricAdjustment, case: _Case) -> MetricBundleResult:
    """Adjust a case at the noise of the model, with covariances."""
    cameras, X, seen, free, prior = case
    options = replace(adjustment.options(model), covariance=True, noise_floor_px=model.sigma_px)
    return refine_metric_bundle(cameras, X, seen, free=free, prior=prior, options=options)


def _adjust_per_view(
    model: MetricEstimate, adjustment: MetricAdjustment, columns: tuple[int, ...], spread: float = np.inf
) -> MetricBundleResult:
    """Adjust the views with unknown own values in some columns of intrinsics; ``spread`` of the focals."""
    case = _per_view(model, adjustment, columns, focal_spread=spread)
    return _adjusted(model, replace(adjustment, inflation=1.0), case)


class Deviations(NamedTuple):
    """Relative standard deviation of the focal lengths by deviations of the images from the camera model.

    ``readout`` is that of a rolling shutter, in times between consecutive images; 0: no evidence.
    """

    focal: float
    readout: float = 0.0
    readout_std: float = 0.0

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence about a rolling shutter."""
        return (Notice("rolling-shutter", abs(self.readout), self.readout_std),) if self.readout else ()


def deviations_of_images(
    model: MetricEstimate, adjustment: MetricAdjustment, *, critical: bool, contradicted: bool
) -> Deviations:
    """Measure the effect of deviations of the images from the camera model.

    Images may have own aspect ratios and skews; with up to six images or after a ``critical`` motion own
    principal points too, as large as possible if ``contradicted``. Videos may show a rolling shutter.
    """
    focal = model.cameras.shared[model.cameras.group[model.registered], FOCAL]
    few = len(focal) <= 6
    if not few and len(np.unique(focal)) == len(focal):
        return Deviations(0.0)
    model, weak = runs_of_views(model), few or critical
    scales = np.ones(1) if weak and contradicted else (np.arange(50) + 0.5) / 50
    kinds = ((ASPECT, SKEW), CENTRE) if weak else ((ASPECT, SKEW),)
    variance = sum(_variance_by_own_values(model, adjustment, columns, scales) for columns in kinds)
    shutter = _change_by_rolling_shutter(model, adjustment)
    return shutter._replace(focal=float(np.hypot(np.sqrt(variance), shutter.focal)))


def _variance_by_own_values(
    model: MetricEstimate, adjustment: MetricAdjustment, columns: tuple[int, ...], scales: F64
) -> float:
    """Variance of the focal lengths (log) if the images have own values in ``columns``.

    The own values are normal about the shared ones with ``OWN_STD`` times one of the ``scales``, averaged
    over its posterior; see bundle-adjustment.md. With eigenvalues l of the information on the own values,
    their gradient h, the response b of a focal length and w = s^2 / (1 + s^2 l): log likelihood sum (w h^2 -
    log(1 + s^2 l)) / 2.
    """
    noise = adjustment.inflation * model.sigma_px, model.loss_sigmas * model.sigma_px
    fit = linearise_fit(*_per_view(model, adjustment, columns, own_std=OWN_STD), noise)
    terms, number = fit.values.terms, fit.values.number
    own, focals = (np.unique(number[:, c][number[:, c] >= 0]) for c in (columns, (FOCAL,)))
    if not len(focals):
        return 0.0
    unit = terms.information().diagonal()[own] ** -0.5
    C = fit.solve(np.eye(fit.information.shape[0])[:, fit.first + own]) / unit
    gradient = fit.J.T @ fit.residual
    gradient[fit.first :] += terms.gradient(fit.start)
    information = np.linalg.inv(C[fit.first + own] / unit[:, None])
    eigenvalues, V = np.linalg.eigh(0.5 * (information + information.T))
    eigenvalues = np.maximum(eigenvalues - 1.0, 0.0)
    h = V.T @ information @ (C.T @ gradient)
    b = C[fit.first + focals] @ information @ V
    square = scales[:, None] ** 2
    w = square / (1.0 + square * eigenvalues)
    likelihood = 0.5 * (w @ h**2 - np.log1p(square * eigenvalues).sum(axis=1))
    posterior = np.exp(likelihood - likelihood.max())
    return float((posterior @ ((w @ (b * h).T) ** 2 + w @ (b**2).T)).max() / posterior.sum())


def _change_by_rolling_shutter(model: MetricEstimate, adjustment: MetricAdjustment) -> Deviations:
    """Largest change of a focal length (log) by the readout time of a rolling shutter, and the readout.

    A point in row y is seen when the camera has moved by (y / height - 1/2) of the readout to the next image.
    """
    t, index = model.tracks, np.flatnonzero(model.inlier)
    view = t.view_index[index]
    shift = _displacement_to_next(model, index)
    # The readout is a part of the time between the images of a video, and meaningless between photographs.
    if np.median(np.linalg.norm(shift, axis=1) / model.sizes[view].max(axis=1)) > 0.1:
        return Deviations(0.0)
    shift *= (t.xy[index, 1] / model.sizes[view, 1] - 0.5)[:, None]

    def adjusted(readout: float) -> MetricBundleResult:
        xy = t.xy.copy()
        xy[index] -= readout * shift
        return _adjust_per_view(replace(model, tracks=replace(t, xy=xy)), adjustment, ())

    # The cost near 0 is a parabola: the score test decides without a search.
    before = adjusted(0.0)
    low, high = adjusted(-READOUT_STEP).cost, adjusted(READOUT_STEP).cost
    slope, curvature = (high - low) / 2.0, high + low - 2.0 * before.cost
    if not (curvature > 0.0 and _beyond_chance(0.5 * slope**2 / curvature, 1)):
        return Deviations(0.0)
    search = {"bounds": (-1.0, 1.0), "method": "bounded", "options": {"xatol": 0.01}}
    found = scipy.optimize.minimize_scalar(lambda readout: adjusted(readout).cost, **search)
    after = adjusted(float(found.x))
    if not _beyond_chance(before.cost - after.cost, 1):
        return Deviations(0.0)
    focals = (one.cameras.intrinsics[:, FOCAL] for one in (before, after))
    change = float(np.abs(np.subtract(*map(np.log, focals))).max())
    # The cost is half of chi-square, of residuals that depend on each other.
    std = USUAL_INFLATION * READOUT_STEP / float(np.sqrt(curvature))
    return Deviations(change, float(found.x), std)


def _displacement_to_next(model: MetricEstimate, index: I64) -> F64:
    """Displacement (n, 2) px of observations ``index`` in the time between consecutive images."""
    t, c, views = model.tracks, model.cameras, np.flatnonzero(model.registered)
    a, b = views[np.clip(np.arange(len(views)) + np.array([[-1], [1]]), 0, len(views) - 1)]
    step = np.zeros((len(c.R), 6))
    turn = c.R[b] @ c.R[a].transpose(0, 2, 1)
    step[views, :3] = scipy.spatial.transform.Rotation.from_matrix(turn).as_rotvec()
    step[views, 3:] = -np.einsum("vab,vb->va", c.R[views], c.centres[b] - c.centres[a])
    step[views] *= SMALL / (b - a)[:, None]
    R, translation = np.empty_like(c.R), np.empty_like(c.t)
    move_poses(np.ascontiguousarray(c.R), np.ascontiguousarray(c.t), step, R, translation)
    moved = replace(model, cameras=replace(c, R=R, t=translation))
    seen = (t.view_index[index], t.point_index[index])
    return (reproject_observations(moved, *seen)[0] - reproject_observations(model, *seen)[0]) / SMALL


@dataclass(frozen=True)
class SharedCameraTest:
    """Result of the test of shared intrinsics.

    ``found`` are contradictions, each with advice; ``warnings`` are on sets of views that cannot be tested,
    and ``focal_std`` (V,) is the relative standard deviation of their focal lengths, NaN elsewhere.
    ``contradicted`` (8,) are the intrinsics that differ between views. ``misfit`` is chi-square per degree of
    freedom of the shared focal lengths if those of single views differ by more than chance but only by
    harmless amounts, else 1.
    """

    found: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    focal_std: F64
    contradicted: B8
    misfit: float = 1.0

    @property
    def failed_checks(self) -> tuple[str, ...]:
        """A sentence for each contradiction."""
        return tuple(f"{fact}. {advice}" for fact, advice in self.found)


@dataclass(frozen=True, eq=False)
class _SharedGroup:
    """Registered views (``places`` in their list) that share a value, or whose value is ``known``."""

    places: I64
    known: bool = False

    @property
    def degrees_of_freedom(self) -> int:
        return len(self.places) - (0 if self.known else 1)


def check_shared_cameras(model: MetricEstimate, adjustment: MetricAdjustment) -> SharedCameraTest:
    """Test shared focals and principal points of two views or more by the decrease in cost (chi-square)."""
    everywhere, model = model.registered, runs_of_views(model)
    views = np.flatnonzero(model.registered)
    focal_std = np.full(len(model.registered), np.nan)
    contradicted = np.zeros(WIDTH, dtype=bool)
    focals, centres = _sets(model, adjustment, views, FOCAL), _sets(model, adjustment, views, CENTRE[0])
    if not focals and not centres:
        return SharedCameraTest((), (), focal_std, contradicted)
    freed: tuple[int, ...] = (FOCAL,) if focals else ()
    found, warnings, misfit = list[tuple[str, str]](), list[str](), 1.0
    before = _adjust_per_view(model, adjustment, ())
    if focals:
        alone = _adjust_per_view(model, adjustment, freed)
        decrease = _beyond_chance(before.cost - alone.cost, sum(s.degrees_of_freedom for s in focals))
        own = (np.log(alone.cameras.intrinsics[s.places, FOCAL]) for s in focals)
        far = [bool(np.abs(log - np.median(log)).max() > MIN_FOCAL_DIFFERENCE) for log in own]
        apart = [s for s, differs in zip(focals, far, strict=True) if decrease and differs]
        misfit = max(decrease, 1.0) if not apart else 1.0
        found += [_focals_differ(views, alone, s) for s in apart]
        contradicted[FOCAL] = bool(apart)
        for s in [s for s in focals if s not in apart]:
            # With less certain own focals the sharing cannot be tested.
            if (std := float(_focal_std(alone, s.places).max())) > 0.03:
                focal_std[views[s.places]] = _std_of_a_kind(model, adjustment, s)
                known = f"only to {std:.0%} (1 sigma)" if std < 1.0 else "not at all"
                warnings.append(Notice("untestable-shared-focal", known, ZOOM_STD))
        before = alone
        bent = [set(s.places.tolist()) for s in apart]
        centres = [s for s in centres if not any(b & set(s.places.tolist()) for b in bent)]
    if centres:
        both = _adjust_per_view(model, adjustment, (*freed, *CENTRE))
        freedom = 2 * sum(s.degrees_of_freedom for s in centres)
        for s in centres if _beyond_chance(before.cost - both.cost, freedom) else ():
            off = _centres_off(model, adjustment, views, both, s)
            if np.abs(off).max() > MIN_CENTRE_DIFFERENCE:
                found.append(_centres_differ(s, off))
                contradicted[list(CENTRE)] |= not s.known
    if np.isfinite(focal_std).any():
        focal_std[everywhere & ~model.registered] = np.nanmax(focal_std)
    return SharedCameraTest(tuple(found), tuple(warnings), focal_std, contradicted, misfit)


def _sets(model: MetricEstimate, adjustment: MetricAdjustment, views: I64, column: int) -> list[_SharedGroup]:
    """Views that share a column; those whose principal point is known."""
    rows = model.cameras.group[views]
    known = adjustment.row_prior(model).std[rows, column] == 0.0
    number = model.cameras.shared[rows, column]
    sets = [_SharedGroup(np.flatnonzero((number == k) & ~known)) for k in np.unique(number)]
    if column != FOCAL:
        sets.append(_SharedGroup(np.flatnonzero(known), known=True))
    return [s for s in sets if len(s.places) >= 2]


def _beyond_chance(decrease: float, freedom: int) -> float:
    """``decrease`` in cost by more unknowns, chi-square per degree of freedom; 0 if it may be chance."""
    saved = 2.0 * decrease / USUAL_INFLATION**2
    return saved / freedom if saved > scipy.special.chdtri(freedom, 1e-3) else 0.0


def _focal_std(fit: MetricBundleResult, rows: I64) -> F64:
    """Inflated relative standard deviations of the focals of ``rows``, from 0.002 on; inf: undetermined."""
    variance = fit.intrinsics_covariance[rows, FOCAL, FOCAL]
    std = USUAL_INFLATION * np.sqrt(np.maximum(variance, 0.0)) / fit.cameras.intrinsics[rows, FOCAL]
    return np.where(np.isfinite(std) & (variance > 0.0), np.hypot(std, 2e-3), np.inf)


def _std_of_a_kind(model: MetricEstimate, adjustment: MetricAdjustment, s: _SharedGroup) -> float:
    """Relative standard deviation of the shared focal of a set if its focals scatter by ``ZOOM_STD``."""
    # Standard deviations are inflated afterwards, the assumed scatter must not be.
    scattered = _adjust_per_view(model, adjustment, (FOCAL,), ZOOM_STD / USUAL_INFLATION)
    rows = model.cameras.group[np.flatnonzero(model.registered)[s.places]]
    off = np.log(scattered.cameras.intrinsics[s.places, FOCAL] / model.cameras.intrinsics[rows, FOCAL])
    return float(np.hypot(_focal_std(scattered, s.places), off).max())


def _centres_off(
    model: MetricEstimate, adjustment: MetricAdjustment, views: I64, both: MetricBundleResult, s: _SharedGroup
) -> F64:
    """(n, 2) offsets, in long sides, of own principal points from the known one or the median."""
    rows = model.cameras.group[views[s.places]]
    off = (both.cameras.intrinsics[s.places] - adjustment.row_prior(model).mean[rows])[:, CENTRE]
    off /= model.sizes[views[s.places]].max(axis=1, keepdims=True)
    return np.asarray(off if s.known else off - np.median(off, axis=0))


def _focals_differ(views: I64, alone: MetricBundleResult, s: _SharedGroup) -> tuple[str, str]:
    focal, std = alone.cameras.intrinsics[s.places, FOCAL], _focal_std(alone, s.places)
    low, high = int(focal.argmin()), int(focal.argmax())
    ratio, ends = focal[high] / focal[low] - 1.0, views[s.places[[high, low]]]
    return (
        Notice("shared-focal-contradicted", ends[0], ratio, ends[1], max(std[low], std[high])),
        "Use one camera per image (cameras = per-image), or leave the zoomed images out",
    )


def _centres_differ(s: _SharedGroup, off: F64) -> tuple[str, str]:
    advice = "se one camera per image (cameras = per-image) if the images were cropped individually"
    if s.known:
        fact = Notice("given-centre-contradicted", len(s.places), np.abs(off).max())
        return fact, f"Leave it out, or u{advice}"
    return Notice("shared-centre-contradicted", len(s.places), np.ptp(off, axis=0).max()), f"U{advice}"


def contradicted_focal_priors(model: MetricEstimate, adjustment: MetricAdjustment) -> list[str]:
    """A sentence for each given focal length that differs from an adjustment without them."""
    prior = adjustment.prior
    given = np.flatnonzero(prior.focal_known & model.registered)
    if len(given) == 0:
        return []
    # Without the prior; known ones of equal value share their focal.
    cameras, rows = model.cameras, adjustment.row_prior(model)
    shared, free_std, free = cameras.shared.copy(), rows.std.copy(), adjustment.free(model)
    known = np.flatnonzero(rows.std[:, FOCAL] == 0.0)
    alike = np.unique(rows.mean[known, FOCAL], return_inverse=True)[1].reshape(-1)
    shared[known, FOCAL] = shared[:, FOCAL].max() + 1 + alike
    free_std[:, FOCAL], free[FOCAL] = np.inf, True
    known_rest, seen = IntrinsicsPrior.unshared(rows.mean, free_std), subsample_inliers(model)
    result = _adjusted(model, adjustment, (replace(cameras, shared=shared), model.X, seen, free, known_rest))
    focal, number = result.cameras.intrinsics[cameras.group, FOCAL], shared[cameras.group, FOCAL]
    std = _focal_std(result, np.arange(len(free_std)))[cameras.group]
    failed_checks: list[str] = []
    for k in np.unique(number[given]):
        view = int(given[number[given] == k][0])
        mean, deviation = float(prior.mean[view, 0]), float(prior.std[view, 0])
        off = float(np.log(focal[view] / mean))
        if abs(off) > MIN_FOCAL_DIFFERENCE and abs(off) > 3.0 * float(np.hypot(std[view], deviation)):
            whose = "" if len(np.unique(number[given])) == 1 else f" of image #{view}"
            direction = "longer" if off > 0 else "shorter"
            advice = "" if deviation == 0.0 else ", or set a larger focal_std_rel"
            found = (whose, abs(np.expm1(off)), direction, std[view], advice)
            failed_checks.append(Notice("given-focal-contradicted", *found))
    return failed_checks


def inconsistent_principal_point(
    model: MetricEstimate, adjustment: MetricAdjustment, scatter: BlockScatter
) -> list[str]:
    """Detect a deformed model: a moved principal point and blocks that disagree (right ones: up to 5)."""
    views = np.flatnonzero(model.registered)
    if scatter.blocks < MIN_BLOCKS or not scatter.overdispersion > 8.0:
        return []
    std = adjustment.prior.std[views][:, CENTRE]
    values = model.cameras.intrinsics[model.cameras.group[views]][:, CENTRE]
    off = np.abs(values - adjustment.prior.mean[views][:, CENTRE])
    sigmas = np.where(std > 0.0, off / np.where(std > 0.0, std, 1.0), 0.0).max(axis=1)
    worst = int(sigmas.argmax())
    if not sigmas[worst] > 5.0:
        return []
    share = float(off[worst].max() / model.sizes[views[worst]].max())
    return [Notice("deformed-by-centre", views[worst], share, sigmas[worst], scatter.overdispersion)]

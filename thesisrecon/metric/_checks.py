"""The self-check of a metric result: numbers per view and for the whole, and a sentence for each failure.

The identifiability is that of the cameras and points that the metric stage returns.

Averages hide a wrong camera, so each view is also checked on its own. Sentences name images as ``#number``,
which the pipeline replaces by the file name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.errors import Notice
from thesisrecon.metric import _model
from thesisrecon.metric._adjustment import MetricAdjustment
from thesisrecon.metric._shared_camera import runs_of_views, subsample_inliers
from thesisrecon.metric._uncertainty import USUAL_INFLATION, Intervals
from thesisrecon.optimize.bundle import identifiability
from thesisrecon.optimize.bundle.identifiability import CalibrationProblem, UpgradedCameras
from thesisrecon.optimize.bundle.metric import MAX_SIGMAS_TO_MINIMUM
from thesisrecon.optimize.bundle.partial import refine_pose
from thesisrecon.optimize.bundle.projection import Observations
from thesisrecon.optimize.least_squares import noise_from_distances
from thesisrecon.records import IdentifiabilityReport, IntrinsicsPrior, common_points

MIN_OBSERVATIONS = 30
MIN_INLIER_RATIO, MIN_CONFIRMED_RATIO = 0.5, 0.6
"""Inlier ratio of a view, wrong matches included, and for points that other views determine: correct cameras
reach 0.9 (0.63 in blurred phone images), wrong ones stay below 0.5."""
MIN_JOINED_SHARE = 0.5
"""Share of inliers among the tracks that join two parts of the images: right models reach 0.6, and parts
joined by matches between similar places stay below 0.45."""


class PerViewChecks(NamedTuple):
    """Measurements of each view (V,), NaN where not registered or not measurable.

    ``inlier_ratio`` of the triangulable observations; ``confirmed`` the same for points that two or more
    other views determine (two-view points fit any two cameras along their epipolar lines); ``behind`` the
    share of their observations whose point lies behind the camera; ``focal_off`` the log ratio of the view's
    own focal length, from its points alone, to the model's.
    """

    inlier_ratio: F64
    confirmed: F64
    behind: F64
    focal_off: F64
    focal_off_std: F64

    @property
    def focal_off_sigmas(self) -> F64:
        """Own focal offset in its standard deviations."""
        return np.asarray(np.abs(self.focal_off) / np.maximum(USUAL_INFLATION * self.focal_off_std, 1e-9))


def check_views(model: _model.MetricEstimate, *, sigmas: float) -> PerViewChecks:
    """Measure every registered view; ``sigmas`` is the gate of inliers in noise sigmas."""
    t, n = model.tracks, model.tracks.n_views
    agree = _model.inlier_mask(model, sigmas=sigmas)
    near = triangulable_observations(model)
    # Points that are inliers in two or more other views.
    count = np.bincount(t.point_index[agree], minlength=t.n_points)
    fixed = count[t.point_index] - agree >= 2
    # Points of wrong two-view matches lie behind the views as often as in front of them.
    known = near & fixed & (np.abs(model.X[t.point_index]).sum(axis=1) > 0)
    _, depth = _model.reproject_observations(model, t.view_index, t.point_index)
    rows = rows_of_views(t.view_index, n)
    own = [_own_camera(model, view, k[agree[k]]) for view, k in enumerate(rows)]
    return PerViewChecks(
        _share(t.view_index, agree, near, n), _share(t.view_index, agree, near & fixed, n),
        _share(t.view_index, depth <= 0, known, n),
        *(np.array(column) for column in zip(*own, strict=True)),
    )  # fmt: skip


def triangulable_observations(model: _model.MetricEstimate) -> B8:
    """Observations (K,) of points seen by two or more registered views with a baseline between them.

    A baseline above 0.002 of the distance has a usable parallax.
    """
    t, centres = model.tracks, model.cameras.centres
    near = model.registered[t.view_index]
    view, point, known = t.view_index[near], t.point_index[near], model.inlier[near]
    useful = np.bincount(point, minlength=t.n_points) >= 2
    if known.any():
        distance = np.median(np.linalg.norm(model.X[point[known]] - centres[view[known]], axis=1))
        first, apart = np.zeros(t.n_points, dtype=np.int64), np.zeros(t.n_points)
        first[point[::-1]] = view[::-1]
        np.maximum.at(apart, point, np.linalg.norm(centres[view] - centres[first[point]], axis=1))
        useful &= apart > 2e-3 * float(distance)
    return np.asarray(near & useful[t.point_index])


def _share(view: I64, good: B8, counted: B8, n: int) -> F64:
    all_ = np.bincount(view[counted], minlength=n)
    right = np.bincount(view[counted & good], minlength=n)
    return np.where(all_ > 0, right / np.maximum(all_, 1), np.nan)


class Join(NamedTuple):
    """The ``views`` of the smaller of two parts; ``inliers`` of the ``tracks`` that both parts observe."""

    views: I64
    inliers: int
    tracks: int

    @property
    def share(self) -> float:
        """Share of inliers."""
        return self.inliers / max(self.tracks, 1)

    @property
    def sentence(self) -> str:
        """The failed check if it is doubtful."""
        return Notice("doubtful-join", _named(self.views), self.inliers, self.tracks)


class SelfCheck(NamedTuple):
    """``numbers`` by name, sentences for ``failed`` checks (none: trusted), and the ``doubtful`` join."""

    numbers: dict[str, float]
    failed: list[str]
    doubtful: Join | None


def weakest_join(model: _model.MetricEstimate, near: B8) -> Join | None:
    """Find the two parts of the images whose common tracks agree least with the model; None without any.

    Matches between similar sides of an object can join two parts whose own matches are right: an edge of the
    maximum spanning tree of the views, weighted by common inliers times their share.
    """
    t, views = model.tracks, np.flatnonzero(model.registered)
    k = np.flatnonzero(near)
    view, point, inlier = np.searchsorted(views, t.view_index[k]), t.point_index[k], model.inlier[k]
    both = scipy.sparse.csr_matrix(common_points(view, point, len(views)))
    agree = scipy.sparse.triu(common_points(view[inlier], point[inlier], len(views)), 1).tocoo()
    if not agree.nnz:
        return None
    weight = agree.data**2 / np.asarray(both[agree.row, agree.col]).ravel()
    # Of least distances 1 / weight, since the tree of scipy is the minimum one.
    graph = scipy.sparse.csr_matrix((1.0 / weight, (agree.row, agree.col)), both.shape)
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    joins = []
    for edge in np.argsort(-tree.data, kind="stable")[:20]:
        rest = np.arange(len(tree.data)) != edge
        parts = scipy.sparse.csr_matrix((tree.data[rest], (tree.row[rest], tree.col[rest])), tree.shape)
        label = scipy.sparse.csgraph.connected_components(parts, directed=False)[1]
        side = label == label[tree.row[edge]]
        side = side if 2 * side.sum() <= len(side) else ~side
        tracks = _on_both_sides(side[view], point)
        joins.append(Join(views[side], _on_both_sides(side[view[inlier]], point[inlier]), tracks))
    return min(joins, key=lambda join: join.share, default=None)


def _on_both_sides(side: B8, point: I64) -> int:
    here, there = (np.bincount(point[of], minlength=int(point.max()) + 1) > 0 for of in (side, ~side))
    return int((here & there).sum())


def _own_camera(model: _model.MetricEstimate, view: int, index: I64) -> tuple[float, float]:
    """Own log focal offset of a view and its standard deviation; NaN with few observations."""
    if not model.registered[view] or len(index) < MIN_OBSERVATIONS:
        return np.nan, np.nan
    index = index[:: int(np.ceil(len(index) / 1500))]
    t, cameras = model.tracks, model.cameras
    X, xy = model.X[t.point_index[index]], t.xy[index]
    seen, _ = _model.reproject_observations(model, t.view_index[index], t.point_index[index])
    noise = max(noise_from_distances(np.linalg.norm(seen - xy, axis=1)), 1e-3)
    intrinsics = cameras.intrinsics[cameras.group[view]]
    free = np.arange(len(intrinsics)) < 2  # focal and aspect
    fit = refine_pose(
        cameras.R[view], cameras.t[view], intrinsics, X, xy, free=free, loss_px=2.0 * noise, iterations=10
    )
    left = max(noise_from_distances(np.linalg.norm(fit.residual_px, axis=1)), 1e-3)
    std = left * np.sqrt(max(fit.covariance[6, 6], 0.0))
    return float(np.log(fit.intrinsics[0] / intrinsics[0])), float(std)


def self_check(
    model: _model.MetricEstimate, initial: F64, intervals: Intervals, *, sigmas: float
) -> SelfCheck:
    """Check a metric model (chapter 7); ``initial`` K (V, 3, 3) of self-calibration, zeros where it had none.

    ``intervals`` are as in ``MetricResult``, ``sigmas`` is the gate of inliers.
    """
    views = np.flatnonzero(model.registered).tolist()
    longest = model.sizes[views].max(axis=1)
    rows = model.cameras.intrinsics[model.cameras.group[views]]
    near = triangulable_observations(model)
    before = initial[views, 0, 0]
    both = before > 0
    focals = [intervals[v]["focal_px"] for v in views]
    agree, noise = _model.inlier_mask(model, sigmas=sigmas), _model.residual_norms(model)
    shift = np.linalg.norm(rows[:, 3:5] - (model.sizes[views] - 1) / 2, axis=1) / longest
    centres = [(intervals[v]["principal_x_px"].std, intervals[v]["principal_y_px"].std) for v in views]
    uncertain = np.max(centres, axis=1) / longest
    change = np.abs(np.log(rows[both, 0] / before[both]))
    check = {
        "focal_min_long_sides": float((rows[:, 0] / longest).min()),
        "focal_max_long_sides": float((rows[:, 0] / longest).max()),
        "focal_std_rel_max": max(focal.std / focal.value for focal in focals),
        "explained_share": float(agree[near].mean()) if near.any() else 0.0,
        "sigma_rel": float(noise_from_distances(noise) / np.median(longest)) if len(noise) else np.inf,
        "principal_shift_max_long_sides": float(shift.max()),
        # Images that determine their principal point better than this may be crops.
        "principal_shift_undetermined": float(shift[uncertain > 0.015].max(initial=0.0)),
        "aspect_std_max": max(intervals[v]["aspect"].std for v in views),
        "focal_change_since_calibration": float(change.max()) if both.any() else 0.0,
        "sigmas_to_minimum": model.sigmas_to_minimum,
    }
    each = check_views(model, sigmas=sigmas)
    worst = {
        "explained_share_worst_view": (each.inlier_ratio, np.nanmin),
        "confirmed_share_worst_view": (each.confirmed, np.nanmin),
        "behind_share_worst_view": (each.behind, np.nanmax),
        "own_focal_off_worst_view": (np.abs(each.focal_off), np.nanmax),
        "own_focal_sigmas_worst_view": (each.focal_off_sigmas, np.nanmax),
    }
    for name, (values, edge) in worst.items():
        check[name] = float(edge(values)) if np.isfinite(values).any() else np.nan
    join = weakest_join(model, near)
    check["joined_share_weakest"] = np.nan if join is None else join.share
    failed = _failed_views(each, model)
    doubtful = None if join is None or join.share >= MIN_JOINED_SHARE else join
    if doubtful is not None:
        failed.append(doubtful.sentence)
    return SelfCheck(check, [*failed, *_failed_model(check)], doubtful)


def _failed_views(views: PerViewChecks, model: _model.MetricEstimate) -> list[str]:
    """A sentence for the views with each failure, the most severe one of each view."""
    left = model.registered.copy()

    def take(bad: B8) -> I64:
        taken = np.flatnonzero(left & bad)
        left[taken] = False
        return taken

    failed: list[str] = []
    if len(wrong := take(views.confirmed < MIN_CONFIRMED_RATIO)):
        failed.append(Notice("view-unconfirmed", _named(wrong), _range(views.confirmed[wrong])))
    if len(wrong := take(~(views.inlier_ratio >= MIN_INLIER_RATIO))):
        failed.append(Notice("view-inliers", _named(wrong), _range(views.inlier_ratio[wrong])))
    if len(wrong := take(views.behind > 0.05)):
        failed.append(Notice("points-behind", _named(wrong), _range(views.behind[wrong])))
    for view in take((np.abs(views.focal_off) > 0.03) & (views.focal_off_sigmas > 5.0)):
        off = float(np.expm1(views.focal_off[view]))
        failed.append(Notice("own-focal", view, abs(off), "longer" if off > 0.0 else "shorter"))
    return failed


def _named(views: I64) -> str:
    """ "Image #3" or "Images #1, #4 and #7"."""
    numbers = [f"#{view}" for view in views]
    if len(numbers) == 1:
        return f"Image {numbers[0]}"
    return f"Images {', '.join(numbers[:-1])} and {numbers[-1]}"


def _range(shares: F64) -> str:
    low, high = (f"{100.0 * np.nan_to_num(edge(shares)):.0f}" for edge in (np.min, np.max))
    return f"{low} %" if low == high else f"{low} to {high} %"


def _failed_model(check: Mapping[str, float]) -> list[str]:
    """A sentence for each failed check of the model as a whole."""
    low, high = check["focal_min_long_sides"], check["focal_max_long_sides"]
    std, share, noise = check["focal_std_rel_max"], check["explained_share"], check["sigma_rel"]
    shift, aspect_std = check["principal_shift_undetermined"], check["aspect_std_max"]
    far = check["sigmas_to_minimum"]
    passed = {
        Notice("not-converged", far): not far > MAX_SIGMAS_TO_MINIMUM,
        Notice("implausible-focal", low, high): low > 0.2 and high < 20.0,
        Notice("focal-std", std): std < 0.15,
        Notice("low-model-inliers", share): share > 0.6,
        Notice("large-noise", noise): noise < 0.0015,
        # Cropping a tenth of the image on two sides moves the principal point by 0.12 long sides.
        Notice("centre-shift", shift): shift < 0.15,
        # An object is stretched by the error of the aspect ratio.
        Notice("aspect-std", aspect_std): aspect_std < 0.05,
    }
    return [sentence for sentence, ok in passed.items() if not ok]


def returned_cameras(model: _model.MetricEstimate) -> UpgradedCameras:
    """Return the registered cameras and valid points, from which the motion is measured."""
    v, cameras = np.flatnonzero(model.registered), model.cameras
    focal = cameras.intrinsics[cameras.group[v], _model.FOCAL] / model.sizes[v].max(axis=1)
    return UpgradedCameras(focal, cameras.R[v], cameras.centres[v], model.X[model.valid])


def check_returned(
    model: _model.MetricEstimate,
    adjustment: MetricAdjustment,
    motion: Mapping[str, float],
    intervals: Intervals,
) -> IdentifiabilityReport:
    """Check whether images and prior determine a model; the ``intervals`` say how well focals are known."""
    part = runs_of_views(model)
    seen = subsample_inliers(part)
    count = np.bincount(seen.view_index, minlength=len(model.registered))
    # The poses of views with fewer of the observations may be undetermined.
    views = np.flatnonzero(part.registered & (count >= min(10, int(np.sort(count)[-3:][0]))))
    used = np.flatnonzero(np.isin(seen.view_index, views))
    used = used[(np.bincount(seen.point_index[used]) >= 2)[seen.point_index[used]]]
    c, rows, prior = model.cameras, model.cameras.group[views], adjustment.row_prior(model)
    problem = CalibrationProblem(
        c.of_views(views), model.X,
        Observations(np.searchsorted(views, seen.view_index[used]), seen.point_index[used], seen.xy[used]),
        IntrinsicsPrior.unshared(prior.mean[rows], prior.std[rows]), max(model.sigma_px, 1e-3),
        len(used) / max(int(model.inlier.sum()), 1), model.sizes[views].max(axis=1).astype(np.float64), views,
    )  # fmt: skip
    focals = [intervals[v]["focal_px"] for v in views.tolist()]
    std = np.array([focal.std / focal.value for focal in focals])
    excess = identifiability.excess_equations(adjustment.prior, model.registered)
    everywhere = np.flatnonzero(model.registered)
    focal = c.intrinsics[c.group[everywhere], _model.FOCAL] / model.sizes[everywhere].max(axis=1)
    motion = {**motion, "focal_long_sides": float(np.median(focal))}
    return identifiability.identifiability_report(problem, excess, motion=motion, focal_std=std)

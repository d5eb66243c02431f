"""The metric stage: from self-calibration (chapter 7) to the final metric model.

Every candidate calibration is adjusted on its cameras; the best is completed by calibrated resection of the
missing cameras, triangulated and adjusted under the prior until the inliers no longer change. Intrinsics of
cameras of the same kind that are not shared get a hierarchical prior. The result is checked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon import records
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.metric import _adjustment, _lens, _model, _shared_camera, _uncertainty
from thesisrecon.metric._adjustment import MetricAdjustment
from thesisrecon.metric._checks import Join, check_returned, returned_cameras, self_check
from thesisrecon.metric._model import EARLY_SIGMAS, K1, LATE_SIGMAS, MetricEstimate
from thesisrecon.metric._resection import MIN_POINTS, WITHOUT_K2_K3, register_missing_cameras
from thesisrecon.optimize.bundle import identifiability
from thesisrecon.optimize.bundle.knowledge import NO_PRIOR, PositionPrior
from thesisrecon.optimize.bundle.scatter import (
    BlockScatter,
    LinearisedFit,
    block_scatter,
    decentring_score,
    pose_uncertainty,
)
from thesisrecon.optimize.least_squares import noise_from_distances

MAX_REMAINING = 0.25
"""Largest cost of held-out observations of a richer camera model that is adopted, over the simple one's."""
NOT_EXPLAINED = (
    "One value per image hardly predicts held-out observations better, so the shared values stay; their "
    "intervals contain the difference"
)


class _Finished(NamedTuple):
    model: MetricEstimate
    adjustment: MetricAdjustment
    own: _uncertainty.PerCameraEstimates
    fit: LinearisedFit
    scatter: BlockScatter


_Settled = tuple[_Finished, _shared_camera.SharedCameraTest, tuple[str, ...], tuple[float, float]]


@dataclass(frozen=True)
class MetricRefinement:
    """Metric refinement of a calibrated projective reconstruction (6.7)."""

    def refine(
        self, reconstruction: records.Reconstruction, calibration: records.SelfCalibration, *,
        prior: records.IntrinsicsPrior, rng: np.random.Generator, threads: int = 1,
        centres: PositionPrior = NO_PRIOR,
    ) -> records.MetricResult:  # fmt: skip
        """See `thesisrecon.config.MetricRefiner.refine`; ``centres``: known positions of cameras."""
        adjustment = MetricAdjustment(
            prior, lens_std=0.02, noise_floor_px=0.02, threads=threads, centres=centres
        )
        trials = [_start(reconstruction, u, adjustment) for u in calibration.candidates]
        models = [m for m in trials if m is not None]
        if not models and not prior.focal_known.any():
            raise StageFailure.of("no-metric-model", len(trials))
        if not models:
            wide = float(prior.std[prior.focal_known, 0].max())
            advice = ", or set a larger focal_std_rel" if wide > 0.0 else ""
            raise StageFailure.of("focal-against-images", advice, len(trials), wide)
        gate = 3.0 * float(np.median([m.sigma_px for m in models]))
        # One minus the truncated quadratic cost of all observations.
        near = [np.maximum(1.0 - (_model.residual_norms(m) / gate) ** 2, 0.0).sum() for m in models]
        shares = [float(share) / len(m.tracks.xy) for share, m in zip(near, models, strict=True)]
        best = int(np.argmax(shares))
        model, rejected = register_missing_cameras(models[best], adjustment, rng)
        model, adjustment = _lens.with_best_lens(model, adjustment)
        reasons = tuple("" if there else rejected.get(v, "") for v, there in enumerate(model.registered))
        # In large sets the points are selected again by the residuals of the model adjusted to the selection.
        selected = model.tracks.n_points != reconstruction.tracks.n_points
        before = np.empty(0, dtype=np.int64)
        for _ in range(5 if selected else 0):
            model, points = _model.with_precise_points(model, reconstruction.tracks)
            model = adjustment.run(model)[0]
            if len(np.intersect1d(points, before)) >= 0.98 * len(points):
                break
            before = points
        model, adjustment, finished = _finished_with_decentring(model, adjustment)
        assessed = _assess(settle_camera_model(finished), reconstruction.tracks, calibration, reasons)
        if assessed[0].trusted:
            return assessed[0]
        part = _trusted_part(assessed, model, adjustment, reconstruction.tracks, calibration)
        return assessed[0] if part is None else part


def _trusted_part(
    assessed: tuple[records.MetricResult, Join | None], model: MetricEstimate, adjustment: MetricAdjustment,
    tracks: records.Tracks, calibration: records.SelfCalibration,
) -> records.MetricResult | None:  # fmt: skip
    """The model without the views whose join is doubtful, adjusted again; None if that is not trusted."""
    result, doubtful = assessed
    joins, reasons, before = list[str](), list(result.reconstruction.reasons), model.registered.sum()
    while not result.trusted:
        if doubtful is None:
            return None
        joins.append(doubtful.sentence)
        registered = model.registered.copy()
        registered[doubtful.views] = False
        if registered.sum() < 3:
            return None
        for view in doubtful.views.tolist():
            reasons[view] = Notice("doubtful-side")
        model = _model.retriangulate_tracks(replace(model, registered=registered), sigmas=LATE_SIGMAS)
        if model.inlier.sum() < _adjustment.MIN_OBSERVATIONS:
            return None
        settled = settle_camera_model(finish_metric(model, adjustment))
        result, doubtful = _assess(settled, tracks, calibration, tuple(reasons))
    check = {**result.self_check, "views_left_out": float(before - model.registered.sum())}
    return replace(result, self_check=check, warnings=(*result.warnings, *joins))


def _assess(
    settled: _Settled, tracks: records.Tracks, calibration: records.SelfCalibration, reasons: tuple[str, ...]
) -> tuple[records.MetricResult, Join | None]:
    """State the intervals of a final model with all ``tracks``, and check it; also its doubtful join."""
    final, sharing, enlarged, difference = settled
    model, adjustment, own, fit, scatter = final
    shrinkage = _uncertainty.focal_shrinkage(own, adjustment.hierarchical, model.cameras.group)
    uncertainty = pose_uncertainty(fit, _uncertainty.MODEL_FLOOR_REL)
    intervals = _uncertainty.intrinsic_intervals(model, adjustment, scatter, shrinkage, uncertainty)
    intervals = _uncertainty.widen_unverified_focals(intervals, sharing.focal_std)
    intervals = _uncertainty.widen_by_camera_model(intervals, difference, sharing.misfit)
    complete = _model.with_tracks(model, tracks)
    motion = identifiability.measure_motion(returned_cameras(complete))
    critical = identifiability.nearest_critical_motion(motion)[1] < 1.0
    deviations = _shared_camera.deviations_of_images(
        model, adjustment, critical=critical, contradicted=bool(enlarged)
    )
    intervals = _uncertainty.widen_by_camera_model(intervals, (deviations.focal, 0.0), 1.0)
    angles = _uncertainty.with_angles_of_view(model, uncertainty, scatter, intervals)
    if _lens.undetermined_lens(model, angles, motion) or (
        critical and _lens.reach_of_points(model) < _lens.MIN_REACH
    ):
        # Near the centre of the images the effect of distortion is as small as other errors.
        expected = _uncertainty.changes_by_expected_lens(model, adjustment, uncertainty)
        intervals = _uncertainty.widen_by_camera_model(intervals, expected, 1.0)
    report = check_returned(model, adjustment, motion, intervals)
    poses = _uncertainty.pose_std(model, uncertainty, scatter, intervals)
    change = adjustment.lens_change
    intervals = _uncertainty.with_angles_of_view(model, uncertainty, scatter, intervals, change)
    model = complete
    checked = self_check(model, calibration.K, intervals, sigmas=LATE_SIGMAS)
    # An enlarged camera model replaces the prior that the images contradicted; pairs know a lens only nearly.
    failed_checks = list(() if report.identifiable else report.sentences)
    before = calibration.identifiability
    if before is not None and before.prior_contradicted and not enlarged and adjustment.prior.lens is None:
        count = counted(int((calibration.K[:, 0, 0] > 0.0).sum()), "image")
        why = identifiability.excess_noise(before.evidence)
        failed_checks.append(Notice("start-contradicts-prior", count, why))
    failed_checks += checked.failed
    failed_checks += [*_shared_camera.contradicted_focal_priors(model, adjustment), *sharing.failed_checks]
    failed_checks += _shared_camera.inconsistent_principal_point(model, adjustment, scatter)
    if deviations.focal > _adjustment.MAX_CHANGE:
        failed_checks.append(Notice("focal-by-camera-model", deviations.focal))
    views = np.flatnonzero(model.registered).tolist()
    warnings = shrinkage.warnings(views, 0.1 / 1.96) + sharing.warnings
    warnings += _lens.undetermined_lens(model, intervals, motion) + deviations.warnings
    result = records.MetricResult(
        as_reconstruction(model, reasons), tuple(intervals), checked.numbers, not failed_checks,
        tuple(failed_checks), warnings, enlarged, report, poses,
    )  # fmt: skip
    return result, checked.doubtful


def _start(
    reconstruction: records.Reconstruction, upgrade: records.Upgrade, adjustment: MetricAdjustment
) -> MetricEstimate | None:
    """Upgrade the core cameras and adjust them on projective inliers while the gate narrows."""
    model = _model.upgraded_model(reconstruction, upgrade, adjustment.prior)
    if model is None:
        return None
    # In large sets a selection of points that cover every image: known points first, then long tracks.
    t = model.tracks
    if len(t.xy) > _model.MAX_OBSERVATIONS or _model.seen_views(t) > _model.MANY_VIEWS:
        order = np.lexsort((-np.bincount(t.point_index, minlength=t.n_points), ~model.valid))
        points = _model.select_spread_points(model, order, _model.LONG_PER_VIEW)
        model = _model.restrict_points(model, points)
    # Without distortion the noise is overestimated: keep the gate at least as wide as before.
    gentle = replace(adjustment, noise_floor_px=max(0.1, adjustment.noise_floor_px))
    # Loss and gates, but not the weight of the prior, begin with the residuals at the start.
    norms = _model.residual_norms(model)
    if len(norms := norms[np.isfinite(norms)]):
        wider = max(1.0, noise_from_distances(norms) / model.sigma_px)
        model = replace(model, tail=wider, loss_sigmas=2.0 * wider)
    start = _adjustment.FOCAL_AND_CENTRE if adjustment.prior.lens is None else WITHOUT_K2_K3
    for _ in range(3):
        if model.valid.sum() < 20:
            return None
        model = _model.select_inliers(model, sigmas=EARLY_SIGMAS, min_angle=0.0)
        if model.inlier.sum() < _adjustment.MIN_OBSERVATIONS:
            return None
        model = gentle.run(model, free=start, iterations=15)[0]
    return _model.select_inliers(model, sigmas=EARLY_SIGMAS, min_angle=0.0)


def settle_camera_model(simple: _Finished) -> _Settled:
    """Choose between the shared camera model and richer ones if the images contradict shared intrinsics.

    Pixels that are not square look like zooms and crops: an unknown aspect ratio is tried first. One value
    per image is adopted if it predicts held-out observations far better. If it hardly changes the cameras,
    contradictions are limitations, and the differences, over the focal, widen the intervals.
    """
    chosen, sharing = simple, _shared_camera.check_shared_cameras(*simple[:2])
    square, limitations, difference = tuple[str, ...](), tuple[str, ...](), (0.0, 0.0)
    if sharing.failed_checks and not simple.adjustment.prior.std[:, _model.ASPECT].any():
        std = simple.adjustment.prior.std.copy()
        std[:, _model.ASPECT] = np.inf
        rich = finish_metric(*_adjustment.with_prior(*simple[:2], replace(simple.adjustment.prior, std=std)))
        if _adjustment.remaining_cost(simple[:2], rich[:2]) < MAX_REMAINING:
            simple = chosen = rich
            sharing, cameras = _shared_camera.check_shared_cameras(*rich[:2]), rich.model.cameras
            ratios = cameras.intrinsics[cameras.group[rich.model.registered], _model.ASPECT]
            square = (Notice("pixels-not-square", ratios[np.abs(np.log(ratios)).argmax()]),)
    for columns in _adjustment.richer_models(sharing.contradicted, simple[1].prior):
        if not sharing.failed_checks:
            break
        shared = simple.adjustment.prior.shared.copy()
        shared[:, columns] = np.arange(len(shared))[:, None]
        own = replace(simple.adjustment.prior, shared=shared)
        rich = finish_metric(*_adjustment.with_prior(*simple[:2], own))
        if _adjustment.remaining_cost(chosen[:2], rich[:2]) < MAX_REMAINING:
            chosen, sharing = rich, _shared_camera.check_shared_cameras(*rich[:2])
            limitations, difference = (_adjustment.differences_of_images(rich.model, columns),), (0.0, 0.0)
        elif (change := _adjustment.camera_differences(chosen.model, rich.model)).harmless:
            difference = max(difference[0], change.focal), max(difference[1], change.principal_point)
    if sharing.failed_checks and any(difference):
        limitations += tuple(f"{fact}. {NOT_EXPLAINED}" for fact, _ in sharing.found)
        sharing = replace(sharing, found=())
    return chosen, sharing, (*square, *limitations), difference


def finish_metric(model: MetricEstimate, adjustment: MetricAdjustment) -> _Finished:
    """Adjust everything, then again with the noise that blocks of the scene show and a hierarchical prior."""
    model = _iterate_inliers(model, adjustment)
    scatter = block_scatter(adjustment.linearised(model))
    own = _uncertainty.per_camera_estimates(model, adjustment, scatter)
    hierarchical = _uncertainty.estimate_hierarchical_prior(own, model.cameras.shared)
    # Correlated errors do not average out: without the inflation they would overrule every prior.
    adjustment = replace(adjustment, inflation=scatter.inflation)
    if hierarchical is not None:
        shared = model.cameras.shared.copy()
        for kind in np.unique(hierarchical.kind[hierarchical.kind >= 0]):
            those = np.flatnonzero(hierarchical.kind == kind)
            # Cameras of one zoom setting share k2 and k3.
            if hierarchical.spread[those[0], _model.FOCAL] < 0.01:
                shared[those, K1 + 1 :] = shared[those[0], K1 + 1 :]
        model = replace(model, cameras=replace(model.cameras, shared=shared))
        adjustment = replace(adjustment, hierarchical=hierarchical)
    # Principal points over 3 standard deviations off, a false minimum, are moved back.
    rows, first = model.cameras.intrinsics.copy(), np.unique(model.cameras.group, return_index=True)[1]
    mean, std = (a[first][:, _model.CENTRE] for a in (adjustment.prior.mean, adjustment.prior.std))
    far = np.any(np.abs(rows[:, _model.CENTRE] - mean) > 3.0 * std, axis=1, keepdims=True)
    rows[:, _model.CENTRE] = np.where(far, mean, rows[:, _model.CENTRE])
    model = replace(model, cameras=replace(model.cameras, intrinsics=rows))
    model = _iterate_inliers(model, adjustment)
    fit, alone = adjustment.linearised(model), replace(adjustment, hierarchical=None)
    scatter = block_scatter(fit)
    single = scatter if hierarchical is None else block_scatter(alone.linearised(model))
    return _Finished(model, adjustment, _uncertainty.per_camera_estimates(model, alone, single), fit, scatter)


def _finished_with_decentring(
    model: MetricEstimate, adjustment: MetricAdjustment
) -> tuple[MetricEstimate, MetricAdjustment, _Finished]:
    """Finish a model; a nearly straight lens is decentred if a score test and held-out observations agree."""
    finished = finish_metric(model, adjustment)
    narrow = adjustment.prior.lens_model == "auto" and model.cameras.intrinsics.shape[1] == _model.WIDTH
    limit = scipy.special.chdtri(2, 1e-3)
    narrow &= adjustment.shares_a_lens(model)
    if narrow and decentring_score(finished.fit, _model.DECENTRING_STD) > limit:
        prior = replace(adjustment.prior, lens_model="brown")
        free = _adjustment.with_prior(model, replace(adjustment, decentred=True), prior)
        decentred = finish_metric(*free)
        if _adjustment.predicts_better(finished[:2], decentred[:2]):
            return *free, decentred
    return model, adjustment, finished


def _iterate_inliers(model: MetricEstimate, adjustment: MetricAdjustment) -> MetricEstimate:
    """Adjust and triangulate until the inliers stay, then adjust to the minimum of these very inliers."""
    gate = {"sigmas": LATE_SIGMAS, "min_angle": _model.MIN_ANGLE}
    for _ in range(4):
        before = model.inlier
        model = adjustment.run(model)[0]
        model = _model.retriangulate_tracks(model, sigmas=LATE_SIGMAS)
        if np.count_nonzero(before != model.inlier) < 0.002 * len(before):
            break
    # Noise and inliers change less each time.
    for _ in range(2):
        model = adjustment.run(_model.select_inliers(model, **gate))[0]
    model = _model.select_inliers(model, **gate)
    return adjustment.run(model, settled=_adjustment.SETTLED, keep_noise=True)[0]


def as_reconstruction(model: MetricEstimate, reasons: tuple[str, ...]) -> records.Reconstruction:
    registered = model.registered
    P = np.where(registered[:, None, None], model.cameras.P, 0.0)
    K = np.where(registered[:, None, None], model.cameras.K, 0.0)
    distortion = np.where(registered[:, None], model.cameras.intrinsics[model.cameras.group, K1:], 0.0)
    X = np.where(model.valid[:, None], np.column_stack([model.X, np.ones(len(model.X))]), 0.0)
    norms = _model.residual_norms(model)
    sigma = noise_from_distances(norms) if len(norms) else model.sigma_px
    seen = (registered, model.valid, model.inlier, model.tracks, model.sizes)
    found = records.Reconstruction("metric", P, X, *seen, sigma, reasons, K, distortion)
    return records.with_reasons(found, MIN_POINTS)

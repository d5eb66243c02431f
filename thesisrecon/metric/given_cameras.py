"""Cameras that are known before: points are triangulated with them, other images are resected from these.

The frame of the given cameras stays. Without ``refine`` their poses and intrinsics do, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon import records
from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.camera import POSE_STDS, Camera, angles_of_view
from thesisrecon.errors import Notice, StageFailure, UsageError, counted
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.lens import BASE, simplest_row
from thesisrecon.metric import _model, _resection
from thesisrecon.metric._adjustment import MIN_OBSERVATIONS, MetricAdjustment, inlier_observations
from thesisrecon.metric._checks import MIN_INLIER_RATIO, self_check, triangulable_observations
from thesisrecon.metric._model import FOCAL, K1, LATE_SIGMAS, WIDTH, MetricEstimate
from thesisrecon.metric._uncertainty import USUAL_INFLATION, intrinsic_columns
from thesisrecon.metric.refinement import MetricRefinement, as_reconstruction
from thesisrecon.metric.world import centres_of, moved
from thesisrecon.optimize.bundle.knowledge import BundleKnowledge
from thesisrecon.optimize.bundle.metric import refine_metric_bundle
from thesisrecon.optimize.bundle.projection import MetricCameras, pinhole_rows
from thesisrecon.optimize.least_squares import noise_from_distances
from thesisrecon.optimize.ransac import AS_GOOD, other_poses
from thesisrecon.records import IntrinsicInterval, IntrinsicsPrior, Tracks

START_NOISE, NOISE_FLOOR_PX = 2e-3, 0.02
"""Noise of the first gate, relative to the long side, and the least noise that is believed."""
MIN_EXPLAINED = 0.3
"""Share of the observations of points in two given cameras that these explain, unless they are wrong."""
MAX_NOISE_RATIO = 3.0
"""Noise in the given cameras over that of the matches beyond which the cameras are inexact."""
EARLIER, ANGLES = "the run before images were added", ("angle_of_view_deg", "corner_deg")


@dataclass(frozen=True)
class GivenCameras:
    """Cameras of the images that are ``known`` (V,), at working size, zeros for the others.

    ``intrinsics`` (V, 8) or (V, 12) are rows as of the bundle adjustment, ``std`` what is stated about each
    camera, as of :attr:`thesisrecon.Camera.std`, in working pixels.
    """

    known: B8
    R: F64
    t: F64
    intrinsics: F64
    std: tuple[Mapping[str, float], ...]
    refine: bool = False
    of_images: bool = False  #: the deviations come from these images, so they are no prior of a refinement

    @classmethod
    def of(
        cls, cameras: Sequence[Camera | None], images: Sequence[records.Image], *, refine: bool,
        of_images: bool,
    ) -> GivenCameras:  # fmt: skip
        """The given cameras of images, in pixels of the original images; None: not known."""
        n = len(images)
        known = np.array([camera is not None for camera in cameras])
        R, t, table = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, _model.LENS_WIDTH))
        stds = [dict[str, float]() for _ in images]
        for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
            if camera is None:
                continue
            K = np.asarray(np.linalg.solve(image.original_from_working, camera.K), dtype=np.float64)
            row = simplest_row(camera.lens, np.zeros(1) if camera.distortion is None else camera.distortion)
            if np.any(row[BASE + 1 :]):
                raise UsageError(Notice("given-lens", image.name, camera.lens))
            row = row[: BASE + 1]
            R[i], t[i] = camera.R, camera.t
            table[i, :K1] = pinhole_rows(K)
            table[i, K1 : K1 + len(row)] = row
            given = camera.std or {}
            stds[i] = {k: v * image.scale if k.endswith("_px") else v for k, v in given.items()}
        wide = np.any(table[:, WIDTH:])
        return cls(known, R, t, table if wide else table[:, :WIDTH], tuple(stds), refine, of_images)


def given_prior(given: GivenCameras, prior: IntrinsicsPrior) -> IntrinsicsPrior:
    """The prior in which given cameras, and those that share all their intrinsics with one, are known."""
    mean, std = prior.mean.copy(), prior.std.copy()
    rows, fixed = given.intrinsics[:, : mean.shape[1]], given.known
    for column in range(mean.shape[1]):
        mean[fixed, column], std[fixed, column] = rows[fixed, column], 0.0
        for view in np.flatnonzero(~fixed):
            same = rows[fixed & (prior.shared[:, column] == prior.shared[view, column]), column]
            if len(same):
                mean[view, column] = np.median(same)
                std[view, column] = 0.0 if np.ptp(same) <= 1e-9 * np.abs(same).max() else std[view, column]
    kind = "auto" if given.intrinsics.shape[1] == WIDTH else "fisheye"
    return replace(prior, mean=mean, std=std, lens=None, lens_model=kind)


def metric_from_given(
    given: GivenCameras, tracks: Tracks, sizes: I64, *, noise_px: float, prior: IntrinsicsPrior,
    rng: np.random.Generator, threads: int = 1,
) -> records.MetricResult:  # fmt: skip
    """Points of given cameras, and the cameras of the other images; ``StageFailure`` if they fit no matches.

    ``noise_px`` is the noise of the matches, against which the given cameras are tested.
    """
    known = given_prior(given, prior)
    adjustment = MetricAdjustment(known, lens_std=0.02, noise_floor_px=NOISE_FLOOR_PX, threads=threads)
    model = _triangulated(_start(given, tracks, sizes, known))
    model, reasons = _with_other_images(model, adjustment, rng)
    result = _finished(given, model, adjustment, reasons, noise_px)
    if not given.refine:
        return result
    start = result.reconstruction
    assert start.K is not None
    calibration = records.calibration_of_metric(start.K, records.GIVEN)
    wide = prior if given.of_images else _prior_of_stds(given, prior)
    refined = MetricRefinement().refine(start, calibration, prior=wide, rng=rng, threads=threads)
    # By the similarity that brings its centres nearest to the given ones.
    both = refined.reconstruction.registered & given.known
    target = -np.einsum("vba,vb->va", given.R[both], given.t[both])
    return moved(refined, estimate_similarity(centres_of(refined.reconstruction)[both], target))


def _start(given: GivenCameras, tracks: Tracks, sizes: I64, prior: IntrinsicsPrior) -> MetricEstimate:
    """The given cameras, without points; unknown focal lengths begin at the median angle of view."""
    n, longest = len(sizes), sizes.max(axis=1)
    table = given.intrinsics.copy()
    typical = float(np.median(table[given.known, FOCAL] / longest[given.known]))
    for view in np.flatnonzero(~given.known):
        mean = prior.mean[view]
        table[view, : len(mean)] = np.where(np.isfinite(mean), mean, typical * longest[view])
        peers = given.known & (prior.shared[:, K1] == prior.shared[view, K1])
        if peers.any():
            table[view, K1:] = given.intrinsics[np.flatnonzero(peers)[0], K1:]
    of_lens = np.repeat(prior.shared[:, K1:], table.shape[1] - K1 - 1, axis=1)
    shared = np.column_stack([prior.shared[:, : K1 + 1], of_lens])
    cameras = MetricCameras(given.R, given.t, table, np.arange(n), shared)
    X, valid, inlier = np.zeros((tracks.n_points, 3)), np.zeros(tracks.n_points), np.zeros(len(tracks.xy))
    noise = START_NOISE * float(np.median(longest))
    return MetricEstimate(tracks, sizes, cameras, given.known, X, valid > 0, inlier > 0, noise)


def _triangulated(model: MetricEstimate) -> MetricEstimate:
    """Triangulate, with gates that narrow to the noise that the cameras leave."""
    while True:
        model = _model.retriangulate_tracks(model, sigmas=LATE_SIGMAS)
        near = triangulable_observations(model)
        share = float(model.inlier[near].mean()) if near.any() else 0.0
        if share < MIN_EXPLAINED or model.inlier.sum() < MIN_OBSERVATIONS:
            seen = f"{share:.0%} of {counted(int(near.sum()), 'observation')}"
            raise StageFailure.of("given-cameras-fit-nothing", int(model.registered.sum()), seen)
        noise = max(noise_from_distances(_model.residual_norms(model)), NOISE_FLOOR_PX)
        if noise > 0.9 * model.sigma_px:
            return model
        model = replace(model, sigma_px=noise)


def _with_other_images(
    model: MetricEstimate, adjustment: MetricAdjustment, rng: np.random.Generator
) -> tuple[MetricEstimate, dict[int, str]]:
    """Register the images that are not given, and adjust these and their points alone."""
    first, rejected = model.registered, dict[int, str]()
    rows = rows_of_views(model.tracks.view_index, model.tracks.n_views)
    while True:
        before = model.registered
        model, rejected = _resection.register_next(model, rng, ~first, rows)
        joined = model.registered & ~before
        if not joined.any():
            break
        for _ in range(2):
            model = _resection.adjust_window(model, adjustment, joined)
    share = _model.inlier_ratios(model)
    wrong = model.registered & ~first & (share < MIN_INLIER_RATIO)
    for view in np.flatnonzero(wrong).tolist():
        rejected[view] = Notice("contradicted-by-others", share[view])
    if wrong.any():
        model = _model.retriangulate_tracks(
            replace(model, registered=model.registered & ~wrong), sigmas=LATE_SIGMAS
        )
    return model, rejected


def _finished(
    given: GivenCameras, model: MetricEstimate, adjustment: MetricAdjustment, rejected: Mapping[int, str],
    noise_px: float,
) -> records.MetricResult:  # fmt: skip
    """State the deviations, and check the model."""
    stds: list[Mapping[str, float]] = list(given.std)
    poses = np.full((len(model.registered), 6), np.nan)
    for view in np.flatnonzero(given.known).tolist():
        poses[view] = [stds[view].get(name, np.nan) for name in POSE_STDS]
    poses[:, :3] = np.radians(poses[:, :3])
    warnings = list[str]()
    if (new := model.registered & ~given.known).any():
        model = _with_stds(model, adjustment, new, stds, poses)
        for view in np.flatnonzero(new).tolist():
            warnings += _competing_poses(model, view, poses)
    known = EARLIER if given.of_images else records.GIVEN
    sources = {view: known if given.known[view] else "resection" for view in range(len(stds))}
    intervals = tuple(
        _interval(model, view, stds[view], sources[view]) if there else {}
        for view, there in enumerate(model.registered.tolist())
    )
    checked = self_check(model, np.zeros((len(stds), 3, 3)), intervals, sigmas=LATE_SIGMAS)
    ratio = model.sigma_px / max(noise_px, NOISE_FLOOR_PX)
    failed = [*checked.failed, *([Notice("given-cameras-noise", ratio)] if ratio > MAX_NOISE_RATIO else [])]
    reasons = tuple("" if there else rejected.get(v, "") for v, there in enumerate(model.registered))
    return records.MetricResult(
        as_reconstruction(model, reasons), intervals, checked.numbers, not failed, tuple(failed),
        tuple(warnings), pose_std=poses,
    )  # fmt: skip


def _with_stds(
    model: MetricEstimate, adjustment: MetricAdjustment, new: B8, stds: list[Mapping[str, float]], poses: F64
) -> MetricEstimate:
    """Adjust new cameras once more with their points; put their deviations into ``stds`` and ``poses``."""
    points = np.unique(model.tracks.point_index[new[model.tracks.view_index] & model.inlier])
    part = _model.restrict_points(model, points)
    options = replace(adjustment.options(model), covariance=True, noise_floor_px=model.sigma_px)
    prior = adjustment.row_prior(part)
    fit = refine_metric_bundle(
        part.cameras, part.X, inlier_observations(part), free=np.any(prior.std > 0.0, axis=0), prior=prior,
        options=options, knowledge=BundleKnowledge(fixed_poses=model.registered & ~new),
    )  # fmt: skip
    assert fit.pose_covariance is not None
    # The frame is as uncertain as the cameras that it is taken from.
    frame = np.sqrt(np.nanmean(poses**2, axis=0)) if np.isfinite(poses).any() else np.zeros(6)
    for view in np.flatnonzero(new).tolist():
        C, R = fit.pose_covariance[view], fit.cameras.R[view]
        variance = np.concatenate([np.diag(C)[:3], np.diag(R.T @ C[3:, 3:] @ R)])
        poses[view] = np.hypot(USUAL_INFLATION * np.sqrt(variance), np.nan_to_num(frame))
        same = (prior.mean[:, : K1 + 1] == prior.mean[view, : K1 + 1]).all(axis=1)
        peers = np.flatnonzero(same & ~new & (prior.std[view] == 0.0).all()).tolist()
        own = USUAL_INFLATION * np.sqrt(np.diag(fit.intrinsics_covariance[view]))
        of_camera = {name: float(own[c]) for name, c in intrinsic_columns(len(own)).items()}
        stds[view] = stds[peers[0]] if peers else of_camera
    X = model.X.copy()
    X[points] = fit.X
    return _model.select_inliers(
        replace(model, cameras=fit.cameras, X=X), sigmas=LATE_SIGMAS, min_angle=_model.MIN_ANGLE
    )


def _competing_poses(model: MetricEstimate, view: int, poses: F64) -> Iterator[str]:
    """Name other poses that explain the points of a view as well; ``poses`` contains the differences then."""
    t, cameras = model.tracks, model.cameras
    k = np.flatnonzero(model.inlier & (t.view_index == view))
    views, X, xy = t.view_index[k], model.X[t.point_index[k]], t.xy[k]
    R, own, row = cameras.R[view], cameras.t[view], cameras.intrinsics[cameras.group[view]]
    cost = np.sum((_model.reproject_observations(model, views, t.point_index[k])[0] - xy) ** 2)
    limit = cost + AS_GOOD * (USUAL_INFLATION * model.sigma_px) ** 2
    rays = homogenize(_model.normalized_observations(cameras, views, xy))
    for pose in other_poses(R, own, row, rays, X, xy):
        if np.sum(pose.residual_px**2) < limit and (X @ pose.R[2] + pose.t[2] > 0.0).all():
            turn = scipy.spatial.transform.Rotation.from_matrix(pose.R @ R.T).as_rotvec()
            poses[view] = np.hypot(poses[view], np.append(turn, R.T @ own - pose.R.T @ pose.t))
            angle = np.degrees(np.linalg.norm(turn))
            yield Notice("competing-pose", view, angle, counted(len(k), "point"))


def _interval(
    model: MetricEstimate, view: int, std: Mapping[str, float], source: str
) -> dict[str, IntrinsicInterval]:
    row, (width, height) = model.cameras.intrinsics[model.cameras.group[view]], model.sizes[view].tolist()
    values = {name: float(row[column]) for name, column in intrinsic_columns(len(row)).items()}
    angles = angles_of_view(model.cameras.K[view], (width, height), row[K1:])
    values |= {name: a for name, a in zip(ANGLES, angles, strict=True) if name in std}
    return {name: IntrinsicInterval(a, float(std.get(name, 0.0)), source) for name, a in values.items()}


def _prior_of_stds(given: GivenCameras, prior: IntrinsicsPrior) -> IntrinsicsPrior:
    """The prior of a refinement: given intrinsics with their deviations; without any they stay known."""
    known = given_prior(given, prior)
    std, columns = known.std.copy(), intrinsic_columns(known.mean.shape[1])
    for row in np.flatnonzero(given.known).tolist():
        for name, column in columns.items():
            unit = given.intrinsics[row, FOCAL] if column == FOCAL else 1.0
            std[row, column] = given.std[row].get(name, 0.0) / unit
    for column in range(std.shape[1]):
        for view in np.flatnonzero(~given.known):
            peers = given.known & (prior.shared[:, column] == prior.shared[view, column])
            if peers.any():
                std[view, column] = std[peers, column].min()
    return replace(known, std=std)

"""The stages of Algorithm 1 from tracks on: cameras (chapters 6 and 7), depth maps and surface (2).

Each function computes one record of the result, or reads it if the run has computed it before.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import scipy

from thesisrecon._numba import code_digest
from thesisrecon.arrays import B8
from thesisrecon.camera import Camera
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import Notice, StageFailure, UsageError
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.io._models import east_north_up
from thesisrecon.matching.look_alikes import swapped_pairs, swapped_sentence
from thesisrecon.matching.pair_selection import reject_repeated_structure
from thesisrecon.metric.given_cameras import metric_from_given
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.metric.world import constrained, placed, upright
from thesisrecon.pipeline.large_sets import align_parts, calibrate_with_core, from_metric, tracks_of_part
from thesisrecon.pipeline.lens import straight_pair, straight_tracks
from thesisrecon.pipeline.matching import build_tracks
from thesisrecon.pipeline.run import FOLDERS, Batch, Job, name_images, stream
from thesisrecon.records import (
    DepthMap,
    Features,
    HeldOut,
    IdentifiabilityReport,
    IntrinsicsPrior,
    MetricResult,
    PinholeView,
    Reconstruction,
    SelfCalibration,
    TexturedMesh,
    Tracks,
    TwoView,
)
from thesisrecon.results import RunResult
from thesisrecon.stereo.depth import MultiViewScene
from thesisrecon.views.render import covered_pixels, match_exposure, psnr_db, render_mesh, ssim

T = TypeVar("T")

MAP_BYTES = 2**29
"""Depth maps in memory, those before and those after confirmation; more are read when they are used."""


def _cached(
    job: Job, stage: str, attempt: int, inputs: Any, compute: Callable[[np.random.Generator], T]
) -> T:
    """The record of one attempt, which depends on ``inputs``."""
    run = job.run
    key = run.key(stage, run.variant_key(stage), inputs, run.seed, attempt)
    run.progress(stage, 0, 1)
    found: T = run.cached(stage, f"attempt-{attempt}", key, lambda: compute(stream(run.seed, stage, attempt)))
    run.progress(stage, 1, 1)
    return found


def reconstruct_projective(
    job: Job, tracks: Tracks, pairs: Sequence[TwoView], attempt: int = 0
) -> Reconstruction:
    """Reconstruct up to a projective transform (chapter 6); ``attempt`` is the rank of the initial pair."""
    sizes, method, lens = job.sizes, job.config.projective, job.prior.lens
    if lens is not None:
        tracks = straight_tracks(tracks, sizes, lens)
        pairs = [straight_pair(pair, sizes, lens) for pair in pairs]
    return _cached(
        job, "projective", attempt, [job.run.logs["tracks"].keys, sizes, *([] if lens is None else [lens])],
        lambda rng: method.reconstruct(tracks, pairs, sizes, rng=rng, attempt=attempt),
    )  # fmt: skip


def self_calibrate(job: Job, projective: Reconstruction, attempt: int) -> SelfCalibration:
    """Calibrate all views of a projective reconstruction, or a core of them (chapter 7)."""
    prior, upstream = job.prior, job.run.logs["projective"].keys[f"attempt-{attempt}"]
    method = job.config.selfcalibration
    return _cached(
        job, "selfcalibration", attempt, [upstream, prior.shared, prior.mean, prior.std, prior.kind],
        lambda rng: calibrate_with_core(method, projective, prior=prior, rng=rng),
    )  # fmt: skip


def refine_metric(
    job: Job, features: Sequence[Features], start: Reconstruction, calibration: SelfCalibration, attempt: int,
    upstream: Sequence[str],
) -> MetricResult:  # fmt: skip
    """Upgrade and refine a reconstruction, register the other views, and test the result (chapter 7)."""
    upstream = [
        job.run.logs["selfcalibration"].keys[f"attempt-{attempt}"],
        *upstream,
        code_digest(swapped_pairs),
    ]
    return _cached(
        job, "metric", attempt, upstream, lambda rng: _refined(job, features, start, calibration, rng)
    )


def _refined(
    job: Job, features: Sequence[Features], start: Reconstruction, calibration: SelfCalibration,
    rng: np.random.Generator,
) -> MetricResult:  # fmt: skip
    """Refine; near images whose surroundings differ, of places that look alike, fail the self-check."""
    threads = job.run.workers.threads
    metric = job.config.metric.refine(start, calibration, prior=job.prior, rng=rng, threads=threads)
    # The corners of images with a strong lens do not lie on the lines of pinhole cameras.
    pairs = [] if job.prior.lens is not None else swapped_pairs(metric.reconstruction, job.images, features)
    if not pairs:
        return metric
    return replace(metric, trusted=False, failed_checks=(*metric.failed_checks, swapped_sentence(pairs)))


def metric_of_given(job: Job, tracks: Tracks, pairs: Sequence[TwoView]) -> MetricResult:
    """Triangulate the points of given cameras, and register the other images in their frame."""
    given, prior, threads = job.given, job.prior, job.run.workers.threads
    assert given is not None
    noise = float(np.median([pair.sigma_px for pair in pairs if pair.accepted]))
    upstream = [job.run.logs["tracks"].keys, job.sizes, prior.shared, prior.mean, prior.std]
    facts = [given.known, given.R, given.t, given.intrinsics, given.std, given.refine, noise]
    code = code_digest(metric_from_given)
    return _cached(
        job, "metric", 0, [upstream, facts, code],
        lambda rng: metric_from_given(
            given, tracks, job.sizes, noise_px=noise, prior=prior, rng=rng, threads=threads
        ),
    )  # fmt: skip


def metric_in_world(job: Job, metric: MetricResult, attempt: int) -> MetricResult:
    """Move a model to the GPS positions of its images, or stand it upright, if that is asked for."""
    run, images = job.run, job.config.images
    if not (images.gps or images.up == "auto"):
        return metric
    keys = [key for name, key in run.logs["metric"].keys.items() if name.startswith(f"attempt-{attempt}")]
    code, options = code_digest(placed, constrained, upright), [images.gps, images.gps_std_m, images.up]
    key = run.key("metric", keys, job.inputs.places, options, run.variant_key("metric"), code, run.seed)

    def moved() -> dict[str, Any]:
        if images.gps:
            return _placed_by_gps(job, metric, attempt)
        return dict(zip(("result", "facts"), upright(metric, job.images), strict=True))

    try:
        found = run.cached("metric", f"attempt-{attempt}-world", key, moved)
    except UsageError as error:
        run.warnings.append(Notice("frame-unknown", error))
        return metric
    run.world = dict(found["facts"])
    result: MetricResult = found["result"]
    return result


def _placed_by_gps(job: Job, metric: MetricResult, attempt: int) -> dict[str, Any]:
    """The result in metres east, north and up, adjusted to the positions if their deviation is given."""
    places, images, refiner = job.inputs.places, job.config.images, job.config.metric
    if not np.isfinite(places).all(axis=1).any():
        raise UsageError("no image has a GPS position with a height")
    # Groups of images have the origin of all.
    whole = job.inputs.whole or job.inputs
    positions, origin = east_north_up(places, east_north_up(whole.places)[1])
    found = placed(metric, positions)
    if images.gps_std_m and isinstance(refiner, MetricRefinement):
        found = constrained(
            found, positions, images.gps_std_m, refiner=refiner, prior=job.prior,
            rng=stream(job.run.seed, "metric", attempt, 3), threads=job.run.workers.threads,
        )  # fmt: skip
    off = np.linalg.norm(found.residual, axis=1)
    facts = {
        "axes": "metres east, north, up", "origin": origin, "used": int(found.used.sum()),
        "rms_m": float(np.sqrt(np.mean(off[found.used] ** 2))),
        "residual_m": {name: float(d) for name, d in zip(job.names, off, strict=True) if np.isfinite(d)},
    }  # fmt: skip
    return {"result": found.result, "facts": facts}


def report_projective(job: Job, result: RunResult) -> None:
    """Report the projective reconstruction, and its self-calibration if there is one."""
    projective, calibration = result.projective, result.calibration
    if projective is not None:
        sigma = {"sigma_px": projective.sigma_px}
        job.run.finish("projective", counts=_sizes_of(projective), metrics=sigma)
    if calibration is not None:
        counts = {"hypotheses": len(calibration.candidates), "identifiable": int(calibration.identifiable)}
        # A metric model has its own report.
        found = calibration.identifiability if result.metric is None else None
        job.run.finish("selfcalibration", counts=counts, warnings=_critical(found))


def report_metric(job: Job, metric: MetricResult) -> None:
    """Report the metric reconstruction with its warnings."""
    texts = (*_critical(metric.identifiability), *metric.warnings)
    warnings = [name_images(text, job.names) for text in texts]
    found = metric.reconstruction
    metrics = {"sigma_px": found.sigma_px}
    job.run.finish("metric", counts=_sizes_of(found), metrics=metrics, warnings=warnings)


def _sizes_of(reconstruction: Reconstruction) -> dict[str, int]:
    return {"registered": int(reconstruction.registered.sum()), "points": int(reconstruction.valid.sum())}


def _critical(found: IdentifiabilityReport | None) -> tuple[str, ...]:
    """A warning about a critical motion that the prior resolves; others fail the self-check."""
    resolved = found is not None and found.critical and found.identifiable
    return ("; ".join(found.sentences),) if found is not None and resolved else ()


def _depths(
    config: PipelineConfig, scene: MultiViewScene, view: int, pool: Executor | None
) -> list[DepthMap]:
    return [config.dense.depth_map(scene, view, pool=pool)]


def _confirmed(
    config: PipelineConfig, scene: MultiViewScene, maps: Mapping[int, DepthMap], view: int
) -> list[DepthMap]:
    return [config.dense.confirm(scene, maps, view)]


def estimate_depth_maps(job: Job, r: Reconstruction) -> tuple[Sequence[DepthMap], Sequence[PinholeView]]:
    """Estimate and cross-check the depth maps of all registered views (2.5); return them with the views."""
    run, dense, images = job.run, job.config.dense, job.images
    run.progress("dense", 0, int(r.registered.sum()))
    with run.clock("dense"):
        scene = dense.prepare(images, r, threads=run.workers.threads)
        order = sorted(scene.views)
        near = {view: dense.required_views(scene, view) for view in order}
    pixels = [(image.rgb, image.mask) for image in images]
    given = [r.P, r.K, r.distortion, r.X, r.registered, r.valid, r.inlier, pixels]
    key = run.key("dense", run.variant_key("dense"), given)
    place = {view: n for n, view in enumerate(order)}

    def part(view: int) -> MultiViewScene:
        """Part of the scene that the depth map of one view needs."""
        return scene if run.workers.in_process else scene.subset(near[view])

    def estimated(missing: Sequence[int]) -> Iterator[Batch]:
        for n in missing:
            yield [n], (job.config, part(order[n]), order[n], run.workers.pool)

    def confirmed(missing: Sequence[int]) -> Iterator[Batch]:
        for n in missing:
            own = {j: maps[place[j]] for j in sorted(near[order[n]])}
            yield [n], (job.config, scene, own, order[n])

    # Cameras that did not move keep the depth maps of the run to which images were added.
    unmoved = run.directory.continues and job.given is not None and not job.given.refine
    # Numbers of several views of one image change with the number of images.
    unmoved &= max(order, default=0) < len(images)
    kept = run.directory.stage(FOLDERS["dense"]).keys() if unmoved else {}
    keys = {(item := f"{i:05d}"): kept.get(item) or run.key("dense", key, i) for i in order}
    maps = run.map_cached("dense", keys, _depths, estimated, max_bytes=MAP_BYTES)
    keys = {
        (item := f"confirmed-{i:05d}"): kept.get(item) or run.key("dense", key, i, "confirmed") for i in order
    }
    # The maps of 12 neighbours take longer to send than to compare.
    final = run.map_cached("dense", keys, _confirmed, confirmed, max_bytes=MAP_BYTES, silent=True, here=True)
    # The views for stereo matching need not stay in memory.
    undistorted = scene.views
    return final, OnDemand(len(order), lambda n: undistorted[order[n]])


def report_depth_maps(job: Job, maps: Sequence[DepthMap]) -> None:
    """Report the depth maps; raise ``StageFailure`` if none has a depth."""
    known = [(m.view % len(job.images), int(np.isfinite(m.depth).sum()), m.depth.size) for m in maps]
    depths = sum(count for _, count, _ in known)
    without = sorted({view for view, _, _ in known} - {view for view, count, _ in known if count})
    warnings = [Notice("no-depth-values", job.images[view].name) for view in without]
    counts = {"views": len(known), "depths": depths}
    metrics = {"median_share_known": float(np.median([count / size for _, count, size in known]))}
    job.run.finish("dense", counts=counts, metrics=metrics, warnings=warnings)
    if not depths:
        raise StageFailure.of("no-depth", len(known))


def build_model(
    job: Job, maps: Sequence[DepthMap], views: Sequence[PinholeView]
) -> tuple[TexturedMesh, HeldOut | None]:
    """Fuse the depth maps to a textured mesh (2.6) and compare it with a held-out view."""
    run = job.run
    key = run.key("model", run.variant_key("model"), list(run.logs["dense"].keys.values()))
    run.progress("model", 0, 1)
    build = partial(job.config.model.build, maps, views, threads=run.workers.threads)
    mesh: TexturedMesh = run.cached("model", "model", key, build)
    compare = partial(_compare_held_out, job, views, mesh)
    held_out_key = run.key("model", key, "held-out", code_digest(_compare_held_out))
    held_out: HeldOut | None = run.cached("model", "held-out", held_out_key, compare)
    without_texture = 0.0 if mesh.untextured is None else float(mesh.untextured.mean())
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    run.finish("model", counts=counts, metrics={"share_untextured": without_texture})
    run.progress("model", 1, 1)
    return mesh, held_out


def _compare_held_out(job: Job, views: Sequence[PinholeView], mesh: TexturedMesh) -> HeldOut | None:
    """Compare the middle view with the model textured without it; None if they cannot be compared."""
    threads = job.run.workers.threads
    # Of fewer than three views the others may not see the surface of the middle one.
    if len(views) < 3 or not len(mesh.faces):
        return None
    # The view with the smallest sum of distances to the other cameras.
    C = np.array([camera_centre(view.P) for view in views])
    centres = C[:, :3] / C[:, 3:]
    view = views[int(np.argmin(scipy.spatial.distance.cdist(centres, centres).sum(axis=1)))]
    n = len(job.images)
    used = [k for k, other in enumerate(views) if (other.view - view.view) % n]
    try:
        others = OnDemand(len(used), lambda k: views[used[k]])
        painted = job.config.model.color(mesh, others, threads=threads)
    except StageFailure:
        return None
    height, width = view.rgb.shape[:2]
    rendered = render_mesh(painted, Camera.from_matrix(view.P, (width, height)), threads=threads)
    compared = covered_pixels(rendered) & view.seen
    if not compared.any():
        return None
    matched = match_exposure(view.rgb, rendered.color, compared)
    similarity = (psnr_db(view.rgb, matched, compared), ssim(view.rgb, matched, compared))
    return HeldOut(view.view % n, view.rgb, matched, compared, *similarity)


NAMES = ("focal_px", "aspect", "skew_px", "principal_x_px", "principal_y_px", "k1")
"""Intrinsics of a result in the columns of a prior."""


# A few matches are not enough to verify the epipolar geometry of a pair. If they lead to points of the model,
# a camera must explain them with twice as many equations: they are used for missing images only.


def register_more(
    job: Job, features: Sequence[Features], views: Sequence[Any], pairs: Sequence[TwoView],
    calibration: SelfCalibration, metric: MetricResult, attempt: int,
) -> MetricResult:  # fmt: skip
    """Register missing images; return the old model if none is added or the new one is not trusted."""
    run, old = job.run, metric.reconstruction
    more = pairs_of_missing(pairs, ~old.registered)
    if len(more) <= sum(pair.accepted for pair in pairs):
        return metric

    def register() -> MetricResult:
        rng = stream(run.seed, "metric", attempt, 1)
        tracks = build_tracks(job, views, more, rng)
        return better_model(job, features, metric, cameras_on_tracks(old, tracks), calibration, rng)

    upstream = run.logs["metric"].keys[f"attempt-{attempt}"]
    key = run.key("metric", upstream, run.variant_key("tracks"), run.seed)
    found: MetricResult = run.cached("metric", f"attempt-{attempt}-more", key, register)
    return found


def pairs_of_missing(pairs: Sequence[TwoView], missing: B8) -> list[TwoView]:
    """The accepted pairs, and rejected ones of missing images that agree with one F and repeat nothing."""

    def of_use(pair: TwoView) -> bool:
        agree = pair.inliers >= 0.5 * pair.candidates
        return bool(pair.configuration) and agree and bool(missing[pair.i] or missing[pair.j])

    more = [replace(p, accepted=True, reason="") for p in pairs if p.accepted or of_use(p)]
    return [pair for pair in reject_repeated_structure(more, len(missing)) if pair.accepted]


def better_model(
    job: Job, features: Sequence[Features], old: MetricResult, start: Reconstruction,
    calibration: SelfCalibration, rng: np.random.Generator,
) -> MetricResult:  # fmt: skip
    """Refine ``start``: if it then has more images, all of the old ones, and is as trusted; else ``old``."""
    try:
        new = _refined(job, features, start, from_metric(start, calibration), rng)
    except StageFailure:
        return old
    before, after = old.reconstruction.registered, new.reconstruction.registered
    joined = after.sum() > before.sum() and (before <= after).all()
    return new if joined and new.trusted >= old.trusted else old


def cameras_on_tracks(metric: Reconstruction, tracks: Tracks) -> Reconstruction:
    """Metric cameras with the points of other tracks, triangulated without distortion."""
    seen = metric.registered[tracks.view_index]
    view, point, xy = tracks.view_index[seen], tracks.point_index[seen], tracks.xy[seen]
    X = triangulate_observations(metric.P, view, point, xy, tracks.n_points)
    valid = np.bincount(point, minlength=tracks.n_points) >= 2
    return replace(metric, X=X, valid=valid, inlier=seen & valid[tracks.point_index], tracks=tracks)


def model_among(model: Reconstruction, views: Sequence[int], part: Reconstruction) -> Reconstruction:
    """The model of some views as a model of all views and points of another one."""
    rows = np.array(views)
    tracks = tracks_of_part(model.tracks, rows)
    # Further matches may have led to other tracks.
    same = np.array_equal(part.tracks.point_index, tracks.point_index)
    found = part if same else cameras_on_tracks(part, tracks)
    aligned = align_parts(model.tracks, model.sizes, [rows], [rows], [found])
    assert aligned is not None
    return aligned


def known_cameras(prior: IntrinsicsPrior, metric: MetricResult | None) -> IntrinsicsPrior:
    """The prior in which cameras of a trusted model have its intrinsics and their standard deviations."""
    if metric is None or not metric.trusted:
        return prior
    mean, std = prior.mean.copy(), prior.std.copy()
    for view in np.flatnonzero(metric.reconstruction.registered)[::-1]:
        for column, name in enumerate(NAMES):
            if (found := metric.intrinsics[view].get(name)) is None:
                continue
            wide = found.std / found.value if name == "focal_px" else found.std
            same = prior.shared[:, column] == prior.shared[view, column]
            same &= wide < prior.std[:, column]
            mean[same, column], std[same, column] = found.value, wide
    return replace(prior, mean=mean, std=std)

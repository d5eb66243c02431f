"""The steps of Algorithm 1 from tracks on: cameras (chapters 6 and 7), depth maps and surface (2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from thesisrecon._code_digest import code_digest
from thesisrecon.camera import Camera
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.pipeline._core_views import calibrate_with_core, calibrated_part
from thesisrecon.pipeline._parts import cameras_from_parts
from thesisrecon.pipeline._second_pass import from_metric, register_more
from thesisrecon.pipeline._state import PipelineState, name_images
from thesisrecon.records import (
    DepthMap,
    HeldOut,
    IdentifiabilityReport,
    MetricResult,
    PinholeView,
    Reconstruction,
    SelfCalibration,
    TexturedMesh,
    Tracks,
)
from thesisrecon.results import RunResult
from thesisrecon.runtime._run import Batch, stream
from thesisrecon.selfcalibration.stratified import with_images
from thesisrecon.stereo.depth import MultiViewScene
from thesisrecon.views._image_similarity import covered_pixels, match_exposure, psnr_db, ssim
from thesisrecon.views.render import render_mesh

ATTEMPTS = 3
"""Maximum number of initial pairs to try until the self-check passes."""
MIN_VIEWS = 3
"""With fewer views no view is held out: the others may not see its surface."""
MAP_BYTES = 2**29
"""Depth maps in memory, those before and those after confirmation; more are read when they are used."""


def build_tracks(state: PipelineState) -> None:
    """Build tracks from the accepted pairs; sets ``result.tracks``."""
    run, pairs = state.run, state.used_pairs
    require_accepted_pair(state)
    group = [list(state.groups[0])] if state.groups else []
    accepted = [(pair.i, pair.j) for pair in pairs if pair.accepted]
    key = run.key("tracks", run.variant_key("tracks"), run.logs["matches"].keys, accepted, run.seed, *group)
    build, map_all, rng = state.config.tracks.build, run.workers.map_all, stream(run.seed, "tracks")
    tracks: Tracks = run.cached(
        "tracks", "tracks", key, lambda: build(state.prepared_views(), pairs, map_all=map_all, rng=rng)
    )
    finish_tracks(state, tracks)


def require_accepted_pair(state: PipelineState) -> None:
    """Raise ``StageFailure`` if no pair is accepted."""
    result = state.result
    if not any(pair.accepted for pair in result.pairs):
        best = max(result.pairs, key=lambda pair: pair.inliers)
        tried, verified = counted(len(result.pairs), "pair"), counted(best.inliers, "verified match")
        evidence = f"the best of {tried} has {verified}: {best.reason}"
        advice = "add images with more overlap, all of one textured scene"
        raise StageFailure("no two images could be matched", evidence, advice)


def finish_tracks(state: PipelineState, tracks: Tracks) -> None:
    """Report the tracks; sets ``result.tracks``."""
    state.result = replace(state.result, tracks=tracks)
    seen = np.bincount(tracks.point_index, minlength=tracks.n_points)
    counts = {"points": tracks.n_points, "observations": len(tracks.xy)}
    state.run.finish("tracks", counts=counts | {"seen_3_times": int((seen >= 3).sum())})


def _cached(
    state: PipelineState, stage: str, attempt: int, inputs: Any, compute: Callable[[np.random.Generator], Any]
) -> Any:
    """The record of one attempt, which depends on ``inputs``."""
    run = state.run
    key = run.key(stage, run.variant_key(stage), inputs, run.seed, attempt)
    run.progress(stage, 0, 1)
    found = run.cached(stage, f"attempt-{attempt}", key, lambda: compute(stream(run.seed, stage, attempt)))
    run.progress(stage, 1, 1)
    return found


def _sizes_of(reconstruction: Reconstruction) -> dict[str, int]:
    return {"registered": int(reconstruction.registered.sum()), "points": int(reconstruction.valid.sum())}


def reconstruct_projective(state: PipelineState, attempt: int = 0) -> None:
    """Reconstruct up to a projective transform (chapter 6); sets ``result.projective``.

    ``attempt`` is the rank of the initial pair.

    Of large sets only a core of ``projective.core_views`` views is reconstructed: the metric stage registers
    the others by calibrated resection.
    """
    run, result = state.run, state.result
    assert result.tracks is not None
    tracks, pairs, sizes = (
        result.tracks,
        state.used_pairs,
        np.array([image.size for image in result.images], dtype=np.int64),
    )
    method = state.config.projective
    projective: Reconstruction = _cached(
        state, "projective", attempt, [run.logs["tracks"].keys, sizes],
        lambda rng: method.reconstruct(tracks, pairs, sizes, rng=rng, attempt=attempt),
    )  # fmt: skip
    state.result = replace(result, projective=projective)


def finish_projective(state: PipelineState) -> None:
    """Report the projective reconstruction, and its self-calibration if there is one."""
    projective, calibration = state.result.projective, state.result.calibration
    if projective is not None:
        sigma = {"sigma_px": projective.sigma_px}
        state.run.finish("projective", counts=_sizes_of(projective), metrics=sigma)
    if calibration is not None:
        counts = {"hypotheses": len(calibration.candidates), "identifiable": int(calibration.identifiable)}
        # A metric model has its own report.
        found = calibration.identifiability if state.result.metric is None else None
        state.run.finish("selfcalibration", counts=counts, warnings=_critical(found))


def _calibrate(state: PipelineState, attempt: int) -> SelfCalibration:
    run, prior, projective = state.run, state.prior, state.result.projective
    assert projective is not None
    upstream = run.logs["projective"].keys[f"attempt-{attempt}"]
    method, images = state.config.selfcalibration, state.result.images
    pixels = images if all(image.has_pixels for image in images) else ()
    calibration: SelfCalibration = _cached(
        state, "selfcalibration", attempt, [upstream, prior.shared, prior.mean, prior.std, prior.kind],
        lambda rng: calibrate_with_core(with_images(method, pixels), projective, prior=prior, rng=rng),
    )  # fmt: skip
    state.result = replace(state.result, calibration=calibration)
    return calibration


def _critical(found: IdentifiabilityReport | None) -> tuple[str, ...]:
    """A warning about a critical motion that the prior resolves; others fail the self-check."""
    resolved = found is not None and found.critical and found.identifiable
    return ("; ".join(found.sentences),) if found is not None and resolved else ()


def _refine(
    state: PipelineState, attempt: int, calibration: SelfCalibration, *, in_parts: bool
) -> MetricResult:
    """The metric reconstruction of one attempt; ``in_parts``: large sets are divided if they can be."""
    prior = state.prior
    assert state.result.projective is not None
    aligned = cameras_from_parts(state, ATTEMPTS) if in_parts else None
    start = calibrated_part(state.result.projective, calibration) if aligned is None else aligned
    known = calibration if aligned is None else from_metric(aligned, calibration)
    parts = [] if aligned is None else list(state.run.logs["metric"].keys.values())
    threads = state.run.workers.threads
    metric: MetricResult = _cached(
        state, "metric", attempt, [state.run.logs["selfcalibration"].keys[f"attempt-{attempt}"], parts],
        lambda rng: state.config.metric.refine(start, known, prior=prior, rng=rng, threads=threads),
    )  # fmt: skip
    state.result = replace(state.result, metric=metric)
    return metric


def reconstruct_metric(state: PipelineState) -> None:
    """Reconstruct, calibrate and refine, from other initial pairs until a result is trusted."""
    tried: list[RunResult] = []
    failures: list[StageFailure] = []
    start = state.result
    for attempt in range(ATTEMPTS):
        state.result, trusted = start, False
        try:
            reconstruct_projective(state, attempt)
            calibration = _calibrate(state, attempt)
            first = all(result.calibration is None for result in tried)
            trusted = _refine(state, attempt, calibration, in_parts=first).trusted
        except StageFailure as failure:
            failures.append(failure)
        tried.append(state.result)
        if trusted:
            break
    state.result = best = best_result(tried)
    finish_projective(state)
    if best.metric is None:
        raise failures[0]
    attempt = next(k for k, result in enumerate(tried) if result is best)
    metric = register_more(state, attempt, best.metric)
    state.result = replace(best, metric=metric)
    texts = (*_critical(metric.identifiability), *metric.warnings)
    warnings = [name_images(text, state.names) for text in texts]
    found = metric.reconstruction
    state.run.finish(
        "metric", counts=_sizes_of(found), metrics={"sigma_px": found.sigma_px}, warnings=warnings
    )
    if len(tried) > 1:
        state.run.warnings.append(Notice("several-starts", len(tried)))


def best_result(tried: Sequence[RunResult]) -> RunResult:
    """The best result: metric before projective, then trusted, then with most cameras, then most points."""
    return max(tried, key=_quality)


def _quality(result: RunResult) -> tuple[bool, bool, int, int]:
    best = result.best_reconstruction
    if best is None:
        return False, False, 0, 0
    trusted = result.metric is not None and result.metric.trusted
    return result.metric is not None, trusted, int(best.registered.sum()), int(best.valid.sum())


def _middle_view(views: Sequence[PinholeView]) -> PinholeView:
    """The view with the smallest sum of distances to the other cameras."""
    C = np.array([camera_centre(view.P) for view in views])
    centres = C[:, :3] / C[:, 3:]
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2).sum(axis=1)
    return views[int(np.argmin(apart))]


def _compare_held_out(state: PipelineState, mesh: TexturedMesh) -> HeldOut | None:
    """Compare the middle view with the model textured without it; None if they cannot be compared."""
    views, threads = state.result.views, state.run.workers.threads
    if len(views) < MIN_VIEWS or not len(mesh.faces):
        return None
    view = _middle_view(views)
    try:
        painted = state.config.model.color(mesh, views, without=view.view, threads=threads)
    except StageFailure:
        return None
    height, width = view.rgb.shape[:2]
    rendered = render_mesh(painted, Camera.from_matrix(view.P, (width, height)), threads=threads)
    compared = covered_pixels(rendered) & view.seen
    if not compared.any():
        return None
    matched = match_exposure(view.rgb, rendered.color, compared)
    similarity = (psnr_db(view.rgb, matched, compared), ssim(view.rgb, matched, compared))
    return HeldOut(view.view, view.rgb, matched, compared, *similarity)


def _depths(
    config: PipelineConfig, scene: MultiViewScene, view: int, pool: Executor | None
) -> list[DepthMap]:
    return [config.dense.depth_map(scene, view, pool=pool)]


def _confirmed(
    config: PipelineConfig, scene: MultiViewScene, maps: Mapping[int, DepthMap], view: int
) -> list[DepthMap]:
    return [config.dense.confirm(scene, maps, view)]


def estimate_depth_maps(state: PipelineState) -> None:
    """Estimate and cross-check the depth maps of all registered views (2.5)."""
    run, result = state.run, state.result
    assert result.metric is not None
    reconstruction, dense = result.metric.reconstruction, state.config.dense
    run.progress("dense", 0, int(reconstruction.registered.sum()))
    with run.clock("dense"):
        scene = dense.prepare(result.images, reconstruction, threads=run.workers.threads)
        order = sorted(scene.views)
        near = {view: dense.required_views(scene, view) for view in order}
    r, pixels = reconstruction, [(image.rgb, image.mask) for image in result.images]
    given = [r.P, r.K, r.distortion, r.X, r.registered, r.valid, r.inlier, pixels]
    key = run.key("dense", run.variant_key("dense"), given)
    place = {view: n for n, view in enumerate(order)}

    def part(view: int) -> MultiViewScene:
        """Part of the scene that the depth map of one view needs."""
        return scene if run.workers.in_process else scene.subset(near[view])

    def estimated(missing: Sequence[int]) -> Iterator[Batch]:
        for n in missing:
            yield [n], (state.config, part(order[n]), order[n], run.workers.pool)

    def confirmed(missing: Sequence[int]) -> Iterator[Batch]:
        for n in missing:
            own = {j: maps[place[j]] for j in sorted(near[order[n]])}
            yield [n], (state.config, scene, own, order[n])

    keys = {f"{i:05d}": run.key("dense", key, i) for i in order}
    maps = run.map_cached("dense", keys, _depths, estimated, max_bytes=MAP_BYTES)
    keys = {f"confirmed-{i:05d}": run.key("dense", key, i, "confirmed") for i in order}
    # The maps of 12 neighbours take longer to send than to compare.
    final = run.map_cached("dense", keys, _confirmed, confirmed, max_bytes=MAP_BYTES, silent=True, here=True)
    # The views for stereo matching need not stay in memory.
    undistorted = scene.views
    views = OnDemand(len(order), lambda n: undistorted[order[n]])
    state.result = replace(result, depth_maps=final, views=views)
    finite = [np.isfinite(m.depth) for m in final]
    known = [float(mask.mean()) for mask in finite]
    counts = {"views": len(order), "depths": int(sum(mask.sum() for mask in finite))}
    empty = [result.images[i].name for i, share in zip(order, known, strict=True) if not share]
    warnings = [Notice("no-depth-values", name) for name in empty]
    metrics = {"median_share_known": float(np.median(known))}
    run.finish("dense", counts=counts, metrics=metrics, warnings=warnings)
    if not counts["depths"]:
        evidence = f"none of {len(order)} views agrees with another on any surface"
        advice = "add images with more overlap of a textured scene"
        raise StageFailure("no depth was found", evidence, advice)


def build_model(state: PipelineState) -> None:
    """Fuse the depth maps to a textured mesh (2.6) and compare it with a held-out view."""
    run, result = state.run, state.result
    key = run.key("model", run.variant_key("model"), list(run.logs["dense"].keys.values()))
    run.progress("model", 0, 1)
    build = partial(state.config.model.build, result.depth_maps, result.views, threads=run.workers.threads)
    mesh: TexturedMesh = run.cached("model", "model", key, build)
    held_out_key = run.key("model", key, "held-out", code_digest(_compare_held_out))
    held_out = run.cached("model", "held-out", held_out_key, lambda: _compare_held_out(state, mesh))
    state.result = replace(state.result, mesh=mesh, held_out=held_out)
    without_texture = 0.0 if mesh.untextured is None else float(mesh.untextured.mean())
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    run.finish("model", counts=counts, metrics={"share_untextured": without_texture})
    run.progress("model", 1, 1)

"""Depth maps of all views and the textured model (2.5 and 2.6), compared with one held-out image."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from thesisrecon.camera import Camera
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.pipeline._state import PipelineState
from thesisrecon.records import DepthMap, HeldOut, Image, PinholeView, Reconstruction, TexturedMesh
from thesisrecon.runtime._run_folder import code_key
from thesisrecon.stereo.depth import MultiViewScene
from thesisrecon.views.image_similarity import covered_pixels, match_exposure, psnr_db, ssim
from thesisrecon.views.render import render

MIN_VIEWS = 3
"""With fewer views, others may not see the surface of the held-out one."""
RENDERER = "thesisrecon.views.render"
"""Module whose code the held-out comparison depends on, besides that of the model."""


def _middle_view(views: Sequence[PinholeView]) -> PinholeView:
    """The view with the smallest sum of distances to the other cameras."""
    C = np.array([camera_centre(view.P) for view in views])
    centres = C[:, :3] / C[:, 3:]
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2).sum(axis=1)
    return views[int(np.argmin(apart))]


def _compare_held_out(state: PipelineState, mesh: TexturedMesh) -> HeldOut | None:
    """Compare the middle view with the model textured without it; None if they cannot be compared.

    The rendering is exposure-matched, one factor per channel.
    """
    views, threads = state.result.views, state.run.workers.threads
    if len(views) < MIN_VIEWS or not len(mesh.faces):
        return None
    view = _middle_view(views)
    try:
        painted = state.config.model.color(mesh, views, without=view.view, threads=threads)
    except StageFailure:
        return None
    height, width = view.rgb.shape[:2]
    rendered = render(painted, Camera.from_matrix(view.P, (width, height)), threads=threads)
    compared = covered_pixels(rendered) & view.seen
    if not compared.any():
        return None
    matched = match_exposure(view.rgb, rendered.color, compared)
    similarity = (psnr_db(view.rgb, matched, compared), ssim(view.rgb, matched, compared))
    return HeldOut(view.view, view.rgb, matched, compared, *similarity)


def _depths(config: PipelineConfig, scene: MultiViewScene, view: int) -> list[DepthMap]:
    return [config.dense.depth_map(scene, view)]


def _confirmed(
    config: PipelineConfig, scene: MultiViewScene, maps: Mapping[int, DepthMap], view: int
) -> DepthMap:
    return config.dense.confirm(scene, maps, view)


def estimate_depth_maps(state: PipelineState) -> None:
    """Estimate and cross-check the depth maps of all registered views (2.5)."""
    run, result = state.run, state.result
    assert result.metric is not None
    reconstruction = result.metric.reconstruction
    with run.clock("dense"):
        scene = state.config.dense.prepare(result.images, reconstruction)
    order = sorted(scene.views)
    given = _depth_inputs(reconstruction, result.images)
    keys = {f"{i:05d}": run.key("dense", run.variant_key("dense"), given, i) for i in order}

    def seen_from(view: int) -> tuple[MultiViewScene, frozenset[int]]:
        """Part of the scene that the depth map of one view needs."""
        near = state.config.dense.required_views(scene, view)
        return (scene if run.workers.in_process else scene.subset(near)), near

    found = run.map_cached(
        "dense",
        keys,
        _depths,
        lambda missing: (([n], (state.config, seen_from(order[n])[0], order[n])) for n in missing),
    )
    maps, confirmed = dict(zip(order, found, strict=True)), dict[int, DepthMap]()

    def confirmations() -> Iterator[tuple[object, ...]]:
        for view in order:
            part, near = seen_from(view)
            yield state.config, part, {j: maps[j] for j in sorted(near)}, view

    with run.clock("dense"):
        run.workers.run(_confirmed, confirmations(), lambda n, depths: confirmed.update({order[n]: depths}))
    final = [confirmed[i] for i in order]
    state.result = replace(result, depth_maps=tuple(final), views=tuple(scene.views[i] for i in order))
    known = [float(np.isfinite(m.depth).mean()) for m in final]
    counts = {"views": len(order), "depths": int(sum(np.isfinite(m.depth).sum() for m in final))}
    empty = [result.images[i].name for i, share in zip(order, known, strict=True) if not share]
    warnings = [f"Image {name} has no depth values" for name in empty]
    run.finish(
        "dense", counts=counts, metrics={"median_share_known": float(np.median(known))}, warnings=warnings
    )
    if not counts["depths"]:
        evidence = f"none of {len(order)} views agrees with another on any surface"
        advice = "add images with more overlap of a textured scene"
        raise StageFailure("no depth was found", evidence, advice)


def _depth_inputs(reconstruction: Reconstruction, images: tuple[Image, ...]) -> list[object]:
    """Inputs of the depth maps: cameras, points and pixels."""
    r = reconstruction
    return [r.P, r.K, r.distortion, r.X, r.registered, r.valid, r.inlier, [image.rgb for image in images]]


def build_model(state: PipelineState) -> None:
    """Fuse the depth maps to a textured mesh (2.6) and compare it with a held-out view."""
    run, result = state.run, state.result
    key = run.key("model", run.variant_key("model"), list(run.logs["dense"].keys.values()))
    run.progress("model", 0, 1)
    build, threads = state.config.model.build, run.workers.threads
    mesh: TexturedMesh = run.cached(
        "model", "model", key, lambda: build(result.depth_maps, result.views, threads=threads)
    )
    held_out_key = run.key("model", key, "held-out", code_key(RENDERER))
    held_out = run.cached("model", "held-out", held_out_key, lambda: _compare_held_out(state, mesh))
    state.result = replace(state.result, mesh=mesh, held_out=held_out)
    without_texture = 0.0 if mesh.untextured is None else float(mesh.untextured.mean())
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    run.finish("model", counts=counts, metrics={"share_untextured": without_texture})
    run.progress("model", 1, 1)

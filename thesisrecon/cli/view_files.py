"""Frames, animation and description that the commands ``render`` and ``interpolate`` write."""

import os
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.api.models import read_cameras
from thesisrecon.api.views import (
    match_images,
    prepare_pair,
    prepare_trilinear_views,
    render,
)
from thesisrecon.arrays import U8
from thesisrecon.camera import Camera
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.errors import Notice, UsageError, counted, made
from thesisrecon.io._exports import frame_name, write_animation, write_image
from thesisrecon.io._files import is_partial, printable, read_json, write_json
from thesisrecon.io._images import read_image
from thesisrecon.io._meshes import read_mesh
from thesisrecon.io._outputs import LOCK_FILE, OutputFolder, claim_folder
from thesisrecon.pipeline.run import Progress
from thesisrecon.records import Image, TexturedMesh
from thesisrecon.runtime._executors import Workers
from thesisrecon.views.interpolation import detect_monotonicity_violations
from thesisrecon.views.paths import interpolate_cameras, orbit, sample_surface
from thesisrecon.views.tensor import camera_at

MODEL, CAMERAS, FRAMES = "model.glb", "cameras.json", "frames.json"
_OWN = re.compile(r"frames\.json|frame-\d{4}\.png|(orbit|interpolate|interpolation|tensor)\.(webp|png)")
"""Names of the files of these commands."""
_MIDWAY = 0.5


@dataclass(frozen=True)
class ViewSequence:
    """Views that ``draw`` computes by number, and what ``frames.json`` says of all and of each frame."""

    draw: Callable[[int], U8]
    facts: dict[str, Any]
    entries: Sequence[dict[str, Any]]
    milliseconds: int = 100  #: of a frame in the animation


def interpolated_sequence(
    images: Sequence[Image], frames: int, *, config: PipelineConfig, seed: int, threads: int
) -> ViewSequence:
    """Interpolate from the first image to the second (section 1.2)."""
    first, second = images
    pair = prepare_pair(first, second, config=config, seed=seed)
    path = np.linspace(0.0, 1.0, frames).tolist() if frames > 1 else [_MIDWAY]
    names, disparity = [first.name, second.name], pair.left.disparity
    # Share of the known pixels of the first image.
    known = int(np.isfinite(disparity).sum())
    violations = float(detect_monotonicity_violations(disparity).sum() / max(known, 1))
    facts = {"images": names, "violating_monotonicity": violations, "known": pair.known}
    entries = [{"weights": [1.0 - s, s]} for s in path]
    return ViewSequence(lambda k: pair.view(path[k], threads=threads), facts, entries)


def trilinear_sequence(
    images: Sequence[Image], frames: int, *, config: PipelineConfig, seed: int, threads: int
) -> ViewSequence:
    """Compute views on the line through both cameras, from half a baseline before to half beyond."""
    first, second = images
    if np.array_equal(first.rgb, second.rgb):
        raise UsageError(f"{first.name} and {second.name} are the same image; give different ones")
    matched = match_images(first, second, config=config, seed=seed)
    views = prepare_trilinear_views(matched, config=config)
    pair, sizes = views.pair, (first.size, second.size)
    positions = np.linspace(-0.5, 1.5, frames).tolist() if frames > 1 else [_MIDWAY]
    path = [camera_at(pair, s, sizes=sizes) for s in positions]
    names, motion = [first.name, second.name], {"R": pair.R, "t": pair.t}
    facts = {"images": names, "K": [pair.K1, pair.K2], "second_from_first": motion}
    entries = [
        {"baselines": s, "R": camera.rotation, "t": camera.translation, "K": camera.K}
        for s, camera in zip(positions, path, strict=True)
    ]
    return ViewSequence(lambda k: views.render(path[k], threads=threads), facts, entries)


METHODS = {"interpolation": interpolated_sequence, "tensor": trilinear_sequence}
"""Method -> function that returns its :class:`ViewSequence`."""


def render_run(
    out: Path, folder: Path, *, path: str = "orbit", frames: int = 90, size: tuple[int, int] | None = None,
    threads: int = 1, progress: Progress | None = None, overwrite: bool = False,
) -> str:  # fmt: skip
    """Render the model of a run; write frames, an animation and ``frames.json``; return a sentence."""
    mesh, cameras = _read_run(out)
    with _claimed(folder, path, frames, overwrite=overwrite) as outputs:
        width, height = size = size or cameras[0].scaled(min(1.0, 1000 / max(cameras[0].size))).size
        if path == "interpolate":
            views = interpolate_cameras(cameras, frames, size=size)
        else:
            points = sample_surface(mesh)
            views = orbit(cameras, points if len(points) else mesh.vertices, frames, size=size)
        facts = {"path": path, "width": width, "height": height}
        # The cameras as in cameras.json.
        entries = [{key: getattr(view, key) for key in ("K", "R", "t", "centre")} for view in views]
        sequence = ViewSequence(lambda k: render(mesh, views[k]).color, facts, entries, milliseconds=40)
        return _write_views(outputs, path, sequence, Workers(threads), progress)


def interpolate_images(
    folder: Path, paths: Sequence[Path], *, method: str = "interpolation", frames: int = 21, seed: int = 0,
    max_size_px: int | None = None, threads: int = 1, progress: Progress | None = None,
    overwrite: bool = False,
) -> str:  # fmt: skip
    """Compute views between images; write frames, an animation and ``frames.json``."""
    if len(paths) != 2:
        raise UsageError(f"interpolate takes 2 images; got {len(paths)}")
    for path in paths:
        if path.is_dir():
            raise UsageError(f"{path} is a folder; interpolate takes image files")
    first, second = paths
    if first.is_file() and second.is_file() and first.samefile(second):
        raise UsageError(f"{first} is given twice; give different images")
    with _claimed(folder, method, frames, overwrite=overwrite) as outputs:
        config = PipelineConfig()
        if max_size_px is not None:
            config = replace(config, images=ImageOptions(max_size_px))
        images = [read_image(path, max_size_px=config.images.max_size_px).images[0] for path in paths]
        report = progress or (lambda *_: None)
        report("correspondence", 0, 1)
        sequence = METHODS[method](images, frames, config=config, seed=seed, threads=threads)
        report("correspondence", 1, 1)
        sequence = replace(sequence, facts={"method": method, **sequence.facts})
        # The threads work on one view at a time.
        return _write_views(outputs, method, sequence, Workers(1), progress)


def _claimed(
    folder: Path, name: str, frames: int, *, overwrite: bool
) -> AbstractContextManager[OutputFolder]:
    """Claim a folder in which only these commands wrote: an image may be called frame-0001.png."""

    def check(outputs: OutputFolder) -> None:
        known = overwrite or any(map(_OWN.fullmatch, outputs.digests)) or not os.path.lexists(folder)
        strange = [] if known else sorted(path.name for path in folder.iterdir())
        if foreign := [name for name in strange if name != LOCK_FILE and not is_partial(name)]:
            raise UsageError(Notice("foreign-frames", folder, foreign[0]))

    names = [FRAMES, *map(frame_name, range(1, frames + 1)), f"{name}.webp"]
    return claim_folder(folder, overwrite=overwrite, names=names, check=check)


def _write_views(
    outputs: OutputFolder, name: str, views: ViewSequence, workers: Workers, progress: Progress | None
) -> str:
    """Write the frames, then animation and description; return a sentence."""
    folder, frames = outputs.path, [frame_name(k + 1) for k in range(len(views.entries))]
    # Files of an earlier command, but for frames that this one replaces.
    outputs.remove([old for old in outputs.digests if _OWN.fullmatch(old) and old not in frames])
    sizes, warnings, report = set[Any](), list[str](), progress or (lambda *_: None)
    files, film, done = [folder / frame for frame in frames], folder / f"{name}.webp", 0

    def write(k: int) -> None:
        rgb = views.draw(k)
        sizes.add(rgb.shape[1::-1])
        write_image(files[k], rgb)

    def finished(*_: Any) -> None:
        nonlocal done
        done += 1
        # The last step is the animation.
        report("views", done, len(frames) + 1)

    workers.run(write, [(k,) for k in range(len(frames))], finished)
    animate = partial(write_animation, film, files, milliseconds=views.milliseconds)
    animation = made(film.name, animate, warnings, None)
    listed = [{"name": frame, **entry} for frame, entry in zip(frames, views.entries, strict=True)]
    content = views.facts | {"frames": listed} | ({"warnings": warnings} if warnings else {})
    write_json(folder / FRAMES, content)
    finished()
    ((width, height),) = sizes
    text = f"{counted(len(frames), 'frame')} of {width} x {height} px"
    text += "" if animation is None else f" and {animation.name}"
    lines = [f"{text} written to {folder}", *(f"warning: {warning}" for warning in warnings)]
    return "\n".join(map(printable, lines))


def _read_run(out: Path) -> tuple[TexturedMesh, list[Camera]]:
    if not out.is_dir() or not any((out / name).is_file() for name in (MODEL, CAMERAS, "run.json")):
        raise UsageError(f"{out} holds no run; create one with thesisrecon reconstruct IMAGES -o {out}")
    if not (out / MODEL).is_file():
        summary = read_json(out / "summary.json")
        warnings = summary.get("warnings", []) if isinstance(summary, dict) else []
        if failed := [str(w) for w in warnings if str(w).startswith("No surface model was built")]:
            raise UsageError(f"the run in {out} has cameras but no model: {failed[0]}")
        raise UsageError(Notice("no-model-yet", out, MODEL))
    mesh = read_mesh(out / MODEL)
    # Views are rendered without lens distortion.
    return mesh, [replace(camera, distortion=None) for camera in read_cameras(out / CAMERAS).values()]

"""Frames, animation and description that the commands ``render`` and ``interpolate`` write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.cli._view_sequences import interpolated_sequence, trilinear_sequence
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.errors import OutputError, UsageError, counted
from thesisrecon.io._exports import animation_suffix, frame_name, read_cameras, write_animation, write_frame
from thesisrecon.io._files import is_partial, printable, read_json, write_json, write_text
from thesisrecon.io.images import read_image
from thesisrecon.io.meshes import read_mesh
from thesisrecon.records import TexturedMesh
from thesisrecon.report._page import strip_page
from thesisrecon.runtime._executors import Workers
from thesisrecon.views.paths import estimate_up, interpolate_cameras, orbit, sample_surface
from thesisrecon.views.render import Light, Shading, render

MODEL, CAMERAS, FRAMES, STRIP = "model.glb", "cameras.json", "frames.json", "strip.html"
PATHS = ("orbit", "interpolate")
METHODS = {"interpolation": interpolated_sequence, "tensor": trilinear_sequence}
"""Method -> function that returns its :class:`ViewSequence`."""
_FRAME_MS = 100
"""Time per frame of an animation of ``interpolate``."""
_DEFAULT_SIDE_PX = 1000
_NO_MODEL = "No surface model was built"
"""Beginning of the warning of a run whose surface stage failed."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class RenderOptions:
    """Options of ``render``; ``size`` None is that of the first image, of at most 1000 px."""

    path: str = "orbit"
    frames: int = 90
    size: tuple[int, int] | None = None
    light: str = "none"
    background: tuple[int, int, int] = (0, 0, 0)


@dataclass(frozen=True)
class InterpolateOptions:
    """Options of ``interpolate``."""

    images: tuple[Path, ...]
    method: str = "interpolation"
    frames: int = 21
    seed: int = 0
    max_size_px: int | None = None

    def __post_init__(self) -> None:
        if len(self.images) not in (2, 3):
            raise UsageError(f"interpolate takes 2 or 3 images; got {len(self.images)}")
        for path in self.images:
            if path.is_dir():
                raise UsageError(f"{path} is a folder; interpolate takes image files")
        for first, second in combinations(self.images, 2):
            if first.is_file() and second.is_file() and first.samefile(second):
                raise UsageError(f"{first} is given twice; give different images")


@dataclass(frozen=True)
class ViewFiles:
    """Files that a command wrote, and the (width, height) of a frame."""

    folder: Path
    frames: tuple[Path, ...]
    animation: Path
    size: tuple[int, int]

    def __str__(self) -> str:
        width, height = self.size
        files = f"{counted(len(self.frames), 'frame')} of {width} x {height} px and {self.animation.name}"
        return f"{files} written to {printable(str(self.folder))}"


def render_run(
    out: Path, folder: Path, options: RenderOptions, *, threads: int = 1, progress: Progress | None = None
) -> ViewFiles:
    """Render the model of a run; write frames, an animation and ``frames.json``.

    Frames of an earlier call that this one does not replace are removed. The files do not depend on
    ``threads``.
    """
    mesh, cameras = _read_run(out)
    _claim(folder)
    path = _camera_path(mesh, list(cameras.values()), options)
    # Written first: it marks the folder as one of these commands.
    write_json(folder / FRAMES, _description(path, options))
    _remove_old(folder, len(path))
    files = [folder / frame_name(k + 1) for k in range(len(path))]
    shading = _shading(mesh, list(cameras.values()), options.light)
    report, done = progress or (lambda *_: None), 0

    def draw(k: int) -> None:
        view = render(mesh, path[k], shading=shading(path[k]), background=options.background)
        write_frame(folder, k + 1, view.color)

    def finished(_: int, __: Any) -> None:
        nonlocal done
        done += 1
        # The last step is the animation.
        report("views", done, len(path) + 1)

    Workers(threads).run(draw, [(k,) for k in range(len(path))], finished)
    animation = write_animation(folder / f"{options.path}{animation_suffix()}", files)
    finished(len(path), animation)
    return ViewFiles(folder, tuple(files), animation, path[0].size)


def interpolate_images(
    folder: Path, options: InterpolateOptions, *, threads: int = 1, progress: Progress | None = None
) -> ViewFiles:
    """Compute views between images; write frames, an animation, ``strip.html`` and ``frames.json``.

    Nothing is written before the images have been matched. The files do not depend on ``threads``.
    """
    _claim(folder)
    config = PipelineConfig()
    if options.max_size_px is not None:
        config = replace(config, images=ImageOptions(options.max_size_px))
    images = [read_image(path, max_size_px=config.images.max_size_px).images[0] for path in options.images]
    report, count = progress or (lambda *_: None), options.frames
    report("correspondence", 0, 1)
    sequence = METHODS[options.method](images, count, config=config, seed=options.seed)
    report("correspondence", 1, 1)
    listed = [{"name": frame_name(k + 1), **entry} for k, entry in enumerate(sequence.frame_metadata)]
    write_json(folder / FRAMES, {"method": options.method, **sequence.metadata, "frames": listed})
    _remove_old(folder, count)
    frames = []
    for k in range(count):
        rgb = sequence.draw(k, threads)
        write_frame(folder, k + 1, rgb)
        frames.append((sequence.captions[k], rgb))
        report("views", k + 1, count + 2)
    files = [folder / frame_name(k + 1) for k in range(count)]
    target = folder / f"{options.method}{animation_suffix()}"
    animation = write_animation(target, files, milliseconds=_FRAME_MS)
    report("views", count + 1, count + 2)
    title = "Between " + " and ".join(image.name for image in images)
    write_text(folder / STRIP, strip_page(title, frames, notes=sequence.notes))
    report("views", count + 2, count + 2)
    height, width = frames[0][1].shape[:2]
    return ViewFiles(folder, tuple(files), animation, (width, height))


def _read_run(out: Path) -> tuple[TexturedMesh, dict[str, Camera]]:
    """Read the model and the cameras of a finished run."""
    if not out.is_dir() or not any((out / name).is_file() for name in (MODEL, CAMERAS, "run.json")):
        raise UsageError(f"{out} holds no run; create one with thesisrecon reconstruct IMAGES -o {out}")
    if not (out / MODEL).is_file():
        raise UsageError(_missing_model(out))
    return read_mesh(out / MODEL), read_cameras(out / CAMERAS)


def _missing_model(out: Path) -> str:
    """Why a run has no model: its surface stage failed, or it has not been run."""
    summary = read_json(out / "summary.json")
    warnings = summary.get("warnings", []) if isinstance(summary, dict) else []
    reason = next((str(w) for w in warnings if str(w).startswith(_NO_MODEL)), None)
    if reason is not None:
        return f"the run in {out} has cameras but no model: {reason}"
    command = f"thesisrecon reconstruct IMAGES -o {out}, without --until"
    return f"the run in {out} has no model yet ({MODEL}); continue it with {command}"


def _claim(folder: Path) -> None:
    """Refuse a folder with files that these commands did not write: an image may be called frame-0001.png."""
    if isinstance(read_json(folder / FRAMES), dict):
        return
    try:
        names = [path.name for path in folder.iterdir()] if folder.exists() else []
    except OSError as error:
        raise UsageError(f"the folder {folder} cannot be used: {error.strerror}") from None
    foreign = sorted(name for name in names if not is_partial(name))
    if foreign:
        strange = f"contains {foreign[0]!r}, which this command did not create"
        raise UsageError(f"the folder {folder} {strange}; choose an empty or a new folder")


def _remove_old(folder: Path, frames: int) -> None:
    names = {frame_name(k + 1) for k in range(frames)}
    old = [p for p in folder.glob("frame-*.png") if p.name not in names]
    old += [folder / f"{path}{suffix}" for path in (*PATHS, *METHODS) for suffix in (".webp", ".png")]
    old += [folder / STRIP, *folder.glob(".*.partial")]
    try:
        for path in old:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"the folder {folder}", error) from None


def _camera_path(mesh: TexturedMesh, cameras: list[Camera], options: RenderOptions) -> list[Camera]:
    first = cameras[0]
    size = options.size or first.scaled(min(1.0, _DEFAULT_SIDE_PX / max(first.size))).size
    if options.path == "interpolate":
        return interpolate_cameras(cameras, options.frames, size=size)
    points = sample_surface(mesh)
    return orbit(cameras, points if len(points) else mesh.vertices, options.frames, size=size)


def _shading(mesh: TexturedMesh, cameras: list[Camera], light: str) -> Callable[[Camera], Shading | None]:
    """Return the shading as a function of the camera of a frame."""
    plain = mesh.colors is None and (mesh.texture is None or mesh.uv is None)
    if light == "none" and not plain:
        return lambda _: None
    if light == "sun":
        # From above, the left and the first camera: walls and ground keep their brightness.
        towards = estimate_up(cameras) - 0.5 * cameras[0].R[0] - cameras[0].R[2]
        sun = Shading(ambient=0.4, lights=(Light(direction=_triple(towards), color=(0.9,) * 3),))
        return lambda _: sun
    return lambda camera: Shading(
        ambient=0.3, lights=(Light(position=_triple(camera.centre), color=(0.8,) * 3),)
    )


def _triple(vector: F64) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def _description(path: list[Camera], options: RenderOptions) -> dict[str, Any]:
    """Content of ``frames.json``: the options, and the camera of each frame as in ``cameras.json``."""
    frames = [
        {"name": frame_name(k + 1), "K": camera.K, "R": camera.R, "t": camera.t, "centre": camera.centre}
        for k, camera in enumerate(path)
    ]
    given = {"path": options.path, "light": options.light, "background": list(options.background)}
    return {**given, "width": path[0].size[0], "height": path[0].size[1], "frames": frames}

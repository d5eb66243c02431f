"""The work of ``thesisrecon views``: pictures of the model of a finished run on the way of a camera, and
views between photographs of which no model was made.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import combinations
from pathlib import Path
from typing import Any

import PIL.ImageColor

from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.errors import OutputError, UsageError
from thesisrecon.io.exports import read_cameras
from thesisrecon.io.files import is_partial, read_json, write_json, write_text
from thesisrecon.io.frames import animation_suffix, frame_name, write_animation, write_frame
from thesisrecon.io.meshes import read_mesh
from thesisrecon.records import TexturedMesh
from thesisrecon.report.page import strip_page
from thesisrecon.runtime.executors import Workers
from thesisrecon.settings import in_words, unknown_word
from thesisrecon.view_interpolation import Film, named_photograph
from thesisrecon.views.paths import interpolate, orbit, surface_points, upward
from thesisrecon.views.render import Light, Shading, render

MODEL, CAMERAS, FRAMES, STRIP = "model.glb", "cameras.json", "frames.json", "strip.html"
PATHS, LIGHTS = ("orbit", "interpolate"), ("none", "camera", "sun")
METHODS = {
    "interpolation": ("thesisrecon.view_interpolation", "interpolation_film"),
    "tensor": ("thesisrecon.view_synthesis", "tensor_film"),
}
"""Ways to views without a model, and what makes the film of each."""
FRAMES_BETWEEN, BETWEEN_MS = 21, 100
"""Pictures where their number is not asked for, and how long each is shown."""
LARGEST_PX = 8192
MOST_FRAMES = 9999
"""As many as the numbers of their files have room for."""
LONG_SIDE_PX = 1000
"""Of the pictures where no size is asked for."""

Progress = Callable[[str, int, int], None]


def _check_frames(frames: int) -> None:
    if frames < 1:
        raise UsageError(f"--frames takes a whole number of at least 1; got {frames}")
    if frames > MOST_FRAMES:
        raise UsageError(f"--frames takes at most {MOST_FRAMES}; got {in_words(frames)}")


@dataclass(frozen=True)
class ViewWishes:
    """What pictures are wanted.

    ``path``: "orbit" around the model, or "interpolate" from photograph to photograph. ``size`` (width,
    height), None = the shape of the first photograph, its long side at most 1000 px. ``light``: "none" shows
    the colours of the photographs, "camera" has a lamp at the camera, "sun" one from above. A model without
    colours is always lit. ``background`` (red, green, blue), 0 to 255.

    Raises :class:`UsageError` for anything else.
    """

    path: str = "orbit"
    frames: int = 90
    size: tuple[int, int] | None = None
    light: str = "none"
    background: tuple[int, int, int] = (0, 0, 0)

    def __post_init__(self) -> None:
        for kind, word, words in (("path", self.path, PATHS), ("light", self.light, LIGHTS)):
            if word not in words:
                raise UsageError(unknown_word(kind, word, list(words)))
        _check_frames(self.frames)
        if self.size is not None and not all(1 <= side <= LARGEST_PX for side in self.size):
            width, height = self.size
            raise UsageError(f"--size takes sides of 1 to {LARGEST_PX} pixels; got {width}x{height}")


@dataclass(frozen=True)
class ViewFiles:
    """What was written: ``frames`` in ``folder``, of ``size`` (width, height), and the ``animation``."""

    folder: Path
    frames: tuple[Path, ...]
    animation: Path
    size: tuple[int, int]


def size_from_text(text: str) -> tuple[int, int]:
    """(width, height) of ``WIDTHxHEIGHT``; :class:`UsageError` for other text."""
    found = re.fullmatch(r"\s*(\d{1,6})\s*[xX×]\s*(\d{1,6})\s*", text)
    if found is None:
        raise UsageError(f"--size takes WIDTHxHEIGHT in pixels, as 1000x700; got {text!r}")
    return int(found[1]), int(found[2])


def color_from_text(text: str) -> tuple[int, int, int]:
    """(red, green, blue) of a name ("white"), "#rrggbb" or "rgb(...)"; :class:`UsageError` for other text."""
    try:
        return PIL.ImageColor.getrgb(text.strip())[:3]
    except ValueError:
        raise UsageError(f"--background takes a colour as white or #20304f; got {text!r}") from None


def write_views(
    out: Path, folder: Path, wishes: ViewWishes, *, threads: int = 1, progress: Progress | None = None
) -> ViewFiles:
    """Render the model of the run in ``out`` into ``folder``.

    Writes ``frame-0001.png`` and so on, an animated file named after the path, and ``frames.json`` with the
    cameras of the frames. Frames of an earlier call that this one does not replace are removed. The files do
    not depend on ``threads``; ``progress`` hears (stage, done, total). Raises :class:`UsageError` where the
    run, its model or its cameras are absent, where ``folder`` holds what is not of this command, and where
    it cannot be written.
    """
    mesh, cameras = _run_of(out)
    _claim(folder)
    path = _cameras_on_path(mesh, list(cameras.values()), wishes)
    # Written first: from now on the folder is known as one of this command.
    write_json(folder / FRAMES, _description(path, wishes))
    _remove_old(folder, len(path))
    files = [folder / frame_name(k + 1) for k in range(len(path))]
    shading = _shading(mesh, list(cameras.values()), wishes.light)
    tell, done = progress or (lambda *_: None), 0

    def draw(k: int) -> None:
        view = render(mesh, path[k], shading=shading(path[k]), background=wishes.background)
        write_frame(folder, k + 1, view.color)

    def finished(_: int, __: Any) -> None:
        nonlocal done
        done += 1
        # The last step is the animation.
        tell("views", done, len(path) + 1)

    Workers(threads).run(draw, [(k,) for k in range(len(path))], finished)
    animation = write_animation(folder / f"{wishes.path}{animation_suffix()}", files)
    finished(len(path), animation)
    return ViewFiles(folder, tuple(files), animation, path[0].size)


@dataclass(frozen=True)
class BetweenWishes:
    """What pictures are wanted of 2 or 3 ``photographs``: how many, and by which ``method``."""

    photographs: tuple[Path, ...]
    method: str = "interpolation"
    frames: int = FRAMES_BETWEEN
    seed: int = 0
    max_size_px: int | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UsageError(unknown_word("method", self.method, list(METHODS)))
        _check_frames(self.frames)
        if len(self.photographs) not in (2, 3):
            raise UsageError(f"views lie between 2 or 3 photographs; got {len(self.photographs)}")
        for path in self.photographs:
            if path.is_dir():
                raise UsageError(f"{path} is a folder; views lie between photographs")
        for first, second in combinations(self.photographs, 2):
            if first.is_file() and second.is_file() and first.samefile(second):
                raise UsageError(f"{first} is given twice; give different photographs")


def write_between(
    folder: Path, wishes: BetweenWishes, *, threads: int = 1, progress: Progress | None = None
) -> ViewFiles:
    """Views between photographs into ``folder``.

    Writes ``frame-0001.png`` and so on, an animated file and a page ``strip.html`` of all frames, and
    ``frames.json`` with the place of each. Frames of an earlier call that this one does not replace are
    removed; nothing is written before the photographs are known to have views between them. The files do not
    depend on ``threads``; ``progress`` hears (stage, done, total). Raises :class:`UsageError` and
    :class:`StageFailure` with what is wrong with the photographs, :class:`UsageError` where ``folder`` holds
    what is not of this command or cannot be written.
    """
    _claim(folder)
    config = PipelineConfig()
    if wishes.max_size_px is not None:
        config = replace(config, images=ImageOptions(wishes.max_size_px))
    photographs = [
        named_photograph(path, max_size_px=config.images.max_size_px).images[0] for path in wishes.photographs
    ]
    tell, count = progress or (lambda *_: None), wishes.frames
    tell("correspondence", 0, 1)
    film = _film_of(wishes.method)(photographs, wishes.frames, config=config, seed=wishes.seed)
    tell("correspondence", 1, 1)
    write_json(folder / FRAMES, {"method": wishes.method, **film.told, "frames": _places(film)})
    _remove_old(folder, count)
    frames = []
    for k in range(count):
        rgb = film.draw(k, threads)
        write_frame(folder, k + 1, rgb)
        frames.append((film.captions[k], rgb))
        tell("views", k + 1, count + 2)
    files = [folder / frame_name(k + 1) for k in range(count)]
    animation = write_animation(
        folder / f"{wishes.method}{animation_suffix()}", files, milliseconds=BETWEEN_MS
    )
    tell("views", count + 1, count + 2)
    title = "Between " + " and ".join(image.name for image in photographs)
    write_text(folder / STRIP, strip_page(title, frames, notes=film.notes))
    tell("views", count + 2, count + 2)
    height, width = frames[0][1].shape[:2]
    return ViewFiles(folder, tuple(files), animation, (width, height))


def _film_of(method: str) -> Callable[..., Film]:
    """The maker of films by that method, loaded when it is asked for."""
    module, name = METHODS[method]
    maker: Callable[..., Film] = getattr(import_module(module), name)
    return maker


def _places(film: Film) -> list[dict[str, Any]]:
    return [{"name": frame_name(k + 1), **place} for k, place in enumerate(film.places)]


def _run_of(out: Path) -> tuple[TexturedMesh, dict[str, Camera]]:
    """The model and the cameras of a finished run."""
    if not out.is_dir() or not any((out / name).is_file() for name in (MODEL, CAMERAS, "run.json")):
        raise UsageError(f"{out} holds no run; make one with thesisrecon reconstruct PHOTOGRAPHS -o {out}")
    if not (out / MODEL).is_file():
        raise UsageError(_why_no_model(out))
    return read_mesh(out / MODEL), read_cameras(out / CAMERAS)


def _why_no_model(out: Path) -> str:
    """A run that went as far as it could says itself why it has no model; others have not come so far."""
    told = read_json(out / "summary.json")
    warnings = told.get("warnings", []) if isinstance(told, dict) else []
    reason = next((str(w) for w in warnings if str(w).startswith("there is no model")), None)
    if reason is not None:
        return f"the run in {out} found its cameras and no surface: {reason}"
    return (
        f"the run in {out} has no model yet ({MODEL}); thesisrecon reconstruct PHOTOGRAPHS -o {out}, "
        "without --until, goes on to it"
    )


def _claim(folder: Path) -> None:
    """Refuse a folder with files that this command did not make: photographs may be called frame-0001.png,
    too."""
    if isinstance(read_json(folder / FRAMES), dict):
        return
    try:
        names = [path.name for path in folder.iterdir()] if folder.exists() else []
    except OSError as error:
        raise UsageError(f"the folder {folder} cannot be used: {error.strerror}") from None
    strange = sorted(name for name in names if not is_partial(name))
    if strange:
        raise UsageError(
            f"the folder {folder} holds {strange[0]!r}, which is not of this command; choose an empty or a "
            "new folder"
        )


def _remove_old(folder: Path, frames: int) -> None:
    names = {frame_name(k + 1) for k in range(frames)}
    old = [p for p in folder.glob("frame-*.png") if p.name not in names]
    old += [folder / f"{path}{suffix}" for path in (*PATHS, *METHODS) for suffix in (".webp", ".png")]
    old += [folder / STRIP, *folder.glob(".*.partial")]
    try:
        for path in old:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"the folder {folder}, of which old frames must go,", error) from None


def _cameras_on_path(mesh: TexturedMesh, cameras: list[Camera], wishes: ViewWishes) -> list[Camera]:
    size = wishes.size or _default_size(cameras[0])
    if wishes.path == "interpolate":
        return interpolate(cameras, wishes.frames, size=size)
    points = surface_points(mesh)
    return orbit(cameras, points if len(points) else mesh.vertices, wishes.frames, size=size)


def _default_size(camera: Camera) -> tuple[int, int]:
    width, height = camera.resized(min(1.0, LONG_SIDE_PX / max(camera.size))).size
    return width, height


def _shading(mesh: TexturedMesh, cameras: list[Camera], light: str) -> Callable[[Camera], Shading | None]:
    """The light of each frame."""
    plain = mesh.colors is None and (mesh.texture is None or mesh.uv is None)
    if light == "none" and not plain:
        return lambda _: None
    if light == "sun":
        # From above, the left and where the first photograph was taken: walls and ground keep their
        # brightness.
        towards = upward(cameras) - 0.5 * cameras[0].R[0] - cameras[0].R[2]
        sun = Shading(ambient=0.4, lights=(Light(direction=_triple(towards), color=(0.9,) * 3),))
        return lambda _: sun
    return lambda camera: Shading(
        ambient=0.3, lights=(Light(position=_triple(camera.centre), color=(0.8,) * 3),)
    )


def _triple(vector: F64) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def _description(path: list[Camera], wishes: ViewWishes) -> dict[str, Any]:
    """``frames.json``: what was asked for, and the camera of each frame as in ``cameras.json``."""
    frames = [
        {"name": frame_name(k + 1), "K": camera.K, "R": camera.R, "t": camera.t, "centre": camera.centre}
        for k, camera in enumerate(path)
    ]
    asked = {"path": wishes.path, "light": wishes.light, "background": list(wishes.background)}
    return {**asked, "width": path[0].size[0], "height": path[0].size[1], "frames": frames}

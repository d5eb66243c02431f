"""The command ``render``: views of the model of a finished run."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from thesisrecon.cli.common import Threads, cap_threads, interruptible, parse_folder, progress_bars
from thesisrecon.errors import UsageError
from thesisrecon.runtime.executors import available_threads


class _CameraPath(StrEnum):
    orbit = "orbit"
    interpolate = "interpolate"


class _Lighting(StrEnum):
    none = "none"
    camera = "camera"
    sun = "sun"


def render(
    run: Annotated[Path, typer.Argument(parser=parse_folder, metavar="OUT", help="Output folder of a run.")],
    path: Annotated[
        _CameraPath,
        typer.Option("--path", help="Camera path: orbit the model, or interpolate between the cameras."),
    ] = _CameraPath.orbit,
    frames: Annotated[int, typer.Option("--frames", help="Number of frames.")] = 90,
    size: Annotated[
        str | None,
        typer.Option(
            "--size", metavar="WxH", help="Frame size (px); by default the aspect ratio of the first image."
        ),
    ] = None,
    light: Annotated[
        _Lighting, typer.Option("--light", help="Lighting: none, camera headlight or sun.")
    ] = _Lighting.none,
    background: Annotated[
        str, typer.Option("--background", help="Background colour, such as white or #20304f.")
    ] = "black",
    folder: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", parser=parse_folder, metavar="FOLDER", help="Output folder (OUT/views/PATH)."
        ),
    ] = None,
    threads: Threads = 0,
) -> None:
    """Render the model of a finished run along a camera path, as frames and an animation."""
    cap_threads(threads)
    if run.is_file():
        raise UsageError(f"render takes the output folder of a run; {run} is a file")
    from thesisrecon.cli.view_files import RenderOptions, color_from_text, render_run, size_from_text

    options = RenderOptions(
        path.value,
        frames,
        None if size is None else size_from_text(size),
        light.value,
        color_from_text(background),
    )
    with interruptible("repeat the command to render all frames"), progress_bars() as progress:
        written = render_run(
            run,
            folder or run / "views" / path.value,
            options,
            threads=threads or available_threads(),
            progress=progress,
        )
    typer.echo(str(written))

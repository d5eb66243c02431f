"""The commands ``render`` (a finished run) and ``interpolate`` (two or three images): sequences of views."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from thesisrecon.cli.common import (
    Frames,
    MaxSize,
    Overwrite,
    Seed,
    Threads,
    cap_threads,
    folder_option,
    interruptible,
    parse_folder,
    progress_bars,
)
from thesisrecon.errors import UsageError
from thesisrecon.io._files import printable
from thesisrecon.runtime._executors import available_threads

_MAX_SIDE_PX = 8192


def render(
    run: Annotated[Path, typer.Argument(parser=parse_folder, metavar="OUT", help="Output folder of a run.")],
    path: Annotated[
        Literal["orbit", "interpolate"],
        typer.Option("--path", help="Camera path: orbit the model, or interpolate between the cameras."),
    ] = "orbit",
    frames: Frames = 90,
    size: Annotated[
        str | None,
        typer.Option(
            "--size", metavar="WxH", help="Frame size (px); by default that of the first image, at most 1000."
        ),
    ] = None,
    light: Annotated[
        Literal["none", "camera", "sun"],
        typer.Option("--light", help="Lighting: none, camera headlight or sun."),
    ] = "none",
    background: Annotated[
        str, typer.Option("--background", help="Background colour, such as white or #20304f.")
    ] = "black",
    folder: Annotated[Path | None, folder_option("Output folder (OUT/views/PATH).")] = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
) -> None:
    """Render the model of a run along a camera path."""
    cap_threads(threads)
    if run.is_file():
        raise UsageError(f"render takes the output folder of a run; {run} is a file")
    from thesisrecon.cli.view_files import render_run

    with interruptible("repeat the command to render all frames"), progress_bars() as progress:
        written = render_run(
            run,
            folder or run / "views" / path,
            path=path,
            frames=frames,
            size=None if size is None else _size(size),
            light=light,
            background=_color(background),
            threads=threads or available_threads(),
            progress=progress,
            overwrite=overwrite,
        )
    typer.echo(written)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"\s*(\d{1,6})\s*[xX×]\s*(\d{1,6})\s*", text)
    if found is None:
        raise UsageError(f"--size takes WIDTHxHEIGHT in pixels, as 1000x700; got {text!r}")
    width, height = int(found[1]), int(found[2])
    if not (1 <= width <= _MAX_SIDE_PX and 1 <= height <= _MAX_SIDE_PX):
        raise UsageError(f"--size takes sides of 1 to {_MAX_SIDE_PX} pixels; got {width}x{height}")
    return width, height


def _color(text: str) -> tuple[int, int, int]:
    """Parse a colour name, "#rrggbb" or "rgb(...)"."""
    import PIL.ImageColor

    try:
        return PIL.ImageColor.getrgb(text.strip())[:3]
    except ValueError:
        raise UsageError(f"--background takes a colour as white or #20304f; got {text!r}") from None


def interpolate(
    images: Annotated[
        list[Path],
        typer.Argument(parser=parse_folder, metavar="IMAGE IMAGE [IMAGE]", help="Two or three image files."),
    ],
    method: Annotated[
        Literal["interpolation", "tensor"],
        typer.Option("--method", help="Matched and blended (thesis 1.2), or by the trilinear tensor (1.3)."),
    ] = "interpolation",
    frames: Frames = 21,
    seed: Seed = 0,
    max_size: MaxSize = None,
    folder: Annotated[Path | None, folder_option("Output folder (views/METHOD).")] = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
) -> None:
    """Compute views between two or three images."""
    cap_threads(threads)
    if max_size is not None and max_size < 64:
        raise UsageError(f"--max-size takes at least 64 px; got {max_size}")
    from thesisrecon.cli.view_files import STRIP, interpolate_images

    folder = folder or Path("views") / method
    with interruptible("repeat the command to compute all frames"), progress_bars() as progress:
        written = interpolate_images(
            folder,
            images,
            method=method,
            frames=frames,
            seed=seed,
            max_size_px=max_size,
            threads=threads or available_threads(),
            progress=progress,
            overwrite=overwrite,
        )
    typer.echo(written)
    if (page := folder / STRIP).is_file():
        typer.echo(f"page: {printable(str(page))}")

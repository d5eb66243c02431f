"""The command ``interpolate``: views between two or three images, without a model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from thesisrecon.cli.common import (
    Frames,
    MaxSize,
    Seed,
    Threads,
    cap_threads,
    interruptible,
    parse_folder,
    progress_bars,
)
from thesisrecon.errors import UsageError
from thesisrecon.io._files import printable
from thesisrecon.runtime._executors import available_threads


def interpolate(
    images: Annotated[
        list[Path],
        typer.Argument(parser=parse_folder, metavar="IMAGE IMAGE [IMAGE]", help="Two or three image files."),
    ],
    method: Annotated[
        Literal["interpolation", "tensor"],
        typer.Option("--method", help="Image interpolation (section 1.2) or trilinear tensor (1.3)."),
    ] = "interpolation",
    frames: Frames = 21,
    seed: Seed = 0,
    max_size: MaxSize = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", parser=parse_folder, metavar="FOLDER", help="Output folder (views/METHOD)."
        ),
    ] = None,
    threads: Threads = 0,
) -> None:
    """Compute views between two or three images."""
    cap_threads(threads)
    if max_size is not None and max_size < 64:
        raise UsageError(f"--max-size takes at least 64 px; got {max_size}")
    from thesisrecon.cli.view_files import STRIP, InterpolateOptions, interpolate_images

    options = InterpolateOptions(tuple(images), method, frames, seed, max_size)
    with interruptible("repeat the command to compute all frames"), progress_bars() as progress:
        where, workers = folder or Path("views") / method, threads or available_threads()
        written = interpolate_images(where, options, threads=workers, progress=progress)
    typer.echo(str(written))
    typer.echo(f"page: {printable(str(written.folder / STRIP))}")

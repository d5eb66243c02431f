"""The command ``views``."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thesisrecon.cli.common import Threads, cap_threads, interruptible, named_folder, progress_bars
from thesisrecon.errors import UsageError, counted
from thesisrecon.io.files import printable
from thesisrecon.runtime.executors import available_threads

if TYPE_CHECKING:
    from thesisrecon.cli.view_files import ViewFiles

VIEWS_AGAIN = "the same command makes all pictures anew"


class Way(StrEnum):
    """Where the camera of ``views`` goes."""

    orbit = "orbit"
    interpolate = "interpolate"


class Method(StrEnum):
    """How ``views`` come about between photographs."""

    interpolation = "interpolation"
    tensor = "tensor"


class Lamp(StrEnum):
    """The light of ``views``."""

    none = "none"
    camera = "camera"
    sun = "sun"


def views(
    what: Annotated[
        list[Path],
        typer.Argument(
            parser=named_folder,
            metavar="OUT | PHOTOGRAPH PHOTOGRAPH [PHOTOGRAPH]",
            help="A run, or photographs.",
        ),
    ],
    path: Annotated[
        Way | None,
        typer.Option(
            "--path",
            help="Of a run: around the model (orbit), or from photograph to photograph (interpolate).",
        ),
    ] = None,
    method: Annotated[
        Method | None,
        typer.Option("--method", help="Between photographs: interpolation, or by the trilinear tensor."),
    ] = None,
    frames: Annotated[
        int | None, typer.Option("--frames", help="How many pictures (90 of a run, 21 between photographs).")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            "--size", metavar="WxH", help="Of a run's pictures (px); by default the first photograph's shape."
        ),
    ] = None,
    light: Annotated[
        Lamp | None,
        typer.Option("--light", help="Of a run: none, as photographed; a lamp at the camera; from above."),
    ] = None,
    background: Annotated[
        str | None, typer.Option("--background", help="Of a run: a colour: white, #20304f (black).")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Of all random steps.")] = None,
    max_size: Annotated[
        int | None,
        typer.Option("--max-size", help="Long side (px) photographs are reduced to (default: 1600)."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            parser=named_folder,
            metavar="FOLDER",
            help="For the pictures (OUT/views/PATH of a run, views/METHOD of photographs).",
        ),
    ] = None,
    threads: Threads = 0,
) -> None:
    """Pictures of a run's model along the way of a camera, or of what lies between two or three photographs,
    and an animated file of them."""
    cap_threads(threads)
    of_run = {"--path": path, "--size": size, "--light": light, "--background": background}
    between = {"--method": method, "--seed": seed, "--max-size": max_size}
    if len(what) > 1:
        _refuse(of_run, "a run, not between photographs")
        _views_between(what, method or Method.interpolation, frames, (seed or 0, max_size), folder, threads)
        return
    if what[0].is_file():
        raise UsageError(f"views takes the folder of a run, or 2 or 3 photographs; got one file, {what[0]}")
    _refuse(between, "views between photographs, not of a run")
    from thesisrecon.cli.view_files import ViewWishes, color_from_text, size_from_text, write_views

    wanted = size_from_text(size) if size is not None else None
    way, lamp = path or Way.orbit, light or Lamp.none
    color = color_from_text("black" if background is None else background)
    wishes = ViewWishes(way.value, 90 if frames is None else frames, wanted, lamp.value, color)
    with interruptible(VIEWS_AGAIN), progress_bars() as progress:
        written = write_views(
            what[0],
            folder or what[0] / "views" / way.value,
            wishes,
            threads=threads or available_threads(),
            progress=progress,
        )
    _say_views(written)


def _refuse(options: Mapping[str, object], sense: str) -> None:
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise UsageError(f"{given[0]} is of {sense}")


def _views_between(
    photographs: list[Path],
    method: Method,
    frames: int | None,
    reading: tuple[int, int | None],
    folder: Path | None,
    threads: int,
) -> None:
    from thesisrecon.cli.view_files import FRAMES_BETWEEN, STRIP, BetweenWishes, write_between

    count = FRAMES_BETWEEN if frames is None else frames
    if reading[1] is not None and reading[1] < 64:
        raise UsageError(f"--max-size takes at least 64 px; got {reading[1]}")
    wishes = BetweenWishes(tuple(photographs), method.value, count, *reading)
    with interruptible(VIEWS_AGAIN), progress_bars() as progress:
        written = write_between(
            folder or Path("views") / method.value,
            wishes,
            threads=threads or available_threads(),
            progress=progress,
        )
    _say_views(written)
    typer.echo(f"the page of them is {printable(str(written.folder / STRIP))}")


def _say_views(written: ViewFiles) -> None:
    width, height = written.size
    pictures = f"{counted(len(written.frames), 'picture')} of {width} x {height} px"
    typer.echo(f"{pictures} and {written.animation.name} are in {printable(str(written.folder))}")

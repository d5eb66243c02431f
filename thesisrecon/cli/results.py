"""The commands on results: ``compare``, ``export``, ``render`` and ``interpolate``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from thesisrecon.cli.common import (
    MaxSize,
    OutputFolder,
    Overwrite,
    Seed,
    Threads,
    cap_threads,
    folder_argument,
    folder_option,
    interruptible,
    parse_folder,
    progress_bars,
)
from thesisrecon.errors import UsageError, made
from thesisrecon.io._files import printable
from thesisrecon.runtime._executors import available_threads

_KINDS = "folder of a run, COLMAP model, cameras.json, or trajectory (TUM or KITTI)"
_PAGE_HELP = "Write a page (HTML) with both models in 3D."
_TO_HELP = "colmap, colmap-undistorted, nerfstudio, openmvs, bundler, opencv or kalibr."
_IMAGES_HELP = "Folder of the original images (default: that of the run)."
_MASKS_HELP = "Folder of the masks of the images (default: that of the run)."
_SCALE_HELP = "Known distance of the cameras of two images."
_SCALE = typer.Option("--scale", metavar="NAME1 NAME2 DISTANCE", help=_SCALE_HELP)
_ALIGN_HELP = "Known camera positions: a CSV of name,x,y,z or name,lat,lon,alt."
_PATH_HELP = "Camera path: orbit the model, or interpolate between the cameras."
_SIZE_HELP = "Frame size (px); by default that of the first image, at most 1000."
_LIGHT_HELP = "Lighting: none, camera headlight or sun."
_BACKGROUND_HELP = "Background colour, such as white or #20304f."
_METHOD_HELP = "Matched and blended (thesis 1.2), or by the trilinear tensor (1.3)."
_TWO_OR_THREE = typer.Argument(
    parser=parse_folder, metavar="IMAGE IMAGE [IMAGE]", help="Two or three image files."
)
Frames = Annotated[int, typer.Option("--frames", min=1, max=9999, help="Number of frames.")]


def compare(
    a: Annotated[Path, folder_argument("A", f"Model: {_KINDS}.")],
    b: Annotated[Path, folder_argument("B", "Reference: any of these.")],
    json: Annotated[Path | None, typer.Option("--json", help="Write all numbers to this file.")] = None,
    page: Annotated[Path | None, typer.Option("--page", help=_PAGE_HELP)] = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare two models of the same images after a similarity alignment."""
    cap_threads(0)
    from thesisrecon.api.compare import compare_models
    from thesisrecon.io._files import json_text, write_new
    from thesisrecon.report._assessment import camera_table, headline, point_table, summary_table
    from thesisrecon.report._page import comparison_page

    if json is not None and json == page:
        raise UsageError("--json and --page name the same file; give different ones")
    found = compare_models(a, b)
    lines = [f"A: {a}", f"B: {b} (reference)", headline(found), *(f"note: {note}" for note in found.notes)]
    cameras, most = camera_table(found), 60
    tables = [summary_table(found), point_table(found), cameras[: most + 1]]
    for rows in filter(None, tables):
        lines += ["", *_aligned(rows)]
    if len(cameras) > most + 1:
        lines.append(f"and {len(cameras) - 1 - most} more cameras; --json writes all")
    files = {} if json is None else {json: json_text({"a": str(a), "b": str(b), **found.as_table()})}
    warnings: list[str] = []
    if page is not None:
        html = made(str(page), lambda: comparison_page(found, str(a), str(b)), warnings, "")
        files |= {page: html} if html else {}
    write_new(files, overwrite=overwrite, extra=page, warnings=warnings)
    lines += [f"warning: {warning}" for warning in warnings]
    typer.echo("\n".join(printable(line) for line in lines))


def _aligned(rows: list[list[str]]) -> list[str]:
    """The rows with columns of one width, the first one flush left and the others flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows
    ]


def export(
    model: Annotated[Path, folder_argument("OUT", "Folder of a run, or a COLMAP model.")],
    folder: OutputFolder,
    to: Annotated[str, typer.Option("--to", metavar="FORMAT", help=_TO_HELP)],
    images: Annotated[Path | None, folder_option(_IMAGES_HELP, "--images")] = None,
    masks: Annotated[Path | None, folder_option(_MASKS_HELP, "--masks")] = None,
    scale: Annotated[tuple[str, str, float] | None, _SCALE] = None,
    align: Annotated[Path | None, typer.Option("--align", metavar="FILE", help=_ALIGN_HELP)] = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
) -> None:
    """Write cameras, points and undistorted images for another program."""
    cap_threads(threads)
    if scale is not None and align is not None:
        raise UsageError("--scale and --align exclude each other; positions determine the scale")
    from thesisrecon.api.export import export as write_export
    from thesisrecon.api.export import recorded_images, recorded_masks, require_separate
    from thesisrecon.api.models import align_to_positions, scaled
    from thesisrecon.io._models import read_model

    if folder.resolve() == model.resolve():
        raise UsageError(f"the folder {folder} holds the model; export to another folder")
    # Checked here, because `export` gets the model from memory and cannot compare its folder.
    require_separate(folder, to, model=model)
    found = read_model(model)
    if scale is not None:
        found = scaled(found, *scale)
    if align is not None:
        found, report = align_to_positions(found, align)
        typer.echo("\n".join(map(printable, str(report).splitlines())))
    with interruptible("repeat the command to write all files"):
        images, lost = images or recorded_images(model), list[str]()
        if masks is None:
            masks, lost = recorded_masks(model, to)
        written = write_export(
            found, folder, to=to, images=images, masks=masks, threads=threads, overwrite=overwrite
        )
    for note in (*lost, *written.notes):
        typer.echo(f"note: {note}")
    typer.echo(f"{len(found.views)} images and {len(found.X)} points: {printable(str(written.file))}")


def render(
    run: Annotated[Path, folder_argument("OUT", "Output folder of a run.")],
    path: Annotated[Literal["orbit", "interpolate"], typer.Option("--path", help=_PATH_HELP)] = "orbit",
    frames: Frames = 90,
    size: Annotated[str | None, typer.Option("--size", metavar="WxH", help=_SIZE_HELP)] = None,
    light: Annotated[Literal["none", "camera", "sun"], typer.Option("--light", help=_LIGHT_HELP)] = "none",
    background: Annotated[str, typer.Option("--background", help=_BACKGROUND_HELP)] = "black",
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
    if not 1 <= min(width, height) <= max(width, height) <= 8192:
        raise UsageError(f"--size takes sides of 1 to 8192 pixels; got {width}x{height}")
    return width, height


def _color(text: str) -> tuple[int, int, int]:
    """Parse a colour name, "#rrggbb" or "rgb(...)"."""
    import PIL.ImageColor

    try:
        return PIL.ImageColor.getrgb(text.strip())[:3]
    except ValueError:
        raise UsageError(f"--background takes a colour as white or #20304f; got {text!r}") from None


def interpolate(
    images: Annotated[list[Path], _TWO_OR_THREE],
    method: Annotated[
        Literal["interpolation", "tensor"], typer.Option("--method", help=_METHOD_HELP)
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

"""The command ``export``: a finished run or a COLMAP model for other programs, in metres if wanted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thesisrecon.cli.common import OutputFolder, Overwrite, Threads, cap_threads, interruptible, parse_folder
from thesisrecon.errors import UsageError
from thesisrecon.io._files import printable


def export(
    model: Annotated[
        Path, typer.Argument(parser=parse_folder, metavar="OUT", help="Folder of a run, or a COLMAP model.")
    ],
    folder: OutputFolder,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORMAT",
            help="colmap, colmap-undistorted, nerfstudio, openmvs, bundler, opencv or kalibr.",
        ),
    ],
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            parser=parse_folder,
            metavar="DIR",
            help="Folder of the original images (default: that of the run).",
        ),
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(
            "--masks",
            parser=parse_folder,
            metavar="DIR",
            help="Folder of the masks of the images (default: that of the run).",
        ),
    ] = None,
    scale: Annotated[
        tuple[str, str, float] | None,
        typer.Option(
            "--scale", metavar="NAME1 NAME2 DISTANCE", help="Known distance of the cameras of two images."
        ),
    ] = None,
    align: Annotated[
        Path | None,
        typer.Option(
            "--align", metavar="FILE", help="Known camera positions: a CSV of name,x,y,z or name,lat,lon,alt."
        ),
    ] = None,
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

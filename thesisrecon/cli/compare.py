"""The command ``compare``: the differences of two models."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thesisrecon.cli.common import Overwrite, cap_threads, parse_folder
from thesisrecon.errors import UsageError, made
from thesisrecon.io._files import printable

_MOST_ROWS = 60
_KINDS = "folder of a run, COLMAP model, cameras.json, or trajectory (TUM or KITTI)"


def compare(
    a: Annotated[Path, typer.Argument(parser=parse_folder, metavar="A", help=f"Model: {_KINDS}.")],
    b: Annotated[Path, typer.Argument(parser=parse_folder, metavar="B", help="Reference: any of these.")],
    json: Annotated[Path | None, typer.Option("--json", help="Write all numbers to this file.")] = None,
    page: Annotated[
        Path | None, typer.Option("--page", help="Write a page (HTML) with both models in 3D.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare two models of the same images after a similarity alignment."""
    cap_threads(0)
    from thesisrecon.api.compare import compare_models
    from thesisrecon.io._files import json_text, write_new
    from thesisrecon.report._comparison import (
        camera_table,
        comparison_page,
        headline,
        point_table,
        summary_table,
    )

    if json is not None and json == page:
        raise UsageError("--json and --page name the same file; give different ones")
    found = compare_models(a, b)
    lines = [f"A: {a}", f"B: {b} (reference)", headline(found), *(f"note: {note}" for note in found.notes)]
    cameras = camera_table(found)
    tables = [summary_table(found), point_table(found), cameras[: _MOST_ROWS + 1]]
    for rows in filter(None, tables):
        lines += ["", *_aligned(rows)]
    if len(cameras) > _MOST_ROWS + 1:
        lines.append(f"and {len(cameras) - 1 - _MOST_ROWS} more cameras; --json writes all")
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

"""The commands ``reconstruct`` and ``demo``: from images to a run folder."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from thesisrecon.cli.common import (
    MaxSize,
    OutputFolder,
    Seed,
    Threads,
    cap_threads,
    interruptible,
    parse_folder,
    progress_bars,
)
from thesisrecon.cli.inspect import summary_text
from thesisrecon.errors import UsageError
from thesisrecon.io._files import printable

if TYPE_CHECKING:
    from thesisrecon.config import PipelineConfig
    from thesisrecon.records import RunResult

_DEMO_SETTINGS: dict[str, Any] = {"dense": {"max_side": 512, "match_side": 512}}
"""Small depth maps: the demo should show a model soon."""


def reconstruct(
    images: Annotated[Path, typer.Argument(parser=parse_folder, metavar="IMAGES", help="Folder of images.")],
    out: OutputFolder,
    preset: Annotated[
        Literal["default", "thesis"] | None,
        typer.Option("--preset", help="Pipeline to start from (default: default)."),
    ] = None,
    cameras: Annotated[
        Literal["shared", "per-image"] | None,
        typer.Option("--cameras", help="One camera per image size, or one per image."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="TOML file of settings that override the preset.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One setting as stage.field=value; may be repeated.")
    ] = None,
    seed: Seed = 0,
    threads: Threads = 0,
    max_size: MaxSize = None,
    pairs: Annotated[
        str | None,
        typer.Option(
            "--pairs",
            metavar="all|overlap|window:N|FILE",
            help="Image pairs to match: all, those that seem to overlap (the default above 30 images), each "
            "image with the next N by name, or the pairs of a file with two names per line.",
        ),
    ] = None,
    until: Annotated[
        str | None,
        typer.Option(
            "--until",
            help="Last stage to run: features, matches, projective, metric, dense or model (the default).",
        ),
    ] = None,
    executor: Annotated[
        str,
        typer.Option(
            "--executor",
            metavar="local|processes|dask://HOST:PORT",
            help="Run workers as threads (local), as processes, or on a Dask cluster.",
        ),
    ] = "local",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace another run in the output folder.")
    ] = False,
) -> None:
    """Reconstruct cameras, points and a textured model from images."""
    cap_threads(threads)
    tables = _option_tables(cameras, max_size, pairs)
    chosen = _config(preset, config, tables, settings or [])
    options = {"until": until, "threads": threads or None, "executor": executor, "overwrite": overwrite}
    _run(images, out, chosen, seed, options)


def demo(out: OutputFolder = Path("out/demo"), threads: Threads = 0) -> None:
    """Reconstruct the courtyard images that come with the package."""
    cap_threads(threads)
    from thesisrecon.io.demo import demo_images

    # The folder may hold a demo of an older version with other settings.
    options = {"threads": threads or None, "overwrite": True}
    _run(demo_images(), out, _config(None, None, _DEMO_SETTINGS, []), 0, options)


def _option_tables(cameras: str | None, max_size: int | None, pairs: str | None) -> dict[str, dict[str, Any]]:
    """Return the settings that have command-line options of their own, as TOML tables."""
    options: dict[str, dict[str, Any]] = {
        "intrinsics": {} if cameras is None else {"cameras": cameras},
        "images": {} if max_size is None else {"max_size_px": max_size},
        "pairs": {} if pairs is None else _pairs_table(pairs),
    }
    return {stage: table for stage, table in options.items() if table}


def _pairs_table(value: str) -> dict[str, Any]:
    """Return the settings for ``--pairs``; an existing file takes precedence over the word "window"."""
    words = {"all": "all-pairs", "overlap": "overlap-estimate"}
    if value in words:
        return {"kind": words[value]}
    word, colon, number = value.partition(":")
    if word == "window" and (colon or not Path(value).is_file()):
        try:
            return {"kind": "sequence-window", "window": int(number)}
        except ValueError:
            raise UsageError(f"--pairs window:N takes a whole number of images; got {value!r}") from None
    if not Path(value).is_file():
        known = "all, overlap, window:N, or a file of pairs"
        raise UsageError(f"--pairs takes {known}; there is no file {value!r}")
    from thesisrecon.io._files import read_pairs

    return {"kind": "listed-pairs", "listed": read_pairs(Path(value))}


def _config(
    preset: str | None, file: Path | None, options: Mapping[str, Mapping[str, Any]], settings: list[str]
) -> PipelineConfig:
    """Apply the preset (of the command, else of the file), the file, the options and --set, in this order."""
    from thesisrecon._settings import config_from_toml, tables_from_settings
    from thesisrecon.config import preset as preset_of
    from thesisrecon.io._files import read_text

    text, base = "" if file is None else read_text(file), preset_of(preset or "default")
    changes = (options, tables_from_settings(settings))
    return config_from_toml(text, base, fixed_preset=preset is not None, changes=changes)


def _run(
    images: Path | list[Path], out: Path, config: PipelineConfig, seed: int, options: Mapping[str, Any]
) -> None:
    from thesisrecon.pipeline.reconstruction import reconstruct as run_pipeline

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    advice = f"repeat the command to resume from {printable(str(out))}"
    with interruptible(advice), progress_bars() as progress:
        result: RunResult = run_pipeline(images, out, config=config, seed=seed, progress=progress, **options)
    typer.echo(summary_text(result.summary, out))

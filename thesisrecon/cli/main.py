"""The command line: parse, call, print."""

from __future__ import annotations

import io
import logging
import os
import sys
import warnings
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thesisrecon import __version__
from thesisrecon.cli.common import (
    DEBUG_VARIABLE,
    Threads,
    cap_threads,
    exit_code_of,
    interruptible,
    named_folder,
    progress_bars,
)
from thesisrecon.cli.inspect import summary_text
from thesisrecon.cli.views import views
from thesisrecon.errors import UsageError
from thesisrecon.io.files import printable
from thesisrecon.runtime.signals import speak_through

if TYPE_CHECKING:
    from thesisrecon.config import PipelineConfig
    from thesisrecon.records import RunResult

DEMO_SETTINGS: dict[str, Any] = {"dense": {"max_side": 512, "match_side": 512}}
"""Whoever tries it wants to see a model soon."""

app = typer.Typer(
    name="thesisrecon",
    help="From uncalibrated photographs to metric cameras, points and a textured model.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


class Preset(StrEnum):
    """Configurations by name."""

    default = "default"
    thesis = "thesis"


class Cameras(StrEnum):
    """What is assumed of the cameras."""

    shared = "shared"
    per_image = "per-image"


Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Take over an output folder that holds another run.")
]


@app.command()
def reconstruct(
    images: Annotated[
        Path, typer.Argument(parser=named_folder, metavar="IMAGES", help="The folder of photographs.")
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", parser=named_folder, metavar="FOLDER", help="The output folder.")
    ],
    preset: Annotated[
        Preset | None, typer.Option("--preset", help="The pipeline to start from (default: default).")
    ] = None,
    cameras: Annotated[
        Cameras | None,
        typer.Option("--cameras", help="One camera for all photographs of a size, or one per image."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="A TOML file of settings, applied to the preset.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One setting as stage.field=value; may be repeated.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of all random steps.")] = 0,
    threads: Threads = 0,
    max_size: Annotated[
        int | None,
        typer.Option("--max-size", help="Long side (px) photographs are reduced to (default: 1600)."),
    ] = None,
    pairs: Annotated[
        str | None,
        typer.Option(
            "--pairs",
            metavar="all|overlap|window:N|FILE",
            help="Which pairs are matched: all, those that seem to overlap (the default above 30 "
            "photographs), each with the next N by name, or those of a file with two names on a line.",
        ),
    ] = None,
    until: Annotated[
        str | None,
        typer.Option(
            "--until",
            help="The last stage: features, matches, projective, metric, dense or model (the default).",
        ),
    ] = None,
    executor: Annotated[
        str,
        typer.Option(
            "--executor",
            metavar="local|processes|dask://HOST:PORT",
            help="Workers are threads (local), processes, or those of a Dask cluster.",
        ),
    ] = "local",
    overwrite: Overwrite = False,
) -> None:
    """Reconstruct metric cameras, points and a textured model from a folder of photographs."""
    cap_threads(threads)
    wishes = _option_tables(cameras, max_size, pairs)
    chosen = _config(preset.value if preset else None, config, wishes, settings or [])
    options = {"until": until, "threads": threads or None, "executor": executor, "overwrite": overwrite}
    _run(images, out, chosen, seed, options)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option("-o", "--out", parser=named_folder, metavar="FOLDER", help="The output folder.")
    ] = Path("out/demo"),
    threads: Threads = 0,
) -> None:
    """Reconstruct the photographs of a courtyard that come with the package."""
    cap_threads(threads)
    from thesisrecon.io.lists import demo_photographs

    # The folder of an older demo may hold other settings: the demo is always that of today.
    options = {"threads": threads or None, "overwrite": True}
    _run(demo_photographs(), out, _config(None, None, DEMO_SETTINGS, []), 0, options)


@app.command()
def inspect(
    out: Annotated[
        Path, typer.Argument(parser=named_folder, metavar="OUT", help="The output folder of a run.")
    ],
) -> None:
    """Print what a run found."""
    from thesisrecon.io.files import read_json

    summary = read_json(out / "summary.json")
    if not isinstance(summary, dict):
        raise UsageError(f"{out} holds no summary of a run (summary.json); has a run ended there?")
    try:
        text = summary_text(summary, out)
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError, RecursionError):
        raise UsageError(f"{out / 'summary.json'} is not a summary of this program") from None
    typer.echo(text)


app.command()(views)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    if version:
        typer.echo(f"thesisrecon {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit


def _option_tables(
    cameras: Cameras | None, max_size: int | None, pairs: str | None
) -> dict[str, dict[str, Any]]:
    """The settings that have options of their own, as tables."""
    options: dict[str, dict[str, Any]] = {}
    if cameras is not None:
        options["intrinsics"] = {"cameras": cameras.value}
    if max_size is not None:
        options["images"] = {"max_size_px": max_size}
    if pairs is not None:
        options["pairs"] = _pairs_table(pairs)
    return options


def _pairs_table(wish: str) -> dict[str, Any]:
    """The settings that ``--pairs`` means: a word, or a file where one of that name is there."""
    words = {"all": "all-pairs", "overlap": "overlap-estimate"}
    if wish in words:
        return {"kind": words[wish]}
    word, colon, number = wish.partition(":")
    if word == "window" and (colon or not Path(wish).is_file()):
        try:
            return {"kind": "sequence-window", "window": int(number)}
        except ValueError:
            raise UsageError(f"--pairs window:N takes a whole number of photographs; got {wish!r}") from None
    if not Path(wish).is_file():
        raise UsageError(
            f"--pairs takes all, overlap, window:N, or a file of pairs; there is no file {wish!r}"
        )
    from thesisrecon.io.lists import read_pairs

    return {"kind": "listed-pairs", "listed": read_pairs(Path(wish))}


def _config(
    preset: str | None,
    file: Path | None,
    options: Mapping[str, Mapping[str, Any]],
    settings: list[str],
) -> PipelineConfig:
    """The preset (of the command, else of the file, else default), then the file, then the options, then
    --set.
    """
    from thesisrecon import config as configs
    from thesisrecon.io.files import read_text

    text = "" if file is None else read_text(file)
    return configs.config_from_toml(
        text,
        configs.preset(preset or "default"),
        fixed_preset=preset is not None,
        changes=(options, configs.tables_from_settings(settings)),
    )


def _run(
    images: Path | list[Path], out: Path, config: PipelineConfig, seed: int, options: Mapping[str, Any]
) -> None:
    from thesisrecon.pipeline.reconstruction import reconstruct as run_pipeline

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    advice = f"the same command goes on where it stopped (what was done is kept in {printable(str(out))})"
    with interruptible(advice), progress_bars() as progress:
        result: RunResult = run_pipeline(images, out, config=config, seed=seed, progress=progress, **options)
    typer.echo(summary_text(result.summary, out))


def run_command(arguments: list[str]) -> int:
    """Run one command line; errors become one sentence on stderr and an exit code."""
    with warnings.catch_warnings():
        # What Pillow thinks of a file is said by us, in one sentence, or is not worth saying.
        warnings.filterwarnings("ignore", module=r"PIL\.")
        return exit_code_of(lambda: app(arguments, standalone_mode=False))


def _keep_stderr_to_ourselves() -> None:
    """Libraries in C write what they like to the terminal (libtiff a line for every bad byte): theirs goes
    nowhere, ours goes on."""
    try:
        ours, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:
        # Whoever closed it wants to hear nothing.
        return
    os.dup2(nowhere, 2)
    os.close(nowhere)
    speak_through(ours)
    encoding = getattr(sys.stderr, "encoding", None)
    sys.stderr = os.fdopen(ours, "w", buffering=1, encoding=encoding, errors="backslashreplace")


def main() -> None:
    """The entry point of the command."""
    # A name that a terminal has no letters for is told all the same.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    if not os.environ.get(DEBUG_VARIABLE):
        _keep_stderr_to_ourselves()
    sys.exit(run_command(sys.argv[1:]))

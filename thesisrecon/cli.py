"""The command line: parse, call, print.

NumPy is imported only inside the commands, after the number of its threads is set: linear algebra on one
thread gives the same bytes however many workers there are, and the workers are the parallelism.
"""

from __future__ import annotations

import io
import logging
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from signal import SIGINT
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thesisrecon import __version__
from thesisrecon.console import summary_text
from thesisrecon.errors import DISK, StageFailure, Unwritable, UsageError
from thesisrecon.io.text import printable, shortened, without_middle
from thesisrecon.stops import CODES, REASONS, advised, speak_through
from thesisrecon.workers import available_threads

if TYPE_CHECKING:
    from thesisrecon.config import PipelineConfig
    from thesisrecon.types import RunResult
    from thesisrecon.view_command import ViewFiles

DONE, INTERNAL, USAGE, IMPOSSIBLE = 0, 1, 2, 3
DEBUG_VARIABLE = "THESISRECON_DEBUG"
DEMO_SETTINGS: dict[str, Any] = {"dense": {"max_side": 512, "match_side": 512}}
"""Whoever tries it wants to see a model soon."""
MOST_THREADS = 1024
PICTURE_BLOCKS = "64m"
VIEWS_AGAIN = "the same command makes all pictures anew"
NO_CACHE = (
    "the compiled kernels can be kept neither beside the code nor in the user's cache folder; name a folder "
    "that can be written in the variable NUMBA_CACHE_DIR"
)
"""numba's own words for that name one of our functions and no remedy."""
STAGE_WORDS = {
    "features": "corners",
    "pairs": "choice of pairs",
    "matches": "pairs of photographs",
    "projective": "projective cameras",
    "selfcalibration": "self-calibration",
    "metric": "metric refinement",
    "dense": "depth maps",
    "model": "surface and texture",
    "correspondence": "which pixels correspond",
    "views": "views",
}

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


Threads = Annotated[
    int, typer.Option("--threads", min=0, max=MOST_THREADS, help="Workers; 0 = one per processor.")
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Take over an output folder that holds another run.")
]


def _folder(text: str | Path) -> Path:
    """A folder as the user names it: an empty name would silently mean the current folder."""
    if not str(text).strip():
        raise typer.BadParameter("the folder has no name; write . for the current one")
    return Path(text)


class _Interrupted(Exception):
    """Ctrl-C in a command."""


@app.command()
def reconstruct(
    images: Annotated[
        Path, typer.Argument(parser=_folder, metavar="IMAGES", help="The folder of photographs.")
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", parser=_folder, metavar="FOLDER", help="The output folder.")
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
    _cap_threads(threads)
    wishes = _option_tables(cameras, max_size, pairs)
    chosen = _config(preset.value if preset else None, config, wishes, settings or [])
    options = {"until": until, "threads": threads or None, "executor": executor, "overwrite": overwrite}
    _run(images, out, chosen, seed, options)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option("-o", "--out", parser=_folder, metavar="FOLDER", help="The output folder.")
    ] = Path("out/demo"),
    threads: Threads = 0,
) -> None:
    """Reconstruct the photographs of a courtyard that come with the package."""
    _cap_threads(threads)
    from thesisrecon.io.demo import demo_photographs

    # The folder of an older demo may hold other settings: the demo is always that of today.
    options = {"threads": threads or None, "overwrite": True}
    _run(demo_photographs(), out, _config(None, None, DEMO_SETTINGS, []), 0, options)


@app.command()
def inspect(
    out: Annotated[Path, typer.Argument(parser=_folder, metavar="OUT", help="The output folder of a run.")],
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


@app.command()
def views(
    what: Annotated[
        list[Path],
        typer.Argument(
            parser=_folder, metavar="OUT | PHOTOGRAPH PHOTOGRAPH [PHOTOGRAPH]", help="A run, or photographs."
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
            parser=_folder,
            metavar="FOLDER",
            help="For the pictures (OUT/views/PATH of a run, views/METHOD of photographs).",
        ),
    ] = None,
    threads: Threads = 0,
) -> None:
    """Pictures of a run's model along the way of a camera, or of what lies between two or three photographs,
    and an animated file of them."""
    _cap_threads(threads)
    of_run = {"--path": path, "--size": size, "--light": light, "--background": background}
    between = {"--method": method, "--seed": seed, "--max-size": max_size}
    if len(what) > 1:
        _refuse(of_run, "a run, not between photographs")
        _views_between(what, method or Method.interpolation, frames, (seed or 0, max_size), folder, threads)
        return
    if what[0].is_file():
        raise UsageError(f"views takes the folder of a run, or 2 or 3 photographs; got one file, {what[0]}")
    _refuse(between, "views between photographs, not of a run")
    from thesisrecon.view_command import ViewWishes, color_from_text, size_from_text, write_views

    wanted = size_from_text(size) if size is not None else None
    way, lamp = path or Way.orbit, light or Lamp.none
    color = color_from_text("black" if background is None else background)
    wishes = ViewWishes(way.value, 90 if frames is None else frames, wanted, lamp.value, color)
    with _interruptible(VIEWS_AGAIN), _progress_bars() as progress:
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
    from thesisrecon.view_command import FRAMES_BETWEEN, STRIP, BetweenWishes, write_between

    count = FRAMES_BETWEEN if frames is None else frames
    if reading[1] is not None and reading[1] < 64:
        raise UsageError(f"--max-size takes at least 64 px; got {reading[1]}")
    wishes = BetweenWishes(tuple(photographs), method.value, count, *reading)
    with _interruptible(VIEWS_AGAIN), _progress_bars() as progress:
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
    typer.echo(
        f"{len(written.frames)} pictures of {width} x {height} px and {written.animation.name} are in "
        f"{printable(str(written.folder))}"
    )


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


def _cap_threads(threads: int) -> None:
    """The one setting that caps every kind of thread; must run before NumPy and Pillow are imported."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ[name] = "1"
    os.environ["NUMBA_NUM_THREADS"] = str(threads or available_threads())
    # Pillow keeps pictures in blocks; of large ones nothing stays with the thread that read the picture.
    os.environ.setdefault("PILLOW_BLOCK_SIZE", PICTURE_BLOCKS)


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
    from thesisrecon.io.pairs import read_pairs

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
    from thesisrecon.io.text import read_text

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
    from thesisrecon.pipeline import reconstruct as run_pipeline

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    advice = f"the same command goes on where it stopped (what was done is kept in {printable(str(out))})"
    with _interruptible(advice), _progress_bars() as progress:
        result: RunResult = run_pipeline(images, out, config=config, seed=seed, progress=progress, **options)
    typer.echo(summary_text(result.summary, out))


@contextmanager
def _interruptible(advice: str) -> Iterator[None]:
    """What is advised where the block is interrupted; the parser has words of its own for a
    ``KeyboardInterrupt``."""
    try:
        with advised(advice):
            yield
    except KeyboardInterrupt as stop:
        raise _Interrupted(*stop.args) from None


@contextmanager
def _progress_bars() -> Iterator[Any]:
    """A bar per stage on a terminal; silence elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:>22}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=Console(stderr=True)) as bars:

        def hear(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(STAGE_WORDS.get(stage, stage), total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield hear


def run_command(arguments: list[str]) -> int:
    """Run one command line; errors become one sentence on stderr and an exit code."""
    try:
        with warnings.catch_warnings():
            # What Pillow thinks of a file is said by us, in one sentence, or is not worth saying.
            warnings.filterwarnings("ignore", module=r"PIL\.")
            code = app(arguments, standalone_mode=False)
        return code if isinstance(code, int) else DONE
    except UsageError as error:
        return _say(str(error), USAGE)
    except StageFailure as failure:
        return _say(str(failure), IMPOSSIBLE)
    except (_Interrupted, KeyboardInterrupt) as stop:
        # Where somebody else's program runs the command: ours is ended by `obey_signals`.
        return _say("; ".join((REASONS[SIGINT], *map(str, stop.args))), CODES[SIGINT])
    except MemoryError:
        return _say("out of memory; try a smaller --max-size or fewer --threads", IMPOSSIBLE)
    except OSError as error:
        if error.errno in DISK:
            # Kernels are kept on a disk too, and what is printed may go to a file.
            return _say(str(Unwritable(error.filename or "what the command writes", error)), USAGE)
        if os.environ.get(DEBUG_VARIABLE):
            raise
        place = f"{shortened(str(error.filename))}: " if error.filename is not None else ""
        return _say(f"{place}{error.strerror or error}", USAGE)
    except Exception as error:
        # The parser's own errors carry their sentence, in some versions with all that was given; its classes
        # differ between its versions.
        if hasattr(error, "format_message"):
            return _say(f"{without_middle(error.format_message())} (see thesisrecon --help)", USAGE)
        if os.environ.get(DEBUG_VARIABLE):
            raise
        if "no locator available" in str(error):
            return _say(NO_CACHE, USAGE)
        return _say(
            f"an error in the program: {type(error).__name__}: {error}; {DEBUG_VARIABLE}=1 shows where",
            INTERNAL,
        )


def _say(sentence: str, code: int) -> int:
    typer.echo(f"thesisrecon: {printable(' '.join(sentence.split()))}", err=True)
    return code


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

"""Options, thread limits, progress bars and exit codes shared by all commands.

NumPy is imported only inside the commands, after the number of its threads is set: single-threaded linear
algebra gives the same bytes for any number of workers.
"""

import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from signal import SIGINT
from typing import Annotated, Any

import typer

from thesisrecon.errors import WRITE_ERRNOS, OutputError, StageFailure, UsageError, shortened
from thesisrecon.io._files import printable, shorten_middle
from thesisrecon.runtime._executors import available_threads
from thesisrecon.runtime._progress import STAGE_LABELS, print_stages
from thesisrecon.runtime._signals import CODES, REASONS, with_resume_advice

DONE, INTERNAL, USAGE, IMPOSSIBLE = 0, 1, 2, 3
DEBUG_VARIABLE = "THESISRECON_DEBUG"


def parse_folder(text: str | Path) -> Path:
    """Parse a folder argument; an empty name would silently mean the current folder."""
    if not str(text).strip():
        raise typer.BadParameter("the folder has no name; write . for the current one")
    return Path(text)


def folder_option(words: str, *flags: str, metavar: str = "") -> Any:
    """An option that takes a folder; without a flag ``-o``."""
    metavar = metavar or ("DIR" if flags else "FOLDER")
    return typer.Option(*(flags or ("-o", "--out")), parser=parse_folder, metavar=metavar, help=words)


def folder_argument(metavar: str, words: str) -> Any:
    """An argument that is a folder or file."""
    return typer.Argument(parser=parse_folder, metavar=metavar, help=words)


Threads = Annotated[
    int, typer.Option("--threads", min=0, max=1024, help="Number of workers; 0 = one per processor.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Random seed.")]
_MAX_SIZE_HELP = "Long side (px) to which larger images are reduced (default: 1600)."
MaxSize = Annotated[int | None, typer.Option("--max-size", help=_MAX_SIZE_HELP)]
_OVERWRITE_HELP = "Replace existing files that thesisrecon did not write."
Overwrite = Annotated[bool, typer.Option("--overwrite", help=_OVERWRITE_HELP)]
OutputFolder = Annotated[Path, folder_option("Output folder.")]


def cap_threads(threads: int) -> None:
    """Limit every kind of thread (0 = one per processor); must run before NumPy and Pillow are imported."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ[name] = "1"
    os.environ["NUMBA_NUM_THREADS"] = str(threads or available_threads())
    # With large blocks Pillow returns the memory of an image when the image is freed.
    os.environ.setdefault("PILLOW_BLOCK_SIZE", "64m")


@contextmanager
def progress_bars() -> Iterator[Any]:
    """Show one progress bar per stage on a terminal, lines elsewhere; yields the ``progress`` callable."""
    if not sys.stderr.isatty():
        yield print_stages(lambda line: typer.echo(line, err=True, nl=False))
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeElapsedColumn as Elapsed
    from rich.progress import TimeRemainingColumn as Left

    label, left = TextColumn("{task.description:>22}"), TextColumn("left")
    columns = (label, BarColumn(), MofNCompleteColumn(), Elapsed(), Left(), left)
    tasks: dict[str, Any] = {}
    from thesisrecon._numba import ThreadPool

    with ThreadPool(1) as threads:
        alone = threads.alone
    with Progress(*columns, console=Console(stderr=True), auto_refresh=not alone) as bars:

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(STAGE_LABELS.get(stage, stage), total=total)
            bars.update(tasks[stage], completed=done, total=total, refresh=alone)

        yield update


class _Interrupted(Exception):
    """Ctrl-C in a command; the parser would print a message of its own for a ``KeyboardInterrupt``."""


@contextmanager
def interruptible(advice: str) -> Iterator[None]:
    """Print this advice on how to continue if the block is interrupted."""
    try:
        with with_resume_advice(advice):
            yield
    except KeyboardInterrupt as stop:
        raise _Interrupted(*stop.args) from None


def _called(command: Callable[[], object]) -> object:
    """The result of a command; under a limit of memory libraries cannot be loaded either."""
    try:
        return command()
    except (ImportError, OSError) as error:
        # llvmlite raises a second error without the reason.
        reasons = f"{error}, {error.__cause__ or error.__context__}"
        if "failed to map segment" in reasons or "annot allocate memory" in reasons:
            raise MemoryError from error
        raise


def exit_code_of(command: Callable[[], object]) -> int:
    """Run a command and turn errors into one sentence on stderr and an exit code."""
    try:
        code = _called(command)
        return code if isinstance(code, int) else DONE
    except UsageError as error:
        return _report(str(error), USAGE)
    except StageFailure as failure:
        return _report(str(failure), IMPOSSIBLE)
    except (_Interrupted, KeyboardInterrupt) as stop:
        # Only if called by another program: the command itself exits in `install_signal_handlers`.
        return _report("; ".join((REASONS[SIGINT], *map(str, stop.args))), CODES[SIGINT])
    except MemoryError:
        return _report("out of memory; reconstruct with a smaller --max-size or fewer --threads", IMPOSSIBLE)
    except OSError as error:
        if error.errno in WRITE_ERRNOS:
            # The kernel cache and redirected output can fill a disk too.
            return _report(str(OutputError(error.filename or "the output", error)), USAGE)
        if os.environ.get(DEBUG_VARIABLE):
            raise
        place = f"{shortened(str(error.filename))}: " if error.filename is not None else ""
        return _report(f"{place}{error.strerror or error}", USAGE)
    except Exception as error:
        # The parser's error classes differ between its versions; all have this method.
        if hasattr(error, "format_message"):
            message = shorten_middle(error.format_message().replace("Value error, ", ""))
            return _report(f"{message} (see thesisrecon --help)", USAGE)
        if os.environ.get(DEBUG_VARIABLE):
            raise
        # The last frame: in a user's own method, if that failed.
        *_, (frame, line) = traceback.walk_tb(error.__traceback__)
        place = f"{Path(frame.f_code.co_filename).name} line {line}"
        sentence = f"{type(error).__name__} in {place}: {error}; set {DEBUG_VARIABLE}=1 for a traceback"
        return _report(sentence, INTERNAL)


def _report(sentence: str, code: int) -> int:
    typer.echo(f"thesisrecon: {printable(' '.join(sentence.split()))}", err=True)
    return code

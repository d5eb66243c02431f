"""What the commands have in common: options, the libraries they start, bars of progress.

NumPy is imported only inside the commands, after the number of its threads is set: linear algebra on one
thread gives the same bytes however many workers there are, and the workers are the parallelism.

How a command ends: an exit code, and one sentence where it did not do what it was told.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from signal import SIGINT
from typing import Annotated, Any

import typer

from thesisrecon.errors import DISK, OutputError, StageFailure, UsageError
from thesisrecon.io.files import printable, shortened, without_middle
from thesisrecon.runtime.executors import available_threads
from thesisrecon.runtime.signals import CODES, REASONS, advised

MOST_THREADS = 1024
PICTURE_BLOCKS = "64m"
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

Threads = Annotated[
    int, typer.Option("--threads", min=0, max=MOST_THREADS, help="Workers; 0 = one per processor.")
]


def named_folder(text: str | Path) -> Path:
    """A folder as the user names it: an empty name would silently mean the current folder."""
    if not str(text).strip():
        raise typer.BadParameter("the folder has no name; write . for the current one")
    return Path(text)


def cap_threads(threads: int) -> None:
    """The one setting that caps every kind of thread; must run before NumPy and Pillow are imported."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ[name] = "1"
    os.environ["NUMBA_NUM_THREADS"] = str(threads or available_threads())
    # Pillow keeps pictures in blocks; of large ones nothing stays with the thread that read the picture.
    os.environ.setdefault("PILLOW_BLOCK_SIZE", PICTURE_BLOCKS)


@contextmanager
def progress_bars() -> Iterator[Any]:
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


DONE, INTERNAL, USAGE, IMPOSSIBLE = 0, 1, 2, 3
DEBUG_VARIABLE = "THESISRECON_DEBUG"
NO_CACHE = (
    "the compiled kernels can be kept neither beside the code nor in the user's cache folder; name a folder "
    "that can be written in the variable NUMBA_CACHE_DIR"
)
"""numba's own words for that name one of our functions and no remedy."""


class Interrupted(Exception):
    """Ctrl-C in a command."""


@contextmanager
def interruptible(advice: str) -> Iterator[None]:
    """What is advised where the block is interrupted; the parser has words of its own for a
    ``KeyboardInterrupt``."""
    try:
        with advised(advice):
            yield
    except KeyboardInterrupt as stop:
        raise Interrupted(*stop.args) from None


def exit_code_of(command: Callable[[], object]) -> int:
    """Carry out a command: its exit code; errors become one sentence on stderr."""
    try:
        code = command()
        return code if isinstance(code, int) else DONE
    except UsageError as error:
        return _say(str(error), USAGE)
    except StageFailure as failure:
        return _say(str(failure), IMPOSSIBLE)
    except (Interrupted, KeyboardInterrupt) as stop:
        # Where somebody else's program runs the command: ours is ended by `obey_signals`.
        return _say("; ".join((REASONS[SIGINT], *map(str, stop.args))), CODES[SIGINT])
    except MemoryError:
        return _say("out of memory; try a smaller --max-size or fewer --threads", IMPOSSIBLE)
    except OSError as error:
        if error.errno in DISK:
            # Kernels are kept on a disk too, and what is printed may go to a file.
            return _say(str(OutputError(error.filename or "what the command writes", error)), USAGE)
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

"""What the commands have in common: options, the libraries they start, bars of progress.

NumPy is imported only inside the commands, after the number of its threads is set: linear algebra on one
thread gives the same bytes however many workers there are, and the workers are the parallelism.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from thesisrecon.workers import available_threads

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

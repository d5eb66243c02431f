"""Report the progress of a study on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from validation.ablation.run import ProgressCallback, State


@contextmanager
def progress_view() -> Iterator[ProgressCallback]:
    """Show finished and failed rows and the estimated remaining time."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("rows", total=None, left="")

        def report(state: State) -> None:
            progress.update(task, total=state.total, completed=state.kept + state.done, left=words_of(state))

        yield report


def words_of(state: State) -> str:
    """Return the part of the state that the bar does not show."""
    parts = [f"{state.steps_done} of {state.steps} shared steps"] if state.steps_done < state.steps else []
    parts += [f"{state.failed} failed"] if state.failed else []
    if state.left_s is not None and state.kept + state.done < state.total:
        parts.append(f"about {duration(state.left_s)} left")
    return ", ".join(parts)


def duration(seconds: float) -> str:
    """Format seconds as hours, minutes or seconds."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"

"""Report the progress of a study on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from validation.ablation.run import ProgressCallback, State


@contextmanager
def progress_view() -> Iterator[ProgressCallback]:
    """Show finished and failed rows and the estimated remaining time."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=None)

        def report(state: State) -> None:
            steps = f"{state.steps_done} of {state.steps} shared steps" if state.steps else ""
            words = f"{steps}, {state.failed} failed" if state.failed else steps
            progress.update(task, total=state.total, completed=state.done, description=words)

        yield report

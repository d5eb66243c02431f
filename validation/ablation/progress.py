"""How far a study is, where somebody looks; silence where nobody does."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from validation.ablation.run import Heard, State


@contextmanager
def progress_view() -> Iterator[Heard]:
    """Rows done and failed, and an estimate of the time left."""
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

        def heard(state: State) -> None:
            progress.update(task, total=state.total, completed=state.kept + state.done, left=words_of(state))

        yield heard


def words_of(state: State) -> str:
    """What the bar does not say."""
    told = [f"{state.steps_done} of {state.steps} shared steps"] if state.steps_done < state.steps else []
    told += [f"{state.failed} failed"] if state.failed else []
    if state.left_s is not None and state.kept + state.done < state.total:
        told.append(f"about {duration(state.left_s)} left")
    return ", ".join(told)


def duration(seconds: float) -> str:
    """Hours, minutes and seconds as a person says them."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"

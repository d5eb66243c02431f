"""The scheduler of reports and ablations."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import TypeVar

Job = TypeVar("Job")
Answer = TypeVar("Answer")


def run_jobs(
    waiting: list[Job],
    submit: Callable[[Job], Future[Answer]],
    is_ready: Callable[[Job, Collection[Job]], bool],
    most: int,
) -> Iterator[list[tuple[Job, Future[Answer]]]]:
    """Submit jobs in order as soon as they are ready, at most ``most`` at a time; yield those that ended.

    ``is_ready`` gets a job and those under way. The caller may put jobs back into ``waiting`` between two
    answers. Some job must be ready whenever none is under way.
    """
    running: dict[Future[Answer], Job] = {}
    while waiting or running:
        for job in tuple(waiting):
            if len(running) < most and is_ready(job, running.values()):
                waiting.remove(job)
                running[submit(job)] = job
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        yield [(running.pop(future), future) for future in done]

"""Many small independent tasks on a few workers, the same answers whatever their number.

Threads serve by default: the compiled kernels release the interpreter. Processes serve where the tasks do
not.
"""

from __future__ import annotations

import concurrent.futures as futures
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from thesisrecon.errors import UsageError
from thesisrecon.settings import unknown_word

Executor = Literal["local", "processes"]


def available_threads() -> int:
    """How many processors this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


@dataclass(frozen=True)
class Workers:
    """``threads`` workers of one kind: threads of this process ("local") or processes of their own."""

    threads: int
    executor: str = "local"

    def __post_init__(self) -> None:
        if self.threads < 1:
            raise UsageError(f"threads must be at least 1; got {self.threads}")
        if self.executor.startswith("dask"):
            raise UsageError("the dask executor does not exist yet; use local or processes")
        if self.executor not in ("local", "processes"):
            raise UsageError(unknown_word("executor", self.executor, ["local", "processes"]))

    def run(
        self,
        function: Callable[..., Any],
        arguments: Sequence[tuple[Any, ...]],
        finished: Callable[[int, Any], None],
    ) -> None:
        """Call ``function(*arguments[n])`` for all n; ``finished(n, answer)`` hears of each as it ends, in
        this thread.

        The first error ends the rest and is raised. With processes the function must stand in a module.
        """
        if self.threads == 1 and self.executor == "local":
            for n, given in enumerate(arguments):
                finished(n, function(*given))
            return
        pool = self._pool(len(arguments))
        try:
            numbers = {pool.submit(function, *given): n for n, given in enumerate(arguments)}
            for future in futures.as_completed(numbers):
                finished(numbers[future], future.result())
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def map_all(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """``function`` of each item in order, always in threads: for reading files."""
        with futures.ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(function, items))

    def _pool(self, tasks: int) -> futures.Executor:
        if self.executor == "processes":
            # Forking a process that runs threads can deadlock.
            context = multiprocessing.get_context("spawn")
            return futures.ProcessPoolExecutor(
                max(1, min(self.threads, tasks)),
                mp_context=context,
                # Ctrl-C is for the process that hands out the tasks.
                initializer=signal.signal,
                initargs=(signal.SIGINT, signal.SIG_IGN),
            )
        return futures.ThreadPoolExecutor(self.threads)

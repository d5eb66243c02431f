"""Threads for independent tasks, also where the system starts no more of them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class ThreadPool(ThreadPoolExecutor):
    """A pool of threads. If none can be started (limit of a container or user), the calling thread works."""

    def __init__(self, threads: int) -> None:
        super().__init__(max(threads, 1))
        self.alone = False
        try:
            super().submit(int)
        except RuntimeError:
            self.alone = True

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Give a task to a thread, or process it."""
        if not self.alone:
            return super().submit(fn, *args, **kwargs)
        done = Future[T]()
        try:
            done.set_result(fn(*args, **kwargs))
        except Exception as error:
            done.set_exception(error)
        return done

    def _adjust_thread_count(self) -> None:
        try:
            super()._adjust_thread_count()
        except RuntimeError:
            # Those that could be started process all tasks.
            if not self._threads:
                raise

"""Who carries rows out: this process, processes beside it, a Dask cluster, any executor of the caller's."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from thesisrecon.errors import UsageError
from thesisrecon.runtime.dask_cluster import Cluster, connect_dask, is_dask_address
from thesisrecon.runtime.executors import NAMES, ProcessPool, available_threads
from thesisrecon.settings import unknown_word

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
MANY = 64
"""Rows that wait at an executor of the caller's, who does not say how many workers it has."""


@dataclass
class Crew:
    """An executor and how many rows it carries out at a time; ``renew`` makes another where its processes
    died, None where that is the caller's affair. ``by_thread``: several rows share a process."""

    executor: Executor
    width: int
    by_thread: bool
    renew: Callable[[], Executor] | None = None
    cluster: Cluster | None = None

    @property
    def most(self) -> int:
        """How many rows it is given at a time: one more for each worker, so that none waits for its next."""
        return 1 if isinstance(self.executor, _Here) else 2 * self.width


class _Here(Executor):
    """Carries a row out where and when it is submitted."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def crew_of(wish: str | Executor, threads: int | None) -> Iterator[Crew]:
    """The crew for an executor or its word: "local", "processes" or "dask://HOST:PORT".

    An executor that was given is left open. Raises :class:`UsageError` for another word, fewer than one
    thread, and a scheduler that does not answer.
    """
    if threads is not None and threads < 1:
        raise UsageError(f"threads must be at least 1; got {threads}")
    if isinstance(wish, Executor):
        workers: int = getattr(wish, "_max_workers", MANY)
        yield Crew(wish, threads or workers, not isinstance(wish, ProcessPoolExecutor))
        return
    count = threads or available_threads()
    if wish == "local":
        crew = Crew(ThreadPoolExecutor(count) if count > 1 else _Here(), count, count > 1)
    elif wish == "processes":
        crew = Crew(_processes(count), count, False, lambda: _processes(count))
    elif is_dask_address(wish):
        with connect_dask(wish) as cluster:
            yield Crew(cluster.executor, cluster.parallel(), True, cluster=cluster)
        return
    else:
        raise UsageError(unknown_word("executor", wish, NAMES))
    try:
        yield crew
    except BaseException:
        if isinstance(crew.executor, ProcessPool):
            crew.executor.abandon()
        raise
    finally:
        crew.executor.shutdown(wait=True, cancel_futures=True)


def _processes(count: int) -> ProcessPool:
    for name in ONE_THREAD:
        # As many processes as cores: each has one, and NumPy's own threads would fight for them.
        os.environ.setdefault(name, "1")
    return ProcessPool(count)

"""Executors of rows: this process, local processes, a Dask cluster or a given executor."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.runtime._dask_cluster import Cluster, connect_dask, is_dask_address
from thesisrecon.runtime.executors import NAMES, ProcessPool, available_threads

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
MANY = 64
"""Queued rows of a given executor with an unknown number of workers."""


@dataclass
class Crew:
    """An executor and its number of parallel rows; ``renew`` replaces a pool whose processes died, None for a
    given executor. ``by_thread``: rows share a process."""

    executor: Executor
    width: int
    by_thread: bool
    renew: Callable[[], Executor] | None = None
    cluster: Cluster | None = None

    @property
    def most(self) -> int:
        """Number of submitted rows: one extra for each worker, so that none waits."""
        return 1 if isinstance(self.executor, _Here) else 2 * self.width


class _Here(Executor):
    """Run each row at once in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def crew_of(executor: str | Executor, threads: int | None) -> Iterator[Crew]:
    """Yield the crew for an executor or its name: "local", "processes" or "dask://HOST:PORT".

    A given executor is left open. Raises :class:`UsageError` for an unknown name, fewer than one thread, and
    a scheduler that does not answer.
    """
    if threads is not None and threads < 1:
        raise UsageError(f"threads must be at least 1; got {threads}")
    if isinstance(executor, Executor):
        workers: int = getattr(executor, "_max_workers", MANY)
        yield Crew(executor, threads or workers, not isinstance(executor, ProcessPoolExecutor))
        return
    count = threads or available_threads()
    if executor == "local":
        crew = Crew(ThreadPoolExecutor(count) if count > 1 else _Here(), count, count > 1)
    elif executor == "processes":
        crew = Crew(_processes(count), count, False, lambda: _processes(count))
    elif is_dask_address(executor):
        with connect_dask(executor) as cluster:
            yield Crew(cluster.executor, cluster.parallel(), True, cluster=cluster)
        return
    else:
        raise UsageError(unknown_word("executor", executor, NAMES))
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
        # One process per core: NumPy's own threads would compete for them.
        os.environ.setdefault(name, "1")
    return ProcessPool(count)

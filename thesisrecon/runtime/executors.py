"""Which code this is.

Many independent tasks on a few workers, the same answers whatever their number and wherever they are.

Threads serve by default: the compiled kernels release the interpreter. Any other
:class:`concurrent.futures.Executor` serves too: a pool of processes, a Dask cluster, one of the caller's own.
What such an executor is given is bytes, and bytes come back, so neither shared memory nor a shared disk is
needed; a task that is given anew after its worker died finds all it needs in what it was given.
"""

from __future__ import annotations

import concurrent.futures as futures
import hashlib
import multiprocessing
import multiprocessing.connection
import multiprocessing.resource_tracker
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from thesisrecon.errors import UsageError, WorkersLost
from thesisrecon.runtime.dask_cluster import Cluster, address_of, connected, is_address
from thesisrecon.runtime.signals import CODES, starting_processes
from thesisrecon.settings import unknown_word


@cache
def package_key() -> str:
    """A short name for the code of the whole package: workers with another one would give other results."""
    package = Path(__file__).parent.parent
    content = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content.update(str(path.relative_to(package)).encode())
        content.update(path.read_bytes())
    return content.hexdigest()[:32]


NAMES = ("local", "processes", "dask://HOST:PORT")
AHEAD = 2
"""Tasks an executor is given at a time, per worker: none waits for work, and few are in memory."""
TOLD_S = 1.0
"""How long a worker process that is told to end waits for the end of its program."""
PATIENCE_S = 5.0
"""How long nothing may end before it is asked whether the workers are still there."""

P = ParamSpec("P")
T = TypeVar("T")
Task = tuple[Any, ...]
Finished = Callable[[int, Any], None]


def available_threads() -> int:
    """How many processors this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


@dataclass
class Workers:
    """Who does the tasks: ``threads`` workers of one kind.

    ``executor`` : threads of this process ("local"), "processes" of their own, a Dask cluster
    ("dask://HOST:PORT"), or any :class:`concurrent.futures.Executor`, which is not shut down. Of a cluster or
    an executor of the caller's, ``threads`` is how many of this process do what is not worth sending; the
    latter is given twice as many tasks at a time. As a context manager it holds its processes or connection
    from one :meth:`run` to the next; else each run has its own.

    Raises :class:`UsageError` for a number below 1, an unknown name or an address that is none.
    """

    threads: int
    executor: str | futures.Executor = "local"
    _remote: _Remote | None = field(default=None, repr=False)
    _kept: ExitStack | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.threads < 1:
            raise UsageError(f"threads must be at least 1; got {self.threads}")
        if isinstance(self.executor, futures.Executor):
            return
        if not isinstance(self.executor, str):
            raise UsageError(
                f"an executor is {', '.join(NAMES)} or a concurrent.futures.Executor; got {self.executor!r}"
            )
        if is_address(self.executor):
            address_of(self.executor)
        elif self.executor not in NAMES:
            raise UsageError(unknown_word("executor", self.executor, NAMES))

    @property
    def name(self) -> str:
        """The executor in a word, for the summary."""
        return self.executor if isinstance(self.executor, str) else type(self.executor).__name__

    @property
    def in_process(self) -> bool:
        """Whether tasks see the memory of this process: then nothing is copied for them."""
        return self.executor == "local" or isinstance(self.executor, futures.ThreadPoolExecutor)

    def __enter__(self) -> Workers:
        """Connect to the cluster; :class:`UsageError` where nobody answers. Processes start when needed."""
        self._kept = ExitStack()
        if isinstance(self.executor, str) and is_address(self.executor):
            self._remote = self._kept.enter_context(self._opened(1))
        return self

    def __exit__(self, *error: object) -> None:
        kept, self._kept, self._remote = self._kept, None, None
        if kept is not None:
            kept.__exit__(*error)  # type: ignore[arg-type]

    def parallel(self) -> int:
        """How many tasks are worked on at a time."""
        return self.threads if self._remote is None else self._remote.parallel()

    def run(self, function: Callable[..., Any], tasks: Iterable[Task], finished: Finished) -> None:
        """Call ``function(*task)`` for all tasks; ``finished(n, answer)`` hears of the n-th as it ends, in
        this thread.

        The first error ends the rest and is raised. Elsewhere than in this process the function must stand in
        a module that the workers can import, and tasks are asked for only as workers become free.
        :class:`WorkersLost` where the workers are gone.
        """
        if self.executor == "local" and self.threads == 1:
            for n, given in enumerate(tasks):
                finished(n, function(*given))
        elif self.executor == "local":
            with futures.ThreadPoolExecutor(self.threads) as pool:
                _hand_out(_Remote(pool, lambda: self.threads), (function, False), tasks, finished)
        else:
            with self._remote_for(tasks) as remote:
                _hand_out(remote, (function, not self.in_process), tasks, finished)

    def map_all(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """``function`` of each item in order, always in threads: for reading files and what is soon done."""
        with futures.ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(function, items))

    @contextmanager
    def _remote_for(self, tasks: Iterable[Task]) -> Iterator[_Remote]:
        if self._kept is None:
            with self._opened(len(tasks) if isinstance(tasks, Sequence) else self.threads) as remote:
                yield remote
            return
        if self._remote is None:
            self._remote = self._kept.enter_context(self._opened(self.threads))
        yield self._remote

    @contextmanager
    def _opened(self, tasks: int) -> Iterator[_Remote]:
        if isinstance(self.executor, futures.Executor):
            yield _Remote(self.executor, lambda: self.threads)
        elif is_address(self.executor):
            with connected(self.executor) as cluster:
                yield _Remote(cluster.executor, cluster.parallel, cluster)
        else:
            count = max(1, min(self.threads, tasks))
            with _processes(count) as pool:
                yield _Remote(pool, lambda: count)


@dataclass(frozen=True)
class _Remote:
    """An executor that is ready: ``parallel`` tells its workers, ``cluster`` is what stands behind it."""

    executor: futures.Executor
    parallel: Callable[[], int]
    cluster: Cluster | None = None


def _hand_out(
    remote: _Remote, wanted: tuple[Callable[..., Any], bool], tasks: Iterable[Task], finished: Finished
) -> None:
    """Keep the executor in work until all tasks are done; ``wanted`` is the function, and whether tasks
    travel as bytes."""
    function, travels = wanted
    waiting: dict[futures.Future[Any], int] = {}
    left = enumerate(tasks)
    try:
        while True:
            # Where workers have died, more may be waiting than are now wanted.
            for n, given in islice(left, max(AHEAD * remote.parallel() - len(waiting), 0)):
                what = (
                    (_answer, package_key(), pickle.dumps((function, given), 5))
                    if travels
                    else (function, *given)
                )
                waiting[remote.executor.submit(*what)] = n
            if not waiting:
                return
            done, _ = futures.wait(waiting, PATIENCE_S, return_when=futures.FIRST_COMPLETED)
            if not done and remote.cluster is not None:
                remote.cluster.check()
            for future in sorted(done, key=waiting.__getitem__):
                answer = future.result()
                finished(waiting.pop(future), pickle.loads(answer) if travels else answer)
    except (futures.BrokenExecutor, futures.CancelledError) as error:
        raise _lost(remote, error) from None
    finally:
        for future in waiting:
            future.cancel()


def _lost(remote: _Remote, error: BaseException) -> WorkersLost:
    if remote.cluster is not None:
        return remote.cluster.lost()
    if isinstance(error, futures.BrokenExecutor):
        return WorkersLost("a worker process ended unexpectedly (killed, or out of memory)")
    return WorkersLost(f"the executor ({type(remote.executor).__name__}) cancelled what it was given")


def _answer(key: str, task: bytes) -> bytes:
    """Do a task somewhere else; both sides must run the same code, or what is kept would have a wrong key."""
    if package_key() != key:
        raise UsageError(
            f"a worker ({multiprocessing.current_process().name} on {os.uname().nodename}) runs another "
            "version of thesisrecon than this program; install the same one there"
        )
    try:
        function, given = pickle.loads(task)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"a worker cannot load its task: {error}; install the module there too") from None
    return pickle.dumps(function(*given), 5)


class ProcessPool(futures.ProcessPoolExecutor):
    """``count`` processes that Ctrl-C does not reach, and that end with this process, however that ends."""

    def __init__(self, count: int) -> None:
        # Forking a process that runs threads can deadlock.
        context = multiprocessing.get_context("spawn")
        # Else the first process starts it, and lets signals through again with that.
        multiprocessing.resource_tracker.ensure_running()
        watched, self._held = context.Pipe(duplex=False)
        super().__init__(count, mp_context=context, initializer=_obey, initargs=(watched,))

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> futures.Future[T]:
        """As of any executor."""
        with starting_processes():
            return super().submit(fn, *args, **kwargs)

    def abandon(self) -> None:
        """End the processes at once, whatever they are at."""
        self._held.close()
        self.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _processes(count: int) -> Iterator[futures.Executor]:
    """Processes that end with the block, at once where it ends by an error."""
    pool = ProcessPool(count)
    try:
        yield pool
        pool.shutdown(wait=True)
    finally:
        pool.abandon()


def _obey(watched: multiprocessing.connection.Connection) -> None:
    """Of a worker process: signals are for the process that hands out the tasks, and when that closes its end
    of the pipe, or dies, there is nobody to work for."""

    def end_with_program() -> None:
        multiprocessing.connection.wait([watched])
        os._exit(1)

    def end_when_told() -> None:
        signal.sigwait({signal.SIGTERM})
        # Where the whole program is told, it is the first to go, and takes this process along.
        time.sleep(TOLD_S)
        os._exit(CODES[signal.SIGTERM])

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for end in (end_with_program, end_when_told):
        threading.Thread(target=end, daemon=True).start()

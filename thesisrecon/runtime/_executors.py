"""Independent tasks on threads, processes or a cluster, with results independent of the workers.

Threads are the default, since compiled kernels release the GIL. Other :class:`concurrent.futures.Executor`
objects receive and return pickled bytes, so no shared memory or disk is needed and tasks can be repeated.
"""

import concurrent.futures as futures
import hashlib
import logging
import multiprocessing
import multiprocessing.connection
import multiprocessing.resource_tracker
import os
import pickle
import platform
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

from thesisrecon import __version__
from thesisrecon.errors import Notice, UsageError, WorkersLost, unknown_word
from thesisrecon.runtime._signals import CODES, starting_processes

P = ParamSpec("P")
T = TypeVar("T")
Task = tuple[Any, ...]
Finished = Callable[[int, Any], None]

NAMES = ("local", "processes", "dask://HOST:PORT", "tls://HOST:PORT")
AHEAD = 2  # Tasks submitted per worker: enough to keep it busy, but few in memory
CHECK_S = 5.0  # Time without results after which the workers are checked
ANSWER_S = 10.0  # Timeout of the scheduler, and of the first worker unless the address has ?wait=SECONDS
WORKERLESS_S = 60.0  # The same for a cluster that loses all workers, so that they can be restarted
_log = logging.getLogger(__name__)


def is_dask_address(executor: object) -> bool:
    return isinstance(executor, str) and executor.partition(":")[0].lower() in ("dask", "tls")


def _dask_place(executor: str) -> tuple[str, str, float]:
    """Protocol, HOST:PORT and seconds of ``dask://HOST:PORT?wait=SECONDS``; 0: not given."""
    host = r"(?:[^\s:/@?#\[\]]+|\[[0-9A-Fa-f:.]+\])"
    found = re.fullmatch(rf"(dask|tls)://({host}:(\d{{1,5}}))(?:\?wait=(\d{{1,7}}))?", executor)
    if found is None or not 0 < int(found[3]) < 65536:
        raise UsageError(Notice("no-scheduler-address", executor))
    return found[1].replace("dask", "tcp"), found[2], float(found[4] or 0)


@dataclass
class Cluster:
    """A connection to a scheduler (HOST:PORT), and its executor."""

    address: str
    client: Any
    executor: futures.Executor
    wait_s: float  #: time it may be without workers
    _alone_since: float = 0.0
    _seen: set[str] = field(default_factory=set)

    def parallel(self) -> int:
        """Number of worker threads, at least 1: a worker may come back."""
        return max(1, sum(self._threads().values()))

    def check(self) -> None:
        """Raise ``WorkersLost`` if the scheduler is gone or has had no worker for ``wait_s``."""
        now = time.monotonic()
        self._alone_since = 0.0 if self._threads() else self._alone_since or now
        if self._alone_since and now - self._alone_since > self.wait_s:
            raise WorkersLost(Notice("cluster-alone", self.address, self.wait_s))

    @staticmethod
    def require_alive(future: futures.Future[Any], task: int) -> None:
        """Raise ``WorkersLost`` if every worker that got a task died."""
        from distributed import KilledWorker

        if not isinstance(error := future.exception(), KilledWorker):
            return
        limit = getattr(error.last_worker, "memory_limit", 0)
        memory = f"their {limit / 2**30:.2g} GiB" if limit else "they have"
        lost = WorkersLost(Notice("workers-died", error.allowed_failures + 1, memory))
        lost.task = task
        raise lost from None

    def lost(self) -> WorkersLost:
        """The error for tasks that were cancelled."""
        return WorkersLost(f"the Dask scheduler at {self.address} is gone")

    def _threads(self) -> dict[str, int]:
        try:
            found: dict[str, int] = self.client.nthreads()
        except Exception:
            # A broken connection raises many types.
            raise self.lost() from None
        if gone := len(self._seen - found.keys()):
            then = "others do their tasks" if found else f"waiting {self.wait_s:.0f} s for others"
            _log.warning("%d of %d Dask workers were lost: %s", gone, len(self._seen), then)
        self._seen = set(found)
        return found


class _Remote(NamedTuple):
    """A running executor, its number of workers and its cluster, if any."""

    executor: futures.Executor
    parallel: Callable[[], int]
    cluster: Cluster | None = None


@contextmanager
def connect_dask(executor: str) -> Iterator[Cluster]:
    """Connect to a Dask scheduler for the duration of a block."""
    protocol, place, wait_s = _dask_place(executor)
    first_s = wait_s or ANSWER_S
    try:
        import dask
        from distributed import Client, Security
    except ImportError:
        raise UsageError(Notice("no-distributed", executor)) from None
    # Errors are reported by this module; large tasks are intended.
    settings = {"distributed.admin.large-graph-warning-threshold": "1TiB"}
    with _quiet("distributed"), dask.config.set(settings):
        if protocol == "tls":
            # Checked before: a client that fails on them can block the start of the next client.
            try:
                missing = Security().get_connection_args("client")["ssl_context"] is None
                fault: object = "no key or certificate of the client is set" if missing else None
            except OSError as error:
                fault = error
            if fault is not None:
                raise UsageError(Notice("no-certificates", executor, fault))
        try:
            client = Client(f"{protocol}://{place}", timeout=ANSWER_S, set_as_default=False)
        except (OSError, futures.TimeoutError):
            raise UsageError(Notice("no-scheduler", place, ANSWER_S)) from None
        try:
            if not client.nthreads():
                _log.warning("the Dask scheduler at %s has no workers yet: waiting %.0f s", place, first_s)
            try:
                client.wait_for_workers(1, timeout=first_s)
            except (OSError, futures.TimeoutError):
                raise UsageError(Notice("no-dask-workers", place, first_s, protocol)) from None
            # By default results pass through the scheduler. Arguments must: scattered ones would be lost with
            # their worker.
            client.direct_to_workers = _reachable(client.nthreads())
            # pure=False: do not hash all bytes of the tasks.
            yield Cluster(place, client, client.get_executor(pure=False), wait_s or WORKERLESS_S)
        finally:
            with suppress(Exception):
                client.close(timeout=1.0)


def _reachable(workers: Iterable[str]) -> bool:
    """Whether this machine can connect to the workers, which a firewall or Kubernetes may prevent."""
    for worker in workers:
        host, _, port = worker.rpartition("://")[2].rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=2.0).close()
        except (OSError, ValueError):
            return False
    return True


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Silence a logger and its children."""
    names = [name, *(n for n in logging.root.manager.loggerDict if n.startswith(f"{name}."))]
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


@cache
def package_key() -> str:
    """Return a digest of the code of the package, to detect workers with another version."""
    package = Path(__file__).parent.parent
    content = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content.update(str(path.relative_to(package)).encode())
        content.update(path.read_bytes())
    return content.hexdigest()[:32]


@cache
def library_versions() -> dict[str, str]:
    """Return the versions that results depend on: others give other last digits."""
    import numba
    import numpy
    import scipy

    libraries: tuple[Any, ...] = (numba, numpy, scipy)
    builds = [lib.show_config(mode="dicts").get("Build Dependencies", {}) for lib in libraries[1:]]
    blas = [build.get("blas", {}) for build in builds]
    return {
        "python": ".".join(platform.python_version_tuple()[:2]),  # its sums of floats changed in 3.12
        **{lib.__name__: str(lib.__version__) for lib in libraries},
        "blas": ", ".join(f"{found.get('name')} {found.get('version')}" for found in blas),
    }


def _environment() -> dict[str, str]:
    return {"thesisrecon": f"{__version__} ({package_key()[:12]})", **library_versions()}


def available_threads() -> int:
    """Return the number of processors this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


@dataclass
class Workers:
    """Workers for independent tasks; as a context manager it keeps them between calls of :meth:`run`."""

    threads: int
    executor: str | futures.Executor = "local"  #: one of ``NAMES``, or an executor, which is not shut down
    _remote: _Remote | None = field(default=None, repr=False)
    _open_stack: ExitStack | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.threads < 1:
            raise UsageError(f"threads must be at least 1; got {self.threads}")
        if not isinstance(self.executor, str | futures.Executor):
            raise UsageError(Notice("no-executor", ", ".join(NAMES), self.executor))
        if is_dask_address(self.executor):
            _dask_place(str(self.executor))
        elif isinstance(self.executor, str) and self.executor not in NAMES:
            raise UsageError(unknown_word("executor", self.executor, NAMES))

    @property
    def name(self) -> str:
        """Name of the executor, for the summary."""
        return self.executor if isinstance(self.executor, str) else type(self.executor).__name__

    @property
    def in_process(self) -> bool:
        """Whether tasks share the memory of this process, so that nothing is copied."""
        return self.executor == "local" or isinstance(self.executor, futures.ThreadPoolExecutor)

    @property
    def pool(self) -> futures.Executor | None:
        """The pool of threads that processes the tasks, for parts of a task; None without one."""
        return self._remote.executor if self.in_process and self._remote is not None else None

    def __enter__(self) -> "Workers":
        """Connect to the cluster; processes start when needed."""
        self._open_stack = ExitStack()
        if is_dask_address(self.executor):
            self._remote = self._open_stack.enter_context(self._opened())
        return self

    def __exit__(self, *error: object) -> None:
        stack, self._open_stack, self._remote = self._open_stack, None, None
        if stack is not None:
            stack.__exit__(*error)  # type: ignore[arg-type]

    def parallel(self) -> int:
        """Return the number of tasks processed at a time, at least 1."""
        return self.threads if self._remote is None else self._remote.parallel()

    def run(self, function: Callable[..., Any], tasks: Iterable[Task], finished: Finished) -> None:
        """Call a function for all tasks; ``finished`` gets (number, result) in this thread."""
        if self.executor == "local" and self.threads == 1:
            for n, given in enumerate(tasks):
                finished(n, function(*given))
        elif self._open_stack is None:
            with self:
                self.run(function, tasks, finished)
        else:
            if self._remote is None:
                self._remote = self._open_stack.enter_context(self._opened())
            _run_all(self._remote, function, not self.in_process, tasks, finished)

    def map_all(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Map a function over items in threads, for short tasks such as reading files."""
        # Imported here: `thesisrecon --help` needs no compiler.
        from thesisrecon._numba import ThreadPool

        with ThreadPool(self.threads) as pool:
            return list(pool.map(function, items))

    @contextmanager
    def _opened(self) -> Iterator[_Remote]:
        if isinstance(self.executor, futures.Executor):
            yield _Remote(self.executor, lambda: self.threads)
        elif is_dask_address(self.executor):
            with connect_dask(self.executor) as cluster:
                yield _Remote(cluster.executor, cluster.parallel, cluster)
        elif self.executor == "local" or (pool := _processes(self.threads)) is None:
            from thesisrecon._numba import ThreadPool

            with ThreadPool(self.threads) as threads:
                yield _Remote(threads, lambda: self.threads)
        else:
            try:
                yield _Remote(pool, lambda: self.threads)
                pool.shutdown(wait=True)
            finally:
                # After an error the processes end at once.
                pool.abandon()


def _processes(count: int) -> "ProcessPool | None":
    """Start worker processes; None, with a warning, if the system starts none."""
    with ExitStack() as opened:
        try:
            pool = ProcessPool(count)
            opened.callback(pool.abandon)
            for started in [pool.submit(int) for _ in range(count)]:
                started.result(timeout=60.0)
        except (OSError, RuntimeError) as error:
            _log.warning("no worker processes can be started (%s): this process does their work", error)
            return None
        opened.pop_all()
        return pool


def _run_all(
    remote: _Remote, function: Callable[..., Any], pickled: bool, tasks: Iterable[Task], finished: Finished
) -> None:
    """Keep the executor busy until all tasks are done."""
    waiting: dict[futures.Future[Any], int] = {}
    left = enumerate(tasks)
    try:
        while True:
            # After the loss of workers more tasks may be waiting than AHEAD allows.
            for n, given in islice(left, max(AHEAD * remote.parallel() - len(waiting), 0)):
                call: Task = (function, *given)
                if pickled:
                    call = (_answer, _environment(), _pickled((function, given)))
                waiting[remote.executor.submit(*call)] = n
            if not waiting:
                return
            done, _ = futures.wait(waiting, CHECK_S, return_when=futures.FIRST_COMPLETED)
            if not done and remote.cluster is not None:
                remote.cluster.check()
            for future in sorted(done, key=waiting.__getitem__):
                if remote.cluster is not None:
                    remote.cluster.require_alive(future, waiting[future])
                answer = future.result()
                finished(waiting.pop(future), pickle.loads(answer) if pickled else answer)
    except (futures.BrokenExecutor, futures.CancelledError) as error:
        if remote.cluster is not None:
            raise remote.cluster.lost() from None
        if isinstance(error, futures.BrokenExecutor):
            raise WorkersLost("a worker process ended unexpectedly (killed, or out of memory)") from None
        raise WorkersLost(f"the executor ({type(remote.executor).__name__}) cancelled its tasks") from None
    finally:
        for future in waiting:
            future.cancel()


def _pickled(task: Any) -> bytes:
    try:
        return pickle.dumps(task, 5)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        # A lambda, an inner function, or an object that belongs to this process.
        raise UsageError(Notice("unpicklable-method", error)) from None


def _answer(caller: Mapping[str, str], task: bytes) -> bytes:
    """Run a pickled task in a worker; other versions would give results with a wrong cache key."""
    own = _environment()
    if others := [name for name in own if own[name] != caller.get(name)]:
        worker = f"{multiprocessing.current_process().name} on {platform.node()}"
        both = [", ".join(f"{name} {side.get(name)}" for name in others) for side in (own, caller)]
        raise UsageError(Notice("other-version", worker, *both))
    try:
        function, given = pickle.loads(task)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"a worker cannot load its task: {error}; install the module there too") from None
    # Imported here: `thesisrecon --help` needs no NumPy.
    from thesisrecon.runtime._blas import one_blas_thread

    with one_blas_thread():
        return pickle.dumps(function(*given), 5)


class ProcessPool(futures.ProcessPoolExecutor):
    """Processes that ignore Ctrl-C and end with this process."""

    def __init__(self, count: int) -> None:
        # Forking a process that runs threads can deadlock.
        context = multiprocessing.get_context("spawn")
        # Otherwise the first worker starts it and unblocks the signals.
        if os.name != "nt":
            multiprocessing.resource_tracker.ensure_running()
        watched, self._held = context.Pipe(duplex=False)
        super().__init__(count, mp_context=context, initializer=_end_with_parent, initargs=(watched,))

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> futures.Future[T]:
        """Submit a call with signals blocked while processes start."""
        with starting_processes():
            return super().submit(fn, *args, **kwargs)

    def abandon(self) -> None:
        """Kill the processes at once."""
        self._held.close()
        # The thread that a pool waits for may not have been started.
        with suppress(RuntimeError):
            self.shutdown(wait=True, cancel_futures=True)


def _end_with_parent(watched: multiprocessing.connection.Connection) -> None:
    """In a worker process: ignore Ctrl-C, and end when the parent closes the pipe or dies."""

    def end_with_program() -> None:
        multiprocessing.connection.wait([watched])
        os._exit(1)

    def end_on_sigterm() -> None:
        signal.sigwait({signal.SIGTERM})
        # If the whole program is terminated, the parent ends first and kills this process.
        time.sleep(1.0)
        os._exit(CODES[signal.SIGTERM])

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for end in (end_with_program, end_on_sigterm)[: 2 if hasattr(signal, "sigwait") else 1]:
        threading.Thread(target=end, daemon=True).start()

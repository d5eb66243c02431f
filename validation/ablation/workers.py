"""Compute rows in this process or in other processes."""

from __future__ import annotations

import os
import pickle
import shutil
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thesisrecon.errors import WRITE_ERRNOS, OutputError, StageFailure, UsageError, unknown_word
from thesisrecon.runtime._executors import ProcessPool, available_threads
from validation.ablation.changes import Setting
from validation.ablation.own import Source, sources_of
from validation.ablation.store import SHARED, WORK, Outcome
from validation.ablation.study import Place

EXECUTORS = ("local", "processes")
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Job:
    """Input of a worker: ``setting`` as bytes, since user classes are known only after their source
    is installed. ``step`` is the shared step to be prepared, empty for the row itself."""

    key: str
    setting: bytes
    sources: tuple[Source, ...]
    scene: str
    seed: int
    out: Path
    step: str = ""


def pack(setting: Setting) -> tuple[bytes, tuple[Source, ...]]:
    """Serialise a setting; :class:`UsageError` if impossible."""
    try:
        content: bytes = _pickler().dumps(setting)
    except Exception as error:
        raise UsageError(f"this variant cannot be sent to a worker: {error}") from None
    return content, sources_of(_modules(setting))


def _pickler() -> Any:
    """Prefer cloudpickle (installed with Dask), which also sends classes of a script."""
    try:
        import cloudpickle
    except ImportError:
        return pickle
    return cloudpickle


def _modules(value: Any) -> set[str]:
    """The modules of every object of a setting."""
    found, waiting = set(), [value]
    while waiting:
        item = waiting.pop()
        found.add(getattr(item, "__module__", type(item).__module__))
        if hasattr(item, "__dataclass_fields__"):
            waiting += [getattr(item, name) for name in item.__dataclass_fields__]
        elif isinstance(item, tuple):
            waiting += item
    return found


def carry_out(job: Job) -> Outcome:
    """Compute the row or the requested step. Errors are recorded, not raised, except for a full disk
    (:class:`OutputError`), because the row itself has not failed."""
    for source in job.sources:
        source.install()
    setting: Setting = pickle.loads(job.setting)
    own = job.out / WORK / job.key
    shutil.rmtree(own, ignore_errors=True)
    place = Place(own, job.out / SHARED)
    start, cpu = time.perf_counter(), time.process_time()
    metrics: Mapping[str, float] = {}
    failure = ""
    try:
        own.mkdir(parents=True, exist_ok=True)
        if job.step:
            setting.task.prepare(setting.config, job.scene, job.seed, place, step=job.step)
        else:
            metrics = _plain(setting.task.run(setting.config, job.scene, job.seed, place))
    except OutputError:
        raise
    except (StageFailure, UsageError) as error:
        failure = str(error)
    except Exception as error:
        if isinstance(error, OSError) and error.errno in WRITE_ERRNOS:
            raise OutputError(error.filename or own, error) from None
        failure = f"{type(error).__name__}: {error}{_where(error)}"
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - cpu
    shutil.rmtree(own, ignore_errors=True)
    return Outcome(metrics, failure, seconds, cpu_s)


def _plain(metrics: Any) -> dict[str, float]:
    if not isinstance(metrics, Mapping):
        raise TypeError(f"a task returns a table of numbers; got {type(metrics).__name__}")
    return {str(name): float(value) for name, value in metrics.items()}


def _where(error: BaseException) -> str:
    """Return file and line of an error, for the author of the variant."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return ""
    return f" ({Path(trace.tb_frame.f_code.co_filename).name}, line {trace.tb_lineno})"


@dataclass
class Workers:
    """Processes (``count``), or this process if 0; they get ``most`` jobs, a spare one each."""

    count: int
    pool: ProcessPool | None = None
    _pool_of: dict[Future[Outcome], ProcessPool] = field(default_factory=dict)

    @property
    def most(self) -> int:
        return max(1, 2 * self.count)

    def submit(self, job: Job) -> Future[Outcome]:
        """Carry out a job; that of a pool that broke has :class:`BrokenProcessPool` as its result."""
        future: Future[Outcome] = Future()
        try:
            if self.count:
                self.pool = self.pool or ProcessPool(self.count)
                future = self.pool.submit(carry_out, job)
                self._pool_of[future] = self.pool
            else:
                future.set_result(carry_out(job))
        except (BrokenProcessPool, OutputError) as error:
            future.set_exception(error)
        return future

    def renew(self, broken: Future[Outcome]) -> None:
        """Start new processes for those that a job was lost with, unless that was done for another job."""
        if self._pool_of.get(broken, self.pool) is self.pool:
            self.pool = None


@contextmanager
def workers_of(executor: str, threads: int | None) -> Iterator[Workers]:
    """Yield the workers of "local" or "processes"; :class:`UsageError` for another name or no thread."""
    if threads is not None and threads < 1:
        raise UsageError(f"threads must be at least 1; got {threads}")
    if executor not in EXECUTORS:
        raise UsageError(unknown_word("executor", executor, EXECUTORS))
    workers = Workers(0 if executor == "local" else threads or available_threads())
    if workers.count:
        for name in ONE_THREAD:
            # One process per core: NumPy's own threads would compete for them.
            os.environ.setdefault(name, "1")
    try:
        yield workers
    except BaseException:
        if workers.pool is not None:
            workers.pool.abandon()
        raise
    finally:
        if workers.pool is not None:
            workers.pool.shutdown(wait=True, cancel_futures=True)

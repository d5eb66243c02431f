"""Compute rows in this process or in other processes."""

from __future__ import annotations

import math
import os
import pickle
import shutil
import time
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thesisrecon.errors import WRITE_ERRNOS, OutputError, StageFailure, UsageError, unknown_word
from thesisrecon.io._files import read_json, write_json
from thesisrecon.runtime._executors import ProcessPool, available_threads
from validation.ablation.changes import Setting, Source, sources_of
from validation.ablation.study import Place

ROWS, STEPS, SHARED, WORK = "rows", "steps", "shared", "work"


@dataclass(frozen=True)
class Outcome:
    """Result of a row.

    ``metrics`` are its numbers; ``failure`` is the error message or empty. ``seconds`` is its wall time,
    ``cpu_s`` its processor time; ``steps`` are the keys of reused shared steps. ``lost``: the process ended
    before the row.
    """

    metrics: Mapping[str, float] = field(default_factory=dict)
    failure: str = ""
    seconds: float = 0.0
    cpu_s: float = 0.0
    steps: tuple[str, ...] = ()
    lost: bool = False


@dataclass(frozen=True)
class Store:
    """The folder of a study."""

    path: Path

    def prepare(self) -> None:
        """Create the folder; :class:`OutputError` if it cannot be written."""
        try:
            for name in (ROWS, STEPS, SHARED, WORK):
                (self.path / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the output folder {self.path}", error) from None

    def load(self, key: str, kind: str = ROWS) -> Outcome | None:
        """Return the outcome of this key, or None if absent or damaged."""
        record = read_json(self.path / kind / f"{key}.json")
        try:
            numbers = {str(name): float(value) for name, value in record["metrics"].items()}
            return Outcome(
                numbers,
                str(record["failure"]),
                float(record["seconds"]),
                float(record["cpu_s"]),
                tuple(record["steps"]),
            )
        except (TypeError, KeyError, ValueError, AttributeError):
            return None

    def save(self, key: str, outcome: Outcome, record: Mapping[str, Any], kind: str = ROWS) -> None:
        """Store an outcome with the ``record`` of its row."""
        found = {
            # JSON has no NaN and no infinity; store them as words.
            "metrics": {k: v if math.isfinite(v) else str(v) for k, v in outcome.metrics.items()},
            "failure": outcome.failure,
            "seconds": outcome.seconds,
            "cpu_s": outcome.cpu_s,
            "steps": list(outcome.steps),
        }
        write_json(self.path / kind / f"{key}.json", {**record, **found}, cached=True)


def finite(metrics: Mapping[str, float], wanted: Collection[str]) -> tuple[dict[str, float], str]:
    """Return the finite numbers of ``metrics`` and a message about missing ``wanted`` ones."""
    good = {name: float(v) for name, v in metrics.items() if math.isfinite(float(v))}
    missing = [name for name in wanted if name not in metrics]
    broken = [f"{name} is {float(metrics[name])}" for name in wanted if name in metrics and name not in good]
    absent = [f"the task returned no {', no '.join(missing)}"] if missing else []
    return good, "; ".join([*broken, *absent])


EXECUTORS = ("local", "processes")
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Job:
    """Input of a worker: ``setting`` as bytes; ``step`` is the shared step, empty for the row itself."""

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
    """Compute the row or the step. Errors are recorded; a full disk raises :class:`OutputError`."""
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

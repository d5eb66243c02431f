"""Compute one row in a worker, of any kind."""

from __future__ import annotations

import pickle
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thesisrecon.errors import WRITE_ERRNOS, OutputError, StageFailure, UsageError
from validation.ablation.changes import Setting
from validation.ablation.own import Source, sources_of
from validation.ablation.store import SHARED, WORK, Outcome
from validation.ablation.study import Place


@dataclass(frozen=True)
class Job:
    """Input of a worker: ``setting`` as bytes, since user classes are known only after their source
    is installed. ``step`` is the shared step to be prepared, empty for the row itself. ``by_thread`` says
    that the worker shares its process with others."""

    key: str
    setting: bytes
    sources: tuple[Source, ...]
    scene: str
    seed: int
    out: Path
    step: str = ""
    by_thread: bool = False


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
    clock = time.thread_time if job.by_thread else time.process_time
    start, cpu = time.perf_counter(), clock()
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
    seconds, cpu_s = time.perf_counter() - start, clock() - cpu
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

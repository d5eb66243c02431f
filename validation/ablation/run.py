"""Compute rows as workers become free and store them; shared first steps run once."""

from __future__ import annotations

import math
import os
import pickle
import shutil
import signal
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from thesisrecon.config.text import table_from_dataclass, tables_from_config
from thesisrecon.errors import WRITE_ERRNOS, OutputError, StageFailure, UsageError, unknown_word
from thesisrecon.io._files import read_json, write_json
from thesisrecon.io._outputs import clear_folder, join_claim
from thesisrecon.runtime._executors import (
    Cluster,
    ProcessPool,
    available_threads,
    connect_dask,
    is_dask_address,
)
from validation.ablation.changes import Setting
from validation.ablation.own_files import Source, digest_of, loaded_sources, read_files, watched
from validation.ablation.plan import Plan, PlannedRow, plan_study
from validation.ablation.study import FunctionTask, Place, Study
from validation.runs.processes import run_jobs

LOST = "the worker process of this row was killed or ran out of memory"
ROWS, STEPS, SHARED, WORK = "rows", "steps", "shared", "work"
PLACE = ("variant", "condition", "scene", "seed")
EXECUTORS = ("local", "processes", "dask://HOST:PORT")
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Row:
    """A finished row; ``cost_s`` is its processor time (s) including shared steps."""

    key: str
    variant: str
    condition: str
    scene: str
    seed: int
    metrics: Mapping[str, float]
    failure: str
    seconds: float
    cost_s: float


@dataclass(frozen=True)
class Rows(Sequence[Row]):
    """The rows of a study that have ended, in the order of its plan."""

    plan: Plan
    rows: tuple[Row, ...]

    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]

    def __len__(self) -> int:
        return len(self.rows)


def ablate(
    study: Study,
    out: str | Path,
    *,
    executor: str = "local",
    threads: int | None = None,
    limit_s: float | None = None,
    on_progress: Callable[[str], None] = lambda _: None,
) -> Rows:
    """Compute the rows of a study that are not in ``out`` yet, and return all of them.

    ``out`` may be used again, after a kill or for a study that has grown: rows that are there under the same
    setting, scene, seed and versions are not computed again. ``executor`` is "local" (this process),
    "processes", for which a script needs ``if __name__ == "__main__":``, or "dask://HOST:PORT", whose workers
    see ``out`` under the same path; ``threads`` is the number of processes. A row that takes more than
    ``limit_s`` seconds fails, not on Dask. ``on_progress`` gets a sentence when a row or a shared step has
    ended. Errors of a row are stored in it.
    """
    plan, store = plan_study(study), Store(Path(out).resolve())
    with join_claim(store.path):
        clear_folder(store.path / WORK)
        store.prepare()
        todo = {row.key: row for row in plan.rows if store.load(row.key) is None}
        with _workers(executor, threads) as workers:
            lost = _compute(plan, store, workers, list(todo.values()), on_progress, limit_s)
        shutil.rmtree(store.path / WORK, ignore_errors=True)
    return _rows(plan, store, lost)


def read_rows(study: Study, out: str | Path) -> Rows:
    """Return the rows of a study that are in ``out``, without computing."""
    return _rows(plan_study(study), Store(Path(out)), {})


def read_earlier_rows(study: Study, out: str | Path) -> Rows:
    """Return the rows of a study in ``out`` by variant, condition, scene and seed, whatever the code and the
    settings that they were computed with; the newest of several.
    """
    plan, store, keys = plan_study(study), Store(Path(out), earlier=True), dict[tuple[Any, ...], str]()
    for path in sorted((store.path / ROWS).glob("*.json"), key=lambda p: (p.stat().st_mtime_ns, p.name)):
        record = read_json(path)
        if isinstance(record, dict):
            keys[tuple(record.get(name) for name in PLACE)] = path.stem
    found = [p._replace(key=keys.get(tuple(getattr(p, name) for name in PLACE), "")) for p in plan.rows]
    if not any(p.key for p in found):
        raise UsageError(f"{out} has no rows of this study")
    return _rows(plan._replace(rows=tuple(p for p in found if p.key)), store, {})


def _rows(plan: Plan, store: Store, lost: Mapping[str, Outcome]) -> Rows:
    rows = []
    for p in plan.rows:
        outcome = store.load(p.key) or lost.get(p.key)
        if outcome is None:
            continue
        shared = [s for s in (store.load(key, STEPS) for key in outcome.steps) if s is not None]
        cost = outcome.cpu_s + sum(s.cpu_s for s in shared)
        metrics, failure = dict(outcome.metrics), outcome.failure
        if not failure:
            metrics, failure = _finite(metrics, plan.wanted(p))
        place = (p.key, p.variant, p.condition, p.scene, p.seed)
        rows.append(Row(*place, metrics, failure, outcome.seconds, cost))
    return Rows(plan, tuple(rows))


def _finite(metrics: Mapping[str, float], wanted: Collection[str]) -> tuple[dict[str, float], str]:
    """Return the finite numbers of ``metrics`` and a message about missing ``wanted`` ones."""
    good = {name: value for name, value in metrics.items() if math.isfinite(value)}
    missing = [name for name in wanted if name not in metrics]
    broken = [f"{name} is {metrics[name]}" for name in wanted if name in metrics and name not in good]
    absent = [f"the task returned no {', no '.join(missing)}"] if missing else []
    return good, "; ".join([*broken, *absent])


# ---------------------------------------------------------------- stored outcomes


@dataclass(frozen=True)
class Outcome:
    """Result of a row: its numbers, or the error message ``failure``; wall and processor seconds; the keys of
    the shared ``steps`` it reused; the data ``files`` that own code read, with digests. ``lost``: the process
    ended before the row.
    """

    metrics: Mapping[str, float] = field(default_factory=dict)
    failure: str = ""
    seconds: float = 0.0
    cpu_s: float = 0.0
    steps: tuple[str, ...] = ()
    lost: bool = False
    files: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Store:
    """The folder of a study; rows of edited data files are not found again, unless they are ``earlier``."""

    path: Path
    earlier: bool = False

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
            files = {} if self.earlier else dict(record["files"])
            if any(digest_of(path) != digest for path, digest in files.items()):
                return None
            metrics = {str(name): float(value) for name, value in record["metrics"].items()}
            seconds, cpu_s = float(record["seconds"]), float(record["cpu_s"])
            return Outcome(metrics, str(record["failure"]), seconds, cpu_s, tuple(record["steps"]))
        except (TypeError, KeyError, ValueError, AttributeError):
            return None

    def save(self, key: str, outcome: Outcome, record: Mapping[str, Any], kind: str = ROWS) -> None:
        """Store an outcome with the ``record`` of its row."""
        # JSON has no NaN and no infinity; store them as words.
        metrics = {k: v if math.isfinite(v) else str(v) for k, v in outcome.metrics.items()}
        found = {**record, **asdict(outcome), "metrics": metrics}
        write_json(self.path / kind / f"{key}.json", found, cached=True)


# ---------------------------------------------------------------- shared steps


class Part(NamedTuple):
    """A row or a shared step to be carried out, once the steps ``after`` have ended."""

    row: PlannedRow
    after: tuple[str, ...]
    step: str = ""
    key: str = ""

    @property
    def name(self) -> str:
        return self.key or self.row.key


def parts_of(rows: Sequence[PlannedRow]) -> list[Part]:
    """Return the rows, preceded by their shared first steps. A step is a part only if its rows differ in the
    next step.
    """
    chains = {r.key: r.setting.task.steps(r.setting.config, r.scene, r.seed) for r in rows}
    users = Counter(key for chain in chains.values() for _, key in chain)
    parts: dict[str, Part] = {}
    for row in rows:
        before: tuple[str, ...] = ()
        chain = chains[row.key]
        for (step, key), following in zip(chain, [*chain, None][1:], strict=True):
            if users[key] > max(1, users[following[1]] if following else 0):
                parts.setdefault(key, Part(row, before, step, key))
                before = (*before, key)
        parts[row.key] = Part(row, before)
    return list(parts.values())


def _compute(
    plan: Plan,
    store: Store,
    workers: _Workers,
    rows: Sequence[PlannedRow],
    on_progress: Callable[[str], None],
    limit_s: float | None,
) -> dict[str, Outcome]:
    """Carry out all rows; return the outcomes of those that were lost, which are not stored."""
    parts = parts_of(rows)
    ended = {p.name for p in parts if p.step and store.load(p.name, STEPS) is not None}
    waiting = [p for p in parts if p.name not in ended]
    packed = {p.row.key: _pack(p.row.setting) for p in waiting}
    suspects, lost, count, total = set[str](), dict[str, Outcome](), 0, len(waiting)

    def is_ready(part: Part, running: Collection[Part]) -> bool:
        # A part whose process died runs alone, so that it is known which one kills processes.
        alone = not suspects or (part.name in suspects and not running)
        return alone and set(part.after) <= ended

    def submit(part: Part) -> Future[Outcome]:
        row = part.row
        job = Job(part.name, *packed[row.key], row.scene, row.seed, store.path, part.step, limit_s)
        return workers.submit(job)

    for done in run_jobs(waiting, submit, is_ready, workers.most):
        for part, future in done:
            broken = isinstance(future.exception(), BrokenProcessPool)
            outcome = Outcome(failure=LOST, lost=True) if broken else future.result()
            if outcome.lost and part.name not in suspects:
                suspects.add(part.name)
                waiting.insert(0, part)
                continue
            suspects.discard(part.name)
            ended.add(part.name)
            if outcome.lost and not part.step:
                lost[part.name] = outcome
            else:
                outcome = replace(outcome, steps=() if part.step else part.after)
                store.save(part.name, outcome, _record(plan, part), STEPS if part.step else ROWS)
            count += 1
            name = f"{part.row.scene}, seed {part.row.seed}, {part.step or part.row.variant}"
            on_progress(f"[{count}/{total}] {name}: {outcome.failure or f'{outcome.seconds:.1f} s'}")
    return lost


def _record(plan: Plan, part: Part) -> dict[str, Any]:
    row, task = part.row, part.row.setting.task
    if part.step:
        return {"step": part.step, "scene": row.scene, "seed": row.seed}
    return {
        **{name: getattr(row, name) for name in PLACE},
        "config": tables_from_config(row.setting.config),
        "task": {} if isinstance(task, FunctionTask) else table_from_dataclass(task),
        "versions": dict(plan.versions),
    }


# ---------------------------------------------------------------- workers


class Job(NamedTuple):
    """Input of a worker: ``setting`` as bytes; ``step`` is the shared step, empty for the row itself. It ends
    after ``limit_s``.
    """

    key: str
    setting: bytes
    sources: tuple[Source, ...]
    scene: str
    seed: int
    out: Path
    step: str = ""
    limit_s: float | None = None


def _pack(setting: Setting) -> tuple[bytes, tuple[Source, ...]]:
    """Serialise a setting; :class:`UsageError` if impossible."""
    try:
        return pickle.dumps(setting), loaded_sources()
    except Exception as error:
        raise UsageError(f"this variant cannot be sent to a worker: {error}") from None


def carry_out(job: Job) -> Outcome:
    """Compute the row or the step. Errors are recorded; a full disk raises :class:`OutputError`."""
    with watched():
        for source in job.sources:
            source.install()
        setting: Setting = pickle.loads(job.setting)
    own = job.out / WORK / job.key
    shutil.rmtree(own, ignore_errors=True)
    place, given = Place(own, job.out / SHARED), (setting.config, job.scene, job.seed)
    start, cpu = time.perf_counter(), time.process_time()
    metrics, failure = dict[str, float](), ""
    try:
        own.mkdir(parents=True, exist_ok=True)
        with _time_limit(job.limit_s), watched() if _is_foreign(job, setting) else nullcontext():
            if job.step:
                setting.task.prepare(*given, place, step=job.step)
            else:
                found = setting.task.run(*given, place)
                metrics = {str(name): float(value) for name, value in found.items()}
    except OutputError:
        raise
    except (StageFailure, UsageError, _TooLongError) as error:
        failure = str(error)
    except Exception as error:
        if isinstance(error, OSError) and error.errno in WRITE_ERRNOS:
            raise OutputError(error.filename or own, error) from None
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}, line {last.lineno}"
        failure = f"{type(error).__name__}: {error} ({where})"
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - cpu
    shutil.rmtree(own, ignore_errors=True)
    return Outcome(metrics, failure, seconds, cpu_s, files=read_files(job.out))


def _is_foreign(job: Job, setting: Setting) -> bool:
    """Whether code of the user runs; that of the project has the content of its scenes in its keys."""
    task = setting.task.function if isinstance(setting.task, FunctionTask) else type(setting.task)
    return bool(job.sources) or not task.__module__.startswith("validation.")


class _TooLongError(BaseException):
    """The time of a row is over. No handler of the row's own code catches it."""


@contextmanager
def _time_limit(limit_s: float | None) -> Iterator[None]:
    """Raise :class:`_TooLongError` in the block after ``limit_s``, in the main thread of the process."""
    if limit_s is None or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: object) -> None:
        raise _TooLongError(f"exceeded the time limit of {limit_s:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@dataclass
class _Workers:
    """Processes (``count``), or this process if 0; they get ``most`` jobs, a spare one each. Or those of a
    ``cluster``.
    """

    count: int
    pool: ProcessPool | None = None
    cluster: Cluster | None = None

    @property
    def most(self) -> int:
        return max(1, 2 * (self.count if self.cluster is None else self.cluster.parallel()))

    def submit(self, job: Job) -> Future[Outcome]:
        if self.cluster is not None:
            return self.cluster.executor.submit(carry_out, job)
        if not self.count:
            future: Future[Outcome] = Future()
            future.set_result(carry_out(job))
            return future
        try:
            self.pool = self.pool or ProcessPool(self.count)
            return self.pool.submit(carry_out, job)
        except BrokenProcessPool:
            # One of its processes was killed.
            self.pool = ProcessPool(self.count)
            return self.pool.submit(carry_out, job)


@contextmanager
def _workers(executor: str, threads: int | None) -> Iterator[_Workers]:
    """Yield the workers of an executor; :class:`UsageError` for another name or no thread."""
    if threads is not None and threads < 1:
        raise UsageError(f"threads must be at least 1; got {threads}")
    if is_dask_address(executor):
        with connect_dask(executor) as cluster:
            yield _Workers(0, cluster=cluster)
        return
    if executor not in EXECUTORS:
        raise UsageError(unknown_word("executor", executor, EXECUTORS))
    workers = _Workers(0 if executor == "local" else threads or available_threads())
    if workers.count:
        for name in ONE_THREAD:
            # One process per core: NumPy's own threads would compete for them.
            os.environ.setdefault(name, "1")
    try:
        yield workers
        if workers.pool is not None:
            workers.pool.shutdown(wait=True)
    finally:
        if workers.pool is not None:
            workers.pool.abandon()

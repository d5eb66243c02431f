"""Compute rows as workers become free and store them; shared first steps run once."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, overload

from thesisrecon.errors import WorkersLost
from thesisrecon.io._files import write_json
from thesisrecon.runtime.executors import CHECK_S
from thesisrecon.settings import table_from_dataclass, tables_from_config
from validation.ablation.plan import Plan, PlannedRow, plan_study
from validation.ablation.row import Job, carry_out, pack
from validation.ablation.store import STEPS, WORK, Outcome, Store, finite
from validation.ablation.study import Study
from validation.ablation.tasks import FunctionTask
from validation.ablation.workers import Crew, crew_of

ProgressCallback = Callable[["State"], None]
"""Called with the state whenever a row or a step has ended."""
LOST = "the worker process of this row was killed or ran out of memory"


@dataclass(frozen=True)
class Row:
    """A finished row: its place in the study and its outcome.

    ``cost_s`` is the processor time (s) of the row including shared steps.
    """

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

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Row]: ...
    def __getitem__(self, index: int | slice) -> Row | Sequence[Row]:
        return self.rows[index]

    def __len__(self) -> int:
        return len(self.rows)


@dataclass
class State:
    """Progress of a study: all rows, rows of earlier runs and of this run, failures; seconds by variant;
    seconds since the start; number of parallel rows."""

    total: int
    kept: int = 0
    done: int = 0
    failed: int = 0
    steps: int = 0
    steps_done: int = 0
    width: int = 1
    started: float = field(default_factory=time.perf_counter)
    spent: dict[str, list[float]] = field(default_factory=dict)
    waiting: Counter[str] = field(default_factory=Counter)

    @property
    def left_s(self) -> float | None:
        """Estimate the remaining seconds from the mean of each variant, else of all rows; None
        before the first row."""
        every = [s for spent in self.spent.values() for s in spent]
        if not every:
            return None
        usual = sum(every) / len(every)
        mean = {v: sum(s) / len(s) for v, s in self.spent.items()}
        return sum(n * mean.get(v, usual) for v, n in self.waiting.items()) / self.width


def ablate(
    study: Study,
    out: str | Path,
    *,
    executor: str | Executor = "processes",
    threads: int | None = None,
    on_progress: ProgressCallback | None = None,
) -> Rows:
    """Compute the rows of a study that are not in ``out`` yet, and return all of them.

    Parameters
    ----------
    study : the study to run.
    out : the folder of the study. It may be used again, after a kill or for a study that has grown: rows that
        are there under the same setting, scene, seed and versions are not computed again.
    executor : "local" (this process), "processes", "dask://HOST:PORT", or any
        :class:`concurrent.futures.Executor`.
    threads : rows at a time; all processors where None.
    on_progress : called with the state after each row.

    Raises
    ------
    UsageError : an invalid study (see :func:`plan_study`), a folder that cannot be written, a scheduler
        that does not answer. Errors of a row are stored in the row.
    """
    plan, store = plan_study(study), Store(Path(out).resolve())
    store.prepare()
    write_json(store.path / "study.json", _study_record(plan))
    todo = {row.key: row for row in plan.rows if store.load(row.key) is None}
    state = State(len({row.key for row in plan.rows}), waiting=Counter(r.variant for r in todo.values()))
    state.kept = state.total - len(todo)
    lost: dict[str, Outcome] = {}
    if todo:
        with crew_of(executor, threads) as crew:
            state.width = min(crew.width, len(todo))
            lost = _Session(plan, store, crew, state, on_progress or (lambda _: None)).run(
                list(todo.values())
            )
    shutil.rmtree(store.path / WORK, ignore_errors=True)
    return _rows(plan, store, lost)


def read_rows(study: Study, out: str | Path) -> Rows:
    """Return the rows of a study that are in ``out``, without computing."""
    return _rows(plan_study(study), Store(Path(out)), {})


def _rows(plan: Plan, store: Store, lost: Mapping[str, Outcome]) -> Rows:
    rows = []
    for planned in plan.rows:
        outcome = store.load(planned.key) or lost.get(planned.key)
        if outcome is None:
            continue
        shared = [s for s in (store.load(key, STEPS) for key in outcome.steps) if s is not None]
        cost = outcome.cpu_s + sum(s.cpu_s for s in shared)
        metrics, failure = dict(outcome.metrics), outcome.failure
        if not failure:
            metrics, failure = finite(metrics, plan.wanted(planned))
        rows.append(
            Row(
                planned.key,
                planned.variant,
                planned.condition,
                planned.scene,
                planned.seed,
                metrics,
                failure,
                outcome.seconds,
                cost,
            )
        )
    return Rows(plan, tuple(rows))


# ---------------------------------------------------------------- shared steps


@dataclass(frozen=True)
class _Part:
    """A row or a shared step to be carried out, once the steps ``after`` have ended."""

    row: PlannedRow
    after: tuple[str, ...]
    step: str = ""
    key: str = ""

    @property
    def name(self) -> str:
        return self.key or self.row.key


def parts_of(rows: Sequence[PlannedRow]) -> list[_Part]:
    """Return the rows, preceded by their shared first steps.

    A step is a part only if its rows differ in the next step.
    """
    chains = {row.key: _chain(row) for row in rows}
    users = Counter(key for chain in chains.values() for _, key in chain)
    parts: dict[str, _Part] = {}
    for row in rows:
        before: tuple[str, ...] = ()
        chain = chains[row.key]
        for (step, key), following in zip(chain, [*chain, None][1:], strict=True):
            goes_on = 0 if following is None else users[following[1]]
            if users[key] > max(1, goes_on):
                parts.setdefault(key, _Part(row, before, step, key))
                before = (*before, key)
        parts[row.key] = _Part(row, before)
    return list(parts.values())


def _chain(row: PlannedRow) -> Sequence[tuple[str, str]]:
    """Return the steps of a row with keys, empty for a task without. The last one is the row itself
    where its measures are all that is left."""
    steps = getattr(row.setting.task, "steps", None)
    return [] if steps is None else list(steps(row.setting.config, row.scene, row.seed))


# ---------------------------------------------------------------- one call


@dataclass
class _Session:
    """The state of one call of :func:`ablate`."""

    plan: Plan
    store: Store
    crew: Crew
    state: State
    on_progress: ProgressCallback
    tries: Counter[str] = field(default_factory=Counter)
    lost: dict[str, Outcome] = field(default_factory=dict)

    def run(self, rows: Sequence[PlannedRow]) -> dict[str, Outcome]:
        """Carry out all rows; the outcomes of those that were lost, which are not kept."""
        parts = parts_of(rows)
        ended = {p.key for p in parts if p.step and self.store.load(p.key, STEPS) is not None}
        waiting = [p for p in parts if p.name not in ended]
        self.state.steps = sum(bool(p.step) for p in waiting)
        packed = {p.row.key: pack(p.row.setting) for p in waiting}
        running: dict[Future[Outcome], _Part] = {}
        self.on_progress(self.state)
        while waiting or running:
            for part in self._ready(waiting, ended, len(running)):
                waiting.remove(part)
                running[self._submit(part, packed[part.row.key])] = part
                if len(running) >= self.crew.most:
                    break
            done, _ = wait(running, CHECK_S, return_when=FIRST_COMPLETED)
            if not done and self.crew.cluster is not None:
                self.crew.cluster.check()
            outcomes = [(running.pop(f), self._outcome(f)) for f in done if not f.cancelled()]
            if self.crew.renew is not None and any(outcome.lost for _, outcome in outcomes):
                # No row of a broken pool ends.
                outcomes += [(part, Outcome(failure=LOST, lost=True)) for part in running.values()]
                running.clear()
                self.crew.executor = self.crew.renew()
            for part, outcome in outcomes:
                if outcome.lost and self._again(part):
                    waiting.insert(0, part)
                else:
                    ended.add(part.name)
                    self._keep(part, outcome)
            if any(future.cancelled() for future in done):
                # Rows are never cancelled here, so the cluster was lost.
                raise self._gone()
        return self.lost

    def _ready(self, waiting: Sequence[_Part], ended: set[str], running: int) -> Iterator[_Part]:
        """The parts that can begin, in order. One that was in a process that died runs alone, so that it is
        known which of them kills processes."""
        ready = [p for p in waiting if set(p.after) <= ended]
        suspects = [p for p in ready if self.tries[p.name]]
        if suspects:
            return iter(suspects[:1] if not running else [])
        return iter(ready[: max(0, self.crew.most - running)])

    def _submit(self, part: _Part, packed: tuple[bytes, Any]) -> Future[Outcome]:
        row = part.row
        job = Job(
            part.name,
            *packed,
            row.scene,
            row.seed,
            self.store.path,
            part.step,
            self.crew.by_thread,
        )
        try:
            return self.crew.executor.submit(carry_out, job)
        except BrokenProcessPool as error:
            future: Future[Outcome] = Future()
            future.set_exception(error)
            return future

    def _outcome(self, future: Future[Outcome]) -> Outcome:
        try:
            return future.result()
        except BrokenProcessPool:
            return Outcome(failure=LOST, lost=True)
        except CancelledError:
            raise self._gone() from None
        except Exception as error:
            # Foreign executors report a lost worker in their own way.
            if type(error).__name__ == "KilledWorker":
                return Outcome(failure=LOST, lost=True)
            raise

    def _gone(self) -> WorkersLost:
        cluster = self.crew.cluster
        lost = WorkersLost("the workers are gone") if cluster is None else cluster.lost()
        return WorkersLost(f"{lost}; the rows that ended are kept, and the same command continues from there")

    def _again(self, part: _Part) -> bool:
        """Return whether a part whose process died is tried once more."""
        self.tries[part.name] += 1
        return self.crew.renew is not None and self.tries[part.name] < 2

    def _keep(self, part: _Part, outcome: Outcome) -> None:
        row, state = part.row, self.state
        if part.step:
            state.steps_done += 1
            record = {"step": part.step, "scene": row.scene, "seed": row.seed}
            self.store.save(part.key, outcome, record, STEPS)
        else:
            outcome = replace(outcome, steps=part.after)
            if outcome.lost:
                self.lost[row.key] = outcome
            else:
                self.store.save(row.key, outcome, _row_record(self.plan, row))
            state.done += 1
            failed = outcome.failure or finite(outcome.metrics, self.plan.wanted(row))[1]
            state.failed += bool(failed)
            state.waiting[row.variant] -= 1
            state.spent.setdefault(row.variant, []).append(outcome.seconds)
        self.on_progress(state)


def _row_record(plan: Plan, row: PlannedRow) -> dict[str, Any]:
    task = row.setting.task
    return {
        "variant": row.variant,
        "condition": row.condition,
        "scene": row.scene,
        "seed": row.seed,
        "config": tables_from_config(row.setting.config),
        "task": {} if isinstance(task, FunctionTask) else table_from_dataclass(task),
        "versions": dict(plan.versions),
    }


def _study_record(plan: Plan) -> dict[str, Any]:
    """The study in plain words, beside its rows."""
    study = plan.study
    return {
        "title": study.title,
        "mode": study.mode,
        "baseline": plan.baseline,
        "variants": {v.name: dict(v.levels) for v in plan.variants},
        "conditions": {c.name: dict(c.levels) for c in plan.conditions},
        "scenes": list(dict.fromkeys(r.scene for r in plan.rows)),
        "seeds": list(plan.seeds),
        "metrics": [vars(m) for m in plan.measures],
        "versions": dict(plan.versions),
    }

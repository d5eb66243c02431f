"""Compute rows as workers become free and store them; shared first steps run once."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from thesisrecon.config.text import table_from_dataclass, tables_from_config
from thesisrecon.io._files import write_json
from thesisrecon.io._outputs import join_claim
from validation.ablation.plan import Plan, PlannedRow, plan_study
from validation.ablation.study import FunctionTask, Study
from validation.ablation.workers import STEPS, WORK, Job, Outcome, Store, Workers, finite, pack, workers_of
from validation.runs.processes import run_jobs

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

    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]

    def __len__(self) -> int:
        return len(self.rows)


@dataclass
class State:
    """Number of all rows, of those that ended (in earlier runs too) and that failed, and of shared steps."""

    total: int
    done: int
    failed: int = 0
    steps: int = 0
    steps_done: int = 0


ProgressCallback = Callable[[State], None]
"""Called with the state whenever a row or a step has ended."""


def ablate(
    study: Study,
    out: str | Path,
    *,
    executor: str = "local",
    threads: int | None = None,
    on_progress: ProgressCallback = lambda _: None,
) -> Rows:
    """Compute the rows of a study that are not in ``out`` yet, and return all of them.

    Parameters
    ----------
    study : the study to run.
    out : the folder of the study. It may be used again, after a kill or for a study that has grown: rows that
        are there under the same setting, scene, seed and versions are not computed again.
    executor : "local" (this process) or "processes", for which a script needs ``if __name__ == "__main__":``.
    threads : processes; as many as processors where None.
    on_progress : called with the state after each row.

    Raises
    ------
    UsageError : an invalid study (see :func:`plan_study`) or a folder that cannot be written. Errors of a row
        are stored in the row.
    """
    plan, store = plan_study(study), Store(Path(out).resolve())
    with join_claim(store.path) as outputs:
        outputs.clear(store.path / WORK)
        store.prepare()
        write_json(store.path / "study.json", _study_record(plan))
        todo = {row.key: row for row in plan.rows if store.load(row.key) is None}
        total = len({row.key for row in plan.rows})
        lost: dict[str, Outcome] = {}
        if todo:
            with workers_of(executor, threads) as workers:
                session = _Session(plan, store, workers, State(total, total - len(todo)), on_progress)
                lost = session.run(list(todo.values()))
        shutil.rmtree(store.path / WORK, ignore_errors=True)
    return _rows(plan, store, lost)


def read_rows(study: Study, out: str | Path) -> Rows:
    """Return the rows of a study that are in ``out``, without computing."""
    return _rows(plan_study(study), Store(Path(out)), {})


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
            metrics, failure = finite(metrics, plan.wanted(p))
        place = (p.key, p.variant, p.condition, p.scene, p.seed)
        rows.append(Row(*place, metrics, failure, outcome.seconds, cost))
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
    """Return the steps of a row with keys, empty for a task without steps."""
    steps = getattr(row.setting.task, "steps", None)
    return [] if steps is None else list(steps(row.setting.config, row.scene, row.seed))


# ---------------------------------------------------------------- one call


@dataclass
class _Session:
    """The state of one call of :func:`ablate`."""

    plan: Plan
    store: Store
    workers: Workers
    state: State
    on_progress: ProgressCallback
    suspects: set[str] = field(default_factory=set)
    lost: dict[str, Outcome] = field(default_factory=dict)

    def run(self, rows: Sequence[PlannedRow]) -> dict[str, Outcome]:
        """Carry out all rows; return the outcomes of those that were lost, which are not stored."""
        parts = parts_of(rows)
        ended = {p.key for p in parts if p.step and self.store.load(p.key, STEPS) is not None}
        waiting = [p for p in parts if p.name not in ended]
        self.state.steps = sum(bool(p.step) for p in waiting)
        packed = {p.row.key: pack(p.row.setting) for p in waiting}

        def is_ready(part: _Part, running: Collection[_Part]) -> bool:
            # A part whose process died runs alone, so that it is known which one kills processes.
            alone = not self.suspects or (part.name in self.suspects and not running)
            return alone and set(part.after) <= ended

        def submit(part: _Part) -> Future[Outcome]:
            row = part.row
            job = Job(part.name, *packed[row.key], row.scene, row.seed, self.store.path, part.step)
            return self.workers.submit(job)

        self.on_progress(self.state)
        for done in run_jobs(waiting, submit, is_ready, self.workers.most):
            for part, future in done:
                outcome = self._outcome(future)
                if outcome.lost and part.name not in self.suspects:
                    self.suspects.add(part.name)
                    waiting.insert(0, part)
                else:
                    self.suspects.discard(part.name)
                    ended.add(part.name)
                    self._keep(part, outcome)
        return self.lost

    def _outcome(self, future: Future[Outcome]) -> Outcome:
        try:
            return future.result()
        except BrokenProcessPool:
            self.workers.renew(future)
            return Outcome(failure=LOST, lost=True)

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
            state.failed += bool(outcome.failure or finite(outcome.metrics, self.plan.wanted(row))[1])
        self.on_progress(state)


def _row_record(plan: Plan, row: PlannedRow) -> dict[str, Any]:
    task = row.setting.task
    return {
        **{name: getattr(row, name) for name in ("variant", "condition", "scene", "seed")},
        "config": tables_from_config(row.setting.config),
        "task": {} if isinstance(task, FunctionTask) else table_from_dataclass(task),
        "versions": dict(plan.versions),
    }


def _study_record(plan: Plan) -> dict[str, Any]:
    """Describe the study for ``study.json``."""
    return {
        "title": plan.study.title,
        "mode": plan.study.mode,
        "baseline": plan.baseline,
        "variants": {v.name: dict(v.levels) for v in plan.variants},
        "conditions": {c.name: dict(c.levels) for c in plan.conditions},
        "scenes": list(dict.fromkeys(r.scene for r in plan.rows)),
        "seeds": list(plan.seeds),
        "metrics": [vars(m) for m in plan.measures],
        "versions": dict(plan.versions),
    }

"""Run all tasks of a report in parallel, each in a process of its own.

The first own task of a stage compiles its kernels. No other task of that stage, nor a first task of another
stage, starts before it ends; references use the other cores.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from thesisrecon.io._files import write_text
from thesisrecon.io._outputs import clear_folder
from validation.harness.forks import Template
from validation.harness.process import Process, failure_of, last_words, own_cores
from validation.harness.records import Judgement, Outcome, Picture, Plot, ReportOptions, Stage, Task
from validation.harness.resume import OURS, earlier_run, take_over
from validation.harness.worker import JUDGEMENT, OUTCOMES
from validation.metrics.record import Metric

Reporter = Callable[[str], None]
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
JUDGE = ""
"""Method name of the judgement task."""


def tasks_of(options: ReportOptions, stages: Mapping[str, Stage]) -> list[Task]:
    """Return every method of every stage on every scene, then its judgement."""
    found = []
    for scene in options.scenes:
        for name in options.stages:
            stage = stages[name]
            if stage.takes(scene, options):
                found += [Task(name, scene, method) for method in stage.methods(scene, options)]
                found.append(Task(name, scene, JUDGE))
    return found


def run_tasks(
    options: ReportOptions, stages: Mapping[str, Stage], report: Reporter
) -> dict[tuple[str, str], tuple[Judgement, dict[str, Outcome]]]:
    """Return the judgement and outcomes of each (stage, scene); failures do not stop other tasks."""
    earlier = earlier_run(options)
    clear_folder(options.out / "data")
    write_text(options.out / "options.json", json.dumps(options.to_json()))
    tasks = tasks_of(options, stages)
    place_of = {task: n for n, task in enumerate(tasks)}
    ended = {} if earlier is None else take_over(earlier, options, tasks, stages)
    behind = tasks_behind(tasks, stages)
    # Start long chains first to finish early.
    waiting = sorted((task for task in tasks if task not in ended), key=lambda task: -behind[task])
    running: dict[Future[Outcome], Task] = {}
    cores = own_cores()[: options.threads]
    total = len(tasks)
    # On an interrupt the processes end first: their threads wait for nothing else.
    with ThreadPoolExecutor(len(cores)) as pool, ExitStack() as stack:
        free = _Templates(cores, options, stack)
        while waiting or running:
            for task in [t for t in waiting if len(running) < len(cores)]:
                if len(running) < len(cores) and _ready(task, waiting, running.values(), ended, stages):
                    waiting.remove(task)
                    running[pool.submit(_carry_out, task, options, dict(ended), free)] = task
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                ended[task] = future.result()
                # In task order, so tables do not depend on completion order.
                ended = dict(sorted(ended.items(), key=lambda item: place_of[item[0]]))
                report(f"[{len(ended)}/{total}] {_words(task, ended[task])}")
    judged = [task for task in ended if task.method == JUDGE]
    return {(t.stage, t.scene): (_judgement(ended[t]), _outcomes(t, ended)) for t in judged}


def tasks_behind(tasks: list[Task], stages: Mapping[str, Stage]) -> dict[Task, int]:
    """Return how many tasks depend, directly or indirectly, on each."""
    followers: dict[Task, set[Task]] = {task: set() for task in tasks}
    for task in tasks:
        before = [Task(s, task.scene, method) for s, method in stages[task.stage].needs(task.method)]
        if task.method == JUDGE:
            before += [t for t in tasks if (t.stage, t.scene) == (task.stage, task.scene) and t != task]
        for other in before:
            if other in followers:
                followers[other].add(task)

    def reached(task: Task, seen: set[Task]) -> set[Task]:
        for follower in followers[task] - seen:
            seen.add(follower)
            reached(follower, seen)
        return seen

    return {task: len(reached(task, set())) for task in tasks}


class _Templates:
    """Idle processes, one per core; that of the core which has been idle longest comes first."""

    def __init__(self, cores: list[int], options: ReportOptions, stack: ExitStack) -> None:
        self._modules = ("validation.harness.worker", options.stages_from)
        self._stack, self._over = stack, False
        self._free: SimpleQueue[tuple[int, Template]] = SimpleQueue()
        for core in cores:
            self._free.put((core, self._start(core)))
        stack.callback(self._end)

    def _end(self) -> None:
        self._over = True

    def _start(self, core: int) -> Template:
        return self._stack.enter_context(closing(Template(self._modules, core, ENVIRONMENT)))

    def run(self, arguments: list[str], log: Path, limit_s: float) -> Process:
        """Run one task."""
        core, template = self._free.get()
        try:
            return template.run(arguments, log=log, limit_s=limit_s)
        except RuntimeError as error:
            if self._over:
                raise
            write_text(log, f"{error}\n")
            template = self._start(core)
            return Process(1, 0.0, 0.0, 0.0)
        finally:
            self._free.put((core, template))


def _ready(
    task: Task,
    waiting: Collection[Task],
    running: Collection[Task],
    ended: Collection[Task],
    stages: Mapping[str, Stage],
) -> bool:
    """Return whether the inputs of the task exist and its kernels are not being compiled."""
    open_tasks = {*waiting, *running}
    own = {t for t in open_tasks - {task} if (t.stage, t.scene) == (task.stage, task.scene)}
    if task.method == JUDGE and own:
        return False
    if _is_ours(task):
        compiled = {t.stage for t in ended if _is_ours(t)}
        first = {t.stage for t in running if _is_ours(t)} - compiled
        if task.stage in first or (first and task.stage not in compiled):
            return False
    return not any(
        Task(stage, task.scene, method) in open_tasks
        for stage, method in stages[task.stage].needs(task.method)
    )


def _is_ours(task: Task) -> bool:
    return task.method.startswith(OURS)


def _carry_out(
    task: Task, options: ReportOptions, ended: Mapping[Task, Outcome], free: _Templates
) -> Outcome:
    place = options.place(task.stage, task.scene, task.method)
    place.mkdir(parents=True, exist_ok=True)
    arguments = [str(options.out / "options.json"), task.stage, task.scene]
    if task.method == JUDGE:
        record = {name: asdict(o) | {"place": str(o.place)} for name, o in _outcomes(task, ended).items()}
        write_text(place / OUTCOMES, json.dumps(record))
    else:
        arguments.append(task.method)
    # Outside the task folder, which the task may empty.
    log = place.with_name(f"{place.name}.log")
    process = free.run(arguments, log, options.limit_s)
    failure = failure_of(process, last_words(log), options.limit_s)
    return Outcome(place, failure, process.wall_s, process.cpu_s, process.peak_mb)


def _outcomes(task: Task, ended: Mapping[Task, Outcome]) -> dict[str, Outcome]:
    """Return the outcomes of the methods of this judgement, in task order."""
    return {
        t.method: outcome
        for t, outcome in ended.items()
        if (t.stage, t.scene) == (task.stage, task.scene) and t.method != JUDGE
    }


def _judgement(outcome: Outcome) -> Judgement:
    if not outcome.ok:
        return Judgement((), notes=(f"This comparison could not be evaluated: {outcome.failure}.",))
    record: dict[str, Any] = json.loads((outcome.place / JUDGEMENT).read_text(encoding="utf-8"))
    return Judgement(
        [Metric(**metric) for metric in record["metrics"]],
        [Plot(**plot) for plot in record["plots"]],
        [Picture(**picture) for picture in record["pictures"]],
        record["notes"],
    )


def _words(task: Task, outcome: Outcome) -> str:
    what = f"{task.scene}: {task.stage}, {task.method or 'judged'}"
    return f"{what}: {outcome.failure or f'{outcome.wall_s:.1f} s'}"

"""Run all tasks of a report in parallel, each in its own process.

The first own task of a stage compiles its kernels. No other task of that stage, nor a first task of another
stage, starts before it ends; references use the other cores.

A run may resume another one: references are reused, and our results where the library finds settings and code
of a stage unchanged in the numbered folders of its run. Own methods have names that begin with "ours".

As a program it runs one task: OPTIONS STAGE SCENE [METHOD]; without a method, the judgement.
"""

from __future__ import annotations

import importlib
import json
import shutil
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, replace
from operator import methodcaller
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Any

from thesisrecon.errors import StageFailure
from thesisrecon.io._files import write_text
from thesisrecon.io._outputs import clear_folder
from thesisrecon.pipeline.run import FOLDERS
from thesisrecon.runtime._run_folder import RUN_FILE
from validation.runs.processes import failure_of, last_line, own_cores, run_jobs, run_process
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task
from validation.runs.tables import OURS, Metric, Plot

Judged = Mapping[tuple[str, str], tuple[Judgement, Mapping[str, Outcome]]]
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
JUDGE = ""  # Method name of the judgement task
JUDGEMENT, OUTCOMES = "judgement.json", "outcomes.json"
REFERENCES_USE_OURS = ("boards", "surface", "view-interpolation", "views")
"""Stages whose references use our code and run again."""
SAME_OPTIONS = ("quick", "gates_only", "seed", "side_px")  # Options that affect the results of a task


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


def run_tasks(options: ReportOptions, stages: Mapping[str, Stage], report: Callable[[str], None]) -> Judged:
    """Return the judgement and outcomes of each (stage, scene); failures do not stop other tasks."""
    earlier = earlier_run(options)
    clear_folder(options.out / "data")
    write_text(options.out / "options.json", json.dumps(options.to_json()))
    tasks = tasks_of(options, stages)
    ended = {} if earlier is None else reuse_results(earlier, options, tasks, stages)
    waiting = [task for task in tasks if task not in ended]
    idle, stop = SimpleQueue[int](), Event()
    cores = own_cores()[: options.threads]
    for core in cores:
        idle.put(core)
    # On an interrupt the processes end first: their threads wait for nothing else.
    with ThreadPoolExecutor(len(cores)) as threads, ExitStack() as stack:
        stack.callback(stop.set)
        jobs = run_jobs(
            waiting,
            lambda task: threads.submit(_run_task, task, options, dict(ended), idle, stop),
            lambda task, running: _is_ready(task, waiting, running, ended, stages),
            len(cores),
        )
        for done in jobs:
            for task, future in done:
                ended[task] = future.result()
                # In task order, so that tables do not depend on the order of completion.
                ended = {t: ended[t] for t in tasks if t in ended}
                name = f"{task.scene}: {task.stage}, {task.method or 'judged'}"
                spent = ended[task].failure or f"{ended[task].wall_s:.1f} s"
                report(f"[{len(ended)}/{len(tasks)}] {name}: {spent}")
    judged = [task for task in ended if task.method == JUDGE]
    return {(t.stage, t.scene): (_judgement(ended[t]), _outcomes(t, ended)) for t in judged}


def _is_ready(
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


def _run_task(
    task: Task, options: ReportOptions, ended: Mapping[Task, Outcome], idle: SimpleQueue[int], stop: Event
) -> Outcome:
    folder = options.folder(task.stage, task.scene, task.method)
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "validation.runs.report", str(options.out / "options.json")]
    command += [task.stage, task.scene, *([] if task.method == JUDGE else [task.method])]
    if task.method == JUDGE:
        record = {name: asdict(o) | {"folder": str(o.folder)} for name, o in _outcomes(task, ended).items()}
        write_text(folder / OUTCOMES, json.dumps(record))
    # Outside the task folder, which the task may empty.
    log, loaded, core = folder.with_name(f"{folder.name}.log"), _loaded_file(folder), idle.get()
    limits: dict[str, Any] = {"limit_s": options.limit_s, "stop": stop, "loaded": loaded}
    try:
        process = run_process(command, log=log, cores=[core], environment=ENVIRONMENT, **limits)
    finally:
        idle.put(core)
    failure = failure_of(process, last_line(log), options.limit_s)
    imports_s = float(loaded.read_text(encoding="utf-8")) if loaded.is_file() else 0.0
    return Outcome(folder, failure, process.wall_s, process.cpu_s - imports_s, process.peak_mb)


def _loaded_file(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.loaded")


def _outcomes(task: Task, ended: Mapping[Task, Outcome]) -> dict[str, Outcome]:
    return {
        t.method: outcome
        for t, outcome in ended.items()
        if (t.stage, t.scene) == (task.stage, task.scene) and t.method != JUDGE
    }


def _judgement(outcome: Outcome) -> Judgement:
    if not outcome.ok:
        return Judgement((), notes=(f"This comparison could not be evaluated: {outcome.failure}.",))
    record: dict[str, Any] = json.loads((outcome.folder / JUDGEMENT).read_text(encoding="utf-8"))
    return Judgement(
        [Metric(**metric) for metric in record["metrics"]],
        record["notes"],
        [Plot(**plot) for plot in record["plots"]],
        [Picture(**picture) for picture in record["pictures"]],
    )


# ---------------------------------------------------------------- one task, in a process of its own


def main(arguments: list[str]) -> int:
    """Run one task."""
    options_file, stage, scene, *method = arguments
    options = ReportOptions.from_json(json.loads(Path(options_file).read_text(encoding="utf-8")))
    stages: dict[str, Stage] = importlib.import_module(options.stages_from).STAGES
    write_text(_loaded_file(options.folder(stage, scene, *method)), f"{time.process_time()}")
    try:
        if method:
            folder = options.folder(stage, scene, method[0])
            folder.mkdir(parents=True, exist_ok=True)
            stages[stage].run(Task(stage, scene, method[0]), folder, options)
        else:
            _judge(options, stages[stage], scene)
    except (StageFailure, ImportError, ValueError) as error:
        print(error, file=sys.stderr)
        return 3
    return 0


def _judge(options: ReportOptions, stage: Stage, scene: str) -> None:
    folder = options.folder(stage.name, scene)
    outcomes = read_outcomes(folder)
    judgement = stage.judge(scene, outcomes, options)
    failures = [f"{name}: {outcome.failure}." for name, outcome in outcomes.items() if not outcome.ok]
    judgement = replace(judgement, notes=[*judgement.notes, *failures])
    write_text(folder / JUDGEMENT, json.dumps(asdict(judgement), default=methodcaller("tolist")))


def read_outcomes(folder: Path) -> dict[str, Outcome]:
    """Return the outcomes of a stage on a scene by method, those of its folder."""
    record = json.loads((folder / OUTCOMES).read_text(encoding="utf-8"))
    return {name: Outcome(**{**o, "folder": Path(o["folder"])}) for name, o in record.items()}


# ---------------------------------------------------------------- resume another run


def earlier_run(options: ReportOptions) -> ReportOptions | None:
    """Return the options of the run to start from, None if there is none to start from."""
    if not options.resume:
        return None
    folder = Path(options.resume)
    try:
        record = json.loads((folder / "options.json").read_text(encoding="utf-8"))
        other = replace(ReportOptions.from_json(record), out=folder)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{folder} holds no run to start from (options.json): {error}") from None
    different = [name for name in SAME_OPTIONS if getattr(other, name) != getattr(options, name)]
    moved = [s for s, place in options.folders.items() if other.folders.get(s, place) != place]
    different += [f"folder of the scene {scene}" for scene in moved]
    if different:
        raise ValueError(
            f"{folder} is a run with another {', '.join(different)}: use a run with the same options"
        )
    return other


def reuse_results(
    other: ReportOptions, options: ReportOptions, tasks: Sequence[Task], stages: Mapping[str, Stage]
) -> dict[Task, Outcome]:
    """Return the outcomes of tasks that need not run again; their files are copied from the ``other`` run."""
    known = {}
    for task in tasks:
        if task.method and (_is_ours(task) or task.stage in REFERENCES_USE_OURS):
            _copy_stage_folders(other.folder(task.stage, task.scene, task.method) / "run", options, task)
        elif task.method:
            folder = other.folder(task.stage, task.scene)
            outcome = read_outcomes(folder).get(task.method) if (folder / OUTCOMES).is_file() else None
            if outcome is not None and outcome.ok:
                kept = options.folder(task.stage, task.scene, task.method)
                shutil.copytree(other.folder(task.stage, task.scene, task.method), kept, dirs_exist_ok=True)
                known[task] = replace(outcome, folder=kept)
        _copy_inputs(other, options, task, stages)
    return known


def _copy_stage_folders(run: Path, options: ReportOptions, task: Task) -> None:
    folder = options.folder(task.stage, task.scene, task.method) / "run"
    if (run / RUN_FILE).is_file():
        # The library accepts only folders with this file.
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy2(run / RUN_FILE, folder / RUN_FILE)
    for name in sorted(set(FOLDERS.values())):
        if (run / name).is_dir():
            shutil.copytree(run / name, folder / name, dirs_exist_ok=True)


def _copy_inputs(
    other: ReportOptions, options: ReportOptions, task: Task, stages: Mapping[str, Stage]
) -> None:
    """Copy the inputs of a task from stages that are not part of this run."""
    for stage, method in stages[task.stage].needs(task.method):
        folder = other.folder(stage, task.scene, method)
        if stage not in options.stages and folder.is_dir():
            shutil.copytree(folder, options.folder(stage, task.scene, method), dirs_exist_ok=True)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

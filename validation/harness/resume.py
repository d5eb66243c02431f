"""A run that starts from what another one left: references as they are, ours from files that still hold.

Ours is every method whose name begins with "ours". Of its results only the numbered folders of a run of the
library are taken, which it reads itself where neither the settings nor the code of a stage has changed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from thesisrecon.runtime.run import FOLDERS
from thesisrecon.runtime.run_folder import RUN_FILE
from validation.harness.records import Outcome, Stage, Task, Wishes
from validation.harness.worker import OUTCOMES

OURS = "ours"
OVER_OURS = ("between", "boards", "surface", "views")
"""Stages whose references, too, go through code of ours: they run again."""
ALIKE = ("quick", "gates_only", "seed", "side_px")
"""Wishes that the results of a task depend on."""


def take_over(wishes: Wishes, tasks: Sequence[Task], stages: Mapping[str, Stage]) -> dict[Task, Outcome]:
    """The outcomes of tasks that need not run again; their files stand in their places of this run.

    Raises ``ValueError`` where the other folder holds no run, or one with other wishes.
    """
    if not wishes.resume:
        return {}
    other = _wishes_of(Path(wishes.resume))
    unlike = [name for name in ALIKE if getattr(other, name) != getattr(wishes, name)]
    if unlike:
        raise ValueError(f"{wishes.resume} is a run with another {', '.join(unlike)}: start from a like one")
    known = {}
    for task in tasks:
        if _runs_again(task, wishes):
            _take_folders(other.place(task.stage, task.scene, task.method) / "run", wishes, task)
        elif task.method:
            outcome = _outcome(other, task)
            if outcome is not None and outcome.ok:
                known[task] = _taken(other, wishes, task, outcome)
        _take_needed(other, wishes, task, stages)
    return known


def _runs_again(task: Task, wishes: Wishes) -> bool:
    if task.method.startswith(OURS):
        return not wishes.methods or task.method in wishes.methods
    return bool(task.method) and task.stage in OVER_OURS


def _wishes_of(folder: Path) -> Wishes:
    try:
        told = json.loads((folder / "wishes.json").read_text(encoding="utf-8"))
        return replace(Wishes.from_json(told), out=folder)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{folder} holds no run to start from (wishes.json): {error}") from None


def _outcome(other: Wishes, task: Task) -> Outcome | None:
    file = other.place(task.stage, task.scene) / OUTCOMES
    if not file.is_file():
        return None
    told = json.loads(file.read_text(encoding="utf-8")).get(task.method)
    return None if told is None else Outcome(**{**told, "place": Path(told["place"])})


def _taken(other: Wishes, wishes: Wishes, task: Task, outcome: Outcome) -> Outcome:
    place = wishes.place(task.stage, task.scene, task.method)
    shutil.copytree(other.place(task.stage, task.scene, task.method), place, dirs_exist_ok=True)
    return replace(outcome, place=place)


def _take_folders(run: Path, wishes: Wishes, task: Task) -> None:
    place = wishes.place(task.stage, task.scene, task.method) / "run"
    if (run / RUN_FILE).is_file():
        # Without it the library takes the folder for none of its own.
        place.mkdir(parents=True, exist_ok=True)
        shutil.copy2(run / RUN_FILE, place / RUN_FILE)
    for name in sorted(set(FOLDERS.values())):
        if (run / name).is_dir():
            shutil.copytree(run / name, place / name, dirs_exist_ok=True)


def _take_needed(other: Wishes, wishes: Wishes, task: Task, stages: Mapping[str, Stage]) -> None:
    """What the task starts from, where the stage that makes it is not asked for."""
    for stage, method in stages[task.stage].needs(task.method):
        place = other.place(stage, task.scene, method)
        if stage not in wishes.stages and place.is_dir():
            shutil.copytree(place, wishes.place(stage, task.scene, method), dirs_exist_ok=True)

"""Resume from an earlier run: reuse its references and still valid files of ours.

Own methods have names that begin with "ours". Only numbered folders of a library run are taken; the library
itself checks whether settings and code of a stage have changed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from thesisrecon.runtime._run import FOLDERS
from thesisrecon.runtime._run_folder import RUN_FILE
from validation.harness.records import Outcome, ReportOptions, Stage, Task
from validation.harness.worker import OUTCOMES, read_outcomes

OURS = "ours"
OVER_OURS = ("between", "boards", "surface", "views")
"""Stages whose references use our code and run again."""
ALIKE = ("quick", "gates_only", "seed", "side_px")
"""Options that affect the results of a task."""


def earlier_run(options: ReportOptions) -> ReportOptions | None:
    """Return the options of the run to start from, None if there is none to start from.

    Raises ``ValueError`` if the folder holds no run, or one with different options.
    """
    if not options.resume:
        return None
    other = _options_of(Path(options.resume))
    different = [name for name in ALIKE if getattr(other, name) != getattr(options, name)]
    moved = [s for s, folder in options.folders.items() if other.folders.get(s, folder) != folder]
    different += [f"folder of the scene {scene}" for scene in moved]
    if different:
        raise ValueError(
            f"{options.resume} is a run with another {', '.join(different)}: use a run with the same options"
        )
    return other


def take_over(
    other: ReportOptions, options: ReportOptions, tasks: Sequence[Task], stages: Mapping[str, Stage]
) -> dict[Task, Outcome]:
    """Return the outcomes of tasks that need not run again; their files are copied from the ``other`` run."""
    known = {}
    for task in tasks:
        if _runs_again(task, options):
            _take_folders(other.place(task.stage, task.scene, task.method) / "run", options, task)
        elif task.method:
            place = other.place(task.stage, task.scene)
            outcome = read_outcomes(place).get(task.method) if (place / OUTCOMES).is_file() else None
            if outcome is not None and outcome.ok:
                kept = options.place(task.stage, task.scene, task.method)
                shutil.copytree(other.place(task.stage, task.scene, task.method), kept, dirs_exist_ok=True)
                known[task] = replace(outcome, place=kept)
        _take_needed(other, options, task, stages)
    return known


def _runs_again(task: Task, options: ReportOptions) -> bool:
    if task.method.startswith(OURS):
        return not options.methods or task.method in options.methods
    return bool(task.method) and task.stage in OVER_OURS


def _options_of(folder: Path) -> ReportOptions:
    try:
        record = json.loads((folder / "options.json").read_text(encoding="utf-8"))
        return replace(ReportOptions.from_json(record), out=folder)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{folder} holds no run to start from (options.json): {error}") from None


def _take_folders(run: Path, options: ReportOptions, task: Task) -> None:
    place = options.place(task.stage, task.scene, task.method) / "run"
    if (run / RUN_FILE).is_file():
        # The library accepts only folders with this file.
        place.mkdir(parents=True, exist_ok=True)
        shutil.copy2(run / RUN_FILE, place / RUN_FILE)
    for name in sorted(set(FOLDERS.values())):
        if (run / name).is_dir():
            shutil.copytree(run / name, place / name, dirs_exist_ok=True)


def _take_needed(
    other: ReportOptions, options: ReportOptions, task: Task, stages: Mapping[str, Stage]
) -> None:
    """Copy the inputs of a task from stages that are not part of this run."""
    for stage, method in stages[task.stage].needs(task.method):
        place = other.place(stage, task.scene, method)
        if stage not in options.stages and place.is_dir():
            shutil.copytree(place, options.place(stage, task.scene, method), dirs_exist_ok=True)

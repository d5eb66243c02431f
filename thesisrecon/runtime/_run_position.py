"""Progress of an unfinished run, read from its folder, so that it also works for killed runs."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path

from thesisrecon.errors import counted
from thesisrecon.io._files import read_json
from thesisrecon.io._outputs import LOCK_FILE
from thesisrecon.runtime._run import FOLDERS
from thesisrecon.runtime._run_folder import MANIFEST_FILE, RUN_FILE, is_running, read_record

MIN_ITEMS = 3
"""Minimum number of items from which the remaining time is estimated."""


def run_position(folder: Path) -> str:
    """One sentence: running or interrupted, the stage, the items done, the time left; empty without a run."""
    content = read_json(folder / RUN_FILE)
    if not isinstance(content, dict):
        return ""
    stage, items, since = _latest_stage(folder)
    total = _total(folder, stage, len(content.get("images", ())))
    if not items:
        where = f"{stage} begins"
    elif 0 < total <= len(items):
        where = f"{stage} is done"
    else:
        where = (
            f"{stage}, {len(items)} of {total} done"
            if total
            else f"{stage}, {counted(len(items), 'item')} done"
        )
    if not is_running(folder):
        return f"interrupted: {where}; repeat the command to resume"
    left = _seconds_left(items, total, max(since, (folder / LOCK_FILE).stat().st_mtime))
    return f"running: {where}" + (f", about {_in_words(left)} left in this stage" if left else "")


def _latest_stage(folder: Path) -> tuple[str, list[float], float]:
    """The last stage that was written to, the times of its items, and when the one before it ended."""
    started = ended = (folder / RUN_FILE).stat().st_mtime
    found = ("images", list[float](), ended)
    for stage, name in FOLDERS.items():
        every = [path.stat().st_mtime for path in (folder / name).glob("*.npz")]
        # Older records belong to a replaced run and were not reused.
        times = sorted(when for when in every if when >= started)
        if times:
            found = (stage, times, ended)
            manifest = folder / name / MANIFEST_FILE
            ended = max(ended, manifest.stat().st_mtime if manifest.exists() else times[-1])
    return found


def _total(folder: Path, stage: str, images: int) -> int:
    """Number of items of a stage, 0 if it is not known."""
    if stage == "features":
        return images
    if stage == "matches":
        manifest = read_json(folder / FOLDERS["pairs"] / MANIFEST_FILE)
        keys = manifest.get("keys", {}) if isinstance(manifest, dict) else {}
        choice = read_record(folder / FOLDERS["pairs"] / "choice.npz", keys.get("choice", ""))
        return 0 if choice is None else len(choice.pairs)
    return 0


def _seconds_left(items: Sequence[float], total: int, since: float) -> float:
    """Remaining time at the rate of this run's items, without those of an earlier run; 0 if unknown."""
    new = [when for when in items if when > since]
    if len(new) < MIN_ITEMS or len(items) >= total:
        return 0.0
    rate = (time.time() - since) / len(new)
    return rate * (total - len(items))


def _in_words(seconds: float) -> str:
    minutes = math.ceil(seconds / 60.0)
    return (
        f"{math.ceil(seconds)} s"
        if seconds < 90.0
        else f"{minutes} min"
        if minutes < 90
        else f"{minutes / 60:.1f} h"
    )

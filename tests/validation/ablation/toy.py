"""Tasks and variants that take no time, for the tests of studies."""

import errno
import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from thesisrecon.errors import StageFailure, UsageError
from validation.ablation.study import Measure, Task


@dataclass(frozen=True)
class Darts(Task):
    """A draw about ``aim``, and a mark in ``log`` whenever one is made.

    ``refuses`` and ``empty`` are scenes where nothing, or no number, is found, and ``full`` is one without
    room, until there is a file ``LOG.room``.
    """

    aim: float = 0.0
    spread: float = 1.0
    pause_s: float = 0.0
    log: str = ""

    sample = "draws"
    measures: ClassVar[Sequence[Measure]] = (
        Measure("miss", "cm", "less", False, "where the dart went"),
        Measure("score", "", "more", False, "its points"),
    )

    def check(self, scene):
        if scene == "nowhere":
            raise UsageError("there is no scene 'nowhere'")

    def run(self, config, scene, seed, place):
        mark(self.log, f"row {scene} {seed} {self.aim:g}")
        time.sleep(self.pause_s)
        if scene == "refuses":
            raise StageFailure("no board", "nothing hangs there", "hang one up")
        if scene == "breaks":
            raise KeyError("board")
        if scene == "full" and not Path(f"{self.log}.room").exists():
            raise OSError(errno.ENOSPC, "No space left on device", "throws.txt")
        rng = np.random.default_rng((seed, len(scene)))
        threshold = getattr(config.epipolar, "threshold_px", 1.0)
        # An effect that is the same in every draw is no sample.
        miss = self.aim * (1.0 + 0.05 * np.sin(seed)) + self.spread * float(rng.normal()) + threshold
        return {"miss": float("nan") if scene == "empty" else miss, "score": -miss}


@dataclass(frozen=True)
class Steps(Task):
    """Two steps that several rows may share, ``miss`` the length of what they left behind."""

    log: str = ""

    measures: ClassVar[Sequence[Measure]] = (Measure("miss"),)

    def steps(self, config, scene, seed):
        first = f"first-{scene}-{config.images.max_size_px}"
        return [("first", first), ("second", f"second-{first}-{seed}-{config.epipolar}".replace(" ", ""))]

    def prepare(self, config, scene, seed, place, *, step):
        for name, key in self.steps(config, scene, seed):
            kept = place.shared / f"{hashlib.sha256(key.encode()).hexdigest()[:16]}.txt"
            if not kept.is_file():
                mark(self.log, name)
                kept.write_text(name, encoding="utf-8")
            if name == step:
                return

    def run(self, config, scene, seed, place):
        self.prepare(config, scene, seed, place, step="second")
        return {"miss": float(seed)}


def mark(log, word):
    """Add a line to the log; short lines are written atomically."""
    if log:
        with Path(log).open("a", encoding="utf-8") as file:
            file.write(f"{word}\n")


def marks(log):
    return log.read_text(encoding="utf-8").splitlines() if log.is_file() else []


def area(config, scene, seed):
    """A task as a plain function."""
    return {"size": float(config.images.max_size_px + seed), "scene_length": float(len(scene))}

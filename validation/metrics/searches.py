"""Traces of robust searches: the best model so far, by samples and by time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

from thesisrecon.arrays import F64
from thesisrecon.optimize.ransac import WATCH


class Step(NamedTuple):
    """A model that was the best of its search after ``samples`` of all searches and ``seconds``: its cost
    (mean of truncated squared residuals over the threshold; 1 - share of inliers where inliers are counted),
    its share of inliers, and itself in the frame of the search.
    """

    samples: int
    seconds: float
    cost: float
    share: float
    model: F64


@dataclass
class Trace:
    """The steps of all searches in a :func:`traced` block, in order; samples of local searches count too."""

    steps: list[Step] = field(default_factory=list)
    samples: int = 0
    started: float = field(default_factory=time.perf_counter)

    def after(self, samples: float, seconds: float = float("inf")) -> Step | None:
        """The step of least cost within so many samples and seconds, the last of several; None before any."""
        known = [s for s in self.steps if s.samples <= samples and s.seconds <= seconds]
        return min(reversed(known), key=lambda step: step.cost, default=None)

    def _watch(self, samples: int, cost: float, share: float, model: F64, ends: bool) -> None:
        if not ends and model.any():
            seconds = time.perf_counter() - self.started
            self.steps.append(Step(self.samples + samples, seconds, cost, share, model))
        self.samples += samples if ends else 0


@contextmanager
def traced() -> Iterator[Trace]:
    """Record every better model of every robust estimator of the library that runs in the block."""
    trace = Trace()
    token = WATCH.set(trace._watch)
    try:
        yield trace
    finally:
        WATCH.reset(token)

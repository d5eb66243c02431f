"""From the certain core to all photographs: postponed cameras join, all tracks are triangulated, and a camera
that the rest contradicts is found again or refused."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import K1, WIDTH, MetricModel, explained_shares, retriangulate
from thesisrecon.metric.resection import add_missing_cameras
from thesisrecon.types import B8

# Lenses are freed early: a camera taken for a pinhole is fitted to its distortion, and its gate then lets
# wrong points in.
BEFORE_LENS = np.arange(WIDTH) <= K1
MOST_ROUNDS = 6
SETTLED = 0.003
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Completion:
    """Parameters of the rounds: gates in sigmas, early and late; ``min_angle`` rad; ``min_points`` that a
    joining camera sees."""

    gates: tuple[float, float]
    min_angle: float
    min_points: int

    def run(
        self, model: MetricModel, adjustment: Adjustment, rng: np.random.Generator
    ) -> tuple[MetricModel, dict[int, str]]:
        """The completed model and the reason of every view that did not join."""
        model, refused = self._grow(model, adjustment, rng, np.ones(len(model.registered), dtype=bool))
        suspects = model.registered & (explained_shares(model) < LEAST_SHARE)
        if suspects.any() and (model.registered & ~suspects).sum() >= 3:
            model, refused = self._seek_again(model, adjustment, rng, suspects)
        return model, refused

    def _grow(
        self, model: MetricModel, adjustment: Adjustment, rng: np.random.Generator, allowed: B8
    ) -> tuple[MetricModel, dict[int, str]]:
        """Rounds of triangulation, resection of ``allowed`` views and adjustment until what is explained
        stops growing."""
        early, late = self.gates
        model = retriangulate(model, sigmas=early, min_angle=self.min_angle)
        refused: dict[int, str] = {}
        share = 0.0
        for n in range(MOST_ROUNDS):
            before = int(model.registered.sum())
            model, refused = add_missing_cameras(
                model, sigmas=early, min_points=self.min_points, rng=rng, allowed=allowed
            )
            joined = int(model.registered.sum()) > before
            if joined:
                model = retriangulate(model, sigmas=early, min_angle=self.min_angle)
            model = adjustment.run(model, free=BEFORE_LENS, iterations=6)[0]
            # What fitted a wrong model comes back under the right one only if the gate is wide meanwhile.
            model = retriangulate(model, sigmas=early if n == 0 else late, min_angle=self.min_angle)
            now = float(model.ok.mean())
            if not joined and n > 0 and now - share < SETTLED:
                break
            share = now
        return model, refused

    def _seek_again(
        self, model: MetricModel, adjustment: Adjustment, rng: np.random.Generator, suspects: B8
    ) -> tuple[MetricModel, dict[int, str]]:
        """Views that explain less than half of their observations are taken out, the rest settles without
        them, and they may join where they then fit."""
        none = np.zeros(len(suspects), dtype=bool)
        model = replace(
            model, registered=model.registered & ~suspects, ok=model.ok & ~suspects[model.tracks.view_index]
        )
        model, _ = self._grow(model, adjustment, rng, none)
        model, refused = self._grow(model, adjustment, rng, ~none)
        share = explained_shares(model)
        wrong = model.registered & (share < LEAST_SHARE)
        if wrong.any():
            for view in np.flatnonzero(wrong):
                refused[int(view)] = f"only {share[view]:.0%} of its matches agree with the other photographs"
            model = replace(model, registered=model.registered & ~wrong)
            model = retriangulate(model, sigmas=self.gates[1], min_angle=self.min_angle)
        return model, refused

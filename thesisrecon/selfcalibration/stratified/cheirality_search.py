"""Chapter 7, stratified: cheirality bounds the plane at infinity, a search in the bounds finds it (Hartley).

R. Hartley, E. Hayman, L. de Agapito, I. Reid, "Camera calibration and the search for infinity", ICCV 1999.
Each plane of a grid gives infinite homographies, these give the image of the absolute conic linearly, and the
planes whose linear equations have a solution, and one alone, are the candidates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.selfcalibration.stratified.descent import descend
from thesisrecon.selfcalibration.stratified.image_conic import (
    ConicKnowledge,
    ConicScan,
    infinite_homographies,
    scan_conics,
    square_knowledge,
)
from thesisrecon.selfcalibration.stratified.region import PlaneRegion, Polytope, distinct_planes
from thesisrecon.selfcalibration.stratified.scene import PlaneCandidates, ProjectiveScene
from thesisrecon.types import Reconstruction

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class CheiralitySearch:
    """Grid search for the plane at infinity inside the cheirality bounds.

    ``steps`` per axis of the box; ``keep`` local minima at most; ``descent`` steps that follow each of
    them to where it ends, 0 for the grid alone; ``max_points`` in the linear programs.
    """

    steps: int = 16
    keep: int = 10
    descent: int = 15
    max_points: int = 2000

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """Candidates, the best first; ``StageFailure`` where the inequalities leave no plane with a conic."""
        planes, _, scores = self._search(scene.frame, scene.reconstruction, scene.knowledge, rng)
        if not len(planes):
            raise StageFailure(
                "Hartley's search found no plane at infinity",
                "no plane leaves all points and cameras on one side with a real image of the absolute conic",
                "use the default preset, which does not depend on every single point being right",
            )
        return PlaneCandidates(planes, scores)

    def search(
        self, frame: ReferenceFrame, reconstruction: Reconstruction, rng: np.random.Generator
    ) -> tuple[F64, F64]:
        """Planes p (B, 3) and reference focals (B,) for square pixels, best first; possibly none."""
        planes, focals, _ = self._search(frame, reconstruction, square_knowledge(frame), rng)
        return planes, focals

    def _search(
        self,
        frame: ReferenceFrame,
        reconstruction: Reconstruction,
        knowledge: ConicKnowledge,
        rng: np.random.Generator,
    ) -> tuple[F64, F64, F64]:
        region = PlaneRegion.of(frame, reconstruction, max_points=self.max_points, rng=rng)
        parts = [self._minima(frame, knowledge, polytope) for polytope in region.polytopes]
        if not parts:
            return np.zeros((0, 3)), np.zeros(0), np.zeros(0)
        planes, f2, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
        kept = distinct_planes(planes, scores)[: self.keep]
        return planes[kept], np.sqrt(f2[kept]), scores[kept]

    def _minima(
        self, frame: ReferenceFrame, knowledge: ConicKnowledge, polytope: Polytope
    ) -> tuple[F64, F64, F64]:
        """Local minima of the score over the grid, each followed to where it ends."""

        def scan(v: F64) -> ConicScan:
            found = scan_conics(infinite_homographies(frame, polytope.reference_planes(v)), knowledge)
            outside = ~polytope.contains(v)
            return ConicScan(found.f2, np.where(outside[:, None], np.nan, found.residuals))

        axes = [np.linspace(low, high, self.steps + 2)[1:-1] for low, high in polytope.box]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        best = local_minima(scan(grid.reshape(-1, 3)).score.reshape(grid.shape[:3]))[: self.keep]
        v = grid.reshape(-1, 3)[best]
        if len(v):
            # The score is flat along valleys that no finer grid along the axes would follow.
            v = descend(lambda x: scan(x).residuals, v, iterations=self.descent)[0]
        found = scan(v)
        return polytope.reference_planes(v), found.f2, found.score


def local_minima(score: F64) -> NDArray[np.int64]:
    """Flat indices of cells of a grid (S, S, S) not worse than their 6 neighbours, best first."""
    padded = np.pad(score, 1, constant_values=np.inf)
    core = padded[1:-1, 1:-1, 1:-1]
    minimum = np.isfinite(core)
    for axis in range(3):
        for shift in (-1, 1):
            minimum &= core <= np.roll(padded, shift, axis=axis)[1:-1, 1:-1, 1:-1]
    flat = np.flatnonzero(minimum.ravel())
    return flat[np.argsort(score.ravel()[flat], kind="stable")]

"""Hartley's search for the plane at infinity within the cheirality bounds (HZ 21; IJCV 26(1), 1998)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.records import Reconstruction
from thesisrecon.selfcalibration._frame import (
    ConicConstraints,
    PlaneCandidates,
    ProjectiveScene,
    ReferenceFrame,
    infinite_homographies,
)
from thesisrecon.selfcalibration._image_conic import solve_conic_batch
from thesisrecon.selfcalibration._refinement import minimize_batch
from thesisrecon.selfcalibration.plane_bounds import CheiralityRegion, Polytope, distinct_planes


@dataclass(frozen=True)
class CheiralitySearch:
    """Grid search for the plane at infinity (R. Hartley, E. Hayman, L. de Agapito, I. Reid, ICCV 1999).

    Each plane of the grid gives infinite homographies and, linearly, the image of the absolute conic; planes
    whose equations have exactly one solution are the candidates.
    """

    # Grid steps per axis of the bounding box.
    steps = 16
    # Maximum number of local minima.
    max_candidates = 10
    # Descent steps from each of them.
    refine_iterations = 15
    # Maximum number of points in the linear programs.
    max_points = 2000

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """Candidate planes at infinity, best first; ``StageFailure`` if there is none."""
        planes, _ = self.search(scene.frame, scene.reconstruction, scene.constraints, rng)
        if not len(planes):
            raise StageFailure(
                "the cheirality search found no plane at infinity",
                "no plane keeps points and cameras on one side and gives a real image of the absolute conic",
                "use the default preset, which tolerates wrong points",
            )
        return PlaneCandidates(planes)

    def search(
        self, frame: ReferenceFrame, reconstruction: Reconstruction, constraints: ConicConstraints,
        rng: np.random.Generator,
    ) -> tuple[F64, F64]:  # fmt: skip
        """Planes p (B, 3), best first, and unit-free focal lengths (B,) of the reference camera."""
        region = CheiralityRegion.of(frame, reconstruction, max_points=self.max_points, rng=rng)
        parts = [self._minima(frame, constraints, polytope) for polytope in region.polytopes]
        if not parts:
            return np.zeros((0, 3)), np.zeros(0)
        planes, f2, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
        kept = distinct_planes(planes, scores)[: self.max_candidates]
        return planes[kept], np.sqrt(f2[kept])

    def _minima(
        self, frame: ReferenceFrame, constraints: ConicConstraints, polytope: Polytope
    ) -> tuple[F64, F64, F64]:
        """Return planes, squared focal lengths and scores of the refined local minima of the grid."""

        def scan(v: F64) -> tuple[F64, F64]:
            H = infinite_homographies(frame, polytope.reference_planes(v))
            f2, residuals = solve_conic_batch(H, constraints)
            return f2, np.where(polytope.contains(v)[:, None], residuals, np.nan)

        def score(residuals: F64) -> F64:
            return np.asarray(np.nan_to_num(np.linalg.norm(residuals, axis=1), nan=np.inf))

        axes = [np.linspace(low, high, self.steps + 2)[1:-1] for low, high in polytope.box]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        scores = score(scan(grid.reshape(-1, 3))[1]).reshape(grid.shape[:3])
        best = _local_minima(scores)[: self.max_candidates]
        v = grid.reshape(-1, 3)[best]
        if len(v):
            # The score is flat along valleys that are not aligned with the axes of the grid.
            v = minimize_batch(lambda x: scan(x)[1], v, iterations=self.refine_iterations)[0]
        f2, residuals = scan(v)
        return polytope.reference_planes(v), f2, score(residuals)


def _local_minima(score: F64) -> I64:
    """Return flat indices of grid cells (S, S, S) not worse than their 6 neighbours, best first."""
    padded = np.pad(score, 1, constant_values=np.inf)
    core = padded[1:-1, 1:-1, 1:-1]
    minimum = np.isfinite(core)
    for axis in range(3):
        for shift in (-1, 1):
            minimum &= core <= np.roll(padded, shift, axis=axis)[1:-1, 1:-1, 1:-1]
    flat = np.flatnonzero(minimum.ravel())
    return flat[np.argsort(score.ravel()[flat], kind="stable")]

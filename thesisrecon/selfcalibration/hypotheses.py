"""Chapter 7 combined: hypotheses of all methods, one refinement, cheirality.

Each closed form fails on some image sets. All of them only propose hypotheses; one robust criterion over all
cameras, cheirality and later the metric bundle adjustment decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.records import Reconstruction, SelfCalibration
from thesisrecon.selfcalibration.candidates import (
    Candidate,
    as_stage_failure,
    candidates_from_parameters,
    distinct_candidates,
    group_focals_from_planes,
    select_candidate,
)
from thesisrecon.selfcalibration.cheirality import CheiralitySearch
from thesisrecon.selfcalibration.focal_scan import focal_pairs, plane_from_focals
from thesisrecon.selfcalibration.frame import ReferenceFrame, normalized_frame
from thesisrecon.selfcalibration.quadric import minimize_quadric, quadric_hypotheses
from thesisrecon.selfcalibration.refinement import RotationCriterion, refine_hypotheses
from thesisrecon.selfcalibration.unknowns import SolverUnknowns, solver_unknowns

# Standard deviation of principal point (long sides), aspect or skew beyond which estimating focal lengths
# alone is insufficient.
_MAX_OFFSET_STD = 0.02


@dataclass(frozen=True)
class HypothesesAndRefinement:
    """Self-calibration by hypotheses of every method, one refinement and cheirality.

    The refinement estimates focal lengths. If the prior leaves more undetermined than a small offset of the
    principal point, the best candidates are refined by the nonlinear quadric over all unknown intrinsics.

    Parameters
    ----------
    focal_range : (float, float)
        Scanned focal lengths in long sides.
    focal_steps : int
        Number of scanned focal lengths.
    camera_subsets : int
        Number of random camera subsets for the quadric.
    max_refined : int
        Number of hypotheses to refine.
    max_candidates : int
        Maximum number of candidates for bundle adjustment.
    max_full_refined : int
        Number of distinct candidates to refine over all unknown intrinsics.
    min_in_front_ratio : float
        Required share of observations with positive depth.
    criterion : RotationCriterion
        Criterion of the refinement.
    search : CheiralitySearch, optional
        Hartley's search; None to omit it.
    """

    focal_range: tuple[float, float] = (0.2, 40.0)
    focal_steps: int = 45
    camera_subsets: int = 6
    max_refined: int = 40
    max_candidates: int = 3
    max_full_refined: int = 8
    min_in_front_ratio: float = 0.95
    criterion: RotationCriterion = field(default_factory=RotationCriterion)
    search: CheiralitySearch | None = field(default_factory=CheiralitySearch)

    @as_stage_failure
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,
    ) -> SelfCalibration:
        """Upgrade a projective reconstruction.

        Parameters
        ----------
        reconstruction, prior, rng
            As in :meth:`thesisrecon.config.SelfCalibrator.calibrate`.

        Returns
        -------
        SelfCalibration
            The upgrade with its identifiability.

        Raises
        ------
        StageFailure
            Below three cameras, or if no candidate places the points in front of the cameras.
        """
        frame = normalized_frame(reconstruction, prior)
        planes, log_f = self._propose(frame, reconstruction, rng)
        cost = np.nan_to_num(self.criterion.cost(frame, planes, log_f), nan=np.inf)
        best = np.argsort(cost, kind="stable")[: self.max_refined]
        theta = np.concatenate([planes[best], log_f[best]], axis=1)
        theta, cost = refine_hypotheses(self.criterion, frame, theta)
        candidates = candidates_from_parameters(frame, theta, cost, "hypotheses and refinement")
        unknown = solver_unknowns(frame, prior)
        if unknown.max_nonfocal_std > _MAX_OFFSET_STD:
            candidates = self._with_all_intrinsics(frame, unknown, candidates)
        return select_candidate(
            frame,
            reconstruction,
            self.criterion,
            candidates,
            max_candidates=self.max_candidates,
            min_in_front_ratio=self.min_in_front_ratio,
        )

    def _with_all_intrinsics(
        self, frame: ReferenceFrame, unknown: SolverUnknowns, candidates: Sequence[Candidate]
    ) -> list[Candidate]:
        """Return the best distinct candidates, refined over all unknown intrinsics."""
        found: list[Candidate] = []
        for candidate in distinct_candidates(frame, candidates, self.max_full_refined):
            log_f = candidate.log_focals(frame)[frame.group]
            best = minimize_quadric(frame, unknown, candidate.plane, log_f, loss_scale=self.criterion.scale)
            found.append(
                Candidate(best.plane, best.K, best.cost, "hypotheses and nonlinear quadric", best.K_std)
            )
        return found

    def _propose(
        self, frame: ReferenceFrame, reconstruction: Reconstruction, rng: np.random.Generator
    ) -> tuple[F64, F64]:
        """Return planes (B, 3) and log focal lengths (B, G) of all methods."""
        focals = np.geomspace(*self.focal_range, self.focal_steps)
        found = [quadric_hypotheses(frame, focals)]
        others = np.delete(np.arange(len(frame.views)), frame.reference)
        for _ in range(self.camera_subsets if len(others) > 3 else 0):
            size = int(rng.integers(3, len(others)))
            chosen = np.sort(np.append(rng.choice(others, size, replace=False), frame.reference))
            found.append(quadric_hypotheses(frame.subset(chosen), focals[::4]))
        for other in others:
            f1, f2 = focal_pairs(focals, frame.group[other] == frame.group[frame.reference])
            found.append((plane_from_focals(frame, int(other), f1, f2), np.concatenate([f1, f1])))
        if self.search is not None:
            found.append(self.search.search(frame, reconstruction, rng))
        p = np.concatenate([part[0] for part in found])
        f = np.concatenate([part[1] for part in found])
        good = np.isfinite(p).all(axis=1) & np.isfinite(f)
        return p[good], group_focals_from_planes(frame, p[good], f[good])

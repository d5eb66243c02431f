"""The methods of chapter 7 combined: each closed form fails on some image sets, so all propose hypotheses."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.records import IntrinsicsPrior, Reconstruction, SelfCalibration
from thesisrecon.selfcalibration._candidates import (
    as_stage_failure,
    candidates_from_parameters,
    distinct_candidates,
    group_focals_from_planes,
    group_log_focals,
    plane_from_focals,
    select_candidate,
)
from thesisrecon.selfcalibration._frame import (
    ReferenceFrame,
    normalized_frame,
    solver_unknowns,
    square_pixel_constraints,
)
from thesisrecon.selfcalibration._refinement import RotationCriterion, refine_hypotheses
from thesisrecon.selfcalibration.cheirality import CheiralitySearch
from thesisrecon.selfcalibration.quadric import minimize_quadric, quadric_hypotheses

# Standard deviation of principal point (long sides), aspect or skew beyond which estimating focal lengths
# alone is insufficient.
_MAX_OFFSET_STD = 0.02


@dataclass(frozen=True)
class HypothesesAndRefinement:
    """Self-calibration by hypotheses of all methods, a common refinement and a cheirality test.

    The refinement estimates focal lengths of cameras without skew. If the prior has a skew, or leaves more
    undetermined than a small offset of the principal point, the best candidates are refined by the nonlinear
    quadric over all unknown intrinsics.

    Parameters
    ----------
    focal_range : (float, float)
        Range of the scanned focal lengths in long sides.
    search : CheiralitySearch, optional
        Hartley's search; None to omit it.
    """

    focal_range: tuple[float, float] = (0.2, 40.0)
    search: CheiralitySearch | None = field(default_factory=CheiralitySearch)

    focal_steps = 45  # number of scanned focal lengths
    camera_subsets = 6  # number of random camera subsets for the quadric
    # Numbers of hypotheses to refine, and of distinct candidates to refine over all unknown intrinsics.
    max_refined, max_full_refined = 40, 8
    max_candidates = 3  # maximum number of candidates for bundle adjustment
    # Required share of observations with positive depth.
    min_in_front_ratio = 0.95
    criterion = RotationCriterion()

    @as_stage_failure
    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
    ) -> SelfCalibration:
        """See `thesisrecon.config.SelfCalibrator.calibrate`."""
        frame = normalized_frame(reconstruction, prior)
        planes, log_f = self._propose(frame, reconstruction, rng)
        cost = np.nan_to_num(self.criterion.cost(frame, planes, log_f), nan=np.inf)
        best = np.argsort(cost, kind="stable")[: self.max_refined]
        theta = np.concatenate([planes[best], log_f[best]], axis=1)
        theta, cost = refine_hypotheses(self.criterion, frame, theta)
        candidates = candidates_from_parameters(frame, theta, cost, "hypotheses and refinement")
        unknown = solver_unknowns(frame, prior)
        others = np.setdiff1d(np.arange(len(unknown.std)), unknown.focals)
        if unknown.std[others].max(initial=0.0) > _MAX_OFFSET_STD or unknown.known[:, 2].any():
            candidates = [
                minimize_quadric(
                    frame, unknown, candidate.plane, group_log_focals(frame, candidate.K)[frame.group],
                    method="hypotheses and nonlinear quadric", loss_scale=self.criterion.scale,
                )
                for candidate in distinct_candidates(frame, candidates, self.max_full_refined)
            ]  # fmt: skip
        return select_candidate(
            frame, reconstruction, self.criterion, candidates,
            max_candidates=self.max_candidates, min_in_front_ratio=self.min_in_front_ratio,
        )  # fmt: skip

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
            f1, f2 = _focal_pairs(focals, frame.group[other] == frame.group[frame.reference])
            found.append((plane_from_focals(frame, int(other), f1, f2), np.concatenate([f1, f1])))
        if self.search is not None:
            found.append(self.search.search(frame, reconstruction, square_pixel_constraints(frame), rng))
        p = np.concatenate([part[0] for part in found])
        f = np.concatenate([part[1] for part in found])
        good = np.isfinite(p).all(axis=1) & np.isfinite(f)
        return p[good], group_focals_from_planes(frame, p[good], f[good])


def _focal_pairs(focals: F64, same_camera: bool) -> tuple[F64, F64]:
    """Return pairs to scan: equal focal lengths of one camera, else all pairs of every other value."""
    if same_camera:
        return focals, focals
    first, second = np.meshgrid(focals[::2], focals[::2])
    return first.ravel(), second.ravel()

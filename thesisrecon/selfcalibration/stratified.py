"""Chapter 7, the stratified approach: first the plane at infinity, then the calibration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.records import Image, Reconstruction, SelfCalibration
from thesisrecon.selfcalibration.candidates import (
    Candidate,
    as_stage_failure,
    require_cameras,
    select_candidate,
)
from thesisrecon.selfcalibration.cheirality import CheiralitySearch, PlaneCandidates, ProjectiveScene
from thesisrecon.selfcalibration.frame import ReferenceFrame, normalized_frame
from thesisrecon.selfcalibration.hartley import CalibrationProblem, FixedPlaneQuadric, LinearAbsoluteConic
from thesisrecon.selfcalibration.modulus import ModulusConstraint
from thesisrecon.selfcalibration.parallel_lines import ParallelLines
from thesisrecon.selfcalibration.quadric import dual_image_residuals, minimize_quadric
from thesisrecon.selfcalibration.refinement import RotationCriterion
from thesisrecon.selfcalibration.unknowns import SolverUnknowns, conic_constraints, solver_unknowns

REFINED = 3
"""The best answers in closed form that are worth refining."""


@dataclass(frozen=True)
class Stratified:
    """Self-calibration in two steps, as the thesis has it: a plane at infinity, and K given the plane.

    ``plane`` is the way to the plane and ``calibration`` the way from it to K; ``refined`` follows every
    answer with the nonlinear criterion over plane and intrinsics together. ``kept`` answers at most are
    handed on, with at least the share ``min_positive`` of the points in front of the cameras.
    """

    plane: CheiralitySearch | ModulusConstraint | ParallelLines = field(default_factory=CheiralitySearch)
    calibration: LinearAbsoluteConic | FixedPlaneQuadric = field(default_factory=LinearAbsoluteConic)
    refine: bool = True
    max_candidates: int = 1
    min_in_front_ratio: float = 0.5
    criterion: RotationCriterion = field(default_factory=RotationCriterion)

    def with_images(self, photographs: Iterable[Image]) -> Stratified:
        """The same where the way to the plane looks at the photographs, one per view."""
        if not isinstance(self.plane, ParallelLines):
            return self
        return replace(self, plane=self.plane.with_images(photographs))

    @as_stage_failure
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,
    ) -> SelfCalibration:
        """Upgrade a projective reconstruction of at least three cameras.

        ``StageFailure`` where no plane is found, and where no plane that was found has a calibration; the
        reason is that of the best plane.
        """
        scene = projective_scene(reconstruction, prior)
        found = self.plane.locate(scene, rng)
        unknown = solver_unknowns(scene.frame, prior)
        answers = self._answers(scene, found, unknown)
        return select_candidate(
            scene.frame, reconstruction, self.criterion, answers,
            max_candidates=self.max_candidates, min_in_front_ratio=self.min_in_front_ratio,
        )  # fmt: skip

    def locate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
    ) -> F64:
        """The best plane at infinity alone, unit (4,) in the projective frame; ``StageFailure`` as above."""
        scene = projective_scene(reconstruction, prior)
        p = self.plane.locate(scene, rng).planes[0]
        plane = np.append(p, 1.0) @ scene.frame.reference_from_projective
        return np.asarray(plane / np.linalg.norm(plane))

    def _answers(
        self, scene: ProjectiveScene, found: PlaneCandidates, unknown: SolverUnknowns
    ) -> list[Candidate]:
        strata = CalibrationProblem(scene.frame, scene.knowledge, unknown, found.orthogonal)
        answers: list[Candidate] = []
        refusals: list[StageFailure] = []
        for plane in found.planes:
            try:
                K = self.calibration.calibrations(strata, plane)
            except StageFailure as refusal:
                refusals.append(refusal)
                continue
            answers.append(self._answer(scene.frame, plane, K))
        if not answers:
            raise refusals[0]
        if not self.refine:
            return answers
        best = sorted(answers, key=lambda answer: answer.cost)[: max(self.max_candidates, REFINED)]
        return [refined_answer(scene.frame, unknown, answer) for answer in best]

    def _answer(self, frame: ReferenceFrame, plane: F64, K: F64) -> Candidate:
        r = dual_image_residuals(frame.A, frame.a, K[None], K[None, frame.reference], plane[None])
        name = f"{type(self.plane).__name__}, {type(self.calibration).__name__}"
        return Candidate(plane, K, float(np.mean(np.sum(r**2, axis=-1))), name)


def refined_answer(frame: ReferenceFrame, unknown: SolverUnknowns, answer: Candidate) -> Candidate:
    """The nearest minimum of the nonlinear criterion over plane and intrinsics."""
    log_f = 0.5 * np.log(answer.K[:, 0, 0] * answer.K[:, 1, 1])
    least = minimize_quadric(frame, unknown, answer.plane, log_f)
    return Candidate(least.plane, least.K, least.cost, f"{answer.method}, refined", least.K_std)


def projective_scene(reconstruction: Reconstruction, prior: IntrinsicsPrior) -> ProjectiveScene:
    """The scene as the ways to the plane see it; ``StageFailure`` below three registered cameras."""
    require_cameras(reconstruction)
    frame = normalized_frame(reconstruction, prior)
    return ProjectiveScene(reconstruction, frame, conic_constraints(frame, prior))

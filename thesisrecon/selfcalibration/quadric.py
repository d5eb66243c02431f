"""Self-calibration by the absolute dual quadric, linear and nonlinear (section 7.3, direct; HZ 19.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.records import IntrinsicsPrior, Reconstruction, SelfCalibration
from thesisrecon.selfcalibration._candidates import (
    as_stage_failure,
    candidates_from_parameters,
    group_focals_from_planes,
    select_candidate,
)
from thesisrecon.selfcalibration._dual_quadric import minimize_quadric, quadric_hypotheses
from thesisrecon.selfcalibration._frame import normalized_frame, solver_unknowns
from thesisrecon.selfcalibration._refinement import RotationCriterion


@dataclass(frozen=True)
class LinearQuadric:
    """Self-calibration by the linear quadric for one normalizing focal length, without refinement.

    The equations assume focal lengths near this one and bias the result even without noise, by tens of
    percent for other lenses: the focal lengths have no standard deviation (NaN).

    Parameters
    ----------
    normalising_focal : float
        In long sides; 1.67 is the 60 mm lens of Pollefeys et al. on 36 mm film.

    Examples
    --------
    ``projective`` as in the example of `thesisrecon.self_calibrate`:

    >>> from thesisrecon import PipelineConfig, self_calibrate
    >>> from thesisrecon.selfcalibration.quadric import LinearQuadric
    >>> config = PipelineConfig(selfcalibration=LinearQuadric(normalising_focal=1.25))
    >>> round(self_calibrate(projective, config=config).K[0, 0, 0])
    800
    """

    normalising_focal: float = 1.67

    # Criterion that orders the candidates.
    criterion = RotationCriterion()

    @as_stage_failure
    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator  # noqa: ARG002
    ) -> SelfCalibration:  # fmt: skip
        """See `thesisrecon.config.SelfCalibrator.calibrate`."""
        frame = normalized_frame(reconstruction, prior)
        p, f = quadric_hypotheses(frame, np.array([self.normalising_focal]))
        log_f = group_focals_from_planes(frame, p, f)
        cost = self.criterion.cost(frame, p, log_f)
        theta = np.concatenate([p, log_f], axis=1)
        candidates = candidates_from_parameters(frame, theta, cost, "linear quadric")
        found = select_candidate(frame, reconstruction, self.criterion, candidates)
        # The error is a bias, not noise: it has no standard deviation.
        K_std = found.K_std.copy()
        K_std[frame.views[:, None], (0, 1), (0, 1)] = np.nan
        return replace(found, K_std=K_std)


@dataclass(frozen=True)
class NonlinearQuadric:
    """Self-calibration by the nonlinear quadric, started from scanned linear quadrics.

    Parameters
    ----------
    focal_range : (float, float)
        Range of the normalizing focal lengths of the linear quadrics, in long sides.
    """

    focal_range: tuple[float, float] = (0.2, 40.0)

    # Number of these focal lengths.
    focal_steps = 45
    # Number of hypotheses to refine over all unknown intrinsics.
    starts = 5
    # Residual beyond which an entry counts linearly (Huber).
    loss_scale = 0.05
    # Criterion that selects the starts.
    criterion = RotationCriterion()

    @as_stage_failure
    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator  # noqa: ARG002
    ) -> SelfCalibration:  # fmt: skip
        """See `thesisrecon.config.SelfCalibrator.calibrate`."""
        frame = normalized_frame(reconstruction, prior)
        unknown = solver_unknowns(frame, prior)
        p, f = quadric_hypotheses(frame, np.geomspace(*self.focal_range, self.focal_steps))
        log_f = group_focals_from_planes(frame, p, f)
        cost = self.criterion.cost(frame, p, log_f)
        best = np.argsort(cost, kind="stable")[: self.starts]
        candidates = [
            minimize_quadric(
                frame, unknown, p[b], log_f[b][frame.group],
                method="nonlinear quadric", loss_scale=self.loss_scale,
            )
            for b in best[np.isfinite(cost[best])]
        ]  # fmt: skip
        return select_candidate(frame, reconstruction, self.criterion, candidates)

"""Section 7.3, direct: the absolute quadric by a nonlinear criterion over all unknown intrinsics.

M. Pollefeys, R. Koch, L. Van Gool, "Self-calibration and metric reconstruction in spite of varying and
unknown internal camera parameters", IJCV 32(1), 1999: min sum |K_i K_i' / |K_i K_i'| - P_i Q P_i' / |P_i Q
P_i'||^2 over the plane at infinity and whatever of the intrinsics is unknown. Q is parametrised by the plane
and the reference camera's K, so that its rank is 3 and it is positive by construction.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thesisrecon.optimize.levenberg_marquardt import minimize_residuals
from thesisrecon.selfcalibration.conclusion import (
    Answer,
    conclude,
    focals_of_groups,
    guarded,
    require_cameras,
)
from thesisrecon.selfcalibration.frame import ReferenceFrame, assumed_frame
from thesisrecon.selfcalibration.intrinsics import UnknownIntrinsics, unknown_intrinsics
from thesisrecon.selfcalibration.quadric import quadric_hypotheses
from thesisrecon.selfcalibration.refinement import RotationCriterion
from thesisrecon.types import Assumptions, Reconstruction, SelfCalibration

F64 = NDArray[np.float64]

_UPPER = np.triu_indices(3)
_ENTRY_WEIGHT = np.where(_UPPER[0] == _UPPER[1], 1.0, np.sqrt(2.0))
_LEAST_NOISE = 1e-9
PASSES = 6
"""Estimates of the noise at the most."""


@dataclass(frozen=True)
class QuadricMinimum:
    """``plane`` (3,) p of the plane at infinity (p, 1), ``unknowns`` (D,), unit-free ``K`` (R, 3, 3), the
    ``cost`` (mean squared residual of a camera), the ``noise`` of one residual entry, ``covariance``
    (3 + D, 3 + D) and what it means for the entries of K, ``K_std`` (R, 3, 3)."""

    plane: F64
    unknowns: F64
    K: F64
    cost: float
    noise: float
    covariance: F64
    K_std: F64


def dual_image_residuals(A: F64, a: F64, K: F64, K_reference: F64, plane: F64) -> F64:
    """Entries (B, R, 6) of K K'/|K K'| - P Q P'/|P Q P'|, those off the diagonal times sqrt 2.

    Cameras P = [A | a], A (R, 3, 3), a (R, 3), in a frame whose reference camera is [I | 0]; calibrations K
    (B, R, 3, 3), K_reference (B, 3, 3), planes (B, 3). The squared sum over a camera is the squared Frobenius
    norm.
    """
    C = (A[None] - a[None, :, :, None] * plane[:, None, None, :]) @ K_reference[:, None]
    difference = _unit(K @ K.swapaxes(-1, -2)) - _unit(C @ C.swapaxes(-1, -2))
    return np.asarray(difference[..., _UPPER[0], _UPPER[1]] * _ENTRY_WEIGHT)


def _unit(conic: F64) -> F64:
    norm = np.sqrt(np.sum(conic**2, axis=(-2, -1), keepdims=True))
    return np.asarray(conic / np.maximum(norm, 1e-300))


def minimize_quadric(
    frame: ReferenceFrame, unknown: UnknownIntrinsics, plane: F64, log_f: F64, *, loss_scale: float = 0.05
) -> QuadricMinimum:
    """The nearest minimum of the criterion from a plane at infinity (3,) and log focals (R,).

    Huber's loss turns at ``loss_scale``, so that a camera that bad matches made wrong does not pull the rest.
    The priors weigh against the residuals by their noise, which is estimated from the residuals themselves: a
    first pass supposes 1 %, each further one takes what the last one found until that no longer falls.
    """
    # Both sides also come together where all focals go to 0, which must cost more than the noise.
    unknown = unknown.with_weak_focals()
    theta, noise = np.concatenate([plane, unknown.start(log_f[None])[0]]), 0.01
    for _ in range(PASSES):
        supposed = noise
        theta, noise, covariance, cost = _minimize(frame, unknown, theta, noise, loss_scale)
        if noise > 0.7 * supposed:
            break
    K = unknown.calibrations(theta[None, 3:])[0]
    K_std = unknown.calibration_std(theta[3:], covariance[3:, 3:])
    return QuadricMinimum(theta[:3], theta[3:], K, cost, noise, covariance, K_std)


def _minimize(
    frame: ReferenceFrame, unknown: UnknownIntrinsics, theta: F64, noise: float, loss_scale: float
) -> tuple[F64, float, F64, float]:
    def residuals(batch: F64) -> F64:
        K = unknown.calibrations(batch[:, 3:])
        data = dual_image_residuals(frame.A, frame.a, K, K[:, frame.reference], batch[:, :3])
        return np.concatenate(
            [data.reshape(len(batch), -1), noise * unknown.deviations(batch[:, 3:])], axis=1
        )

    def jacobian(x: F64) -> F64:
        steps = np.diag(1e-6 * (1.0 + np.abs(x)))
        return np.asarray(
            ((residuals(x + steps) - residuals(x - steps)) / (2.0 * steps.diagonal()[:, None])).T
        )

    found = minimize_residuals(
        lambda x: residuals(x[None])[0], theta, jacobian=jacobian, loss="huber", loss_scale=loss_scale,
        max_iterations=100, tolerance=1e-14,
    )  # fmt: skip
    data = found.residual[: 6 * len(frame.views)]
    # Five independent entries a camera but the reference, whose term vanishes.
    free = np.isinf(unknown.std).sum() + 3
    dof = max(5 * (len(frame.views) - 1) - int(free), 1)
    noise = max(float(np.sqrt(np.sum(data**2) / dof)), _LEAST_NOISE)
    scale = noise**2 * max(len(found.residual) - len(theta), 1) / max(2.0 * found.cost, 1e-300)
    return found.x, noise, found.covariance * scale, float(np.sum(data**2) / len(frame.views))


@dataclass(frozen=True)
class NonlinearQuadric:
    """The nonlinear quadric alone, started from the linear one.

    The linear quadric is scanned over ``focal_steps`` normalising focals in ``focal_range`` (long sides); the
    ``starts`` whose cameras are nearest to rotations are refined over all intrinsics that the assumptions
    leave unknown, and the least cost wins. ``loss_scale``: residual beyond which an entry counts linearly.
    """

    focal_range: tuple[float, float] = (0.2, 40.0)
    focal_steps: int = 45
    starts: int = 5
    loss_scale: float = 0.05
    criterion: RotationCriterion = field(default_factory=RotationCriterion)

    @guarded
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        assumed: Assumptions,
        rng: np.random.Generator,  # noqa: ARG002 - one signature for all methods
    ) -> SelfCalibration:
        """Upgrade by the quadric; ``StageFailure`` below three cameras and where no answer puts the scene in
        front of the cameras."""
        require_cameras(reconstruction)
        frame = assumed_frame(reconstruction, assumed)
        unknown = unknown_intrinsics(frame, assumed)
        p, f = quadric_hypotheses(frame, np.geomspace(*self.focal_range, self.focal_steps))
        log_f = focals_of_groups(frame, p, f)
        cost = self.criterion.cost(frame, p, log_f)
        best = np.argsort(cost, kind="stable")[: self.starts]
        answers = []
        for b in best[np.isfinite(cost[best])]:
            found = minimize_quadric(frame, unknown, p[b], log_f[b][frame.group], loss_scale=self.loss_scale)
            answers.append(Answer(found.plane, found.K, found.cost, "nonlinear quadric", found.K_std))
        return conclude(frame, reconstruction, self.criterion, answers, kept=1, min_positive=0.5)

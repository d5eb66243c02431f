"""Section 7.3, direct: the absolute dual quadric by weighted linear equations.

Pollefeys, Verbiest and Van Gool (ECCV 2002): each camera that is square, without skew and with its principal
point in the middle gives six equations linear in the quadric. The weights suppose a focal near 1; scanning a
normalising focal over the plausible range makes them right for one of the scanned values whatever the lens.

Section 7.3, direct: the absolute quadric by a nonlinear criterion over all unknown intrinsics.

M. Pollefeys, R. Koch, L. Van Gool, "Self-calibration and metric reconstruction in spite of varying and
unknown internal camera parameters", IJCV 32(1), 1999: min sum |K_i K_i' / |K_i K_i'| - P_i Q P_i' / |P_i Q
P_i'||^2 over the plane at infinity and whatever of the intrinsics is unknown. Q is parametrised by the plane
and the reference camera's K, so that its rank is 3 and it is positive by construction.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.levenberg_marquardt import minimize_residuals
from thesisrecon.records import Reconstruction, SelfCalibration
from thesisrecon.selfcalibration.candidates import (
    FOCAL_LIMITS,
    Candidate,
    as_stage_failure,
    candidates_from_parameters,
    group_focals_from_planes,
    require_cameras,
    select_candidate,
)
from thesisrecon.selfcalibration.frame import ReferenceFrame, normalized_frame
from thesisrecon.selfcalibration.refinement import RotationCriterion, central_differences
from thesisrecon.selfcalibration.unknowns import SolverUnknowns, solver_unknowns

_PAIRS = [(a, b) for a in range(4) for b in range(a, 4)]


def _quadratic_rows(x: F64, y: F64) -> F64:
    """Rows r with r . q = x' Q y for the upper-triangle vector q of a symmetric Q; (..., 4), (..., 4) ->
    (..., 10)."""
    terms = [x[..., a] * y[..., b] + (x[..., b] * y[..., a] if a != b else 0.0) for a, b in _PAIRS]
    return np.stack(terms, axis=-1)


def _symmetric(q: F64) -> F64:
    Q = np.zeros((*q.shape[:-1], 4, 4))
    for k, (a, b) in enumerate(_PAIRS):
        Q[..., a, b] = Q[..., b, a] = q[..., k]
    return Q


def linear_quadric(frame: ReferenceFrame, focals: F64, *, iterations: int = 4) -> F64:
    """Absolute dual quadrics (B, 4, 4) in the reference frame for normalising focals (B,) or (B, R).

    The rows are those of Pollefeys et al. with uncertainties 9 (focal), 0.2 (aspect), 0.01 (skew), 0.1
    (principal point), divided by the w33 of the previous iterate. The first iterate divides by the norm of
    the row that gives w33 in place of their 1, which would depend on the scale of each camera. The sign is
    that with which the reference camera's image has a positive trace, the norm is 1, the rank is 4 with noise
    (:func:`rank_three` makes it 3).
    """
    P = np.concatenate([frame.A, frame.a[:, :, None]], axis=2)[None].repeat(len(focals), axis=0)
    P[:, :, :2] /= (focals if focals.ndim == 2 else focals[:, None])[:, :, None, None]
    p1, p2, p3 = P[:, :, 0], P[:, :, 1], P[:, :, 2]
    w11, w22, w33 = (_quadratic_rows(p, p) for p in (p1, p2, p3))
    rows = np.stack(
        [(w11 - w33) / 9, (w22 - w33) / 9, (w11 - w22) / 0.2, _quadratic_rows(p1, p2) / 0.01,
         _quadratic_rows(p1, p3) / 0.1, _quadratic_rows(p2, p3) / 0.1], axis=2,
    )  # fmt: skip
    nu = np.linalg.norm(w33, axis=-1)
    q = np.zeros((len(focals), 10))
    for _ in range(iterations):
        weighted = rows / np.maximum(nu, 1e-9 * nu.max(axis=1, keepdims=True))[:, :, None, None]
        A = weighted.reshape(len(focals), -1, 10)
        # Of A, not of A'A, which would leave half the digits.
        q = np.linalg.svd(A, full_matrices=A.shape[1] < 10)[2][:, 9]
        nu = np.abs(np.einsum("bvk,bk->bv", w33, q))
    Q = _symmetric(q)
    Q *= np.where(np.trace(Q[:, :3, :3], axis1=1, axis2=2) < 0, -1.0, 1.0)[:, None, None]
    return Q


def rank_three(Q: F64) -> tuple[F64, F64]:
    """Nearest quadrics of rank 3 to Q (B, 4, 4) and their null vectors (B, 4), the planes at infinity.

    The eigenvalue of least magnitude is set to 0.
    """
    value, vector = np.linalg.eigh(Q)
    smallest = np.abs(value).argmin(axis=1)
    null = np.take_along_axis(vector, smallest[:, None, None], axis=2)[:, :, 0]
    np.put_along_axis(value, smallest[:, None], 0.0, axis=1)
    return np.asarray((vector * value[:, None, :]) @ vector.swapaxes(1, 2)), null


def quadric_hypotheses(frame: ReferenceFrame, focals: F64) -> tuple[F64, F64]:
    """Planes at infinity (B, 3) and reference focals (B,) from the linear quadric scanned over ``focals``.

    The plane is the null vector of the nearest quadric of rank 3; a quadric whose w* of the reference camera
    is not positive keeps the normalising focal.
    """
    try:
        Q, null = rank_three(linear_quadric(frame, focals))
    except np.linalg.LinAlgError:
        return np.zeros((0, 3)), np.zeros(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        p = null[:, :3] / null[:, 3:]
        f2 = (Q[:, 0, 0] + Q[:, 1, 1]) / (2.0 * Q[:, 2, 2])
    supposed = focals if focals.ndim == 1 else focals[:, frame.reference]
    f = np.sqrt(np.where(np.isfinite(f2) & (f2 > 0), f2, supposed**2))
    good = np.isfinite(p).all(axis=1)
    return p[good], np.clip(f[good], *FOCAL_LIMITS)


@dataclass(frozen=True)
class LinearQuadric:
    """The linear quadric alone: one normalising focal, no refinement.

    ``normalising_focal`` in long sides; 1.67 is the 60 mm lens of Pollefeys et al. on 36 mm film. The
    equation that expects it pulls the answer even without noise, by tens of percent with another lens: its
    focals have no standard deviation (NaN).
    """

    normalising_focal: float = 1.67
    criterion: RotationCriterion = field(default_factory=RotationCriterion)

    @as_stage_failure
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,  # noqa: ARG002 - one signature for all methods
    ) -> SelfCalibration:
        """Upgrade by the quadric; ``StageFailure`` below three cameras and where no answer puts the scene in
        front of the cameras."""
        require_cameras(reconstruction)
        frame = normalized_frame(reconstruction, prior)
        p, log_f = _with_cameras(frame, *quadric_hypotheses(frame, np.array([self.normalising_focal])))
        found = _conclude_best(frame, reconstruction, self.criterion, p, log_f)
        # What pulls the answer is no noise: nothing here tells how far off it is.
        K_std = found.K_std.copy()
        K_std[frame.views[:, None], (0, 1), (0, 1)] = np.nan
        return replace(found, K_std=K_std)


@dataclass(frozen=True)
class ScannedQuadric:
    """The linear quadric for each of ``focal_steps`` normalising focals in ``focal_range`` (long sides), the
    one whose cameras are nearest to rotations, solved again with every camera normalised by its own focal.

    Up to ``repeats`` times, until the focals stay: then no equation pulls any more, and exact cameras give
    the exact answer.
    """

    focal_range: tuple[float, float] = (0.2, 40.0)
    focal_steps: int = 45
    repeats: int = 30
    criterion: RotationCriterion = field(default_factory=RotationCriterion)

    @as_stage_failure
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,  # noqa: ARG002 - one signature for all methods
    ) -> SelfCalibration:
        """As :meth:`LinearQuadric.calibrate`."""
        require_cameras(reconstruction)
        frame = normalized_frame(reconstruction, prior)
        focals = np.geomspace(*self.focal_range, self.focal_steps)
        p, log_f = _with_cameras(frame, *quadric_hypotheses(frame, focals))
        best = int(np.nan_to_num(self.criterion.cost(frame, p, log_f), nan=np.inf).argmin()) if len(p) else 0
        log_f = log_f[best : best + 1]
        for _ in range(self.repeats if len(p) else 0):
            before = log_f
            again = quadric_hypotheses(frame, np.exp(log_f[:, frame.group]))
            if not len(again[0]):
                break
            p, log_f = _with_cameras(frame, *again)
            if np.abs(log_f - before).max() < 1e-12:
                break
        return _conclude_best(frame, reconstruction, self.criterion, p, log_f)


def _with_cameras(frame: ReferenceFrame, p: F64, f_reference: F64) -> tuple[F64, F64]:
    return p, group_focals_from_planes(frame, p, f_reference)


def _conclude_best(
    frame: ReferenceFrame, reconstruction: Reconstruction, criterion: RotationCriterion, p: F64, log_f: F64
) -> SelfCalibration:
    answers = candidates_from_parameters(
        frame, np.concatenate([p, log_f], axis=1), criterion.cost(frame, p, log_f), "linear quadric"
    )
    return select_candidate(
        frame, reconstruction, criterion, answers, max_candidates=1, min_in_front_ratio=0.5
    )


_UPPER = np.triu_indices(3)
_ENTRY_WEIGHT = np.where(_UPPER[0] == _UPPER[1], 1.0, np.sqrt(2.0))
_LEAST_NOISE = 1e-9
PASSES = 6
"""Estimates of the noise at the most."""


@dataclass(frozen=True)
class QuadricFit:
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
    frame: ReferenceFrame, unknown: SolverUnknowns, plane: F64, log_f: F64, *, loss_scale: float = 0.05
) -> QuadricFit:
    """The nearest minimum of the criterion from a plane at infinity (3,) and log focals (R,).

    Huber's loss turns at ``loss_scale``, so that a camera that bad matches made wrong does not pull the rest.
    The priors weigh against the residuals by their noise, which is estimated from the residuals themselves: a
    first pass supposes 1 %, each further one takes what the last one found until that no longer falls.
    """
    # Both sides also come together where all focals go to 0, which must cost more than the noise.
    unknown = unknown.with_focal_prior()
    theta, noise = np.concatenate([plane, unknown.from_log_focals(log_f[None])[0]]), 0.01
    for _ in range(PASSES):
        supposed = noise
        theta, noise, covariance, cost = _minimize(frame, unknown, theta, noise, loss_scale)
        if noise > 0.7 * supposed:
            break
    K = unknown.calibrations(theta[None, 3:])[0]
    K_std = unknown.calibration_std(theta[3:], covariance[3:, 3:])
    return QuadricFit(theta[:3], theta[3:], K, cost, noise, covariance, K_std)


def _minimize(
    frame: ReferenceFrame, unknown: SolverUnknowns, theta: F64, noise: float, loss_scale: float
) -> tuple[F64, float, F64, float]:
    def residuals(batch: F64) -> F64:
        K = unknown.calibrations(batch[:, 3:])
        data = dual_image_residuals(frame.A, frame.a, K, K[:, frame.reference], batch[:, :3])
        return np.concatenate(
            [data.reshape(len(batch), -1), noise * unknown.prior_residuals(batch[:, 3:])], axis=1
        )

    found = minimize_residuals(
        lambda x: residuals(x[None])[0], theta,
        jacobian=lambda x: central_differences(residuals, x, 1e-6 * (1.0 + np.abs(x))),
        loss="huber", loss_scale=loss_scale,
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

    @as_stage_failure
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,  # noqa: ARG002 - one signature for all methods
    ) -> SelfCalibration:
        """Upgrade by the quadric; ``StageFailure`` below three cameras and where no answer puts the scene in
        front of the cameras."""
        require_cameras(reconstruction)
        frame = normalized_frame(reconstruction, prior)
        unknown = solver_unknowns(frame, prior)
        p, f = quadric_hypotheses(frame, np.geomspace(*self.focal_range, self.focal_steps))
        log_f = group_focals_from_planes(frame, p, f)
        cost = self.criterion.cost(frame, p, log_f)
        best = np.argsort(cost, kind="stable")[: self.starts]
        answers = []
        for b in best[np.isfinite(cost[best])]:
            found = minimize_quadric(frame, unknown, p[b], log_f[b][frame.group], loss_scale=self.loss_scale)
            answers.append(Candidate(found.plane, found.K, found.cost, "nonlinear quadric", found.K_std))
        return select_candidate(
            frame, reconstruction, self.criterion, answers, max_candidates=1, min_in_front_ratio=0.5
        )

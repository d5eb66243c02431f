"""Plane at infinity from guessed focals of two cameras (Gherardi and Fusiello, "Practical autocalibration",
ECCV 2010).

Two cameras with known K fix the plane at infinity in closed form; scanning the two focals over the plausible
range and looking at all the other cameras replaces every nonconvex search.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.records import Reconstruction, SelfCalibration
from thesisrecon.selfcalibration.candidates import (
    as_stage_failure,
    candidates_from_parameters,
    group_focals_from_planes,
    require_cameras,
    select_candidate,
)
from thesisrecon.selfcalibration.frame import ReferenceFrame, normalized_frame
from thesisrecon.selfcalibration.refinement import RotationCriterion, refine_hypotheses

SCAN_WEIGHTS = (1.0 / 0.01, 1.0 / 0.2, 1.0 / 0.1, 1.0 / 0.1)
"""Of skew, aspect and the two coordinates of the principal point."""


def _rotation_to_first_axis(t: F64) -> F64:
    """Rotations R (B, 3, 3) with R t = (|t|, 0, 0); rows t/|t| and any two orthonormal to it."""
    first = t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
    helper = np.eye(3)[np.abs(first).argmin(axis=1)]
    second = np.cross(first, helper)
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-300)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def plane_from_focals(frame: ReferenceFrame, other: int, f_reference: F64, f_other: F64) -> F64:
    """Planes at infinity p (2 B, 3) for guessed unit-free focals (B,) of the reference and of camera
    ``other``.

    Both signs of the second camera are returned, since a projective camera has none.
    """
    K1 = np.stack([f_reference, f_reference, np.ones_like(f_reference)], axis=1)
    K2 = np.stack([f_other, f_other, np.ones_like(f_other)], axis=1)
    t = frame.a[other] / K2
    rotation = _rotation_to_first_axis(t)
    W = rotation @ ((frame.A[other][None] / K2[:, :, None]) * K1[:, None, :])
    planes = []
    for sign in (1.0, -1.0):
        w1, w2, w3 = sign * W[:, 0], sign * W[:, 1], sign * W[:, 2]
        length = np.maximum(np.linalg.norm(w3, axis=1, keepdims=True), 1e-300)
        baseline = sign * np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
        planes.append(-(np.cross(w2, w3) / length - w1) / baseline / K1)
    return np.concatenate(planes)


def log_grid(focal_range: tuple[float, float], steps: int) -> F64:
    """Evenly spaced log focals (steps,) over a range of focals."""
    return np.linspace(np.log(focal_range[0]), np.log(focal_range[1]), steps)


def focal_pairs(focals: F64, same_camera: bool) -> tuple[F64, F64]:
    """Focals (B,) of two cameras to try: equal ones, or every other one with every other one."""
    if same_camera:
        return focals, focals
    first, second = np.meshgrid(focals[::2], focals[::2])
    return first.ravel(), second.ravel()


def planes_for_focals(
    frame: ReferenceFrame, criterion: RotationCriterion, log_f: F64, *, max_refined: int = 8
) -> tuple[F64, float]:
    """The plane at infinity (3,) that suits known log focals (G,) best, and the criterion's cost there.

    Started from the reference with every other camera and both signs of it; the focals stay.
    """
    f = np.exp(log_f[frame.group])
    reference = np.array([f[frame.reference]])
    others = np.delete(np.arange(len(f)), frame.reference)
    planes = np.concatenate([plane_from_focals(frame, int(k), reference, f[k : k + 1]) for k in others])
    planes = planes[np.isfinite(planes).all(axis=1)]
    if not len(planes):
        return np.full(3, np.nan), np.inf
    theta = np.concatenate([planes, np.repeat(log_f[None], len(planes), axis=0)], axis=1)
    order = np.argsort(criterion.cost(frame, theta[:, :3], theta[:, 3:]), kind="stable")[:max_refined]
    theta, cost = refine_hypotheses(criterion, frame, theta[order], planes_only=True)
    best = int(np.nan_to_num(cost, nan=np.inf).argmin())
    return theta[best, :3], float(cost[best])


def calibrations_from_planes(frame: ReferenceFrame, p: F64, f_reference: F64) -> F64:
    """Unit-free K (B, R, 3, 3) of all cameras that planes p (B, 3) and reference focals (B,) imply.

    The triangular factor of C C', C = (A - a p') K_r, written out; what RQ of the upgraded camera gives.
    """
    C = frame.A[None] - frame.a[None, :, :, None] * p[:, None, None, :]
    C[..., :2] *= f_reference[:, None, None, None]
    w = C @ C.swapaxes(-1, -2)
    K = np.zeros_like(w)
    w = w / np.maximum(w[..., 2:, 2:], 1e-300)
    K[..., 0, 2], K[..., 1, 2], K[..., 2, 2] = w[..., 0, 2], w[..., 1, 2], 1.0
    K[..., 1, 1] = np.sqrt(np.maximum(w[..., 1, 1] - w[..., 1, 2] ** 2, 1e-300))
    K[..., 0, 1] = (w[..., 0, 1] - w[..., 0, 2] * w[..., 1, 2]) / K[..., 1, 1]
    rest = w[..., 0, 0] - K[..., 0, 1] ** 2 - w[..., 0, 2] ** 2
    K[..., 0, 0] = np.sqrt(np.maximum(rest, 1e-300))
    return K


def scan_cost(K: F64) -> F64:
    """The criterion of the scan (B,): sum over cameras of (w_s |k12| + w_a |k11 - k22| + w_u |k13| + w_v
    |k23|)^2 for K (B, R, 3, 3).

    All four are taken over k22: the paper's cameras have a focal near 1, ours any.
    """
    parts = np.stack([K[..., 0, 1], K[..., 0, 0] - K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]], axis=-1)
    total = np.sum(np.abs(parts) * SCAN_WEIGHTS, axis=-1) / K[..., 1, 1]
    return np.asarray(np.sum(total**2, axis=-1))


@dataclass(frozen=True)
class FocalScan:
    """Gherardi's and Fusiello's method alone: the focals of the reference camera and of another are scanned,
    the best of every pair are refined over the plane at infinity and all focals.

    ``focal_range`` in long sides, ``focal_steps`` of the scan (each of two focals where the cameras differ:
    every other step), ``refined`` hypotheses that are refined.
    """

    focal_range: tuple[float, float] = (0.2, 40.0)
    focal_steps: int = 65
    max_refined: int = 10
    criterion: RotationCriterion = field(default_factory=RotationCriterion)

    @as_stage_failure
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,  # noqa: ARG002 - one signature for all methods
    ) -> SelfCalibration:
        """Upgrade by the scan; ``StageFailure`` below three cameras and where no answer puts the scene in
        front of the cameras."""
        require_cameras(reconstruction)
        frame = normalized_frame(reconstruction, prior)
        focals = np.geomspace(*self.focal_range, self.focal_steps)
        planes, references = [], []
        for other in np.delete(np.arange(len(frame.views)), frame.reference):
            f1, f2 = focal_pairs(focals, bool(frame.group[other] == frame.group[frame.reference]))
            planes.append(plane_from_focals(frame, int(other), f1, f2))
            references.append(np.concatenate([f1, f1]))
        p, f = np.concatenate(planes), np.concatenate(references)
        good = np.isfinite(p).all(axis=1)
        p, f = p[good], f[good]
        best = np.argsort(scan_cost(calibrations_from_planes(frame, p, f)), kind="stable")[: self.max_refined]
        theta = np.concatenate([p[best], group_focals_from_planes(frame, p[best], f[best])], axis=1)
        answers = candidates_from_parameters(
            frame, *refine_hypotheses(self.criterion, frame, theta), "Gherardi and Fusiello's scan"
        )
        return select_candidate(
            frame, reconstruction, self.criterion, answers, max_candidates=1, min_in_front_ratio=0.5
        )

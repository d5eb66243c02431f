"""Self-calibration by scanning focal lengths of two cameras.

R. Gherardi, A. Fusiello, "Practical autocalibration", ECCV 2010: two cameras with known K determine the plane
at infinity in closed form; scanning both focal lengths and checking all other cameras replaces a nonconvex
search.
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
    select_candidate,
)
from thesisrecon.selfcalibration.frame import ReferenceFrame, normalized_frame
from thesisrecon.selfcalibration.refinement import RotationCriterion, refine_hypotheses

# Weights of skew, aspect and principal point (x, y).
SCAN_WEIGHTS = (1.0 / 0.01, 1.0 / 0.2, 1.0 / 0.1, 1.0 / 0.1)


def _rotation_to_first_axis(t: F64) -> F64:
    """Return rotations R (B, 3, 3) with R t = (|t|, 0, 0)."""
    first = t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
    helper = np.eye(3)[np.abs(first).argmin(axis=1)]
    second = np.cross(first, helper)
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-300)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def plane_from_focals(frame: ReferenceFrame, other: int, f_reference: F64, f_other: F64) -> F64:
    """Compute planes at infinity from the focal lengths of the reference and another camera.

    Parameters
    ----------
    frame : ReferenceFrame
        Cameras.
    other : int
        Place of the other camera.
    f_reference, f_other : ndarray (B,)
        Unit-free focal lengths.

    Returns
    -------
    ndarray (2 B, 3)
        Planes for both signs of the other camera, since a projective camera has none.

    References
    ----------
    R. Gherardi, A. Fusiello, ECCV 2010.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.selfcalibration.frame import _example_frame
    >>> frame, p = _example_frame(f=1.2)
    >>> planes = plane_from_focals(frame, 1, np.array([1.2]), np.array([1.2]))
    >>> bool(np.abs(planes - p).max(axis=1).min() < 1e-9)
    True
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
    """Return evenly spaced log focal lengths.

    Parameters
    ----------
    focal_range : (float, float)
        First and last focal length.
    steps : int
        Number of values.

    Returns
    -------
    ndarray (steps,)
        Log focal lengths.
    """
    return np.linspace(np.log(focal_range[0]), np.log(focal_range[1]), steps)


def focal_pairs(focals: F64, same_camera: bool) -> tuple[F64, F64]:
    """Return pairs of focal lengths to scan.

    Parameters
    ----------
    focals : ndarray (N,)
        Focal lengths.
    same_camera : bool
        Equal focal lengths only; else all pairs of every other value.

    Returns
    -------
    first, second : ndarray (B,)
        Focal lengths of both cameras.
    """
    if same_camera:
        return focals, focals
    first, second = np.meshgrid(focals[::2], focals[::2])
    return first.ravel(), second.ravel()


def planes_for_focals(
    frame: ReferenceFrame, criterion: RotationCriterion, log_f: F64, *, max_refined: int = 8
) -> tuple[F64, float]:
    """Fit the plane at infinity for known focal lengths.

    Starts from the reference with every other camera and both signs.

    Parameters
    ----------
    frame : ReferenceFrame
        Cameras.
    criterion : RotationCriterion
        Criterion to minimize.
    log_f : ndarray (G,)
        Log focal lengths of the camera groups.
    max_refined : int
        Number of starts to refine.

    Returns
    -------
    plane : ndarray (3,)
        Best plane, NaN if there is none.
    cost : float
        Its cost.
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
    """Compute the calibrations that planes at infinity imply.

    K is the triangular factor of C C', C = (A - a p') K_r, written out: the result of RQ of the upgraded
    camera.

    Parameters
    ----------
    frame : ReferenceFrame
        Cameras.
    p : ndarray (B, 3)
        Planes at infinity.
    f_reference : ndarray (B,)
        Unit-free focal lengths of the reference camera.

    Returns
    -------
    ndarray (B, R, 3, 3)
        Unit-free calibrations.
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
    """Compute sum over cameras of (w_s |k12| + w_a |k11 - k22| + w_u |k13| + w_v |k23|)^2.

    All terms are divided by k22: the paper's cameras have a focal length near 1, these any.

    Parameters
    ----------
    K : ndarray (B, R, 3, 3)
        Calibrations.

    Returns
    -------
    ndarray (B,)
        Costs.

    References
    ----------
    R. Gherardi, A. Fusiello, ECCV 2010.

    Examples
    --------
    >>> import numpy as np
    >>> scan_cost(np.diag([2.0, 2.0, 1.0])[None, None])
    array([0.])
    """
    parts = np.stack([K[..., 0, 1], K[..., 0, 0] - K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]], axis=-1)
    total = np.sum(np.abs(parts) * SCAN_WEIGHTS, axis=-1) / K[..., 1, 1]
    return np.asarray(np.sum(total**2, axis=-1))


@dataclass(frozen=True)
class FocalScan:
    """Self-calibration by the focal scan of Gherardi and Fusiello, refined over plane and focal lengths.

    Parameters
    ----------
    focal_range : (float, float)
        Scanned focal lengths in long sides.
    focal_steps : int
        Number of focal lengths; every other one for two different cameras.
    max_refined : int
        Number of hypotheses to refine.
    criterion : RotationCriterion
        Criterion of the refinement.

    References
    ----------
    R. Gherardi, A. Fusiello, ECCV 2010.
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
        candidates = candidates_from_parameters(
            frame, *refine_hypotheses(self.criterion, frame, theta), "Gherardi and Fusiello's scan"
        )
        return select_candidate(frame, reconstruction, self.criterion, candidates)

"""Chapter 7, stratified: the calibration under a known plane at infinity, Hartley's and Pollefeys' ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.geometry.absolute_conic import calibration_from_image
from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.selfcalibration.intrinsics import UnknownIntrinsics
from thesisrecon.selfcalibration.nonlinear_quadric import dual_image_residuals
from thesisrecon.selfcalibration.stratified.descent import derivatives, descend
from thesisrecon.selfcalibration.stratified.image_conic import (
    NOISE,
    ConicKnowledge,
    ImageConic,
    carried_conics,
    dual_image_constant,
    infinite_homographies,
    solve_conic,
)

F64 = NDArray[np.float64]

_DESCENTS = 3


@dataclass(frozen=True)
class Strata:
    """What the calibration of a plane at infinity starts from: the cameras, what is assumed of them, and
    vanishing points ``orthogonal`` (M, 2, 3) in the reference view of directions at right angles."""

    frame: ReferenceFrame
    knowledge: ConicKnowledge
    unknown: UnknownIntrinsics
    orthogonal: F64


@dataclass(frozen=True)
class HartleyLinear:
    """Hartley's way: the image of the absolute conic by linear equations, K by Cholesky.

    Where nothing is known of any K but that it is constant these are w* = H w* H'; else the equations of
    :func:`~thesisrecon.selfcalibration.stratified.image_conic.conic_equations`.
    """

    def calibrations(self, strata: Strata, plane: F64) -> F64:
        """Unit-free K (R, 3, 3) under a plane at infinity (3,).

        ``StageFailure`` where the conic is not definite (the plane, or what is assumed of the cameras, is
        wrong) and where the motion leaves a family of conics (rotations about one axis: named).
        """
        frame, knowledge = strata.frame, strata.knowledge
        H = _homographies(frame, plane)
        one_camera = bool((knowledge.first == knowledge.first[0]).all())
        if one_camera and np.isinf(knowledge.std).all() and not len(strata.orthogonal):
            dual, s = dual_image_constant(H)
            definite = bool((np.linalg.eigvalsh(dual) > 0).all())
            conic = ImageConic(np.asarray(np.linalg.inv(dual)) if definite else dual, s)
        else:
            conic = solve_conic(H, knowledge, orthogonal=strata.orthogonal)
        if not conic.determined:
            raise _undetermined(frame, H, conic)
        if not conic.definite:
            raise _indefinite(conic)
        K = np.array([calibration_from_image(w) for w in carried_conics(H, conic.w)])
        return as_assumed(strata.unknown, K)


@dataclass(frozen=True)
class PollefeysQuadric:
    """Pollefeys' way: the criterion of the absolute dual quadric with its plane held fixed.

    min sum |K_i K_i' / |.| - H_i w* H_i' / |.||^2 (IJCV 32(1), 1999) over all unknown intrinsics, started at
    the best of ``starts`` focals over ``focal_range`` (in long sides).
    """

    focal_range: tuple[float, float] = (0.3, 10.0)
    starts: int = 9

    def calibrations(self, strata: Strata, plane: F64) -> F64:
        """Unit-free K (R, 3, 3) under a plane at infinity (3,); ``StageFailure`` where the criterion does not
        determine it."""
        unknown, frame = strata.unknown, strata.frame
        H = _homographies(frame, plane)
        focals = np.log(np.geomspace(*self.focal_range, self.starts))
        starts = unknown.start(np.repeat(focals[:, None], len(H), axis=1))

        def residuals(batch: F64) -> F64:
            K = unknown.calibrations(batch)
            data = dual_image_residuals(frame.A, frame.a, K, K[:, frame.reference], plane[None])
            data = data.reshape(len(batch), -1)
            return np.asarray(np.concatenate([data, NOISE * unknown.deviations(batch)], axis=1))

        nearest = np.argsort(np.sum(residuals(starts) ** 2, axis=1), kind="stable")[:_DESCENTS]
        found, cost = descend(residuals, starts[nearest], iterations=60, loss_scale=0.05)
        best = found[cost.argmin()]
        s = np.linalg.svd(derivatives(residuals, best[None])[0], compute_uv=False)
        if len(s) and not s[-1] > 1e-5 * s[0]:
            raise _undetermined(frame, H, None)
        return np.asarray(unknown.calibrations(best[None])[0], dtype=np.float64)


def _homographies(frame: ReferenceFrame, plane: F64) -> F64:
    H = infinite_homographies(frame, plane[None])[0]
    if not np.isfinite(H).all():
        raise StageFailure(
            "the plane at infinity runs through a camera",
            f"view {int(frame.views[~np.isfinite(H).all(axis=(1, 2))][0])} has no infinite homography",
        )
    return np.asarray(H, dtype=np.float64)


def as_assumed(unknown: UnknownIntrinsics, K: F64) -> F64:
    """Calibrations (R, 3, 3) brought to the assumptions: what is known takes its value, what is shared its
    mean."""
    f = K[:, 0, 0]
    values = np.column_stack([np.log(f), np.log(K[:, 1, 1] / f), K[:, 0, 1], K[:, 0, 2], K[:, 1, 2]])
    # Where the aspect is known the two focals are two measurements of one.
    values[:, 0] += np.where(unknown.place[:, 1] < 0, (values[:, 1] - unknown.value[:, 1]) / 2.0, 0.0)
    asked = unknown.place >= 0
    total = np.bincount(unknown.place[asked], values[asked], minlength=len(unknown.mean))
    count = np.bincount(unknown.place[asked], minlength=len(unknown.mean))
    return np.asarray(unknown.calibrations((total / np.maximum(count, 1))[None])[0])


def turns(H: F64) -> tuple[float, F64]:
    """Largest turn (deg) between the reference view and the others, and the vanishing point (3,) of its axis.

    An infinite homography of a constant K is conjugate to a rotation: its trace is 1 + 2 cos, its real
    eigenvector the axis.
    """
    cosine = (np.trace(H, axis1=1, axis2=2) - 1.0) / 2.0
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    value, vector = np.linalg.eig(H[angle.argmax()])
    axis = np.real(vector[:, np.abs(value - 1.0).argmin()])
    return float(angle.max()), np.asarray(axis / np.linalg.norm(axis))


def _undetermined(frame: ReferenceFrame, H: F64, conic: ImageConic | None) -> StageFailure:
    angle, axis = turns(H)
    found = "the criterion has a flat direction"
    if conic is not None:
        s = conic.singular_values
        found = f"singular values {s[4] / max(s[0], 1e-300):.1e} and {s[5] / max(s[0], 1e-300):.1e} of 1"
    if angle < 1.0:
        return StageFailure(
            "the cameras do not turn, so the plane at infinity does not give the calibration",
            f"largest turn {angle:.1f} deg; {found}",
            "turn the camera between photographs",
        )
    pixel = frame.pixel_from_unit[frame.views[frame.reference]] @ axis
    with np.errstate(divide="ignore", invalid="ignore"):
        place = pixel[:2] / pixel[2]
    return StageFailure(
        "the plane at infinity leaves a one-parameter family of calibrations, as turns about one axis do",
        f"{found}; the largest turn, {angle:.1f} deg, has its axis at ({place[0]:.0f}, {place[1]:.0f}) px",
        "turn the camera about a second axis, or assume square pixels without skew",
    )


def _indefinite(conic: ImageConic) -> StageFailure:
    values = np.linalg.eigvalsh(conic.w)
    return StageFailure(
        "the image of the absolute conic is not that of a real camera",
        f"its eigenvalues are {values[0]:.2e}, {values[1]:.2e} and {values[2]:.2e}, not all positive",
        "the plane at infinity or the assumptions of the cameras are wrong",
    )

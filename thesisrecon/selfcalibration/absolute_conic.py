"""Calibration from the plane at infinity: Hartley's linear and Pollefeys' nonlinear method (chapter 7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import Notice, StageFailure
from thesisrecon.geometry.conics import calibration_from_image
from thesisrecon.selfcalibration._frame import (
    HOMOGRAPHY_NOISE,
    ProjectiveScene,
    ReferenceFrame,
    SolverUnknowns,
    infinite_homographies,
)
from thesisrecon.selfcalibration._image_conic import (
    ImageConic,
    dual_conic_of_constant_camera,
    solve_conic,
    transferred_conics,
)
from thesisrecon.selfcalibration._refinement import dual_image_residuals, minimize_batch, numerical_jacobian

_DESCENTS = 3


@dataclass(frozen=True)
class LinearAbsoluteConic:
    """Hartley's method: the image of the absolute conic by linear equations, K by Cholesky factorization.

    With a constant K and no other prior the equations are w* = H w* H', else the linear constraints on w_j.
    """

    def calibrations(self, scene: ProjectiveScene, plane: F64) -> F64:
        """Unit-free calibrations (R, 3, 3) of a plane p (3,); ``StageFailure`` without a unique conic."""
        frame, constraints = scene.frame, scene.constraints
        H = _homographies(frame, plane)
        one_camera = bool((constraints.first == constraints.first[0]).all())
        if one_camera and np.isinf(constraints.std).all() and scene.orthogonal is None:
            dual, s = dual_conic_of_constant_camera(H)
            definite = (np.linalg.eigvalsh(dual) > 0).all()
            conic = ImageConic(np.asarray(np.linalg.inv(dual)) if definite else dual, s)
        else:
            conic = solve_conic(H, constraints, orthogonal=scene.orthogonal)
        if not conic.determined:
            raise _undetermined_failure(frame, H, conic)
        if not conic.definite:
            values = np.linalg.eigvalsh(conic.w)
            raise StageFailure(
                "the image of the absolute conic is not that of a real camera",
                f"its eigenvalues are {values[0]:.2e}, {values[1]:.2e} and {values[2]:.2e}, not all positive",
                "check the plane at infinity and the prior of the intrinsics: one of them is wrong",
            )
        K = np.array([calibration_from_image(w) for w in transferred_conics(H, conic.w)])
        return _apply_known_values(scene.unknown, K)


@dataclass(frozen=True)
class FixedPlaneQuadric:
    """Pollefeys' method: the nonlinear quadric with a fixed plane, over all unknown intrinsics."""

    # Range of the starting focal lengths in long sides, and their number.
    focal_range = (0.3, 10.0)
    starts = 9

    def calibrations(self, scene: ProjectiveScene, plane: F64) -> F64:
        """See `thesisrecon.selfcalibration.absolute_conic.LinearAbsoluteConic.calibrations`."""
        unknown, frame = scene.unknown, scene.frame
        H = _homographies(frame, plane)
        if not len(unknown.std):
            return np.asarray(unknown.calibrations(np.zeros((1, 0)))[0], dtype=np.float64)
        focals = np.log(np.geomspace(*self.focal_range, self.starts))
        starts = unknown.from_log_focals(np.repeat(focals[:, None], len(H), axis=1))

        def residuals(batch: F64) -> F64:
            K = unknown.calibrations(batch)
            data = dual_image_residuals(frame.A, frame.a, K, K[:, frame.reference], plane[None])
            data = data.reshape(len(batch), -1)
            return np.asarray(
                np.concatenate([data, HOMOGRAPHY_NOISE * unknown.prior_residuals(batch)], axis=1)
            )

        nearest = np.argsort(np.sum(residuals(starts) ** 2, axis=1), kind="stable")[:_DESCENTS]
        found, cost = minimize_batch(residuals, starts[nearest], iterations=60, loss_scale=0.05)
        best = found[cost.argmin()]
        s = np.linalg.svd(numerical_jacobian(residuals, best[None])[0], compute_uv=False)
        if len(s) and not s[-1] > 1e-5 * s[0]:
            raise _undetermined_failure(frame, H, None)
        return np.asarray(unknown.calibrations(best[None])[0], dtype=np.float64)


def _homographies(frame: ReferenceFrame, plane: F64) -> F64:
    H = infinite_homographies(frame, plane[None])[0]
    if not np.isfinite(H).all():
        raise StageFailure(
            Notice("plane-through-camera"),
            f"image #{int(frame.views[~np.isfinite(H).all(axis=(1, 2))][0])} has no infinite homography",
        )
    return np.asarray(H, dtype=np.float64)


def _apply_known_values(unknown: SolverUnknowns, K: F64) -> F64:
    """Return calibrations (R, 3, 3) with known values inserted and shared values averaged."""
    f = K[:, 0, 0]
    values = np.column_stack([np.log(f), np.log(K[:, 1, 1] / f), K[:, 0, 1], K[:, 0, 2], K[:, 1, 2]])
    # With a known aspect, fx and fy are two measurements of one focal length.
    values[:, 0] += np.where(unknown.index[:, 1] < 0, (values[:, 1] - unknown.known[:, 1]) / 2.0, 0.0)
    free = unknown.index >= 0
    total = np.bincount(unknown.index[free], values[free], minlength=len(unknown.mean))
    count = np.bincount(unknown.index[free], minlength=len(unknown.mean))
    return np.asarray(unknown.calibrations((total / np.maximum(count, 1))[None])[0])


def _largest_rotation(H: F64) -> tuple[float, F64]:
    """Largest rotation (degrees) from the reference, and its axis; H ~ rotation, trace 1 + 2 cos(angle)."""
    cosine = (np.trace(H, axis1=1, axis2=2) - 1.0) / 2.0
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    value, vector = np.linalg.eig(H[angle.argmax()])
    axis = np.real(vector[:, np.abs(value - 1.0).argmin()])
    return float(angle.max()), np.asarray(axis / np.linalg.norm(axis))


def _undetermined_failure(frame: ReferenceFrame, H: F64, conic: ImageConic | None) -> StageFailure:
    angle, axis = _largest_rotation(H)
    found = "the criterion has a flat direction"
    if conic is not None:
        s = conic.singular_values
        found = f"singular values {s[4] / max(s[0], 1e-300):.1e} and {s[5] / max(s[0], 1e-300):.1e} of 1"
    if angle < 1.0:
        return StageFailure(
            "the cameras do not rotate, so the plane at infinity does not determine the calibration",
            f"largest rotation {angle:.1f} deg; {found}",
            "rotate the camera between images",
        )
    pixel = frame.pixel_from_unit[frame.views[frame.reference]] @ axis
    with np.errstate(divide="ignore", invalid="ignore"):
        place = pixel[:2] / pixel[2]
    return StageFailure(
        "a one-parameter family of calibrations fits the plane at infinity: all rotations have the same axis",
        f"{found}; largest rotation {angle:.1f} deg with its axis at ({place[0]:.0f}, {place[1]:.0f}) px",
        "rotate the camera about a second axis, or assume square pixels without skew",
    )

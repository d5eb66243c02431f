"""Calibration from the plane at infinity: Hartley's linear and Pollefeys' nonlinear method (chapter 7).

Homographies H_j (3.29) with det H_j = 1 transfer the image of the absolute conic exactly, w_j = H_j^-T w
H_j^-1, so prior knowledge of w_j is linear in w: constant K: w_j = w (R. Hartley, ECCV 1994); no skew: w_12 =
0; known principal point: w_13 = w_23 = 0; known aspect: w_11 = w_22 (L. de Agapito, R. Hartley, E. Hayman,
CVPR 1999).
"""

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import Notice, StageFailure
from thesisrecon.geometry.homogeneous import quadratic_rows, symmetric
from thesisrecon.geometry.strata import calibration_from_image
from thesisrecon.optimize.bundle.projection import pinhole_rows
from thesisrecon.optimize.least_squares import central_differences
from thesisrecon.selfcalibration import _frame, _refinement

_REWEIGHTINGS = 4


def _conic_equations(H: F64, constraints: _frame.ConicConstraints, focals: F64) -> F64:
    """Return rows (B, M, 6) in the entries 11, 12, 13, 22, 23, 33 of w in the reference view."""
    # H (B, R, 3, 3) of determinant 1 or NaN (no row); `focals` (B, R) are unit-free estimates: dividing the
    # coordinates by the reference focal length balances entries and weights.
    focals = focals[:, constraints.first]
    scale = np.stack([focals, focals, np.ones_like(focals)], axis=-1)
    reference = scale[:, constraints.reference]
    bad = np.asarray(~np.isfinite(H).all(axis=(-2, -1)))
    scaled = np.where(bad[..., None, None], np.eye(3), H) / scale[..., :, None] * reference[:, None, None, :]
    det = np.linalg.det(scaled)
    # Matrices (B, R, 6, 6) from the entries of w to those of M' w M.
    M, (i, j) = np.linalg.inv(scaled / np.cbrt(det)[..., None, None]), np.triu_indices(3)
    carried = quadratic_rows(M[..., i].swapaxes(-1, -2), M[..., j].swapaxes(-1, -2))
    carried[bad] = 0.0
    std = np.repeat(constraints.std[None], len(H), axis=0)
    std[..., :3] /= focals[..., None]
    weight = _frame.HOMOGRAPHY_NOISE / np.hypot(std, _frame.HOMOGRAPHY_NOISE)
    half_aspect = (carried[..., 0, :] - carried[..., 3, :]) / 2.0
    known = np.stack([carried[..., 1, :], carried[..., 2, :], carried[..., 4, :], half_aspect], axis=2)
    later = np.flatnonzero(constraints.first != np.arange(H.shape[1]))
    constant = carried[:, later] - carried[:, constraints.first[later]]
    constant[bad[:, later] | bad[:, constraints.first[later]]] = 0.0
    return np.concatenate(
        [(known * weight[..., None]).reshape(len(H), 4 * H.shape[1], 6),
         (constant * _refinement.ENTRY_WEIGHT[:, None]).reshape(len(H), 6 * len(later), 6)], axis=1,
    )  # fmt: skip


def solve_conic_batch(H: F64, constraints: _frame.ConicConstraints) -> tuple[F64, F64]:
    """Solve for the conics of B planes from their homographies (B, R, 3, 3), without reweighting.

    Return squared focal lengths (B,) of the reference view and the residuals (B, M) over the second smallest
    singular value of the equations: 0 for the true plane, NaN if no real camera fits.
    """
    A = _conic_equations(H, constraints, np.ones(H.shape[:2]))
    value, vector = np.linalg.eigh(np.einsum("bri,brj->bij", A, A))
    w = vector[:, :, 0] * np.where(vector[:, [0, 3, 5], 0].sum(axis=1) < 0, -1.0, 1.0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        f2 = 2.0 * w[:, 5] / (w[:, 0] + w[:, 3])
    bad = ~(f2 > 0) | ~np.isfinite(f2) | (w[:, 0] * w[:, 3] <= 0) | ~np.isfinite(H).all(axis=(1, 2, 3))
    residuals = np.einsum("brk,bk->br", A, w) / np.sqrt(np.maximum(value[:, 1:2], 1e-300))
    return np.where(bad, np.nan, f2), np.where(bad[:, None], np.nan, residuals)


@dataclass(frozen=True)
class ImageConic:
    """Image w (3, 3) of the absolute conic, with the singular values (6,) of its equations."""

    w: F64
    singular_values: F64

    @property
    def definite(self) -> bool:
        """Whether the conic is positive definite: the image of the absolute conic in a real camera."""
        return bool((np.linalg.eigvalsh(self.w) > 0).all())

    @property
    def determined(self) -> bool:
        """Whether the equations have one solution: the second smallest singular value stands out."""
        s = self.singular_values
        # The second bound excludes cameras without rotation, whose equations are only rounding errors.
        return bool(s[4] > 1e-7 * max(s[0], 1e-3) and s[4] > 2.0 * s[5])


def solve_conic(H: F64, constraints: _frame.ConicConstraints) -> ImageConic:
    """Solve for the conic by SVD, reweighted by the estimated focals."""
    focals = np.ones((1, len(H)))
    conic = ImageConic(np.eye(3), np.zeros(6))
    for _ in range(_REWEIGHTINGS):
        rows = _conic_equations(H[None], constraints, focals)[0]
        back = np.array([focals[0, constraints.first[constraints.reference]]] * 2 + [1.0])
        _, s, Vt = np.linalg.svd(rows, full_matrices=False)
        w = symmetric(Vt[5])
        w = (w if np.trace(w) > 0 else -w) / np.outer(back, back)
        conic = ImageConic(np.asarray(w / np.linalg.norm(w)), s)
        if not conic.definite:
            break
        good = np.asarray(np.isfinite(H).all(axis=(1, 2)))
        usable = np.asarray(np.where(good[:, None, None], H, np.eye(3)), dtype=np.float64)
        dual = np.linalg.inv(transferred_conics(usable, conic.w))
        centred = dual[:, [0, 1], [0, 1]] / dual[:, 2, 2, None] - (dual[:, :2, 2] / dual[:, 2, 2, None]) ** 2
        found = np.where(good, np.sqrt(np.abs(np.prod(centred, axis=1)) ** 0.5), 1.0)
        focals = np.clip(found, 0.02, 200.0)[None]
    return conic


def transferred_conics(H: F64, w: F64) -> F64:
    """Return w_j = H_j^-T w H_j^-1 (R, 3, 3)."""
    inverse = np.linalg.inv(H)
    return np.asarray(inverse.swapaxes(-1, -2) @ w @ inverse)


_DESCENTS = 3


@dataclass(frozen=True)
class LinearAbsoluteConic:
    """Hartley's method: the image of the absolute conic by linear equations, K by Cholesky factorization."""

    def calibrations(self, scene: _frame.ProjectiveScene, plane: F64) -> F64:
        """Unit-free calibrations (R, 3, 3) of a plane p (3,); ``StageFailure`` without a unique conic."""
        frame, constraints = scene.frame, scene.constraints
        H = _homographies(frame, plane)
        conic = solve_conic(H, constraints)
        if not conic.determined:
            raise _undetermined_failure(frame, H, conic)
        if not conic.definite:
            values = np.linalg.eigvalsh(conic.w)
            raise StageFailure.of("imaginary-camera", values[0], values[1], values[2])
        values = pinhole_rows(np.array([calibration_from_image(w) for w in transferred_conics(H, conic.w)]))
        values[:, :2] = np.log(values[:, :2])
        # With a known aspect, fx and fy are two measurements of one focal length; shared values are averaged.
        unknown = scene.unknown
        values[:, 0] += np.where(unknown.index[:, 1] < 0, (values[:, 1] - unknown.known[:, 1]) / 2.0, 0.0)
        free = unknown.index >= 0
        total = np.bincount(unknown.index[free], values[free], minlength=len(unknown.mean))
        count = np.bincount(unknown.index[free], minlength=len(unknown.mean))
        return np.asarray(unknown.calibrations((total / np.maximum(count, 1))[None])[0])


@dataclass(frozen=True)
class FixedPlaneQuadric:
    """Pollefeys' method: the nonlinear quadric with a fixed plane, over all unknown intrinsics."""

    # Range of the starting focal lengths in long sides, and their number.
    focal_range = (0.3, 10.0)
    starts = 9

    def calibrations(self, scene: _frame.ProjectiveScene, plane: F64) -> F64:
        """See `thesisrecon.selfcalibration.absolute_conic.LinearAbsoluteConic.calibrations`."""
        unknown, frame = scene.unknown, scene.frame
        H = _homographies(frame, plane)
        if not len(unknown.std):
            return np.asarray(unknown.calibrations(np.zeros((1, 0)))[0], dtype=np.float64)
        focals = np.log(np.geomspace(*self.focal_range, self.starts))
        starts = unknown.from_log_focals(np.repeat(focals[:, None], len(H), axis=1))

        def residuals(batch: F64) -> F64:
            K = unknown.calibrations(batch)
            data = _refinement.dual_image_residuals(frame, K, plane[None]).reshape(len(batch), -1)
            return np.concatenate([data, _frame.HOMOGRAPHY_NOISE * unknown.prior_residuals(batch)], axis=1)

        nearest = np.argsort(np.sum(residuals(starts) ** 2, axis=1), kind="stable")[:_DESCENTS]
        found, cost = _refinement.minimize_batch(residuals, starts[nearest], iterations=60, loss_scale=0.05)
        best = found[cost.argmin()]
        s = np.linalg.svd(central_differences(residuals, best[None])[0], compute_uv=False)
        if len(s) and not s[-1] > 1e-5 * s[0]:
            raise _undetermined_failure(frame, H, None)
        return np.asarray(unknown.calibrations(best[None])[0], dtype=np.float64)


def _homographies(frame: _frame.ReferenceFrame, plane: F64) -> F64:
    H = _frame.infinite_homographies(frame, plane[None])[0]
    if not np.isfinite(H).all():
        view = frame.views[~np.isfinite(H).all(axis=(1, 2))][0]
        raise StageFailure(Notice("plane-through-camera"), f"image #{view} has no infinite homography")
    return np.asarray(H, dtype=np.float64)


def _largest_rotation(H: F64) -> tuple[float, F64]:
    """Largest rotation (degrees) from the reference, and its axis; H ~ rotation, trace 1 + 2 cos(angle)."""
    cosine = (np.trace(H, axis1=1, axis2=2) - 1.0) / 2.0
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    value, vector = np.linalg.eig(H[angle.argmax()])
    axis = np.real(vector[:, np.abs(value - 1.0).argmin()])
    return float(angle.max()), np.asarray(axis / np.linalg.norm(axis))


def _undetermined_failure(frame: _frame.ReferenceFrame, H: F64, conic: ImageConic | None) -> StageFailure:
    angle, axis = _largest_rotation(H)
    found = "the criterion has a flat direction"
    if conic is not None:
        s = conic.singular_values
        found = f"singular values {s[4] / max(s[0], 1e-300):.1e} and {s[5] / max(s[0], 1e-300):.1e} of 1"
    if angle < 1.0:
        return StageFailure.of("no-rotation", angle, found)
    pixel = frame.pixel_from_unit[frame.views[frame.reference]] @ axis
    with np.errstate(divide="ignore", invalid="ignore"):
        place = pixel[:2] / pixel[2]
    return StageFailure.of("one-rotation-axis", found, angle, place[0], place[1])

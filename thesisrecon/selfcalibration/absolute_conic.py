"""Calibration from the plane at infinity by the image of the absolute conic (chapter 7; HZ 19.5).

The infinite homographies H_j (3.29) with det H_j = 1 transfer the conic exactly, w_j = H_j^-T w H_j^-1, so
prior knowledge of w_j is linear in w: constant K: w_j = w (R. Hartley, ECCV 1994); no skew: w_12 = 0; known
principal point: w_13 = w_23 = 0; known aspect: w_11 = w_22 (L. de Agapito, R. Hartley, E. Hayman, CVPR 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conics import calibration_from_image
from thesisrecon.selfcalibration._frame import (
    HOMOGRAPHY_NOISE,
    ConicConstraints,
    ProjectiveScene,
    ReferenceFrame,
    SolverUnknowns,
)
from thesisrecon.selfcalibration._refinement import (
    dual_image_residuals,
    minimize_batch,
    numerical_jacobian,
    quadratic_rows,
)

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_ENTRY_WEIGHT = np.array([1.0 if a == b else np.sqrt(2.0) for a, b in _PAIRS])
_PLACE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_DESCENTS = 3
_REWEIGHTINGS = 4


def infinite_homographies(frame: ReferenceFrame, planes: F64) -> F64:
    """Compute the infinite homographies A_i - a_i p' (3.29) from the reference view, with determinant 1.

    Parameters
    ----------
    frame : ReferenceFrame
        Cameras.
    planes : ndarray (B, 3)
        Planes at infinity.

    Returns
    -------
    ndarray (B, R, 3, 3)
        Homographies; NaN if the plane passes through a camera centre.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.selfcalibration._frame import example_frame
    >>> frame, p = example_frame(f=1.2)
    >>> H = infinite_homographies(frame, p[None])[0]
    >>> R = np.diag([1 / 1.2, 1 / 1.2, 1.0]) @ H @ np.diag([1.2, 1.2, 1.0])
    >>> bool(np.allclose(R @ R.swapaxes(1, 2), np.eye(3)))
    True
    """
    H = frame.A[None] - frame.a[None, :, :, None] * planes[:, None, None, :]
    det = np.linalg.det(H)
    size = np.linalg.norm(H, axis=(-2, -1)) ** 3
    det = np.where(np.abs(det) > 1e-13 * size, det, np.nan)
    return np.asarray(H / np.cbrt(det)[..., None, None])


def dual_conic_of_constant_camera(H: F64) -> tuple[F64, F64]:
    """Solve w* = H w* H' for the dual image of the absolute conic of a constant K (R. Hartley, ECCV 1994).

    Parameters
    ----------
    H : ndarray (R, 3, 3)
        Infinite homographies of determinant 1.

    Returns
    -------
    w : ndarray (3, 3)
        w* ~ K K'.
    s : ndarray (6,)
        Singular values: the last is 0 for exact homographies; if the fifth is 0 too, w* is one of a family.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.selfcalibration._frame import example_frame
    >>> frame, p = example_frame(f=1.2)
    >>> w, s = dual_conic_of_constant_camera(infinite_homographies(frame, p[None])[0])
    >>> np.round(np.diag(w / w[2, 2]) ** 0.5, 6)
    array([1.2, 1.2, 1. ])
    """
    equations = _transfer_matrix(H.swapaxes(-1, -2)) - np.eye(6)
    _, s, Vt = np.linalg.svd((_ENTRY_WEIGHT[:, None] * equations).reshape(-1, 6), full_matrices=False)
    w = Vt[5][_PLACE]
    return (w if np.trace(w) > 0 else -w), s


def _transfer_matrix(M: F64) -> F64:
    """Return the matrices (..., 6, 6) from the entries of a symmetric w to those of M' w M."""
    x, y = (M[..., :, [pair[side] for pair in _PAIRS]].swapaxes(-1, -2) for side in (0, 1))
    return quadratic_rows(x, y)


def _conic_equations(H: F64, constraints: ConicConstraints, focals: F64) -> F64:
    """Return rows (B, M, 6) in the entries 11, 12, 13, 22, 23, 33 of w in the reference view.

    H (B, R, 3, 3) of determinant 1 or NaN (no row); ``focals`` (B, R) are unit-free estimates: dividing the
    coordinates by the reference focal length balances entries and weights.
    """
    focals = focals[:, constraints.first]
    scale = np.stack([focals, focals, np.ones_like(focals)], axis=-1)
    reference = scale[:, constraints.reference]
    bad = np.asarray(~np.isfinite(H).all(axis=(-2, -1)))
    scaled = np.where(bad[..., None, None], np.eye(3), H) / scale[..., :, None] * reference[:, None, None, :]
    det = np.linalg.det(scaled)
    carried = _transfer_matrix(np.linalg.inv(scaled / np.cbrt(det)[..., None, None]))
    carried[bad] = 0.0
    std = np.repeat(constraints.std[None], len(H), axis=0)
    std[..., :3] /= focals[..., None]
    weight = HOMOGRAPHY_NOISE / np.hypot(std, HOMOGRAPHY_NOISE)
    half_aspect = (carried[..., 0, :] - carried[..., 3, :]) / 2.0
    known = np.stack([carried[..., 1, :], carried[..., 2, :], carried[..., 4, :], half_aspect], axis=2)
    later = np.flatnonzero(constraints.first != np.arange(H.shape[1]))
    constant = carried[:, later] - carried[:, constraints.first[later]]
    constant[bad[:, later] | bad[:, constraints.first[later]]] = 0.0
    return np.concatenate(
        [(known * weight[..., None]).reshape(len(H), 4 * H.shape[1], 6),
         (constant * _ENTRY_WEIGHT[:, None]).reshape(len(H), 6 * len(later), 6)], axis=1,
    )  # fmt: skip


@dataclass(frozen=True)
class ConicBatch:
    """Linear solutions for B planes, NaN if no real camera fits.

    Parameters
    ----------
    f2 : ndarray (B,)
        Squared focal lengths of the reference view.
    residuals : ndarray (B, M)
        Residuals of the equations over their second smallest singular value.
    """

    f2: F64
    residuals: F64

    @property
    def score(self) -> F64:
        """Smallest over second smallest singular value (B,): 0 for the true plane, inf if not a camera."""
        return np.asarray(np.nan_to_num(np.linalg.norm(self.residuals, axis=1), nan=np.inf))


def solve_conic_batch(H: F64, constraints: ConicConstraints) -> ConicBatch:
    """Solve for the image conics of many planes at once, without reweighting.

    Parameters
    ----------
    H : ndarray (B, R, 3, 3)
        Infinite homographies of determinant 1.
    constraints : ConicConstraints
        Prior knowledge of the cameras.

    Returns
    -------
    ConicBatch
        Squared focal lengths and residuals.
    """
    A = _conic_equations(H, constraints, np.ones(H.shape[:2]))
    value, vector = np.linalg.eigh(np.einsum("bri,brj->bij", A, A))
    w = vector[:, :, 0] * np.where(vector[:, [0, 3, 5], 0].sum(axis=1) < 0, -1.0, 1.0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        f2 = 2.0 * w[:, 5] / (w[:, 0] + w[:, 3])
    bad = ~(f2 > 0) | ~np.isfinite(f2) | (w[:, 0] * w[:, 3] <= 0) | ~np.isfinite(H).all(axis=(1, 2, 3))
    residuals = np.einsum("brk,bk->br", A, w) / np.sqrt(np.maximum(value[:, 1:2], 1e-300))
    return ConicBatch(np.where(bad, np.nan, f2), np.where(bad[:, None], np.nan, residuals))


@dataclass(frozen=True)
class _ImageConic:
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
        # The second bound is for cameras that do not rotate: their equations are rounding errors only.
        return bool(s[4] > 1e-7 * max(s[0], 1e-3) and s[4] > 2.0 * s[5])


def solve_conic(H: F64, constraints: ConicConstraints, *, orthogonal: F64 | None = None) -> _ImageConic:
    """Solve for the image of the absolute conic by SVD, reweighted by the estimated focal lengths.

    Parameters
    ----------
    H : ndarray (R, 3, 3)
        Infinite homographies of determinant 1.
    constraints : ConicConstraints
        Prior knowledge of the cameras.
    orthogonal : ndarray (M, 2, 3), optional
        Pairs of vanishing points in the reference view of orthogonal directions: x' w y = 0.

    Returns
    -------
    _ImageConic
        The conic with its singular values.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.selfcalibration._frame import example_frame, square_pixel_constraints
    >>> frame, p = example_frame(f=1.2)
    >>> conic = solve_conic(infinite_homographies(frame, p[None])[0], square_pixel_constraints(frame))
    >>> np.round(np.sqrt(conic.w[2, 2] / np.diag(conic.w)), 6)
    array([1.2, 1.2, 1. ])
    """
    focals = np.ones((1, len(H)))
    conic = _ImageConic(np.eye(3), np.zeros(6))
    for _ in range(_REWEIGHTINGS):
        rows = _conic_equations(H[None], constraints, focals)[0]
        back = np.array([focals[0, constraints.first[constraints.reference]]] * 2 + [1.0])
        if orthogonal is not None:
            pairs = orthogonal / back
            x, y = np.swapaxes(pairs / np.linalg.norm(pairs, axis=-1, keepdims=True), 0, 1)
            rows = np.concatenate([rows, quadratic_rows(x, y)])
        _, s, Vt = np.linalg.svd(rows, full_matrices=False)
        w = Vt[5][_PLACE]
        w = (w if np.trace(w) > 0 else -w) / np.outer(back, back)
        conic = _ImageConic(np.asarray(w / np.linalg.norm(w)), s)
        if not conic.definite:
            break
        focals = np.clip(_focals(H, conic.w), 0.02, 200.0)[None]
    return conic


def _transferred_conics(H: F64, w: F64) -> F64:
    """Return w_j = H_j^-T w H_j^-1 (R, 3, 3)."""
    inverse = np.linalg.inv(H)
    return np.asarray(inverse.swapaxes(-1, -2) @ w @ inverse)


def _focals(H: F64, w: F64) -> F64:
    """Return unit-free focal lengths (R,) of the transferred conics, 1 without a homography."""
    good = np.asarray(np.isfinite(H).all(axis=(1, 2)))
    usable = np.asarray(np.where(good[:, None, None], H, np.eye(3)), dtype=np.float64)
    dual = np.linalg.inv(_transferred_conics(usable, w))
    centred = dual[:, [0, 1], [0, 1]] / dual[:, 2, 2, None] - (dual[:, :2, 2] / dual[:, 2, 2, None]) ** 2
    return np.where(good, np.sqrt(np.abs(np.prod(centred, axis=1)) ** 0.5), 1.0)


@dataclass(frozen=True)
class LinearAbsoluteConic:
    """Hartley's method: the image of the absolute conic by linear equations, K by Cholesky factorization.

    With a constant K and no other prior the equations are w* = H w* H', else those of :func:`solve_conic`.
    """

    def calibrations(self, scene: ProjectiveScene, plane: F64) -> F64:
        """Compute the calibrations for a plane at infinity.

        Parameters
        ----------
        scene : ProjectiveScene
            Cameras and prior.
        plane : ndarray (3,)
            Plane p.

        Returns
        -------
        ndarray (R, 3, 3)
            Unit-free calibrations.

        Raises
        ------
        StageFailure
            If the conic is not positive definite, or the motion leaves a family of conics.
        """
        frame, constraints = scene.frame, scene.constraints
        H = _homographies(frame, plane)
        one_camera = bool((constraints.first == constraints.first[0]).all())
        if one_camera and np.isinf(constraints.std).all() and scene.orthogonal is None:
            dual, s = dual_conic_of_constant_camera(H)
            definite = (np.linalg.eigvalsh(dual) > 0).all()
            conic = _ImageConic(np.asarray(np.linalg.inv(dual)) if definite else dual, s)
        else:
            conic = solve_conic(H, constraints, orthogonal=scene.orthogonal)
        if not conic.determined:
            raise _undetermined_failure(frame, H, conic)
        if not conic.definite:
            values = np.linalg.eigvalsh(conic.w)
            raise StageFailure(
                "the image of the absolute conic is not that of a real camera",
                f"its eigenvalues are {values[0]:.2e}, {values[1]:.2e} and {values[2]:.2e}, not all positive",
                "the plane at infinity or the prior of the intrinsics is wrong",
            )
        K = np.array([calibration_from_image(w) for w in _transferred_conics(H, conic.w)])
        return _apply_known_values(scene.unknown, K)


@dataclass(frozen=True)
class FixedPlaneQuadric:
    """Pollefeys' method: the nonlinear quadric with a fixed plane, over all unknown intrinsics.

    Parameters
    ----------
    focal_range, starts : (float, float), int
        Range of the starting focal lengths in long sides, and their number.
    """

    focal_range: tuple[float, float] = (0.3, 10.0)
    starts: int = 9

    def calibrations(self, scene: ProjectiveScene, plane: F64) -> F64:
        """Compute the calibrations for a plane at infinity.

        Parameters
        ----------
        scene : ProjectiveScene
            Cameras and prior.
        plane : ndarray (3,)
            Plane p.

        Returns
        -------
        ndarray (R, 3, 3)
            Unit-free calibrations.

        Raises
        ------
        StageFailure
            If the criterion does not determine the calibrations.
        """
        unknown, frame = scene.unknown, scene.frame
        H = _homographies(frame, plane)
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
            "the plane at infinity passes through a camera centre",
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
    """Return the largest rotation (degrees) between the reference view and the others, and its axis.

    An infinite homography of a constant K is conjugate to a rotation: its trace is 1 + 2 cos(angle), its real
    eigenvector the vanishing point of the axis.
    """
    cosine = (np.trace(H, axis1=1, axis2=2) - 1.0) / 2.0
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    value, vector = np.linalg.eig(H[angle.argmax()])
    axis = np.real(vector[:, np.abs(value - 1.0).argmin()])
    return float(angle.max()), np.asarray(axis / np.linalg.norm(axis))


def _undetermined_failure(frame: ReferenceFrame, H: F64, conic: _ImageConic | None) -> StageFailure:
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
        "a one-parameter family of calibrations fits the plane at infinity: all rotations have one axis",
        f"{found}; largest rotation {angle:.1f} deg with its axis at ({place[0]:.0f}, {place[1]:.0f}) px",
        "rotate the camera about a second axis, or assume square pixels without skew",
    )

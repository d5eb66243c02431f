"""Chapter 7, stratified: Hartley's way: the image of the absolute conic from infinite homographies, linearly.

A plane at infinity gives its homographies H_j from the reference view to the others (3.29), which are
K_j R K_r^-1 up to scale (3.31). With det H_j = 1 the image of the absolute conic is carried by them exactly,
w_j = H_j^-T w H_j^-1, so whatever is known of w_j is linear in w:

* a camera whose K is constant has w_j = w, six equations (Hartley, "Self-calibration from multiple views with
  a rotating camera", ECCV 1994, who writes them for the dual w* = H w* H');
* no skew is w_12 = 0, a known principal point w_13 = w_23 = 0, a known aspect w_11 = w_22, in coordinates
  from which these values are taken away (de Agapito, Hartley and Hayman, CVPR 1999).

Chapter 7, stratified: the calibration under a known plane at infinity, Hartley's and Pollefeys' ways.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conics import calibration_from_image
from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.selfcalibration.quadric import dual_image_residuals
from thesisrecon.selfcalibration.refinement import minimize_batch, numerical_jacobian
from thesisrecon.selfcalibration.unknowns import HOMOGRAPHY_NOISE, ConicConstraints, SolverUnknowns

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_ENTRY_WEIGHT = np.array([1.0 if a == b else np.sqrt(2.0) for a, b in _PAIRS])
_PLACE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def infinite_homographies(frame: ReferenceFrame, planes: F64) -> F64:
    """H (B, R, 3, 3) = A_i - a_i p' (3.29) of planes (B, 3), reference view to view i, det H = 1.

    NaN where a plane runs through a camera's centre: it then has no such homography.
    """
    H = frame.A[None] - frame.a[None, :, :, None] * planes[:, None, None, :]
    det = np.linalg.det(H)
    size = np.linalg.norm(H, axis=(-2, -1)) ** 3
    det = np.where(np.abs(det) > 1e-13 * size, det, np.nan)
    return np.asarray(H / np.cbrt(det)[..., None, None])


def dual_conic_of_constant_camera(H: F64) -> tuple[F64, F64]:
    """w* ~ K K' (3, 3) of a constant K from homographies H (R, 3, 3) of determinant 1, and the six singular
    values of its equations w* = H w* H', largest first.

    The smallest is 0 for exact homographies; where the next one is 0 too w* is one of a family.
    """
    equations = _carried(H.swapaxes(-1, -2)) - np.eye(6)
    _, s, Vt = np.linalg.svd((_ENTRY_WEIGHT[:, None] * equations).reshape(-1, 6), full_matrices=False)
    return _positive(Vt[5][_PLACE]), s


def _carried(M: F64) -> F64:
    """(..., 6, 6) that takes the entries of symmetric w to those of M' w M."""
    x, y = (M[..., :, [pair[side] for pair in _PAIRS]].swapaxes(-1, -2) for side in (0, 1))
    terms = [x[..., i] * y[..., j] + (x[..., j] * y[..., i] if i != j else 0.0) for i, j in _PAIRS]
    return np.stack(terms, axis=-1)


def conic_equations(H: F64, knowledge: ConicConstraints, focals: F64) -> F64:
    """Rows (B, M, 6) in the entries 11, 12, 13, 22, 23, 33 of w in the reference view, scaled by the focals.

    H (B, R, 3, 3) of determinant 1 or NaN (then no row); ``focals`` (B, R) unit-free guesses: the unknown is
    w in coordinates divided by the reference's, which makes its entries alike and the weights right. The
    first row of ``focals`` in a camera of constant K counts for all its views.
    """
    focals = focals[:, knowledge.first]
    scale = np.stack([focals, focals, np.ones_like(focals)], axis=-1)
    reference = scale[:, knowledge.reference]
    bad = np.asarray(~np.isfinite(H).all(axis=(-2, -1)))
    scaled = np.where(bad[..., None, None], np.eye(3), H) / scale[..., :, None] * reference[:, None, None, :]
    det = np.linalg.det(scaled)
    carried = _carried(np.linalg.inv(scaled / np.cbrt(det)[..., None, None]))
    carried[bad] = 0.0
    std = np.repeat(knowledge.std[None], len(H), axis=0)
    std[..., :3] /= focals[..., None]
    weight = HOMOGRAPHY_NOISE / np.hypot(std, HOMOGRAPHY_NOISE)
    half_aspect = (carried[..., 0, :] - carried[..., 3, :]) / 2.0
    known = np.stack([carried[..., 1, :], carried[..., 2, :], carried[..., 4, :], half_aspect], axis=2)
    later = np.flatnonzero(knowledge.first != np.arange(H.shape[1]))
    constant = carried[:, later] - carried[:, knowledge.first[later]]
    constant[bad[:, later] | bad[:, knowledge.first[later]]] = 0.0
    return np.concatenate(
        [(known * weight[..., None]).reshape(len(H), 4 * H.shape[1], 6),
         (constant * _ENTRY_WEIGHT[:, None]).reshape(len(H), 6 * len(later), 6)], axis=1,
    )  # fmt: skip


@dataclass(frozen=True)
class ConicBatch:
    """The linear solutions for B planes: squared focals ``f2`` (B,) of the reference view, NaN where the
    conic is not that of a real camera; ``residuals`` (B, M) of the equations over their second smallest
    singular value, NaN there too."""

    f2: F64
    residuals: F64

    @property
    def score(self) -> F64:
        """Smallest over second smallest singular value (B,): 0 for the right plane, infinite without a
        camera."""
        return np.asarray(np.nan_to_num(np.linalg.norm(self.residuals, axis=1), nan=np.inf))


def solve_conic_batch(H: F64, knowledge: ConicConstraints) -> ConicBatch:
    """The image conics of homographies H (B, R, 3, 3) at once, without reweighing."""
    A = conic_equations(H, knowledge, np.ones(H.shape[:2]))
    value, vector = np.linalg.eigh(np.einsum("bri,brj->bij", A, A))
    w = vector[:, :, 0] * np.where(vector[:, [0, 3, 5], 0].sum(axis=1) < 0, -1.0, 1.0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        f2 = 2.0 * w[:, 5] / (w[:, 0] + w[:, 3])
    bad = ~(f2 > 0) | ~np.isfinite(f2) | (w[:, 0] * w[:, 3] <= 0) | ~np.isfinite(H).all(axis=(1, 2, 3))
    residuals = np.einsum("brk,bk->br", A, w) / np.sqrt(np.maximum(value[:, 1:2], 1e-300))
    return ConicBatch(np.where(bad, np.nan, f2), np.where(bad[:, None], np.nan, residuals))


@dataclass(frozen=True)
class ImageConic:
    """``w`` (3, 3) image of the absolute conic in the reference view, of norm 1 and positive trace, and the
    six ``singular_values`` of its equations, largest first."""

    w: F64
    singular_values: F64

    @property
    def definite(self) -> bool:
        """Whether a real camera has this image."""
        return bool((np.linalg.eigvalsh(self.w) > 0).all())

    @property
    def determined(self) -> bool:
        """Whether the equations have one solution: the second smallest singular value stands out."""
        s = self.singular_values
        # The second bound is for cameras that do not turn at all, whose equations are nothing but rounding.
        return bool(s[4] > 1e-7 * max(s[0], 1e-3) and s[4] > 2.0 * s[5])


def solve_conic(
    H: F64, knowledge: ConicConstraints, *, orthogonal: F64 | None = None, iterations: int = 4
) -> ImageConic:
    """The image conic of homographies H (R, 3, 3), by SVD of equations reweighed by the focals found.

    ``orthogonal`` (M, 2, 3): vanishing points in the reference view of directions at right angles, each pair
    x, y an equation x' w y = 0 more.
    """
    focals = np.ones((1, len(H)))
    conic = ImageConic(np.eye(3), np.zeros(6))
    for _ in range(iterations):
        rows = conic_equations(H[None], knowledge, focals)[0]
        back = np.array([focals[0, knowledge.first[knowledge.reference]]] * 2 + [1.0])
        if orthogonal is not None and len(orthogonal):
            rows = np.concatenate([rows, _orthogonal_rows(orthogonal / back)])
        _, s, Vt = np.linalg.svd(rows, full_matrices=False)
        scaled = _positive(Vt[5][_PLACE])
        conic = ImageConic(_unit(scaled / np.outer(back, back)), s)
        if not conic.definite:
            break
        focals = np.clip(_focals(H, conic.w), 0.02, 200.0)[None]
    return conic


def _orthogonal_rows(pairs: F64) -> F64:
    x, y = np.swapaxes(pairs / np.linalg.norm(pairs, axis=-1, keepdims=True), 0, 1)
    terms = [x[:, i] * y[:, j] + (x[:, j] * y[:, i] if i != j else 0.0) for i, j in _PAIRS]
    return np.stack(terms, axis=-1)


def _positive(w: F64) -> F64:
    return w if np.trace(w) > 0 else -w


def _unit(w: F64) -> F64:
    return np.asarray(w / np.linalg.norm(w))


def _transferred_conics(H: F64, w: F64) -> F64:
    """w_j = H_j^-T w H_j^-1 (R, 3, 3)."""
    inverse = np.linalg.inv(H)
    return np.asarray(inverse.swapaxes(-1, -2) @ w @ inverse)


def _focals(H: F64, w: F64) -> F64:
    """Unit-free focals (R,) of the carried conics, 1 where a homography is missing."""
    good = np.asarray(np.isfinite(H).all(axis=(1, 2)))
    usable = np.asarray(np.where(good[:, None, None], H, np.eye(3)), dtype=np.float64)
    dual = np.linalg.inv(_transferred_conics(usable, w))
    centred = dual[:, [0, 1], [0, 1]] / dual[:, 2, 2, None] - (dual[:, :2, 2] / dual[:, 2, 2, None]) ** 2
    return np.where(good, np.sqrt(np.abs(np.prod(centred, axis=1)) ** 0.5), 1.0)


_DESCENTS = 3


@dataclass(frozen=True)
class CalibrationProblem:
    """What the calibration of a plane at infinity starts from: the cameras, what is assumed of them, and
    vanishing points ``orthogonal`` (M, 2, 3) in the reference view of directions at right angles."""

    frame: ReferenceFrame
    knowledge: ConicConstraints
    unknown: SolverUnknowns
    orthogonal: F64


@dataclass(frozen=True)
class LinearAbsoluteConic:
    """Hartley's way: the image of the absolute conic by linear equations, K by Cholesky.

    Where nothing is known of any K but that it is constant these are w* = H w* H'; else the equations of
    :func:`~thesisrecon.selfcalibration.hartley.conic_equations`.
    """

    def calibrations(self, strata: CalibrationProblem, plane: F64) -> F64:
        """Unit-free K (R, 3, 3) under a plane at infinity (3,).

        ``StageFailure`` where the conic is not definite (the plane, or what is assumed of the cameras, is
        wrong) and where the motion leaves a family of conics (rotations about one axis: named).
        """
        frame, knowledge = strata.frame, strata.knowledge
        H = _homographies(frame, plane)
        one_camera = bool((knowledge.first == knowledge.first[0]).all())
        if one_camera and np.isinf(knowledge.std).all() and not len(strata.orthogonal):
            dual, s = dual_conic_of_constant_camera(H)
            definite = bool((np.linalg.eigvalsh(dual) > 0).all())
            conic = ImageConic(np.asarray(np.linalg.inv(dual)) if definite else dual, s)
        else:
            conic = solve_conic(H, knowledge, orthogonal=strata.orthogonal)
        if not conic.determined:
            raise _undetermined(frame, H, conic)
        if not conic.definite:
            raise _indefinite(conic)
        K = np.array([calibration_from_image(w) for w in _transferred_conics(H, conic.w)])
        return _apply_known_values(strata.unknown, K)


@dataclass(frozen=True)
class FixedPlaneQuadric:
    """Pollefeys' way: the criterion of the absolute dual quadric with its plane held fixed.

    min sum |K_i K_i' / |.| - H_i w* H_i' / |.||^2 (IJCV 32(1), 1999) over all unknown intrinsics, started at
    the best of ``starts`` focals over ``focal_range`` (in long sides).
    """

    focal_range: tuple[float, float] = (0.3, 10.0)
    starts: int = 9

    def calibrations(self, strata: CalibrationProblem, plane: F64) -> F64:
        """Unit-free K (R, 3, 3) under a plane at infinity (3,); ``StageFailure`` where the criterion does not
        determine it."""
        unknown, frame = strata.unknown, strata.frame
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


def _apply_known_values(unknown: SolverUnknowns, K: F64) -> F64:
    """Calibrations (R, 3, 3) brought to the assumptions: what is known takes its value, what is shared its
    mean."""
    f = K[:, 0, 0]
    values = np.column_stack([np.log(f), np.log(K[:, 1, 1] / f), K[:, 0, 1], K[:, 0, 2], K[:, 1, 2]])
    # Where the aspect is known the two focals are two measurements of one.
    values[:, 0] += np.where(unknown.index[:, 1] < 0, (values[:, 1] - unknown.known[:, 1]) / 2.0, 0.0)
    asked = unknown.index >= 0
    total = np.bincount(unknown.index[asked], values[asked], minlength=len(unknown.mean))
    count = np.bincount(unknown.index[asked], minlength=len(unknown.mean))
    return np.asarray(unknown.calibrations((total / np.maximum(count, 1))[None])[0])


def largest_rotation(H: F64) -> tuple[float, F64]:
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
    angle, axis = largest_rotation(H)
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

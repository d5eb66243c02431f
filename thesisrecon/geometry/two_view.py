"""Section 3.6: two views: F, epipoles and epipolar lines, Sampson distances, homographies, canonical cameras.

x2' F x1 = 0; the epipolar line in image 2 is F x1, in image 1 F' x2; F e1 = 0, F' e2 = 0. Homographies are
those of a plane (3.6.4) and of matches, with the test for parallax.
"""

import numpy as np

from thesisrecon.arrays import F64, require_finite, require_shapes
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import (
    checked_unit,
    cross_matrix,
    dehomogenize,
    homogenize,
    normalizing_transform,
    unit_norm,
    unit_normals,
)


def _check(F: F64, caller: str) -> None:
    require_shapes(caller, F=(F, (3, 3)))
    require_finite(caller, F)


def enforce_rank_two(F: F64) -> F64:
    """The nearest matrix of rank 2 (Frobenius norm), scaled to unit norm."""
    _check(F, "enforce_rank_two")
    U, s, Vt = np.linalg.svd(F)
    return unit_norm((U[:, :2] * s[:2]) @ Vt[:2])


def fundamental_from_cameras(P1: F64, P2: F64) -> F64:
    """F = [e2]x P2 P1^+ of two cameras, of unit norm and rank 2, e2 = P2 C1 (3.33, 3.35).

    Equal centres are a ``ValueError``.
    """
    P1, P2 = checked_unit(P1, "fundamental_from_cameras"), checked_unit(P2, "fundamental_from_cameras")
    C1 = checked_unit(camera_centre(P1), "fundamental_from_cameras, for the centre of its first camera,")
    e2 = P2 @ C1
    # M2 is small against P2 if the origin is far from the cameras; e2 = M2 (C1 - C2) C1_4.
    if not np.linalg.norm(e2) > 1e-12 * np.linalg.norm(P2[:, :3]):
        raise ValueError("fundamental_from_cameras needs cameras with different centres")
    return unit_norm(cross_matrix(e2) @ P2 @ np.linalg.pinv(P1))


def epipoles(F: F64) -> tuple[F64, F64]:
    """The unit epipoles, F e1 = 0 and F' e2 = 0, of the nearest matrix of rank 2 (3.34, 3.35).

    They are the thesis' e_ji and e_ij (section 5.3 exchanges the two).
    """
    _check(F, "epipoles")
    U, _, Vt = np.linalg.svd(F)
    return Vt[2], U[:, 2]


def lines_of_points(F: F64, xy1: F64) -> F64:
    """The epipolar lines F x1 (N, 3) with unit normals; see :func:`thesisrecon.epipolar_lines`."""
    x = homogenize(xy1)
    lines = x @ F.T
    # At an epipole only rounding errors are left.
    lines[np.linalg.norm(lines, axis=1) <= 1e-15 * np.linalg.norm(F) * np.linalg.norm(x, axis=1)] = 0.0
    return unit_normals(lines)


def clip_line(line: F64, width: float, height: float) -> F64 | None:
    """The ends (2, 2) of a line a x + b y + c = 0 in an image, left first; None if it misses the image."""
    a, b, c = (float(v) for v in line)
    hits = [(x, -(a * x + c) / b) for x in (-0.5, width - 0.5) if b != 0]
    hits += [(-(b * y + c) / a, y) for y in (-0.5, height - 0.5) if a != 0]
    low = -0.5 - 1e-6 * max(width, height)
    inside = [(x, y) for x, y in hits if low <= x <= width - 1 - low and low <= y <= height - 1 - low]
    return np.array([min(inside), max(inside)]) if len(inside) >= 2 else None


def epipolar_distances(F: F64, xy1: F64, xy2: F64) -> F64:
    """Distances (N, 2) of x1 to the line F' x2 and of x2 to F x1 (5.5); both are multiples of x2' F x1."""
    of_first = np.sum(homogenize(xy1) * lines_of_points(F.T, xy2), axis=1)
    of_second = np.sum(homogenize(xy2) * lines_of_points(F, xy1), axis=1)
    return np.asarray(np.abs(np.column_stack([of_first, of_second])))


def _algebraic_residuals(F: F64, xy1: F64, xy2: F64) -> F64:
    """x2' F x1 (N,) of (5.2)."""
    residuals: F64 = np.einsum("na,ab,nb->n", homogenize(xy2), F, homogenize(xy1))
    return residuals


def _gradients(F: F64, xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Squared norms of the gradient of x2' F x1 by x2 and by x1; (N,) each, never 0."""
    lines2, lines1 = homogenize(xy1) @ F.T, homogenize(xy2) @ F
    return np.sum(lines2[:, :2] ** 2, axis=1) + 1e-300, np.sum(lines1[:, :2] ** 2, axis=1) + 1e-300


def sampson_residuals(F: F64, xy1: F64, xy2: F64) -> F64:
    """Signed Sampson distances (N,) (5.4): to the nearest exact match to first order, of the noise (5.3)."""
    g2, g1 = _gradients(F, xy1, xy2)
    return _algebraic_residuals(F, xy1, xy2) / np.sqrt(g1 + g2)


def symmetric_residuals(F: F64, xy1: F64, xy2: F64) -> F64:
    """The root (N,) of the sum of the two squared distances to the epipolar lines (5.6)."""
    g2, g1 = _gradients(F, xy1, xy2)
    return np.abs(_algebraic_residuals(F, xy1, xy2)) * np.sqrt(1.0 / g1 + 1.0 / g2)


def epipolar_distance_std(F: F64, covariance: F64, xy1: F64, xy2: F64) -> F64:
    """Standard deviations (N,) of the distances of exact matches to their epipolar lines in image 2.

    First order in the error of F alone, whose entries have the ``covariance`` (9, 9). A match with own noise
    sigma has sqrt(std^2 + sigma^2 (1 + g1 / g2)), g1 and g2 the squared gradients of x2' F x1 by x1 and x2.
    """
    x1, x2 = homogenize(xy1), homogenize(xy2)
    lines = x1 @ F.T
    norm = np.sqrt(np.sum(lines[:, :2] ** 2, axis=1, keepdims=True)) + 1e-300
    # The distance is x2 . l / |l12|; near 0 only the derivative of the numerator matters.
    foot = x2.copy()
    foot[:, :2] -= np.sum(x2 * lines, axis=1, keepdims=True) * lines[:, :2] / norm**2
    gradient = (foot[:, :, None] * x1[:, None, :]).reshape(-1, 9) / norm
    variance = np.einsum("na,ab,nb->n", gradient, covariance, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def plane_homography(P1: F64, P2: F64, plane: F64) -> F64:
    """The homography x2 ~ H x1 of unit norm between two images induced by a plane (3.29 - 3.32).

    H = P2 ((Pi'C) I - C Pi') P1^+ with the centre C of P1: the ray of a pixel meets the plane and the point
    is projected. For P1 = [I 0], P2 = [M m] and the plane (pi, 1) it is H_Pi = M - m pi' (3.29), and [M m] =
    [H_Pi + e2 pi', e2] with the epipole e2 = m (3.36-3.40). In general it equals H_Pi2 H_Pi1^-1 (3.30), also
    for planes through the origin; singular for a plane through the second centre.
    """
    P1, P2, plane = (checked_unit(array, "plane_homography") for array in (P1, P2, plane))
    centre = checked_unit(camera_centre(P1), "plane_homography, for the centre of its first camera,")
    if not abs(plane @ centre) > 1e-14:
        raise ValueError("plane_homography needs a plane that does not contain the first camera's centre")
    meet = (plane @ centre) * np.eye(4) - np.outer(centre, plane)
    return unit_norm(np.asarray(P2 @ meet @ np.linalg.pinv(P1)))


def infinite_homography(P1: F64, P2: F64) -> F64:
    """H = M2 M1^-1 (3.31), the homography of the plane (0, 0, 0, 1), of unit norm.

    K2 R2 R1' K1^-1 in a metric frame (3.28, where the thesis' R are transposed), for any centres.
    """
    require_finite("infinite_homography", P1, P2)
    if not np.linalg.cond(P1[:, :3]) < 1e14:
        raise ValueError("infinite_homography needs a finite first camera")
    H = np.linalg.solve(P1[:, :3].T, P2[:, :3].T).T
    return unit_norm(np.asarray(H, dtype=np.float64))


def quasi_euclidean_planes(F: F64) -> F64:
    """The two v that make the left part of P2 (:func:`canonical_cameras`) nearest to a rotation.

    v = +-(s1 + s2) / 2 e1 with the singular values s1 >= s2 of F: near the plane at infinity if the
    calibration is near the identity (Beardsley, Zisserman and Murray, IJCV 23, 1997). Only matches decide
    between the two, which differ by 180 degrees about the baseline; that of the smaller rotation is first.
    """
    F = unit_norm(F)
    e1, e2 = epipoles(F)
    M = -cross_matrix(e2) @ F
    v = 0.5 * np.linalg.svd(F, compute_uv=False)[:2].sum() * e1
    turned = float(np.trace(M) * np.linalg.det(M + np.outer(e2, v)))
    return np.stack([v, -v]) if turned >= 0.0 else np.stack([-v, v])


def canonical_cameras(F: F64, *, plane: F64 | None = None, scale: float = 1.0) -> tuple[F64, F64]:
    """P1 = [I 0], P2 = [H  scale e2] (3.42), H = -[e2]x F + e2 v': two cameras of F.

    H is the homography of a plane for any v (3.39), [e2]x H = F for F of unit norm. (3.41) is the singular H
    of v = 0, the plane through the second centre; with the default v, the first of
    :func:`quasi_euclidean_planes`, its condition number is that of F.
    """
    if scale == 0.0 or not np.isfinite(scale):
        raise ValueError(f"canonical_cameras needs a finite scale other than 0; got {scale}")
    F = unit_norm(F)
    _, e2 = epipoles(F)
    plane = quasi_euclidean_planes(F)[0] if plane is None else plane
    P2 = np.hstack([-cross_matrix(e2) @ F + np.outer(e2, plane), scale * e2[:, None]])
    return np.hstack([np.eye(3), np.zeros((3, 1))]), P2


_PARALLAX_PER_NOISE, _MIN_PARALLAX_PX = 3.0, 0.05
"""Least parallax (90 % quantile): this multiple of the epipolar distances plus this many px."""
_MAX_OFF_PX, _MAX_OFF_REL = 1.0, 0.001
"""Largest median distance of the matches of F from their epipolar lines, in px or over their extent."""


def homography_linear(xy1: F64, xy2: F64) -> F64:
    """The homography x2 ~ H x1 of unit norm by normalised DLT of four matches or more (HZ algorithm 4.2)."""
    require_shapes("homography_linear", xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    if len(xy1) < 4:
        raise ValueError(f"homography_linear needs at least 4 matches; got {len(xy1)}")
    T1, T2 = normalizing_transform(xy1), normalizing_transform(xy2)
    x1, (u, v) = homogenize(xy1) @ T1.T, (xy2 @ T2[:2, :2].T + T2[:2, 2]).T
    zero = np.zeros_like(x1)
    A = np.concatenate([np.hstack([x1, zero, -u[:, None] * x1]), np.hstack([zero, x1, -v[:, None] * x1])])
    H: F64 = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
    return unit_norm(np.asarray(np.linalg.solve(T2, H @ T1)))


def homography_residuals(H: F64, xy1: F64, xy2: F64) -> F64:
    """Distances |x2 - H x1| (N,) in image 2; inf for points that H maps to infinity."""
    moved = dehomogenize(homogenize(xy1) @ H.T)
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(xy2 - moved, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def homography_sampson_residuals(H: F64, xy1: F64, xy2: F64) -> F64:
    """Whitened residuals (N, 2) of x2 ~ H x1, px (Chum, Pajdla and Sturm, CVIU 97(1), 2005).

    Each has to first order the standard deviation of one image coordinate.
    """
    x1 = homogenize(xy1)
    u, v, w = (x1 @ H.T).T
    c = np.stack([u - w * xy2[:, 0], v - w * xy2[:, 1]], axis=1)
    J = np.zeros((len(x1), 2, 4))
    J[:, :, :2] = H[None, :2, :2] - xy2[:, :, None] * H[2, :2]
    J[:, 0, 2] = J[:, 1, 3] = -w
    # Cholesky factor of J J' (2 x 2).
    a, b, d = (np.sum(J[:, i] * J[:, j], axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    l11 = np.sqrt(a + 1e-300)
    l21 = b / l11
    l22 = np.sqrt(np.maximum(d - l21**2, 1e-300))
    first = c[:, 0] / l11
    return np.stack([first, (c[:, 1] - l21 * first) / l22], axis=1)


def require_parallax_of_matches(
    F: F64, xy1: F64, xy2: F64, *, at_infinity: F64 | None = None, advice: str = ""
) -> None:
    """Raise ``StageFailure`` if one homography explains the N >= 4 inliers of F.

    With ``at_infinity``, the homography of the plane at infinity of known cameras, a plane has parallax.
    Without it, matches that are no inliers of F are refused too, as of images in the other order.
    """
    distances = np.abs(sampson_residuals(F, xy1, xy2))
    noise, off = (float(np.quantile(distances, share)) for share in (0.9, 0.5))
    most = max(_MAX_OFF_PX, _MAX_OFF_REL * float(max(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max())))
    if at_infinity is None:
        what, inliers = "one homography", np.ones(len(xy1), dtype=bool)
        # Least squares, fitted twice more without the worst tenth.
        for _ in range(3):
            H = homography_linear(xy1[inliers], xy2[inliers])
            residuals = homography_residuals(H, xy1, xy2)
            inliers = residuals <= np.fmax(np.quantile(residuals, 0.9), np.partition(residuals, 3)[3])
    else:
        what, residuals = "a scene at infinity", homography_residuals(at_infinity, xy1, xy2)
    parallax = float(np.quantile(residuals, 0.9))
    fits = at_infinity is not None or off <= most
    if fits and parallax > _PARALLAX_PER_NOISE * noise + _MIN_PARALLAX_PX:
        return
    if not fits and parallax > most:
        raise StageFailure.of("fundamental-of-other-matches", off)
    raise StageFailure.of("no-parallax", advice, what, len(xy1), parallax, noise)

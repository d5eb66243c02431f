"""Section 3.6: two views: F, epipoles and epipolar lines, Sampson distances, homographies, canonical cameras.

x2' F x1 = 0; the epipolar line in image 2 is F x1, in image 1 F' x2; F e1 = 0, F' e2 = 0.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64, require_finite, require_shapes
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.conditioning import checked_unit, unit_norm
from thesisrecon.geometry.homogeneous import cross_matrix, homogenize, unit_normals


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
    """Signed Sampson distances (N,) (5.4).

    To first order the distance of (x1, y1, x2, y2) to the nearest exact match, with the standard deviation of
    one image coordinate (5.3).
    """
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
    is projected. For P1 = [I 0], P2 = [M m] and the plane (pi, 1) it is H_Pi = M - m pi' (3.29), which maps
    the point (x, -pi'x) to its image; [M m] = [H_Pi + e2 pi', e2] with the epipole e2 = m (3.36-3.40). In
    general it equals H_Pi2 H_Pi1^-1 (3.30), also for planes through the origin; singular for a plane through
    the second centre.
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

    v = +-(s1 + s2) / 2 e1 with the singular values s1 >= s2 of F gives the left part the singular values s1,
    (s1 + s2) / 2, s2. With a calibration near the identity v is near the plane at infinity. The two solutions
    differ by a rotation of 180 degrees about the baseline; only matches decide between them. That of the
    smaller rotation is first (Beardsley, Zisserman and Murray, IJCV 23, 1997).
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

"""Section 3.6: what two views share: F, epipoles and lines, residuals, homographies, canonical cameras.

x2' F x1 = 0; the epipolar line in image 2 is F x1, in image 1 F' x2; F e1 = 0, F' e2 = 0.

Whether two photographs show any depth (section 5.5: what a turning camera or a plane leaves of F).
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import (
    cross_matrix,
    dehomogenize,
    homogenize,
    normalizing_transform,
    require_finite,
    unit_of,
)


def unit_norm(F: F64) -> F64:
    """F with Frobenius norm 1 (zeros stay zeros); (..., 3, 3)."""
    norm = np.sqrt(np.sum(F**2, axis=(-2, -1), keepdims=True))
    return F / np.where(norm > 0.0, norm, 1.0)


def _check(F: F64, caller: str) -> None:
    if F.shape != (3, 3):
        raise ValueError(f"{caller} needs a fundamental matrix (3, 3); got {F.shape}")
    require_finite(caller, F)


def enforce_rank_two(F: F64) -> F64:
    """The nearest matrix of rank 2 (Frobenius norm), scaled to unit norm; (3, 3), else ``ValueError``."""
    _check(F, "enforce_rank_two")
    U, s, Vt = np.linalg.svd(F)
    return unit_norm((U[:, :2] * s[:2]) @ Vt[:2])


def fundamental_from_cameras(P1: F64, P2: F64) -> F64:
    """F = [e2]x P2 P1^+ of two cameras (3, 4) with different centres, unit norm; e2 = P2 C1 (3.33).

    The line of x joins e2 and the image of P1^+ x, another point of its ray; F has rank 2 (3.35).

    Raises ``ValueError`` where the centres coincide: the views are then related by a homography, not by an F;
    and for cameras that are zero, not finite or of a rank below 3, which have no centre.
    """
    P1, P2 = unit_of(P1, "fundamental_from_cameras"), unit_of(P2, "fundamental_from_cameras")
    e2 = P2 @ unit_of(camera_centre(P1), "fundamental_from_cameras, for the centre of its first camera,")
    if not np.linalg.norm(e2) > 1e-12:
        raise ValueError("fundamental_from_cameras needs cameras with different centres")
    return unit_norm(cross_matrix(e2) @ P2 @ np.linalg.pinv(P1))


def epipoles(F: F64) -> tuple[F64, F64]:
    """Unit vectors e1, e2 (3,) with F e1 = 0 and F' e2 = 0, of the nearest matrix of rank 2 (3.34, 3.35).

    e2 is the thesis' e_ij, the image of the first centre, e1 its e_ji (section 5.3 exchanges the two). Raises
    ``ValueError`` for another shape and entries that are not finite.
    """
    _check(F, "epipoles")
    U, _, Vt = np.linalg.svd(F)
    return Vt[2], U[:, 2]


def epipolar_lines(F: F64, xy1: F64) -> F64:
    """Lines (N, 3) in image 2 of points (N, 2) of image 1, unit normals: l . (x, y, 1) is a distance in px.

    For lines in image 1 of points of image 2 pass F'. The line of an epipole is zero.
    """
    lines = homogenize(xy1) @ F.T
    norm = np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    return lines / np.where(norm > 0.0, norm, 1.0)


def epipolar_distances(F: F64, xy1: F64, xy2: F64) -> F64:
    """Distances (N, 2) in px of x1 to the epipolar line F' x2 and of x2 to F x1 (5.5).

    Both are multiples of the one residual x2' F x1: small together, large together.
    """
    of_first = np.sum(homogenize(xy1) * epipolar_lines(F.T, xy2), axis=1)
    of_second = np.sum(homogenize(xy2) * epipolar_lines(F, xy1), axis=1)
    return np.asarray(np.abs(np.column_stack([of_first, of_second])))


def algebraic_residuals(F: F64, xy1: F64, xy2: F64) -> F64:
    """x2' F x1 of (5.2); (N,)."""
    residuals: F64 = np.einsum("na,ab,nb->n", homogenize(xy2), F, homogenize(xy1))
    return residuals


def _gradients(F: F64, xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Squared norms of the gradient of x2' F x1 by x2 and by x1; (N,) each, never 0."""
    lines2, lines1 = homogenize(xy1) @ F.T, homogenize(xy2) @ F
    return np.sum(lines2[:, :2] ** 2, axis=1) + 1e-300, np.sum(lines1[:, :2] ** 2, axis=1) + 1e-300


def sampson_residuals(F: F64, xy1: F64, xy2: F64) -> F64:
    """Signed Sampson distances in px (5.4); (N,).

    To first order the distance of (x1, y1, x2, y2) to the nearest exact match; its standard deviation is that
    of one image coordinate: the residual's own, sigma |grad r| (5.3), divides it.
    """
    g2, g1 = _gradients(F, xy1, xy2)
    return algebraic_residuals(F, xy1, xy2) / np.sqrt(g1 + g2)


def symmetric_residuals(F: F64, xy1: F64, xy2: F64) -> F64:
    """Root of the sum of the two squared distances to the epipolar lines (5.6), px; (N,) >= 0."""
    g2, g1 = _gradients(F, xy1, xy2)
    return np.abs(algebraic_residuals(F, xy1, xy2)) * np.sqrt(1.0 / g1 + 1.0 / g2)


def estimate_homography(xy1: F64, xy2: F64) -> F64:
    """H (3, 3), unit norm, with x2 ~ H x1 of N >= 4 matches by the normalised linear transform (HZ 4.2).

    Raises ``ValueError`` for fewer than 4 matches, wrong shapes or points that are all equal.
    """
    if xy1.shape != xy2.shape or xy1.ndim != 2 or xy1.shape[1] != 2 or len(xy1) < 4:
        raise ValueError(f"estimate_homography needs two (N >= 4, 2) arrays; got {xy1.shape} and {xy2.shape}")
    T1, T2 = normalizing_transform(xy1), normalizing_transform(xy2)
    x1, (u, v) = homogenize(xy1) @ T1.T, (xy2 @ T2[:2, :2].T + T2[:2, 2]).T
    zero = np.zeros_like(x1)
    A = np.concatenate([np.hstack([x1, zero, -u[:, None] * x1]), np.hstack([zero, x1, -v[:, None] * x1])])
    H: F64 = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
    return unit_norm(np.asarray(np.linalg.solve(T2, H @ T1)))


def homography_residuals(H: F64, xy1: F64, xy2: F64) -> F64:
    """Distances |x2 - H x1| in image 2, px; (N,), inf for points that H sends to infinity."""
    moved = dehomogenize(homogenize(xy1) @ H.T)
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(xy2 - moved, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def homography_distances(H: F64, xy1: F64, xy2: F64) -> F64:
    """Whitened residuals (N, 2) of x2 ~ H x1: to first order the two parts of the distance to the nearest
    exact match, each with the standard deviation of one coordinate (Sampson; Chum, Pajdla and Sturm 2005)."""
    x1 = homogenize(xy1)
    u, v, w = (x1 @ H.T).T
    c = np.stack([u - w * xy2[:, 0], v - w * xy2[:, 1]], axis=1)
    J = np.zeros((len(x1), 2, 4))
    J[:, :, :2] = H[None, :2, :2] - xy2[:, :, None] * H[2, :2]
    J[:, 0, 2] = J[:, 1, 3] = -w
    # Cholesky of J J' by hand: two by two.
    a, b, d = (np.sum(J[:, i] * J[:, j], axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    l11 = np.sqrt(a + 1e-300)
    l21 = b / l11
    l22 = np.sqrt(np.maximum(d - l21**2, 1e-300))
    first = c[:, 0] / l11
    return np.stack([first, (c[:, 1] - l21 * first) / l22], axis=1)


def rotation_planes(F: F64) -> F64:
    """The two v (2, 3) for which the left part of :func:`canonical_cameras` comes nearest to a rotation.

    With the singular values s1 >= s2 of F and unit epipoles, v = +-(s1 + s2) / 2 e1 makes -[e2]x F + e2 v'
    have the singular values s1, (s1 + s2) / 2, s2: the nearest multiple of a rotation that any v gives (least
    squares). In pixels that make the calibration near the identity, the plane v plays infinity well, so that
    the frame is near a metric one (quasi-Euclidean; Beardsley, Zisserman and Murray, IJCV 23, 1997). The two
    differ by half a turn about the baseline, as the two rotations of an essential matrix do; the one that
    turns less comes first, and only matches can tell.
    """
    F = unit_norm(F)
    e1, e2 = epipoles(F)
    M = -cross_matrix(e2) @ F
    v = 0.5 * np.linalg.svd(F, compute_uv=False)[:2].sum() * e1
    turned = float(np.trace(M) * np.linalg.det(M + np.outer(e2, v)))
    return np.stack([v, -v]) if turned >= 0.0 else np.stack([-v, v])


def canonical_cameras(F: F64, *, plane: F64 | None = None, scale: float = 1.0) -> tuple[F64, F64]:
    """P1 = [I 0], P2 = [-[e2]x F + e2 v'  scale e2] (3.42): two cameras of a projective frame that have F.

    ``plane`` v (3,) are the free coordinates of the plane that plays the part of infinity. With v = 0 the
    left part of P2 is singular; without a plane v is the first of :func:`rotation_planes`, for which its
    condition number is s1 / s2, the ratio of the singular values of F. ``scale`` is the last of the four free
    parameters and must not be 0.
    """
    if scale == 0.0 or not np.isfinite(scale):
        raise ValueError(f"canonical_cameras needs a finite scale other than 0; got {scale}")
    F = unit_norm(F)
    _, e2 = epipoles(F)
    plane = rotation_planes(F)[0] if plane is None else plane
    P2 = np.hstack([-cross_matrix(e2) @ F + np.outer(e2, plane), scale * e2[:, None]])
    return np.hstack([np.eye(3), np.zeros((3, 1))]), P2


PARALLAX_PER_NOISE, LEAST_PARALLAX_PX = 3.0, 0.05
"""Displacements that no homography explains, 90 % quantile, over the distances from the epipolar lines."""


def require_parallax(F: F64, xy1: F64, xy2: F64, *, at_infinity: F64 | None = None, advice: str = "") -> None:
    """Refuse matches that one homography takes to each other: F is then any, and no depth is to be had.

    ``F`` (3, 3) and N >= 4 of its inliers (N, 2), (N, 2) px; ``at_infinity`` (3, 3) the homography of the
    plane at infinity, where the cameras are known: then a plane of the scene has parallax. ``advice`` goes on
    after that of taking photographs from places farther apart. Raises ``StageFailure``.
    """
    noise = float(np.quantile(np.abs(sampson_residuals(F, xy1, xy2)), 0.9))
    if at_infinity is None:
        residuals = _homography_residuals(xy1, xy2)
    else:
        residuals = homography_residuals(at_infinity, xy1, xy2)
    parallax = float(np.quantile(residuals, 0.9))
    if parallax > PARALLAX_PER_NOISE * noise + LEAST_PARALLAX_PX:
        return
    what = "one homography" if at_infinity is None else "a scene at infinity"
    raise StageFailure(
        "the photographs show no parallax: the camera only turned, or the scene is a plane or too far away",
        f"{what} explains 90 % of {len(xy1)} matches to {parallax:.2g} px, the noise being {noise:.2g} px",
        f"take photographs from places farther apart{advice}",
    )


def _homography_residuals(xy1: F64, xy2: F64) -> F64:
    """Of the homography of most matches: least squares, twice more without the worst tenth."""
    kept, residuals = np.ones(len(xy1), dtype=bool), np.zeros(len(xy1))
    for _ in range(3):
        H = estimate_homography(xy1[kept], xy2[kept])
        residuals = homography_residuals(H, xy1, xy2)
        kept = residuals <= np.quantile(residuals, 0.9)
    return residuals

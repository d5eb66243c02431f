"""Section 3.5: the projective camera P = K [R t], its parts and its centre.

The thesis writes R for camera-to-world (3.21); here R is world-to-camera, its transpose.

Section 3.5.2: which side of a camera a point is on, and signs that put every point in front.

Hartley, "Chirality", IJCV 26(1), 1998. The thesis' (3.27) is his chi; its magnitude is an inverse depth.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize

SETTLED = 1e-9
"""Relative step after which Newton's method has no digit left to find: the next error is its square."""


def compose_camera(K: F64, R: F64, t: F64) -> F64:
    """P = K [R t]; K, R (..., 3, 3), t (..., 3) -> (..., 3, 4)."""
    return np.asarray(K @ np.concatenate([R, t[..., None]], axis=-1))


def decompose_camera(P: F64) -> tuple[F64, F64, F64]:
    """K, R, t of P (3.21), with K33 = 1, positive focals and det R = 1.

    P (3, 4) may have any scale and sign. Raises ``ValueError`` where the left 3x3 part is singular (a camera
    at infinity has no K).
    """
    P = P * np.sign(_left_determinant(P, "decompose_camera"))
    K, R = rq(P[:, :3])
    t = np.linalg.solve(K, P[:, 3])
    return K / K[2, 2], R, np.asarray(t, dtype=np.float64)


def calibration_matrix(f_u: float, f_v: float, u_0: float, v_0: float, *, skew: float = 0.0) -> F64:
    """K (3, 3) of (3.17): [[f_u, skew, u_0], [0, f_v, v_0], [0, 0, 1]], all in px.

    f_u = f / p_x and f_v = f / p_y, the focal length over the pixel's width and height; skew = f_v tan(alpha)
    with the angle alpha by which the pixel's sides differ from a right one (table 3.1). Raises ``ValueError``
    for a focal that is not positive.
    """
    if not (f_u > 0.0 and f_v > 0.0):
        raise ValueError(f"calibration_matrix needs positive focals; got {f_u} and {f_v}")
    return np.array([[f_u, skew, u_0], [0.0, f_v, v_0], [0.0, 0.0, 1.0]])


def camera_from_centre(K: F64, R: F64, centre: F64) -> F64:
    """P = K [R, -R centre] (3.21), the thesis' K [R' | -R' C]; K, R (..., 3, 3), centre (..., 3)."""
    return compose_camera(K, R, -np.einsum("...ij,...j->...i", R, centre))


def normalize_camera(P: F64) -> F64:
    """P scaled such that det M = 1 (definition 3.5.1): then the centre of (3.24) has the last entry 1.

    P (..., 3, 4) of any scale and sign; points in front have t > 0 in P X (proposition 3.5.1). The thesis
    divides by det M^(1/3), whose real value also turns the sign. Raises ``ValueError`` for a camera at
    infinity, det M = 0.
    """
    det = _left_determinant(P, "normalize_camera")
    return np.asarray(P / np.cbrt(det)[..., None, None])


def _left_determinant(P: F64, caller: str) -> F64:
    """det M (...) of cameras (..., 3, 4), refused where it is 0 to rounding."""
    if not np.isfinite(P).all():
        raise ValueError(f"{caller} needs finite cameras; some entries are NaN or infinite")
    det = np.linalg.det(P[..., :3])
    if not (np.abs(det) > 1e-14 * np.linalg.norm(P[..., :3], axis=(-2, -1)) ** 3).all():
        raise ValueError(f"{caller} needs a finite camera; the left 3x3 part of P is singular")
    return np.asarray(det)


def principal_plane(P: F64) -> F64:
    """The last row of P, the plane of the centre that is parallel to the image (3.23); (..., 4).

    Its points project to (u, v, 0) (3.22).
    """
    return P[..., 2, :]


def principal_ray(P: F64) -> F64:
    """Unit direction (..., 3) of the optical axis, pointing to the front: det(M) m_3, normalised (3.23).

    Without det M the last row's sign depends on that of P. Meaningful in a metric frame.
    """
    axis = np.linalg.det(P[..., :3])[..., None] * P[..., 2, :3]
    return np.asarray(axis / np.linalg.norm(axis, axis=-1, keepdims=True))


def principal_point(P: F64) -> F64:
    """Pixel (..., 2) where the principal ray meets the image, M m_3 in a metric frame (HZ 6.2)."""
    return dehomogenize(np.einsum("...ij,...j->...i", P[..., :3], P[..., 2, :3]))


def back_project(P: F64, xy: F64) -> F64:
    """Points at infinity (..., 4) on the rays of pixels (..., 2): (M^-1 (u, v, 1), 0), the ray's direction.

    With the centre they span the ray. In a projective frame they are points of the plane W = 0, which is no
    special one. Raises ``ValueError`` for a camera P (3, 4) at infinity.
    """
    _left_determinant(P, "back_project")
    direction = np.linalg.solve(P[:, :3], homogenize(xy)[..., None])[..., 0]
    return np.concatenate([direction, np.zeros((*direction.shape[:-1], 1))], axis=-1)


def rq(M: F64) -> tuple[F64, F64]:
    """M = K R, K upper triangular with positive diagonal, R orthogonal (a rotation where det M > 0)."""
    Q, U = np.linalg.qr(M[::-1].T)
    K = U.T[::-1, ::-1]
    R = Q.T[::-1]
    signs = np.sign(np.diag(K))
    signs[signs == 0] = 1.0
    return K * signs, signs[:, None] * R


def camera_centre(P: F64) -> F64:
    """Centre by minors (3.24): the signed homogeneous 4-vector C with P C = 0; (..., 3, 4) -> (..., 4)."""
    columns = [0, 1, 2, 3]
    minors = [np.linalg.det(P[..., [c for c in columns if c != k]]) for k in columns]
    return np.stack([-minors[0], minors[1], -minors[2], minors[3]], axis=-1)


def project(P: F64, X: F64) -> F64:
    """Pixels of space points: P (3, 4), X (N, 3) or homogeneous (N, 4) -> (N, 2)."""
    Xh = homogenize(X) if X.shape[-1] == 3 else X
    return dehomogenize(Xh @ P.T)


def distort(xy_normalized: F64, distortion: float | F64) -> F64:
    """(x, y) (1 + k1 r^2 + k2 r^4 + ...): radial distortion of normalised image points (N, 2).

    ``radial`` is k1, or coefficients (C,) or (N, C), those of higher powers last.
    """
    r2 = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    return np.asarray(xy_normalized * _radial_factor(distortion, r2))


def undistort(xy_normalized: F64, distortion: float | F64, *, iterations: int = 20) -> F64:
    """Inverse of :func:`distort`, exact to rounding wherever the distortion grows with the radius.

    Newton's method on r^2 (1 + k1 r^2 + ...)^2 = r_d^2, from r = r_d, for all points until none moves.
    Points beyond the largest radius that the distortion reaches have no inverse; they stay where they are.
    """
    distorted = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    k = np.atleast_1d(distortion)
    slopes = k * np.arange(1, k.shape[-1] + 1)
    r2 = distorted
    with np.errstate(all="ignore"):
        for _ in range(iterations):
            factor = _radial_factor(k, r2)
            slope = factor * (factor + 2.0 * (_radial_factor(slopes, r2) - 1.0))
            step = (r2 * factor**2 - distorted) / slope
            r2 = r2 - step
            if np.all(np.abs(step) <= SETTLED * np.abs(r2)):
                break
        factor = _radial_factor(k, r2)
        reached = np.abs(r2 * factor**2 - distorted) <= 1e-9 * distorted
    return np.asarray(xy_normalized / np.where(reached & (factor > 0.0), factor, 1.0))


def _radial_factor(distortion: float | F64, r2: F64) -> F64:
    k = np.atleast_1d(distortion)
    factor = np.zeros_like(r2)
    for n in reversed(range(k.shape[-1])):
        factor = (factor + k[..., n : n + 1]) * r2
    return 1.0 + factor


def project_camera(K: F64, R: F64, t: F64, X: F64, *, distortion: float | F64 = 0.0) -> F64:
    """Pixels (N, 2) of X (N, 3) seen by a metric camera with the ``radial`` distortion of :func:`distort`."""
    normalized = dehomogenize(X @ R.T + t)
    return distort(normalized, distortion) @ K[:2, :2].T + K[:2, 2]


def cheirality(X: F64, P: F64) -> F64:
    """chi(X, P) = det(M)^(1/3) W / t (3.27): positive in front of the camera, 0 on the plane at infinity.

    X (N, 4), P (3, 4) -> (N,); does not change when X or P is scaled, by a negative number either. Only its
    sign is that of the depth: its magnitude is an inverse depth, which for a camera not normalised has no
    unit; :func:`depth` measures.
    """
    t = X @ P[2]
    return np.asarray(np.cbrt(np.linalg.det(P[:, :3])) * X[:, 3] / t)


def depth(X: F64, P: F64) -> F64:
    """Signed distance of X (N, 4) from the principal plane of P (3, 4), in units of space (HZ 6.15)."""
    M = P[:, :3]
    return np.asarray(np.sign(np.linalg.det(M)) * (X @ P[2]) / (X[:, 3] * np.linalg.norm(M[2])))


def orient_signs(P: F64, X: F64, view: I64, point: I64, *, sweeps: int = 20) -> tuple[F64, F64, float]:
    """Signs of cameras and points that make the projective depths w of P_i X_j = w (u, v, 1) positive.

    P (V, 3, 4), X (N, 4), observations (view, point) (K,). Returns signs (V,), (N,) of +-1 and the share of
    observations they satisfy. For a reconstruction of real points the share is 1 up to wrong matches
    (Hartley 1998, theorem 17); votes of the neighbours decide, so a few wrong ones do not spread.
    """
    w = np.sign(np.einsum("kj,kj->k", P[view, 2], X[point]))
    views = np.zeros(len(P))
    points = np.zeros(len(X))
    if len(view) == 0:
        return np.ones(len(P)), np.ones(len(X)), 1.0
    views[np.bincount(view, minlength=len(P)).argmax()] = 1.0
    for _ in range(sweeps):
        points = np.sign(np.bincount(point, w * views[view], minlength=len(X)))
        votes = np.sign(np.bincount(view, w * points[point], minlength=len(P)))
        if np.array_equal(votes, views):
            break
        views = votes
    views[views == 0] = 1.0
    points[points == 0] = 1.0
    return views, points, float(np.mean(w * views[view] * points[point] > 0))

"""Section 3.5: the projective camera P = K [R t], its parts, projection, lens distortion and cheirality.

The thesis writes R for camera-to-world (3.21); here R is world-to-camera, its transpose.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize

_CONVERGED = 1e-9
"""Relative step at which Newton's method has converged to rounding: the next error is its square."""


def compose_camera(K: F64, R: F64, t: F64) -> F64:
    """Return P = K [R t], with t = -R C the thesis' K [R' | -R' C] (3.18 - 3.21).

    Parameters
    ----------
    K, R, t : ndarray (..., 3, 3), (..., 3, 3) and (..., 3)
        Calibration matrix, rotation world-to-camera and translation.

    Returns
    -------
    ndarray (..., 3, 4)
    """
    return np.asarray(K @ np.concatenate([R, t[..., None]], axis=-1))


def camera_from_centre(K: F64, R: F64, centre: F64) -> F64:
    """Return P = K [R, -R C] (3.21), the thesis' K [R' | -R' C].

    Parameters
    ----------
    K, R, centre : ndarray (..., 3, 3), (..., 3, 3) and (..., 3)
        Calibration matrix, rotation world-to-camera and camera centre C.

    Returns
    -------
    ndarray (..., 3, 4)
    """
    return compose_camera(K, R, -np.einsum("...ij,...j->...i", R, centre))


def decompose_camera(P: F64) -> tuple[F64, F64, F64]:
    """Decompose P of any scale and sign into K, R and t (3.21).

    Parameters
    ----------
    P : ndarray (3, 4)
        Finite camera; a singular left 3x3 part is a ``ValueError``.

    Returns
    -------
    K, R, t : ndarray (3, 3), (3, 3) and (3,)
        K33 = 1, positive focal lengths, det R = 1.

    Examples
    --------
    >>> K, R, t = decompose_camera(-3.0 * np.hstack([np.diag([2.0, 2.0, 1.0]), [[0.0], [0.0], [5.0]]]))
    >>> np.allclose(K, np.diag([2.0, 2.0, 1.0])), np.allclose(R, np.eye(3)), np.allclose(t, [0.0, 0.0, 5.0])
    (True, True, True)
    """
    P = P * np.sign(_left_determinant(P, "decompose_camera"))
    K, R = rq(P[:, :3])
    t = np.linalg.solve(K, P[:, 3])
    return K / K[2, 2], R, np.asarray(t, dtype=np.float64)


def calibration_matrix(f_u: float, f_v: float, u_0: float, v_0: float, *, skew: float = 0.0) -> F64:
    """Return K (3.16, 3.17): [[f_u, skew, u_0], [0, f_v, v_0], [0, 0, 1]].

    Parameters
    ----------
    f_u, f_v, u_0, v_0 : float
        Focal lengths, positive (otherwise a ``ValueError``), and principal point, px.
    skew : float
        f_v tan(alpha), px, for pixel sides that deviate from a right angle by alpha (table 3.1).

    Returns
    -------
    ndarray (3, 3)
    """
    if not (f_u > 0.0 and f_v > 0.0):
        raise ValueError(f"calibration_matrix needs positive focals; got {f_u} and {f_v}")
    return np.array([[f_u, skew, u_0], [0.0, f_v, v_0], [0.0, 0.0, 1.0]])


def normalize_camera(P: F64) -> F64:
    """Scale P such that det M = 1 (definition 3.5.1): P / det(M)^(1/3), which also corrects the sign.

    Points in front then have t > 0 in P X (proposition 3.5.1).

    Parameters
    ----------
    P : ndarray (..., 3, 4)
        Finite cameras [M m]; a singular M is a ``ValueError``.

    Returns
    -------
    ndarray (..., 3, 4)
    """
    det = _left_determinant(P, "normalize_camera")
    return np.asarray(P / np.cbrt(det)[..., None, None])


def _left_determinant(P: F64, caller: str) -> F64:
    """det M (...) of cameras (..., 3, 4); ``ValueError`` if one is 0 to rounding."""
    if not np.isfinite(P).all():
        raise ValueError(f"{caller} needs finite cameras; some entries are NaN or infinite")
    if not finite_cameras(P).all():
        raise ValueError(f"{caller} needs a finite camera; the left 3x3 part of P is singular")
    return np.asarray(np.linalg.det(P[..., :3]))


def finite_cameras(P: F64) -> B8:
    """Whether the centres of cameras are finite: their left 3x3 parts are not singular to rounding.

    Parameters
    ----------
    P : ndarray (..., 3, 4)
        Cameras; the scale of each row, and so the unit of the pixels, has no influence.

    Returns
    -------
    ndarray (...) of bool
    """
    rows = np.linalg.norm(P[..., :3], axis=-1)
    return np.asarray(np.abs(np.linalg.det(P[..., :3])) > 1e-14 * rows.prod(axis=-1))


def principal_ray(P: F64) -> F64:
    """Return the direction of the optical axis towards the front: det(M) m_3, normalised (3.23).

    The last row (m_3, p_34) of P is the principal plane (3.22); the principal point is M m_3 (HZ 6.2).

    Parameters
    ----------
    P : ndarray (..., 3, 4)
        Cameras of a metric frame, of any sign.

    Returns
    -------
    ndarray (..., 3)
    """
    axis = np.linalg.det(P[..., :3])[..., None] * P[..., 2, :3]
    return np.asarray(axis / np.linalg.norm(axis, axis=-1, keepdims=True))


def rq(M: F64) -> tuple[F64, F64]:
    """Factor M = K R with K upper triangular, of positive diagonal, and R orthogonal.

    Parameters
    ----------
    M : ndarray (3, 3)
        Matrix.

    Returns
    -------
    K, R : ndarray (3, 3)
        R is a rotation if det M > 0.
    """
    Q, U = np.linalg.qr(M[::-1].T)
    K = U.T[::-1, ::-1]
    R = Q.T[::-1]
    signs = np.sign(np.diag(K))
    signs[signs == 0] = 1.0
    return K * signs, signs[:, None] * R


def camera_centre(P: F64) -> F64:
    """Return the centre C with P C = 0, by minors (3.24 - 3.26).

    Parameters
    ----------
    P : ndarray (..., 3, 4)
        Cameras.

    Returns
    -------
    ndarray (..., 4)
        Homogeneous, with the sign of the minors.
    """
    minors = [np.linalg.det(np.delete(P, k, axis=-1)) for k in range(4)]
    return np.stack([-minors[0], minors[1], -minors[2], minors[3]], axis=-1)


def project(P: F64, X: F64) -> F64:
    """Project space points to pixels.

    Parameters
    ----------
    P, X : ndarray (3, 4), and (N, 3) or (N, 4)
        Camera, and Euclidean or homogeneous points.

    Returns
    -------
    ndarray (N, 2)
        Inf or NaN for points of the principal plane.

    Examples
    --------
    >>> project(np.eye(3, 4), np.array([[1.0, 2.0, 4.0]])).tolist()
    [[0.25, 0.5]]
    """
    Xh = homogenize(X) if X.shape[-1] == 3 else X
    return dehomogenize(Xh @ P.T)


def distort(xy_normalized: F64, distortion: float | F64) -> F64:
    """Apply radial distortion (x, y) (1 + k1 r^2 + k2 r^4 + ...).

    Parameters
    ----------
    xy_normalized, distortion : ndarray (N, 2); float or ndarray (C,) or (N, C)
        Normalised image points and k1, or the coefficients k1, k2, ...

    Returns
    -------
    ndarray (N, 2)
    """
    r2 = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    return np.asarray(xy_normalized * _radial_factor(distortion, r2))


def undistort(xy_normalized: F64, distortion: float | F64) -> F64:
    """Invert :func:`distort` by Newton's method on r^2 (1 + k1 r^2 + ...)^2 = r_d^2.

    Parameters
    ----------
    xy_normalized, distortion
        As in :func:`distort`, distorted points.

    Returns
    -------
    ndarray (N, 2)
        Points beyond the largest radius that the distortion reaches have no inverse and are not changed.
    """
    distorted = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    k = np.atleast_1d(distortion)
    slopes = k * np.arange(1, k.shape[-1] + 1)
    r2 = distorted
    with np.errstate(all="ignore"):
        for _ in range(20):
            factor = _radial_factor(k, r2)
            slope = factor * (factor + 2.0 * (_radial_factor(slopes, r2) - 1.0))
            step = (r2 * factor**2 - distorted) / slope
            r2 = r2 - step
            if np.all(np.abs(step) <= _CONVERGED * np.abs(r2)):
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
    """Project space points with a metric camera and radial distortion.

    Parameters
    ----------
    K, R, t, X : ndarray (3, 3), (3, 3), (3,) and (N, 3)
        Calibration matrix, rotation world-to-camera, translation and points.
    distortion : float or ndarray (C,) or (N, C)
        Coefficients of :func:`distort`.

    Returns
    -------
    ndarray (N, 2)
    """
    normalized = dehomogenize(X @ R.T + t)
    return distort(normalized, distortion) @ K[:2, :2].T + K[:2, 2]


def depth(P: F64, X: F64) -> F64:
    """Return the signed distance of points from the principal plane (HZ 6.2.3).

    Parameters
    ----------
    P, X : ndarray (3, 4) and (N, 4)
        Camera of any scale and sign, homogeneous points.

    Returns
    -------
    ndarray (N,)
    """
    M = P[:, :3]
    return np.asarray(np.sign(np.linalg.det(M)) * (X @ P[2]) / (X[:, 3] * np.linalg.norm(M[2])))


def orient_signs(P: F64, X: F64, view: I64, point: I64) -> tuple[F64, F64, float]:
    """Choose signs of cameras and points that make the projective depths w of P X = w (u, v, 1) positive.

    Starts from the view with most observations; then the sign of each point and of each camera is that of the
    majority of its observations, so that a few wrong matches do not spread.

    Parameters
    ----------
    P, X, view, point : ndarray (V, 3, 4), (N, 4), (K,) and (K,), int
        Cameras, homogeneous points, and view and point of each observation.

    Returns
    -------
    views, points, ratio : ndarray (V,) and (N,), float
        Signs +-1 of cameras and points, and the fraction of the observations with positive depth.

    References
    ----------
    Hartley, "Chirality", IJCV 26(1), 1998, theorem 17.
    """
    w = np.sign(np.einsum("kj,kj->k", P[view, 2], X[point]))
    views, points = np.zeros(len(P)), np.zeros(len(X))
    if len(view) == 0:
        return np.ones(len(P)), np.ones(len(X)), 1.0
    views[np.bincount(view, minlength=len(P)).argmax()] = 1.0
    # Each pass reaches at least one more view of a chain.
    for _ in range(len(P) + 20):
        points = np.sign(np.bincount(point, w * views[view], minlength=len(X)))
        votes = np.sign(np.bincount(view, w * points[point], minlength=len(P)))
        if np.array_equal(votes, views):
            break
        views = votes
    views[views == 0] = 1.0
    points[points == 0] = 1.0
    return views, points, float(np.mean(w * views[view] * points[point] > 0))

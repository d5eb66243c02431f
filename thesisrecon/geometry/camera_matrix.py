"""Section 3.5: the projective camera P = K [R t], its parts, projection, lens distortion and cheirality.

The thesis writes R for camera-to-world (3.21); here R is world-to-camera, its transpose.
"""

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.camera import _left_determinant, compose_camera
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.records import Reconstruction


def camera_from_centre(K: F64, R: F64, centre: F64) -> F64:
    """P = K [R, -R C] (3.21), the thesis' K [R' | -R' C], of a camera with the centre C (..., 3)."""
    return compose_camera(K, R, -np.einsum("...ij,...j->...i", R, centre))


def calibration_matrix(f_u: float, f_v: float, u_0: float, v_0: float, *, skew: float = 0.0) -> F64:
    """K (3.16, 3.17): [[f_u, skew, u_0], [0, f_v, v_0], [0, 0, 1]].

    The skew is f_v tan(alpha) for pixel sides that deviate from a right angle by alpha (table 3.1).
    """
    if not (f_u > 0.0 and f_v > 0.0):
        raise ValueError(f"calibration_matrix needs positive focals; got {f_u} and {f_v}")
    return np.array([[f_u, skew, u_0], [0.0, f_v, v_0], [0.0, 0.0, 1.0]])


def normalize_camera(P: F64) -> F64:
    """Scale P such that det M = 1 (definition 3.5.1): P / det(M)^(1/3), which also corrects the sign.

    Points in front then have t > 0 in P X (proposition 3.5.1).
    """
    det = _left_determinant(P, "normalize_camera")
    return np.asarray(P / np.cbrt(det)[..., None, None])


def principal_ray(P: F64) -> F64:
    """Direction of the optical axis towards the front: det(M) m_3, normalised (3.23), in a metric frame.

    The last row (m_3, p_34) of P is the principal plane (3.22); the principal point is M m_3 (HZ 6.2).
    """
    axis = np.linalg.det(P[..., :3])[..., None] * P[..., 2, :3]
    return np.asarray(axis / np.linalg.norm(axis, axis=-1, keepdims=True))


def pose_of_camera(K: F64, P: F64) -> tuple[F64, F64]:
    """R (..., 3, 3) and t (..., 3) of cameras P = K [R t]."""
    Rt = np.asarray(np.linalg.solve(K, P), dtype=np.float64)
    return Rt[..., :3], Rt[..., 3]


def poses_of_model(model: Reconstruction, views: B8 | I64) -> tuple[F64, F64, F64]:
    """R (N, 3, 3), t (N, 3) and centres (N, 3) of registered ``views`` of a metric model."""
    assert model.K is not None
    R, t = pose_of_camera(model.K[views], model.P[views])
    return R, t, -np.einsum("vba,vb->va", R, t)


def camera_centre(P: F64) -> F64:
    """The centre C with P C = 0, homogeneous with the signs of the minors (3.24 - 3.26)."""
    minors = [np.linalg.det(np.delete(P, k, axis=-1)) for k in range(4)]
    return np.stack([-minors[0], minors[1], -minors[2], minors[3]], axis=-1)


def project(P: F64, X: F64) -> F64:
    """Pixels (N, 2) of points (N, 3) or (N, 4); inf or NaN in the principal plane."""
    Xh = homogenize(X) if X.shape[-1] == 3 else X
    return dehomogenize(Xh @ P.T)


def depth(P: F64, X: F64) -> F64:
    """Signed distances of points (N, 4) from the principal plane of a camera of any scale (HZ 6.2.3)."""
    M = P[:, :3]
    return np.asarray(np.sign(np.linalg.det(M)) * (X @ P[2]) / (X[:, 3] * np.linalg.norm(M[2])))


def orient_signs(P: F64, X: F64, view: I64, point: I64) -> tuple[F64, F64, float]:
    """Signs of cameras and points that make the projective depths w of P X = w (u, v, 1) positive.

    From the view with most observations on, each sign is that of the majority of its observations. Also
    returns the fraction with positive depth (Hartley, "Chirality", IJCV 26(1), 1998, theorem 17).
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

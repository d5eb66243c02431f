"""Section 3.6.3: the trifocal tensor of three views.

T (3, 3, 3) is indexed T[i, j, k] = T_i^jk: i is a coordinate of a point of view 1, j and k of lines of views
2 and 3 (Hartley 1997; Hartley and Zisserman, chapter 15). A point x of view 1 and lines l2, l3 through its
matches satisfy sum x^i l2_j l3_k T_i^jk = 0; every relation of points and lines follows from this one.
"""

import numpy as np

from thesisrecon.arrays import F64, require_finite
from thesisrecon.geometry import homogeneous
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.polynomial_triangulation import correct_matches

_SKEW = homogeneous.cross_matrix(np.array([0.31, 0.17, 0.53]))
_TURN = np.linalg.solve(np.eye(3) - _SKEW, np.eye(3) + _SKEW)
"""A rotation without symmetry: its rows are not the epipoles of usual camera positions."""


def tensor_from_cameras(P1: F64, P2: F64, P3: F64) -> F64:
    """T_i^jk = (-1)^i det [P1 without row i; row j of P2; row k of P3] (HZ 17), i from 0, of unit norm.

    For P1 = [I 0], P2 = [A a], P3 = [B b] it is A_ji b_k - a_j B_ki; zero if all three centres coincide.
    """
    P1, P2, P3 = (homogeneous.checked_unit(P, "tensor_from_cameras") for P in (P1, P2, P3))
    T, centre = np.zeros((3, 3, 3)), camera_centre(P1)
    # The determinants of one centre are rounding errors.
    least = 1e-12 * float(np.linalg.norm(centre))
    if all(np.linalg.norm(P @ centre) <= least * np.linalg.norm(P[:, :3]) for P in (P2, P3)):
        return T
    for i in range(3):
        rows = np.empty((3, 3, 4, 4))
        rows[:, :, :2] = np.delete(P1, i, axis=0)
        rows[:, :, 2], rows[:, :, 3] = P2[:, None], P3[None]
        T[i] = (-1.0) ** i * np.linalg.det(rows)
    return homogeneous.unit_tensor(T)


def transfer_lines(T: F64, l1: F64, l2: F64) -> F64:
    """Transfer lines of views 1 and 2 to view 3: l3 is the null vector of [l1]x (l2_j T_i^jk) (figure 3.15).

    It is undetermined if both lines belong to one epipolar plane of views 1 and 2.
    """
    require_finite("transfer_lines", T, l1, l2)
    M = np.einsum("...j,ijk->...ik", l2, T)
    scaled = l1 / np.maximum(np.linalg.norm(l1, axis=-1, keepdims=True), 1e-300)
    return np.asarray(np.linalg.svd(homogeneous.cross_matrix(scaled) @ M)[2][..., 2, :])


def transfer_points(T: F64, xy1: F64, xy2: F64) -> F64:
    """Transfer matches of views 1 and 2 to view 3 (figure 3.14).

    The line l2 through the corrected x2 (6.3.3) perpendicular to its epipolar line transfers x1 by the
    homography l2_j T_i^jk (HZ 15.3). Inf or NaN for points of the line through the centres of views 1 and 2.
    """
    F21, _ = fundamentals_from_tensor(T)
    xy1, xy2 = correct_matches(F21, xy1, xy2)
    x1, x2 = homogeneous.homogenize(xy1), homogeneous.homogenize(xy2)
    epipolar = x1 @ F21.T
    across = np.cross(x2, np.column_stack([epipolar[:, :2], np.zeros(len(x2))]))
    return homogeneous.dehomogenize(np.einsum("nki,ni->nk", np.einsum("nj,ijk->nki", across, T), x1))


def tensor_epipoles(T: F64) -> tuple[F64, F64]:
    """The unit epipoles of the first camera in views 2 and 3 (HZ algorithm 15.1).

    e2 is orthogonal to the left null vectors of the T_i, e3 to the right ones. The coordinates of view 1 are
    rotated first: T_i has rank 1 if the i-th unit vector of view 1 is an epipole, as in rectified images.
    """
    require_finite("tensor_epipoles", T)
    sizes = np.linalg.norm(T, axis=(1, 2), keepdims=True)
    U, _, Vt = np.linalg.svd(np.einsum("ai,ijk->ajk", _TURN, T / np.maximum(sizes, 1e-300)))
    return np.linalg.svd(U[:, :, 2])[2][2], np.linalg.svd(Vt[:, 2])[2][2]


def fundamentals_from_tensor(T: F64) -> tuple[F64, F64]:
    """F21 = [e2]x [T_1, T_2, T_3] e3 and F31 = [e3]x [T_1', T_2', T_3'] e2 of unit norm (HZ 15.1)."""
    e2, e3 = tensor_epipoles(T)
    F21 = homogeneous.cross_matrix(e2) @ np.einsum("ijk,k->ji", T, e3)
    F31 = homogeneous.cross_matrix(e3) @ np.einsum("ijk,j->ki", T, e2)
    return homogeneous.unit_norm(F21), homogeneous.unit_norm(F31)


def cameras_from_tensor(T: F64) -> tuple[F64, F64, F64]:
    """Cameras [I 0], [[T_1, T_2, T_3] e3, e2] and [(e3 e3' - I) [T_1', T_2', T_3'] e2, e3] of T (HZ 15.1)."""
    e2, e3 = tensor_epipoles(T)
    A = np.einsum("ijk,k->ji", T, e3)
    B = (np.outer(e3, e3) - np.eye(3)) @ np.einsum("ijk,j->ki", T, e2)
    return np.eye(3, 4), np.column_stack([A, e2]), np.column_stack([B, e3])
